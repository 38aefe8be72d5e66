"""No context moves an image, however wrong it is: tables shape densities, and densities are divided by.

Half of all directions go where a table of random numbers, of a single cell, of nothing or of another place says, and
three of four light points. That makes more noise, so that the tests of roulette, which then also goes by random
numbers, have few bounces; it may end paths from the first bounce on.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from elps_core import device
from elps_core.context.encoding import DirectionalTables
from tests import adversaries
from tests.core.integrators.conftest import Agree
from tests.core.integrators.test_analytic import IMAGES, check, sphere, up_to
from tests.rendering import render

BOUND = 0.02
"""Relative bias of the mean that each comparison finds with a chance of 95%; by light alone it is :data:`DIM`."""
DIM = 0.035
DEPTH = 4
EVERYWHERE: dict[str, Any] = {"table_share": 0.5, "bdpt__guided_light": True}
"""Tables guide the paths from both ends."""

UNJOINED: dict[str, Any] = {"bdpt__joins": False, "bdpt__eye_paths": 4}
"""Light paths bring what they can show to the sensor."""

SCENES: list[tuple[str, str, adversaries.Kind, float]] = [
    ("mixed", "path", "random", 2.0),
    ("mixed", "light", "random", 16.0),
    ("mask", "bdpt", "random", 1.3),
    ("roughdielectric", "path", "spiked", 30.0),
]
"""Scene, algorithm, kind of context, and samples as a multiple of the usual ones."""


@pytest.mark.parametrize(("name", "algorithm", "kind", "more"), SCENES, ids=[" ".join(case[:3]) for case in SCENES])
def test_no_tables_move_the_image(agree: Agree, name: str, algorithm: str, kind: adversaries.Kind, more: float) -> None:
    agreement = agree(name, algorithm, more=more, wrong=kind, roulette="albedo", **EVERYWHERE)
    assert agreement.agrees, agreement
    assert agreement.detectable < (DIM if algorithm == "light" else BOUND), agreement


IN_A_SPHERE: list[tuple[str, adversaries.Kind]] = [
    *[("bdpt", kind) for kind in adversaries.KINDS],
    ("path", "random"),
    ("light", "spiked"),
]


@pytest.mark.parametrize(("algorithm", "kind"), IN_A_SPHERE)
def test_no_tables_move_the_radiance_in_a_sphere(mi: Any, algorithm: str, kind: adversaries.Kind) -> None:
    scene = sphere(mi, "area")
    parts = adversaries.parts(scene, kind)
    options = EVERYWHERE | {"parts": parts, "roulette": "albedo"}
    spp = 640 if algorithm == "light" else 192  # A spiked table has many paths with little to bring
    images = render(scene, algorithm, images=IMAGES, spp=spp, max_depth=DEPTH, **options)
    check(images, up_to("area", DEPTH), bound=BOUND)


def test_no_tables_move_what_chains_find(mi: Any) -> None:
    scene = sphere(mi, "area")
    parts = adversaries.parts(scene, "random")
    options: dict[str, Any] = {"parts": parts, "roulette": "albedo", "pssmlt__bootstrap": 4096}
    options |= EVERYWHERE
    images = render(scene, "pssmlt", images=IMAGES, spp=128, max_depth=3, **options)
    check(images, up_to("area", 3), bound=BOUND)


@pytest.mark.parametrize("kind", ["random", "spiked"])
def test_no_tables_move_what_unjoined_paths_find(mi: Any, kind: adversaries.Kind) -> None:
    scene = sphere(mi, "area")
    options = EVERYWHERE | UNJOINED | {"parts": adversaries.parts(scene, kind), "roulette": "albedo"}
    images = render(scene, "bdpt", images=IMAGES, spp=256, max_depth=DEPTH, **options)
    check(images, up_to("area", DEPTH), bound=BOUND)


def test_no_tables_move_the_image_of_unjoined_paths(agree: Agree) -> None:
    agreement = agree("roughdielectric", "bdpt", more=16.0, wrong="random", roulette="albedo", **EVERYWHERE, **UNJOINED)
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement


LEARNED: dict[str, Any] = {"bdpt__guided_light": True}
"""Each region has a chance of its own of directions by its table."""
ROULETTE: list[tuple[str, adversaries.Kind, dict[str, Any]]] = [
    ("path", "random", EVERYWHERE),
    ("path", "spiked", LEARNED),
    ("path", "random", LEARNED | {"direction_sampling": "scattering"}),
    ("bdpt", "random", LEARNED | UNJOINED),
    ("light", "spiked", EVERYWHERE),
]
"""Eye paths that are not joined are paid where they end; what others have expected to find is lost."""


@pytest.mark.parametrize(("algorithm", "kind", "options"), ROULETTE)
def test_no_roulette_by_context_moves_the_radiance_in_a_sphere(
    mi: Any, algorithm: str, kind: adversaries.Kind, options: dict[str, Any]
) -> None:
    scene = sphere(mi, "area")
    parts = adversaries.parts(scene, kind)
    images = render(scene, algorithm, images=IMAGES, spp=768, max_depth=DEPTH, parts=parts, rr_depth=1, **options)
    check(images, up_to("area", DEPTH), bound=DIM)


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_no_payment_moves_the_radiance_in_other_variants(variant: str) -> None:
    """Colours are told in RGB, and paid by what carries them."""
    mi = device.use(variant)
    mi.set_log_level(mi.LogLevel.Error)  # The film announces that it turns monochrome.
    scene = sphere(mi, "area")
    parts = adversaries.parts(scene, "random")
    images = render(scene, "path", images=IMAGES, spp=768, max_depth=DEPTH, parts=parts, rr_depth=1, **LEARNED)
    check(images, up_to("area", DEPTH), bound=DIM)


@pytest.mark.parametrize("algorithm", ["path", "bdpt"])
def test_no_roulette_by_context_moves_the_image(agree: Agree, algorithm: str) -> None:
    """Directions are those of scattering: tables serve roulette alone."""
    agreement = agree("mixed", algorithm, more=6.0, wrong="random", direction_sampling="scattering", rr_depth=1)
    assert agreement.agrees, agreement
    assert agreement.detectable < DIM, agreement


def test_paths_that_are_paid_are_no_noisier_where_tables_know_what_they_would_find(mi: Any) -> None:
    """In a sphere with a light at its centre all light that has been reflected comes alike from all sides."""
    from elps_core.context.clustering import build_regions
    from elps_core.context.directional import EqualAreaMap

    scene = sphere(mi, "point")
    parts = adversaries.parts(scene, "random")
    outward = np.random.default_rng(3).normal(size=(20000, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    regions = build_regions(outward, -outward, 200, seed=1)
    rows, columns, count = 16, 32, regions.count
    grid, cells = EqualAreaMap(rows, columns), np.arange(rows * columns)
    middle = grid.direction(mi.UInt32(cells // columns), mi.UInt32(cells % columns), mi.Point2f(0.5))
    facing = np.maximum(regions.normals @ np.array(middle), 0.0).reshape(-1, rows, columns) + 1e-3
    bright = np.full(count, np.pi * up_to("point", 16))
    tables = DirectionalTables.of(facing, bright, np.full(count, 1000))
    known = replace(
        parts,
        regions=regions,
        radiance=tables,
        importance=tables,
        lights=np.ones((count, parts.lights.shape[1]), np.float32),
        shares=None,
        aims=None,
        slits=None,
        prospects=np.stack([*[bright] * 3, np.full(count, 0.05)], axis=1).astype(np.float32),
    )
    assert known.prospects is not None
    unpaid = replace(known, prospects=known.prospects * np.array([0, 0, 0, 1], np.float32))
    noise = []
    for told in (known, unpaid):
        options: dict[str, Any] = {"parts": told, "rr_depth": 1, "direction_sampling": "scattering"}
        images = render(scene, "path", images=IMAGES, spp=256, max_depth=16, **options)
        check(images, up_to("point", 16), bound=BOUND)
        noise.append(images.var(axis=0).mean())
    assert noise[0] < 0.2 * noise[1]
