"""Random streams: uniform, independent of each other, and the same for the same key."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import stats

LANES = 1 << 16


def draw(*key: int, count: int = 3) -> np.ndarray[Any, Any]:
    """Numbers [count, lanes] of a stream."""
    from elps_core.paths.stream import Stream

    stream = Stream.of(LANES, *key)
    return np.stack([np.array(stream.next_1d()) for _ in range(count)])


def test_the_key_decides(mi: Any) -> None:
    assert np.array_equal(draw(1, 2, 3), draw(1, 2, 3))
    assert not np.array_equal(draw(1, 2, 3), draw(1, 2, 4))


def test_numbers_are_uniform(mi: Any) -> None:
    for numbers in draw(4, 5):
        assert numbers.min() >= 0.0
        assert numbers.max() < 1.0
        assert stats.kstest(numbers, "uniform").pvalue > 1e-3


def test_lanes_dimensions_and_streams_are_uncorrelated(mi: Any) -> None:
    numbers = draw(6, 7) - 0.5
    other = draw(6, 8) - 0.5
    bound = 4.5 / np.sqrt(LANES)
    for lag in (1, 2, 64, 2304):
        correlation = np.mean(numbers[0][lag:] * numbers[0][:-lag]) * 12.0
        assert abs(correlation) < bound
    assert abs(np.mean(numbers[0] * numbers[1]) * 12.0) < bound
    assert abs(np.mean(numbers[0] * other[0]) * 12.0) < bound


def test_lanes_are_no_lattice(mi: Any) -> None:
    """Numbers of neighbouring lanes fill the unit square: consecutive seeds would leave lines.

    One stream may fail by chance; the p-values of many are uniform.
    """
    found = []
    for key in range(40):
        numbers = draw(9, key, count=1)[0]
        counts, _, _ = np.histogram2d(numbers[:-1:2], numbers[1::2], bins=16, range=[[0, 1], [0, 1]])
        found.append(stats.chisquare(counts.ravel()).pvalue)
    assert stats.kstest(found, "uniform").pvalue > 1e-3
