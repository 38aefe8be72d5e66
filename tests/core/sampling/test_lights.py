"""Lights by region: of many emitters, runs of neighbours; what is drawn is what the density says."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from tests.lamps import room

LANES = 1 << 20
LAMPS = 333
REGIONS = 5


@pytest.fixture(params=["even", "uneven", "spiked"])
def weights(request: pytest.FixtureRequest) -> Any:
    """A table of the start density, by its kind: [rows, emitters]."""
    rng = np.random.default_rng(4)
    rows = 1 if request.param == "even" else 3
    table = rng.random((rows, LAMPS)) ** 4 if request.param != "even" else np.ones((1, LAMPS))
    if request.param == "spiked":
        table = np.zeros((rows, LAMPS))
        table[1, 200] = 1.0
    return table


def drawn(mi: Any, weights: Any, table: Any) -> Any:
    """Start density, density by region, and what it draws: (lights, by region, start, density of paths, region)."""
    import drjit as dr

    from elps_core.paths.stream import Stream
    from elps_core.sampling.lights import RegionLights
    from elps_core.sampling.start import StartDensity
    from elps_core.scene.emission import Emission

    lights = StartDensity(Emission(room(mi, LAMPS)), weights)
    by_region = RegionLights(lights, table)
    stream = Stream.of(LANES, 8)
    region = dr.arange(mi.UInt32, LANES) % REGIONS
    active = dr.full(mi.Bool, True, LANES)
    start, pdf_start = by_region.sample(region, stream.next_2d(), stream.next_2d(), mi.Color0f(), active)
    return lights, by_region, start, pdf_start, region


def test_cells_are_drawn_with_their_probability(mi: Any, weights: Any) -> None:
    import drjit as dr

    from elps_core.sampling.lights import MOST_PIECES, pieces, runs

    table = np.random.default_rng(6).random((REGIONS, MOST_PIECES)).astype(np.float32) ** 3
    table[0] = 0.0
    lights, by_region, start, pdf_start, region = drawn(mi, weights, table)
    assert pieces(lights) == MOST_PIECES
    assert runs(lights)[0] == 0
    assert runs(lights)[-1] == LAMPS
    cells = lights.rows * LAMPS
    every = dr.arange(mi.UInt32, cells)
    for number in range(REGIONS):
        here = dr.full(mi.UInt32, number, cells)
        ratio = np.array(by_region.ratio(here, every, dr.full(mi.Bool, True, cells)), np.float64)
        chance = ratio * lights.probability.ravel()
        assert chance.sum() == pytest.approx(1.0, abs=1e-5)
        mine = np.array(region) == number
        counts = np.bincount(np.array(start.cell)[mine], minlength=cells)
        wanted = chance / chance.sum() * mine.sum()
        often = wanted >= 8
        rest = [counts[~often].sum()], [max(wanted[~often].sum(), 1e-9)]
        joined = (np.concatenate([counts[often], rest[0]]), np.concatenate([wanted[often], rest[1]]))
        if rest[1][0] < 8:
            joined = counts[often], wanted[often] * counts[often].sum() / wanted[often].sum()
            assert rest[0][0] < 40
        assert stats.chisquare(*joined).pvalue > 1e-3
    ratio = np.array(by_region.ratio(region, start.cell, dr.full(mi.Bool, True, LANES)))
    assert np.allclose(np.array(start.pdf), ratio * np.array(pdf_start), rtol=1e-5)


def test_points_of_a_lamp_are_even(mi: Any) -> None:
    """The number that chooses among the lamps of a run must not tell where on a lamp the point is."""
    from elps_core.sampling.lights import MOST_PIECES

    table = np.ones((REGIONS, MOST_PIECES), np.float32)
    _, _, start, _, _ = drawn(mi, np.ones((1, LAMPS)), table)
    uv, index = np.array(start.point.si.uv), np.array(start.point.index)
    kind = np.bincount(index).argmax()
    for lamp in (kind, 160, 168):  # A rectangle and a picture are even in uv; others are not asked
        assert (index == lamp).sum() > 500
    flat = [k for k in range(LAMPS) if np.ptp(uv[0][index == k]) > 0.9 and np.ptp(uv[1][index == k]) > 0.9]
    worst = min(stats.kstest(uv[0][index == k], "uniform").pvalue for k in flat[:1])
    assert worst > 1e-4


def test_where_nobody_knows_the_region_lights_are_chosen_as_paths_start(mi: Any) -> None:
    import drjit as dr

    from elps_core.sampling.lights import MOST_PIECES, NOWHERE

    table = np.random.default_rng(6).random((REGIONS, MOST_PIECES)).astype(np.float32)
    lights, by_region, _, _, _ = drawn(mi, np.ones((1, LAMPS)), table)
    nowhere = dr.full(mi.UInt32, NOWHERE, 64)
    ratio = by_region.ratio(nowhere, dr.arange(mi.UInt32, 64), dr.full(mi.Bool, True, 64))
    assert np.all(np.array(ratio) == 1.0)
    assert lights.many
