"""First directions of light paths: drawn with the density that is evaluated, and by the table where there is one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from elps_core.context.encoding import DirectionalTables
from elps_core.errors import ContextMismatch

LANES = 1 << 18
GRID = (8, 16)
CELLS = 12
"""Of the emitters' unit square: three for each of four pieces."""


def departures(evidence: int = 1000) -> Any:
    """Random tables of four pieces; the last one has no evidence."""
    from elps_core.sampling.departures import Departures

    values = np.random.default_rng(3).random((4, *GRID)) ** 3
    known = np.array([evidence] * 3 + [0])
    return Departures(DirectionalTables.of(values, np.ones(4), known), 4, lambda cell, _: cell // (CELLS // 4))


def drawn(cell: int) -> tuple[Any, Any, Any]:
    """Directions from a cell of a lamp that faces +z, as light paths take them; and which are the table's."""
    import drjit as dr
    import mitsuba as mi

    from elps_core.paths.stream import Stream

    stream = Stream.of(LANES, 5, cell)
    here = dr.full(mi.UInt32, cell, LANES)
    by_table, direction, u = departures().choose(here, stream.next_2d(), mi.Bool(True))
    return dr.select(by_table, direction, mi.warp.square_to_cosine_hemisphere(u)), by_table, here


def density(direction: Any, here: Any) -> Any:
    import drjit as dr
    import mitsuba as mi

    emitted = dr.maximum(direction.z, 0.0) * dr.inv_pi
    return departures().mixed(emitted, here, direction, mi.Bool(True))


@pytest.mark.parametrize("cell", [0, 5, 11])
def test_directions_have_the_density_that_is_evaluated(mi: Any, cell: int) -> None:
    """E[1 / p over a set] is its solid angle, and E[q / p] is one for another density q: here that of a few lobes."""
    import drjit as dr
    import mitsuba as mi

    direction, by_table, here = drawn(cell)
    pdf = density(direction, here)
    for axis in ((0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (0.0, -0.8, 0.6)):
        along = dr.dot(direction, mi.Vector3f(axis))
        # A lobe of cosine to the 8th about the axis, above the lamp, where both densities are positive.
        ratio = np.array(dr.select((along > 0.0) & (direction.z > 0.0), along**8 / pdf, 0.0), np.float64)
        error = ratio.std() / np.sqrt(LANES)
        assert abs(ratio.mean() - lobe(axis)) < 4.5 * error
        assert error < 0.01 * ratio.mean()
    share = float(np.mean(np.array(by_table)))
    assert share == (0.0 if cell == 11 else pytest.approx(0.75, abs=0.01))


def lobe(axis: tuple[float, float, float]) -> float:
    """Integral of the positive part of cosine^8 about ``axis`` over the upper hemisphere."""
    z, phi = np.meshgrid((np.arange(1000) + 0.5) / 1000, (np.arange(2000) + 0.5) / 2000 * 2 * np.pi)
    sine = np.sqrt(1.0 - z**2)
    along = sine * np.cos(phi) * axis[0] + sine * np.sin(phi) * axis[1] + z * axis[2]
    return float((np.maximum(along, 0.0) ** 8).mean() * 2.0 * np.pi)


def test_densities_sum_to_one(mi: Any) -> None:
    import drjit as dr
    import mitsuba as mi

    from elps_core.paths.stream import Stream

    direction = mi.warp.square_to_uniform_sphere(Stream.of(LANES, 7).next_2d())
    for cell in (0, 4, 8, 11):
        pdf = np.array(density(direction, dr.full(mi.UInt32, cell, LANES)), np.float64) * 4.0 * np.pi
        assert abs(pdf.mean() - 1.0) < 4.5 * pdf.std() / np.sqrt(LANES)


def test_without_evidence_light_leaves_as_it_is_emitted(mi: Any) -> None:
    import drjit as dr
    import mitsuba as mi

    direction, by_table, here = drawn(11)
    assert not np.array(by_table).any()
    cosine = np.array(direction.z)
    assert stats.kstest(cosine**2, "uniform").pvalue > 1e-3
    assert np.allclose(np.array(density(direction, here)), cosine / np.pi)
    few = departures(evidence=9).choose(dr.zeros(mi.UInt32, 64), mi.Point2f(dr.full(mi.Float, 0.1, 64)), mi.Bool(True))
    assert not np.array(few[0]).any()


def test_tables_of_other_lights_are_refused(mi: Any) -> None:
    from elps_core.sampling.departures import Departures

    tables = DirectionalTables.of(np.ones((5, *GRID)), np.ones(5), np.ones(5, int))
    with pytest.raises(ContextMismatch, match="other lights"):
        Departures(tables, 4, lambda cell, _: cell // (CELLS // 4))
