"""Bidirectional path tracing without joined subpaths: eye paths, and light paths straight to the sensor."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pytest

from elps_core.settings import HeuristicKind
from tests import adversaries
from tests.core.integrators.conftest import Agree
from tests.core.integrators.test_analytic import IMAGES, check, of_length, sphere
from tests.rendering import render

BOUND = 0.02
DEPTH = 4
UNJOINED: dict[str, Any] = {"bdpt__joins": False, "bdpt__eye_paths": 4}


@pytest.mark.parametrize("heuristic", get_args(HeuristicKind))
def test_weights_of_its_strategies_sum_to_one(mi: Any, heuristic: str) -> None:
    """For each length apart: an excess of one would else hide what another lacks. A lens has every strategy."""
    scene = sphere(mi, "area", lens=0.25)
    for segments in range(2, DEPTH + 1):
        pairs = " ".join(f"{s},{segments + 1 - s}" for s in range(segments + 2))
        options = {**UNJOINED, "bdpt__strategies": pairs, "heuristic": heuristic}
        images = render(scene, "bdpt", images=IMAGES, spp=192, max_depth=DEPTH, **options)
        check(images, of_length("area", segments), bound=BOUND)


def test_nothing_is_joined(mi: Any) -> None:
    scene = sphere(mi, "area")
    options = {**UNJOINED, "bdpt__strategies": "2,2 2,3 3,2"}
    assert not render(scene, "bdpt", images=1, spp=8, max_depth=DEPTH, **options).any()


@pytest.mark.parametrize(
    ("name", "more"), [("thinlens-wide", 4.0), ("envmap", 3.0), ("mixed", 3.0), ("roughdielectric", 4.0), ("mask", 3.0)]
)
def test_the_image_is_that_of_the_reference(agree: Agree, name: str, more: float) -> None:
    agreement = agree(name, "bdpt", more=more, **UNJOINED)
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement


@pytest.mark.parametrize("name", ["thinlens-wide", "envmap"])
def test_no_context_moves_it(agree: Agree, name: str) -> None:
    agreement = agree(name, "bdpt", more=8.0, wrong="random", roulette="albedo", table_share=0.5, **UNJOINED)
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement


LIT: dict[str, Any] = {"direction_sampling": "scattering", "roulette": "albedo", "light_sampling": "context"}


def test_lights_by_context_ask_for_others(mi: Any) -> None:
    """Tables of the lights alone change the samples; those of directions do not enter."""
    scene = sphere(mi, "area")
    options: dict[str, Any] = {"images": 1, "spp": 8, "max_depth": DEPTH, **UNJOINED, **LIT}
    plain = render(scene, "bdpt", **options | {"light_sampling": "adjoint"})
    lit, again = (
        render(scene, "bdpt", parts=adversaries.parts(scene, "random"), table_share=share, **options)
        for share in (0.2, 0.8)
    )
    assert np.allclose(lit, again, rtol=1e-4)
    assert (np.abs(lit - plain) > 1e-3 * plain).mean() > 0.5


@pytest.mark.parametrize("name", ["mixed", "area-mesh"])
def test_no_lights_by_context_move_it(agree: Agree, name: str) -> None:
    agreement = agree(name, "bdpt", more=8.0, wrong="random", **LIT, **UNJOINED)
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement
