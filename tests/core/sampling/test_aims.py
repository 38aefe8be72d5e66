"""Directions towards points: what is drawn is what is evaluated, from the bluntest lobe to the sharpest."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

DRAWS = 1 << 16
LEVEL = 1e-4
"""Probability with which a test of a correct density fails; seeds are fixed, so it fails never or always."""
ORIGIN, PLACE = np.array([0.3, -0.2, 0.1]), np.array([1.0, 2.0, -0.5])
DISTANCE = float(np.linalg.norm(PLACE - ORIGIN))


def aimed(spread: float, roots: list[float], irradiance: float) -> Any:
    """One region; its second point, where it has a chance, is opposite the first."""
    from elps_core.context.aims import Aims
    from elps_core.sampling.aims import AimedDirections

    other = 2.0 * ORIGIN - PLACE
    points = np.array([[[*PLACE, spread**2], [*other, spread**2]]], np.float32)
    return AimedDirections(Aims(points, np.array([roots], np.float32)), np.array([irradiance], np.float32))


def draw(mi: Any, aims: Any) -> tuple[Any, Any, Any]:
    import drjit as dr

    from elps_core.paths.stream import Stream

    every = dr.full(mi.Bool, True, DRAWS)
    region = dr.zeros(mi.UInt32, DRAWS)
    which, direction, left = aims.sample(mi.Point3f(*ORIGIN.tolist()), region, Stream.of(DRAWS, 5).next_2d(), every)
    return np.array(which), direction, left


@pytest.mark.parametrize("spread", [1e-5, 0.01, 0.3, 3.0, 1e3])
def test_directions_are_drawn_by_the_density_that_is_told(mi: Any, spread: float) -> None:
    import drjit as dr

    from elps_core.sampling.aims import BLUNTEST, SHARPEST

    aims = aimed(spread, [1.0, 0.0], 1.0)
    which, direction, _ = draw(mi, aims)
    assert abs(which.mean() - 0.5) < 5.0 * 0.5 / np.sqrt(DRAWS)
    told = aims.mixed(mi.Float(0.0), mi.Point3f(*ORIGIN.tolist()), dr.zeros(mi.UInt32, DRAWS), direction, mi.Bool(True))
    unit = np.array(direction, np.float64)
    assert np.abs(np.linalg.norm(unit, axis=0) - 1.0).max() < 1e-6
    middle = (PLACE - ORIGIN) / DISTANCE
    height = 0.5 * np.square(unit - middle[:, None]).sum(axis=0)[which]
    sharp = np.clip(0.25 * (DISTANCE / spread) ** 2, BLUNTEST, SHARPEST)
    whole = 1.0 - (1.0 + 2.0 * sharp) ** -3
    assert stats.kstest(height, lambda h: (1.0 - (1.0 + sharp * h) ** -3) / whole).pvalue > LEVEL
    density = 0.5 * 3.0 * sharp / (2.0 * np.pi * whole) * (1.0 + sharp * height) ** -4
    assert np.array(told)[which] == pytest.approx(density, rel=5e-3)


def test_chances_follow_roots_and_are_a_half_at_most(mi: Any) -> None:
    middle = (PLACE - ORIGIN) / DISTANCE
    for roots, irradiance, expected in (
        ([1.0, 3.0], 12.0, [1 / 16, 3 / 16]),
        ([1.0, 3.0], 1.0, [1 / 8, 3 / 8]),
        ([0.0, 0.0], 1.0, [0.0, 0.0]),
        ([1.0, 0.0], 0.0, [0.0, 0.0]),
    ):
        which, direction, left = draw(mi, aimed(0.01, roots, irradiance))
        first = np.array(direction).T @ middle > 0.0
        for share, chance in zip(((which & first).mean(), (which & ~first).mean()), expected, strict=True):
            assert abs(share - chance) <= 5.0 * np.sqrt(chance * (1.0 - chance) / DRAWS)
        # What is left to a table is even again.
        assert stats.kstest(np.array(left.x)[~which], "uniform").pvalue > LEVEL


def test_what_is_not_aimed_is_the_tables(mi: Any) -> None:
    import drjit as dr

    aims = aimed(0.01, [1.0, 3.0], 12.0)
    away = mi.Vector3f(*np.cross(PLACE - ORIGIN, [0.0, 0.0, 1.0]).tolist())
    told = aims.mixed(mi.Float(0.7), mi.Point3f(*ORIGIN.tolist()), mi.UInt32(0), dr.normalize(away), mi.Bool(True))
    assert float(told[0]) == pytest.approx(0.75 * 0.7, rel=1e-4)
