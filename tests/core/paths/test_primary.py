"""Primary sample space: uniform, symmetric, local, and a chain over it finds its target."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import stats

LANES = 1 << 16
STEPS = 12
Array = np.ndarray[Any, Any]


def coordinates(seed: int, count: int = LANES) -> Array:
    return np.random.default_rng(seed).integers(0, 2**32, count, dtype=np.uint32)


def distance(a: Array, b: Array) -> Array:
    """Between coordinates of the torus, as a share of its length."""
    difference = a - b  # Wraps around, as the coordinates do.
    return np.minimum(difference, -difference.astype(np.int64) % 2**32) / 2.0**32


def proposals(mi: Any, old: Array, seed: int, *, large: bool) -> Array:
    from elps_core.paths.primary import moved

    bits = coordinates(seed, len(old))
    return np.array(moved(mi.UInt32(old), mi.UInt32(bits), mi.Bool(large)))


def test_steps_leave_the_uniform_distribution_alone(mi: Any) -> None:
    old = coordinates(1)
    for step in range(STEPS):
        old = proposals(mi, old, 100 + step, large=False)
    assert stats.kstest(old / 2.0**32, "uniform").pvalue > 1e-3
    from_one_place = proposals(mi, np.zeros(LANES, np.uint32), 2, large=True)
    assert stats.kstest(from_one_place / 2.0**32, "uniform").pvalue > 1e-3


def test_small_steps_are_symmetric_and_exponential_in_size(mi: Any) -> None:
    from elps_core.paths.primary import LARGEST_STEP, SMALLEST_STEP

    # From the border, so that half of the steps wrap around.
    new = proposals(mi, np.zeros(LANES, np.uint32), 3, large=False)
    size = distance(new, np.zeros(LANES, np.uint32))
    assert size.min() >= SMALLEST_STEP * 0.999
    assert size.max() <= LARGEST_STEP * 1.001
    share = np.log(size / SMALLEST_STEP) / np.log(LARGEST_STEP / SMALLEST_STEP)
    assert stats.kstest(share, "uniform").pvalue > 1e-3
    up = new < 2**31
    assert abs(up.mean() - 0.5) < 4.5 * 0.5 / np.sqrt(LANES)
    assert stats.ks_2samp(size[up], size[~up]).pvalue > 1e-3


def test_numbers_that_walks_see_are_below_one(mi: Any) -> None:
    from elps_core.paths.primary import to_unit

    seen = np.array(to_unit(mi.UInt32([0, 2**31, 2**32 - 1])))
    assert seen[0] == 0.0
    assert seen[1] == 0.5
    assert 0.999999 < seen[2] < 1.0


def test_commit_keeps_what_the_stream_showed(mi: Any) -> None:
    """Accepted chains move in all their coordinates, to just the numbers that were seen; the others stay."""
    import drjit as dr

    from elps_core.paths.primary import commit, stream, to_unit
    from elps_core.paths.stream import generator, opaque_key

    dimensions, chains = 7, 1000
    before = coordinates(4, dimensions * chains)
    rng = np.random.default_rng(5)
    large, accepted = mi.Bool(rng.random(chains) < 0.5), mi.Bool(rng.random(chains) < 0.5)
    used = mi.UInt32(rng.integers(1, dimensions + 1, chains).astype(np.uint32))
    vectors = mi.UInt32(before)

    def random() -> Any:
        return generator(dr.arange(mi.UInt32, chains), opaque_key(6))

    proposal = stream(vectors, random(), large)
    seen = np.stack([np.array(proposal.next_1d()) for _ in range(dimensions)], axis=1)
    commit(vectors, random(), large, accepted, used)
    after = np.array(vectors).reshape(chains, dimensions)
    moved = np.array(accepted)[:, None] & (np.arange(dimensions) < np.array(used)[:, None])
    assert np.array_equal(after[~moved], before.reshape(chains, dimensions)[~moved])
    shown = np.array(to_unit(mi.UInt32(after.ravel()))).reshape(chains, dimensions)
    assert np.array_equal(shown[moved], seen[moved])
    small = moved & ~np.array(large)[:, None]
    assert distance(after[small], before.reshape(chains, dimensions)[small]).max() < 0.02
    assert (after != before.reshape(chains, dimensions))[moved].mean() > 0.999


def test_a_chain_of_small_steps_keeps_its_distribution(mi: Any) -> None:
    """Detailed balance: from the target, x y over the square, many small steps lead to the target again."""
    import drjit as dr

    from elps_core.paths.primary import commit, stream, to_unit
    from elps_core.paths.stream import ChanceStream, generator, opaque_key

    rng = np.random.default_rng(7)
    start = np.sqrt(rng.random((LANES, 2)))  # The density 2 x by inversion.
    vectors = mi.UInt32((start * 2.0**32).astype(np.uint32).ravel())
    chain = dr.arange(mi.UInt32, LANES)
    small = dr.full(mi.Bool, False, LANES)
    first = np.array(vectors)
    for step in range(40):
        key = opaque_key(8, step)
        proposal = stream(vectors, generator(chain * 2 + 1, key), small)
        new = proposal.next_1d() * proposal.next_1d()
        old = to_unit(dr.gather(mi.UInt32, vectors, 2 * chain)) * to_unit(dr.gather(mi.UInt32, vectors, 2 * chain + 1))
        accepted = ChanceStream(generator(chain * 2, key)).next_1d() * old < new
        dr.eval(accepted)
        commit(vectors, generator(chain * 2 + 1, key), small, accepted, dr.full(mi.UInt32, 2, LANES))
        dr.eval(vectors)
    found = np.array(vectors).reshape(LANES, 2).T / 2.0**32
    assert stats.kstest(found[0] ** 2, "uniform").pvalue > 1e-3
    assert stats.kstest(found[1] ** 2, "uniform").pvalue > 1e-3
    assert distance(np.array(vectors), first).mean() > 0.01, "the chains have not moved"


def test_walks_of_any_chain_take_its_own_numbers(mi: Any) -> None:
    """Lanes that take several chains in turn see of each what it would show to a lane of its own."""
    import drjit as dr

    from elps_core.paths.primary import stream
    from elps_core.paths.stream import generator, opaque_key

    dimensions, chains, lanes = 5, 12, 4
    large = mi.Bool(np.random.default_rng(9).random(chains) < 0.5)
    vectors = mi.UInt32(coordinates(8, dimensions * chains))

    def proposals() -> Any:
        return stream(vectors, generator(dr.arange(mi.UInt32, chains), opaque_key(6)), large)

    whole = proposals()
    shown = np.stack([np.array(whole.next_1d()) for _ in range(dimensions)])
    begun = proposals()
    assert np.array_equal(np.array(begun.next_2d()), shown[:2])
    begun = begun.begin(begun.next_1d())
    assert np.array_equal(np.array(begun.wavelengths(chains, 3)), shown[2])
    chain = dr.arange(mi.UInt32, lanes)
    one = begun.at(chain, mi.Bool(True))
    assert np.array_equal(np.array(one.next_1d()), shown[3][:lanes])
    renewed = mi.Bool([False, True, True, False])
    mixed = one.where(renewed, begun.at(chain + 2 * lanes, renewed))
    expected = np.where(np.array(renewed), shown[3][2 * lanes :], shown[4][:lanes])
    assert np.array_equal(np.array(mixed.next_1d()), expected)


def test_walks_wait_for_the_stream_of_all_chains(mi: Any) -> None:
    import drjit as dr
    import pytest

    from elps_core.paths.primary import stream
    from elps_core.paths.stream import generator, opaque_key

    lane = dr.arange(mi.UInt32, 3)
    begun = stream(mi.UInt32(coordinates(1, 6)), generator(lane, opaque_key(1)), mi.Bool([True] * 3))
    with pytest.raises(RuntimeError, match="no walk"):
        begun.at(lane, mi.Bool(True))
