"""What may shape densities and weights leaves the expected image alone; and the comparison finds faults that exist."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from elps_core.settings import HeuristicKind
from tests.core.integrators.conftest import Agree
from tests.rendering import Table, render
from tests.zoo import ZOO

Array = np.ndarray[Any, Any]

BOUND = 0.02
HEURISTICS = get_args(HeuristicKind)


def random_table(emission: Any) -> Array:
    """Knows nothing of the scene; its densities differ a hundred to one."""
    return np.asarray(np.random.default_rng(5).random((16, 8 * emission.count)) ** 2 + 0.01)


def spiked_table(emission: Any) -> Array:
    """Half of the samples in one cell."""
    table = np.full((8, 4 * emission.count), 1.0)
    table[3, 1] = table.size
    return table


def empty_table(emission: Any) -> Array:
    """Says that there is no light anywhere."""
    return np.zeros((8, 4 * emission.count))


TABLES = [
    ("area-disk-cylinder", random_table),
    ("area-mesh", random_table),
    ("envmap", random_table),
    ("mixed", random_table),
    ("mixed", spiked_table),
    ("mixed", empty_table),
]


@pytest.mark.parametrize(("name", "table"), TABLES, ids=[f"{name}-{table.__name__}" for name, table in TABLES])
def test_no_table_moves_the_image(agree: Agree, name: str, table: Table) -> None:
    agreement = agree(name, "bdpt", more=3.0, table=table)
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement


@pytest.mark.parametrize("heuristic", HEURISTICS)
@pytest.mark.parametrize("name", ["thinlens-wide", "roughdielectric"])
def test_no_heuristic_moves_the_image(agree: Agree, name: str, heuristic: str) -> None:
    agreement = agree(name, "bdpt", heuristic=heuristic)
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement


@pytest.mark.parametrize("algorithm", ["path", "light"])
@pytest.mark.parametrize("heuristic", HEURISTICS)
def test_no_heuristic_moves_the_image_of_fewer_strategies(agree: Agree, algorithm: str, heuristic: str) -> None:
    """A thin lens, so that light paths have two strategies too."""
    agreement = agree("thinlens-wide", algorithm, more=6.0, heuristic=heuristic)
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement


@pytest.mark.parametrize("roulette", ["none", "throughput", "albedo"])
def test_no_roulette_moves_the_image(agree: Agree, roulette: str) -> None:
    agreement = agree("roughdielectric", "bdpt", roulette=roulette, rr_depth=2)
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement


@pytest.mark.parametrize("name", ["roughdielectric", "thinlens-wide", "envmap"])
def test_strategies_add_up_to_the_image(tmp_path: Path, name: str) -> None:
    """The same paths, one strategy at a time: exact to float rounding."""
    entry = ZOO[name]
    scene = entry.load(tmp_path)
    options: dict[str, Any] = {"images": 1, "spp": 8, "max_depth": entry.max_depth}
    whole = render(scene, "bdpt", **options)
    sizes = range(entry.max_depth + 2)
    pairs = [(0, 2), *((s, t) for s in sizes for t in sizes if 3 <= s + t <= entry.max_depth + 1)]
    parts = [render(scene, "bdpt", bdpt__strategies=f"{s},{t}", **options) for s, t in pairs]
    assert sum(part.max() > 0.0 for part in parts) > 2 * entry.max_depth, "most strategies contribute"
    assert np.allclose(sum(parts), whole, rtol=1e-3, atol=1e-5 * whole.mean())


FAULTS = [
    ("near-clip", "mi_ptracer"),  # What lies before the near plane casts shadows.
    ("normalmap", "mi_ptracer"),  # The adjoint lacks the correction for bent normals.
    ("crop-gaussian", "mi_ptracer"),  # Borders are too dark.
    ("area-mesh", "mi_path"),  # Light sampling takes the interpolated normal for the surface's.
]


@pytest.mark.parametrize(("name", "algorithm"), FAULTS, ids=[name for name, _ in FAULTS])
def test_the_comparison_finds_faults_that_exist(agree: Agree, name: str, algorithm: str) -> None:
    """Mitsuba's own, in integrators that are not ours."""
    assert not agree(name, algorithm, more=3.0).agrees
