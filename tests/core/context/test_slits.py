"""Slits: found where lines pass by one another, however it lies, and not where they fill cells or meet by chance."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from elps_core.context.slits import HELD, LARGEST_CHANCE, MOST, Lines, Slits, find
from elps_core.errors import ContextMismatch

Array = np.ndarray[Any, Any]
REGIONS, CELL = 256, 4.0 * np.pi / 2048
NEIGHBOURHOODS, LENDERS = np.arange(REGIONS) // 64, np.arange(REGIONS) // 8
GAP = np.array([[0.2, 0.1, 1.5], [0.25, 1.9, 1.6]])
"""Ends of a slit over the floor."""
WIDTH = 0.006


def photons(part: float, *, width: float = WIDTH, gap: Array = GAP, count: int = 6000, seed: int = 0) -> Lines:
    """On a floor of 4 x 4, of which so much as ``part`` comes through the gap onto the half that is near to it."""
    rng = np.random.default_rng(seed)
    place = rng.random((count, 2))
    cell = np.floor(16.0 * place).astype(int)
    position = np.concatenate([4.0 * place, np.zeros((count, 1))], axis=1) - np.array([2.0, 1.0, 0.0])
    share = rng.random((count, 1))
    through = (1.0 - share) * gap[0] + share * gap[1] + width * rng.uniform(-1.0, 1.0, (count, 1)) * [1.0, 0.0, 0.0]
    anywhere = position + rng.normal(size=(count, 3)) * [1.0, 1.0, 0.5] + [0.0, 0.0, 1.5]
    lit = (rng.random(count) < part) & (cell[:, 0] >= 8)
    line = np.where(lit[:, None], through, anywhere) - position
    line[:, 2] = np.abs(line[:, 2])
    return Lines(
        position, line / np.linalg.norm(line, axis=1, keepdims=True), rng.random(count), 16 * cell[:, 0] + cell[:, 1]
    )


def turned(lines: Lines, by: Rotation, scale: float, shift: float) -> Lines:
    return Lines(scale * by.apply(lines.position) + shift, by.apply(lines.direction), lines.weight, lines.region)


def distance(points: Array, ends: Array) -> Array:
    """Of points from the line through ends."""
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    off = points - ends[0]
    found: Array = np.linalg.norm(off - (off @ along)[:, None] * along, axis=1)
    return found


def test_a_slit_is_found_where_it_is() -> None:
    slits = find(photons(0.4), NEIGHBOURHOODS, LENDERS, CELL, 0)
    assert slits is not None
    assert len(slits.spread) == 1
    assert distance(GAP, slits.ends[0]).max() < WIDTH
    assert distance(slits.ends[0], GAP).max() < WIDTH
    ends = np.sort((slits.ends[0] - GAP[0]) @ (GAP[1] - GAP[0]) / np.square(GAP[1] - GAP[0]).sum())
    assert ends == pytest.approx([0.0, 1.0], abs=0.05)
    assert 0.2 * WIDTH < slits.spread[0] < WIDTH
    # What comes through is told by region, and taken to fall off slowly.
    assert 0.36 < np.median(slits.chances[128:]) <= LARGEST_CHANCE
    assert np.median(slits.chances[:128]) < 0.02
    assert slits.chances.max() <= LARGEST_CHANCE


@pytest.mark.parametrize("seed", range(4))
def test_slits_may_lie_anyhow(seed: int) -> None:
    by, scale, shift = Rotation.random(random_state=seed), 10.0 ** (seed - 1), 3.0 * seed
    slits = find(turned(photons(0.25, seed=seed), by, scale, shift), NEIGHBOURHOODS, LENDERS, CELL, seed)
    assert slits is not None
    gap = scale * by.apply(GAP) + shift
    assert distance(gap, slits.ends[0]).max() < 2.0 * WIDTH * scale
    assert 0.22 < np.median(slits.chances[128:]) < 0.25 / HELD + 0.05


def test_two_slits_are_told_apart() -> None:
    other = GAP + np.array([1.2, 0.3, -0.4])
    one, two = photons(0.4), photons(0.4, gap=other, seed=1)
    both = Lines(*(np.concatenate([getattr(one, name), getattr(two, name)]) for name in vars(one)))
    slits = find(both, NEIGHBOURHOODS, LENDERS, CELL, 0)
    assert slits is not None
    assert len(slits.spread) == 2
    apart = [min(distance(gap, ends).max() for ends in slits.ends) for gap in (GAP, other)]
    assert max(apart) < 2.0 * WIDTH


@pytest.mark.parametrize(
    "lines",
    [
        photons(0.0),
        photons(0.4, width=0.6),
        photons(0.4, count=20),
        Lines(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64)),
        Lines(np.ones((500, 3)), np.tile([0.0, 0.0, 1.0], (500, 1)), np.ones(500), np.zeros(500, np.int64)),
    ],
    ids=["light from anywhere", "a window", "hardly any photons", "no photons", "one photon again and again"],
)
def test_what_is_no_slit_is_not_found(lines: Lines) -> None:
    assert find(lines, NEIGHBOURHOODS, LENDERS, CELL, 0) is None


def test_the_order_of_photons_does_not_matter() -> None:
    some = photons(0.3)
    order = np.random.default_rng(1).permutation(len(some.weight))
    ours = find(some, NEIGHBOURHOODS, LENDERS, CELL, 0)
    theirs = find(Lines(*(values[order] for values in vars(some).values())), NEIGHBOURHOODS, LENDERS, CELL, 0)
    assert ours is not None
    assert theirs is not None
    assert np.allclose(ours.ends, theirs.ends, atol=1e-5)
    assert np.allclose(ours.chances, theirs.chances, atol=1e-5)


def changed(name: str, value: Any) -> dict[str, Array]:
    slits = find(photons(0.4), NEIGHBOURHOODS, LENDERS, CELL, 0)
    assert slits is not None
    return slits.arrays() | {name: value}


@pytest.mark.parametrize(
    "arrays",
    [
        changed("ends", np.ones((2, 2, 3), np.float32)),
        changed("ends", np.ones((1, 2, 3), np.float32)),
        changed("ends", np.array([[[0, 0, 0], [0, 0, np.nan]]], np.float32)),
        changed("ends", np.array([[[0, 0, 0], [0, 0, 1e30]]], np.float32)),
        changed("spread", np.zeros(1, np.float32)),
        changed("spread", np.ones(1)),
        changed("which", np.ones(REGIONS, np.uint32)),
        changed("which", np.zeros(REGIONS, np.int64)),
        changed("chances", np.full(REGIONS, 0.6, np.float32)),
        changed("chances", np.full(REGIONS, np.nan, np.float32)),
        changed("chances", np.zeros(REGIONS - 1, np.float32)),
        changed("ends", np.zeros((0, 2, 3), np.float32)) | {"spread": np.zeros(0, np.float32)},
        {"spread": np.ones(1, np.float32)},
        {
            "ends": np.tile(np.eye(3, dtype=np.float32)[:2], (MOST + 1, 1, 1)),
            "spread": np.ones(MOST + 1, np.float32),
            "which": np.zeros(REGIONS, np.uint32),
            "chances": np.zeros(REGIONS, np.float32),
        },
    ],
)
def test_what_does_not_fit_is_refused(arrays: dict[str, Array]) -> None:
    with pytest.raises(ContextMismatch):
        Slits.from_arrays(arrays, REGIONS)


def test_what_fits_is_taken_over() -> None:
    slits = find(photons(0.4), NEIGHBOURHOODS, LENDERS, CELL, 0)
    assert slits is not None
    again = Slits.from_arrays(slits.arrays(), REGIONS)
    assert all(getattr(again, name) is value for name, value in vars(slits).items())
