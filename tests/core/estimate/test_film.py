"""Chunks merge to the same image in any order; the error estimate is that of their scatter."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from elps_core.estimate.film import RGBA, Accumulation, Chunk

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


def with_statistics(index: int, spp: int, **values: float) -> Chunk:
    blank = np.ones((4, 5, 3), np.float32)
    return Chunk(index, spp, 0.5, blank, blank[..., 0], values)


def test_statistics_are_weighed_by_samples_and_survive_bytes() -> None:
    first, second = with_statistics(0, 1, b=1.0, rate=0.5), with_statistics(1, 3, b=2.0, rate=np.nan, none=np.nan)
    assert Chunk.from_bytes(first.to_bytes()).statistics == {"b": 1.0, "rate": 0.5}
    left, right = Accumulation.empty(5, 4), Accumulation.empty(5, 4)
    left.add(first)
    right.add(second)
    left.merge(Accumulation.from_bytes(right.to_bytes()))
    found = left.statistics()
    assert list(found) == ["b", "rate"]
    assert found["b"].mean == pytest.approx(1.75)
    assert found["b"].standard_error == pytest.approx(np.sqrt((0.75**2 + 9 * 0.25**2) / (16 - 10)))
    assert found["rate"] == (0.5, None)
    assert Accumulation.from_bytes(left.to_bytes()).statistics() == found


@pytest.mark.parametrize("power", [0.0, 0.5])
def test_the_error_of_statistics_is_calibrated(power: float) -> None:
    """Values that every chunk measures equally well (power 0), and those that gain by its samples."""
    rng = np.random.default_rng(7)
    squares, variances = [], []
    for _ in range(2000):
        merged = Accumulation.empty(5, 4)
        for index, spp in enumerate([1, 1, 2, 4, 4, 4, 4, 4]):
            merged.add(with_statistics(index, spp, b=float(rng.standard_normal()) / spp**power))
        found = merged.statistics()["b"]
        assert found.standard_error is not None
        squares.append(found.mean**2)
        variances.append(found.standard_error**2)
    # The mean of 2000 squares of normal values is known to about 3%.
    assert np.mean(variances) / np.mean(squares) == pytest.approx(1.0, abs=0.12)


def test_alpha_is_merged_and_is_no_part_of_the_error() -> None:
    rng = np.random.default_rng(9)
    plain, covered = Accumulation.empty(5, 4), Accumulation.empty(5, 4)
    for index in range(4):
        colours, alpha = rng.random((4, 5, 3), np.float32), np.full((4, 5, 1), 0.25 * index, np.float32)
        weight = np.full((4, 5), 2, np.float32)
        plain.add(Chunk(index, 2, 0.5, colours, weight))
        covered.add(Chunk(index, 2, 0.5, np.concatenate([colours, alpha], axis=-1), weight, channels=RGBA))
    assert covered.mean()[..., 3] == pytest.approx(0.375)
    assert np.array_equal(covered.mean()[..., :3], plain.mean())
    assert covered.relative_error() == plain.relative_error()
    again = Accumulation.from_bytes(covered.to_bytes())
    assert again.channels == RGBA
    assert np.array_equal(again.mean(), covered.mean())
    with pytest.raises(ValueError, match="channels"):
        covered.merge(plain)


def test_bands_keep_their_names() -> None:
    names = ("band1_green", "nir")
    chunk = Chunk(0, 1, 0.5, np.ones((4, 5, 2), np.float32), np.ones((4, 5), np.float32), channels=names)
    assert Chunk.from_bytes(chunk.to_bytes()).channels == names
    merged = Accumulation.empty(5, 4)
    merged.add(Chunk.from_bytes(chunk.to_bytes()))
    assert merged.weighted(0.5).channels == names
    assert merged.mean().shape == (4, 5, 2)


def test_quotients_of_sums_know_their_error() -> None:
    rng = np.random.default_rng(10)
    ratios = []
    for _ in range(300):
        merged, halves = Accumulation.empty(5, 4), [Accumulation.empty(5, 4) for _ in range(2)]
        for index, spp in enumerate([1, 1, 2, 4, 8, 8, 8, 8]):
            share = (1.0 + rng.normal(size=(4, 5, 1)) * 0.3 / np.sqrt(spp)).astype(np.float32)
            noise = rng.normal(size=(4, 5, 3)) * 0.2 / np.sqrt(spp)
            image = (2.0 * share + noise).astype(np.float32)
            weight = np.full((4, 5), spp, np.float32)
            chunk = Chunk.from_bytes(Chunk(index, spp, 0.5, image, weight, filtered=share[..., 0]).to_bytes())
            merged.add(chunk)
            halves[index % 2].add(chunk)
        halves[0].merge(Accumulation.from_bytes(halves[1].to_bytes()))
        assert np.allclose(halves[0].mean(), merged.mean(), rtol=1e-5)
        assert np.allclose(halves[0].standard_error(), merged.standard_error(), rtol=1e-3)
        ratios.append(((merged.mean() - 2.0) ** 2).mean() / (merged.standard_error() ** 2).mean())
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.1)
    assert merged.weighted(0.5).mean() == pytest.approx(merged.mean(), rel=1e-6)


def test_what_was_left_out_is_summed_and_told_once() -> None:
    rng = np.random.default_rng(6)
    counts: tuple[dict[str, int], ...] = ({"a": 2, "b": 5}, {}, {"a": 10_000, "c": 1, "d": 1})
    chunks = [replace(chunk(index, 4, rng), left_out=left_out) for index, left_out in enumerate(counts)]
    merged, other = Accumulation.empty(5, 4), Accumulation.empty(5, 4)
    assert merged.warnings() == ()
    merged.add(Chunk.from_bytes(chunks[0].to_bytes()))
    other.add_all(chunks[1:])
    merged.merge(Accumulation.from_bytes(other.weighted(0.5).to_bytes()))
    assert merged.left_out == {"a": 10_002, "b": 5, "c": 1, "d": 1}
    assert other.left_out == counts[2]
    (warning,) = merged.warnings()
    assert "10,009 samples that are not finite are left out (the image has 240)" in warning
    assert "their pixels show a, b, c, and 1 other things" in warning
