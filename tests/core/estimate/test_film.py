"""Chunks merge to the same image in any order; the error estimate is that of their scatter."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from elps_core.estimate.film import Accumulation, Chunk

Array = np.ndarray[Any, Any]


def chunk(index: int, spp: int, rng: np.random.Generator, spread: float = 1.0) -> Chunk:
    image = (2.0 + spread * rng.standard_normal((4, 5, 3)) / np.sqrt(spp)).astype(np.float32)
    return Chunk(index, spp, 0.5, image, np.full((4, 5), spp, np.float32))


def test_mean_weighs_by_samples() -> None:
    rng = np.random.default_rng(0)
    chunks = [chunk(0, 1, rng), chunk(1, 2, rng), chunk(2, 5, rng)]
    merged = Accumulation.empty(5, 4)
    merged.add_all(chunks)
    wanted = sum(c.spp * c.image.astype(np.float64) for c in chunks) / 8
    assert np.allclose(merged.mean(), wanted, rtol=1e-6)
    assert merged.spp == 8
    assert merged.seconds == 1.5


@settings(max_examples=25, deadline=None)
@given(st.permutations(range(6)), st.integers(1, 5))
def test_order_and_grouping_do_not_matter(order: list[int], split: int) -> None:
    rng = np.random.default_rng(1)
    chunks = [chunk(i, 1 << (i % 3), rng) for i in range(6)]
    straight, left, right = (Accumulation.empty(5, 4) for _ in range(3))
    straight.add_all(chunks)
    left.add_all(chunks[i] for i in order[:split])
    right.add_all(chunks[i] for i in order[split:])
    left.merge(right)
    assert left.chunks == straight.chunks
    assert np.allclose(left.mean(), straight.mean(), rtol=1e-6)
    assert np.allclose(left.standard_error(), straight.standard_error(), rtol=1e-5)


def test_standard_error_is_calibrated_for_unequal_chunks() -> None:
    rng = np.random.default_rng(2)
    ratios = []
    for _ in range(400):
        merged = Accumulation.empty(5, 4)
        merged.add_all(chunk(i, spp, rng) for i, spp in enumerate([1, 1, 2, 4, 8, 8, 8, 8]))
        ratios.append(((merged.mean() - 2.0) ** 2).mean() / (merged.standard_error() ** 2).mean())
    # 400 x 60 values: the ratio of true to estimated variance is known to about 1%.
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.05)


def test_the_same_chunk_is_refused_twice() -> None:
    rng = np.random.default_rng(3)
    merged = Accumulation.empty(5, 4)
    merged.add(chunk(0, 1, rng))
    with pytest.raises(ValueError, match="already"):
        merged.add(chunk(0, 1, rng))
    other = Accumulation.empty(5, 4)
    other.add(chunk(0, 1, rng))
    with pytest.raises(ValueError, match="share"):
        merged.merge(other)
    with pytest.raises(ValueError, match="size"):
        Accumulation.empty(4, 4).add(chunk(1, 1, rng))


def test_records_survive_bytes() -> None:
    rng = np.random.default_rng(4)
    first = chunk(7, 3, rng)
    again = Chunk.from_bytes(first.to_bytes())
    assert (again.index, again.spp, again.seconds) == (7, 3, 0.5)
    assert np.array_equal(again.image, first.image)
    merged = Accumulation.empty(5, 4)
    merged.add_all([first, chunk(1, 2, rng)])
    copy = Accumulation.from_bytes(merged.to_bytes())
    assert copy.chunks == {1, 7}
    assert np.array_equal(copy.mean(), merged.mean())
    assert copy.relative_error() == merged.relative_error()


def test_one_chunk_has_no_error_estimate() -> None:
    merged = Accumulation.empty(5, 4)
    merged.add(chunk(0, 1, np.random.default_rng(5)))
    assert merged.relative_error() is None
    assert not merged.standard_error().any()
