"""Even numbers: cells filled one by one, each number uniform by itself, no pair that knows of another."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

SETS, POINTS = 1 << 12, 64
Numbers = NDArray[np.float64]


def streams(key: int, sets: int = SETS, points: int = POINTS) -> Any:
    """The streams of all points of some sets, set by set."""
    import drjit as dr
    import mitsuba as mi

    from elps_core.paths.nets import Nets
    from elps_core.paths.stream import opaque_key

    sample = dr.arange(mi.UInt32, sets * points)
    return Nets(sample // points, sample % points, opaque_key(key)).stream(sample)


def pairs(key: int, *, even: bool = True, count: int = 4, sets: int = SETS, points: int = POINTS) -> Numbers:
    """[count, sets, points, 2]."""
    stream = streams(key, sets, points)
    drawn = [np.array(stream.next_2d(even=even), np.float64) for _ in range(count)]
    return np.stack([numbers.T.reshape(sets, points, 2) for numbers in drawn])


def test_every_cell_of_a_net_holds_one_point(mi: Any) -> None:
    numbers = pairs(1, sets=16)
    for columns in (1, 2, 4, 8, 16, 32, 64):
        cells = np.floor(numbers * (columns, POINTS // columns)).astype(int)
        index = np.sort(cells[..., 0] * (POINTS // columns) + cells[..., 1], axis=-1)
        assert np.array_equal(index, np.broadcast_to(np.arange(POINTS), index.shape))


def test_points_that_follow_fill_what_is_left(mi: Any) -> None:
    """The second half of a set is a net of its own, and so is each quarter."""
    numbers = pairs(2, sets=16).reshape(4, 16, 4, POINTS // 4, 2)
    cells = np.floor(numbers * 4).astype(int)
    index = np.sort(cells[..., 0] * 4 + cells[..., 1], axis=-1)
    assert np.array_equal(index, np.broadcast_to(np.arange(POINTS // 4), index.shape))


def test_single_numbers_are_even_too(mi: Any) -> None:
    stream = streams(3, sets=16)
    for _ in range(3):
        numbers = np.array(stream.next_1d(), np.float64).reshape(16, POINTS)
        cells = np.sort(np.floor(numbers * POINTS).astype(int), axis=-1)
        assert np.array_equal(cells, np.broadcast_to(np.arange(POINTS), cells.shape))


def test_each_point_is_uniform_over_the_sets(mi: Any) -> None:
    """Whatever its number: so the mean of any of them is unbiased."""
    found = []
    for even in (True, False):
        numbers = pairs(4, even=even)
        assert numbers.min() >= 0.0
        assert numbers.max() < 1.0
        for pair in numbers:
            for number in (0, 1, 17, 63):
                counts, _, _ = np.histogram2d(*pair[:, number].T, bins=16, range=[[0, 1], [0, 1]])
                found.append(stats.chisquare(counts.ravel()).pvalue)
                found += [stats.kstest(pair[:, number, axis], "uniform").pvalue for axis in (0, 1)]
    assert stats.kstest(found, "uniform").pvalue > 1e-3


def test_numbers_of_one_point_know_nothing_of_each_other(mi: Any) -> None:
    """Over the sets the numbers of a path are independent: in all cells of four of them as often as chance has it."""
    found = []
    for even in (True, False):
        first, second, *_ = pairs(5, even=even, sets=1 << 16, points=8)
        for number in range(8):
            cells = np.floor(np.concatenate([first[:, number], second[:, number]], axis=-1) * 4).astype(int)
            counts = np.bincount(cells @ (64, 16, 4, 1), minlength=256)
            found.append(stats.chisquare(counts).pvalue)
    assert stats.kstest(found, "uniform").pvalue > 1e-3


def test_pairs_within_a_set_are_decoupled(mi: Any) -> None:
    """The order of a pair's points says of another's what random orders of the same kind say."""
    numbers = pairs(6)[..., 0]
    found, expected = correlations(numbers[0], numbers[1]), correlations(shuffled(11), shuffled(12))
    assert abs(found.mean()) < 4.5 * found.std() / np.sqrt(SETS)
    # Of 4096 values the deviation is known to one in a hundred.
    assert abs(found.std() / expected.std() - 1.0) < 0.07


def correlations(first: Numbers, second: Numbers) -> Numbers:
    """Of each set's points."""
    first, second = (np.floor(numbers * POINTS) - (POINTS - 1) / 2 for numbers in (first, second))
    return np.asarray((first * second).mean(axis=1) / POINTS**2)


def shuffled(seed: int) -> Numbers:
    """The sequence in orders drawn by chance: every aligned block of 2^m numbers becomes another one [sets, points]."""
    rng, number = np.random.default_rng(seed), np.arange(POINTS)
    result = np.zeros((SETS, POINTS))
    for bit in range(6):
        flips = rng.integers(0, 2, (SETS, POINTS >> (bit + 1)))
        result += ((number >> bit & 1) ^ flips[:, number >> (bit + 1)]) / 2.0 ** (bit + 1)
    return result


def test_sets_and_keys_are_independent(mi: Any) -> None:
    bound = 4.5 / np.sqrt(SETS)
    numbers, other = pairs(7)[0, :, 5, 0] - 0.5, pairs(8)[0, :, 5, 0] - 0.5
    assert np.array_equal(pairs(7), pairs(7))
    assert abs(np.mean(numbers * other) * 12.0) < bound
    for lag in (1, 2, 64, 192):
        assert abs(np.mean(numbers[lag:] * numbers[:-lag]) * 12.0) < bound


def test_what_is_smooth_loses_noise_and_keeps_its_mean(mi: Any) -> None:
    """The mean of sin over pairs: unbiased, with a small part of the variance that chance would leave."""
    first, second, *_ = pairs(9)
    values = np.sin(first[..., 0] * first[..., 1] * 3.0) + np.cos(second[..., 0] * second[..., 1])
    grid = (np.arange(2000) + 0.5) / 2000
    product = grid[:, None] * grid
    truth = np.sin(product * 3.0).mean() + np.cos(product).mean()
    means = values.mean(axis=1)
    assert abs(means.mean() - truth) < 4.5 * means.std() / np.sqrt(SETS)
    assert means.var() < 0.05 * values.var() / POINTS


def test_a_stream_starts_again_at_another_sample(mi: Any) -> None:
    import drjit as dr
    import mitsuba as mitsuba

    stream = streams(10)
    whole = np.array(stream.next_2d()), np.array(stream.next_1d())
    # All lanes ask once more; every other one then begins the sample that its right neighbour has.
    lanes = dr.arange(mitsuba.UInt32, SETS * POINTS)
    odd = (lanes & 1) == 1
    there = stream.where(odd, stream.at(lanes - 1, odd))
    again = np.array(there.next_2d())
    assert np.array_equal(again[:, 1::2], whole[0][:, ::2])
    assert not np.any(again[:, ::2] == whole[0][:, ::2])
