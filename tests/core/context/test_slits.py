"""Slits: found where lines pass by an edge, however it lies, and not where they fill cells or do so by chance."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from elps_core.context.slits import HELD, LARGEST_CHANCE, MOST, NONE, Lines, Slits, find
from elps_core.errors import ContextMismatch

Array = np.ndarray[Any, Any]
REGIONS, CELL = 256, 4.0 * np.pi / 2048
LENDERS = np.arange(REGIONS) // 8
GAP = np.array([[0.2, 0.1, 1.5], [0.25, 1.9, 1.6]])
"""Ends of a slit over the floor."""
WIDTH = 0.006
OTHER = GAP + np.array([1.2, 0.3, -0.4])
"""Of another one."""
EDGES = np.concatenate(
    [GAP[None] + [[[0.9 * WIDTH, 0.0, 0.0]], [[-WIDTH, 0.0, 0.02]]], OTHER[None] - [[[WIDTH, 0.0, 0.0]]],
     np.random.default_rng(5).uniform([-2.0, -1.0, 0.0], [2.0, 3.0, 2.0], (40, 2, 3))]
)  # fmt: skip
"""Of the scene: beside both gaps, and anywhere."""


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
    line /= np.linalg.norm(line, axis=1, keepdims=True)
    return Lines(
        position, line, rng.random(count), 16 * cell[:, 0] + cell[:, 1], np.full(count, 10.0), np.zeros(count, np.bool_)
    )


def turned(lines: Lines, by: Rotation, scale: float, shift: float) -> Lines:
    return replace(lines, position=scale * by.apply(lines.position) + shift, direction=by.apply(lines.direction))


def together(one: Lines, two: Lines) -> Lines:
    return Lines(*(np.concatenate([getattr(one, name), getattr(two, name)]) for name in vars(one)))


def distance(points: Array, ends: Array) -> Array:
    """Of points from the line through ends."""
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    off = points - ends[0]
    found: Array = np.linalg.norm(off - (off @ along)[:, None] * along, axis=1)
    return found


def test_a_slit_is_found_where_it_is() -> None:
    slits = find(photons(0.4), NONE, LENDERS, EDGES, CELL, 0)
    assert slits is not None
    assert len(slits.spread) == 1
    assert distance(GAP, slits.ends[0]).max() < WIDTH
    assert distance(slits.ends[0], GAP).max() < WIDTH
    ends = np.sort((slits.ends[0] - GAP[0]) @ (GAP[1] - GAP[0]) / np.square(GAP[1] - GAP[0]).sum())
    assert ends == pytest.approx([0.0, 1.0], abs=0.05)
    assert 0.2 * WIDTH < slits.spread[0] < WIDTH
    # What comes through is told by region, and taken to fall off slowly.
    assert 0.36 < np.median(slits.chances[0, 128:]) <= LARGEST_CHANCE
    assert np.median(slits.chances[0, :128]) < 0.02
    assert slits.chances.max() <= LARGEST_CHANCE


@pytest.mark.parametrize("seed", range(4))
def test_slits_may_lie_anyhow(seed: int) -> None:
    by, scale, shift = Rotation.random(random_state=seed), 10.0 ** (seed - 1), 3.0 * seed
    edges = scale * by.apply(EDGES.reshape(-1, 3)).reshape(-1, 2, 3) + shift
    slits = find(turned(photons(0.15, seed=seed), by, scale, shift), NONE, LENDERS, edges, CELL, seed)
    assert slits is not None
    gap = scale * by.apply(GAP) + shift
    assert distance(gap, slits.ends[0]).max() < 2.0 * WIDTH * scale
    assert 0.28 < slits.chances[0, 128:].mean() < 2.0 * 0.15 / HELD + 0.05


def test_two_slits_are_told_apart() -> None:
    one, two = photons(0.4), photons(0.4, gap=OTHER, seed=1)
    both = together(one, two)
    slits = find(both, one, LENDERS, EDGES, CELL, 0)
    assert slits is not None
    assert len(slits.spread) == 2
    apart = [min(distance(gap, ends).max() for ends in slits.ends) for gap in (GAP, OTHER)]
    assert max(apart) < 2.0 * WIDTH
    assert np.median(slits.chances[0, 128:], axis=0).min() > 0.17
    assert (slits.chances.sum(axis=-1) < LARGEST_CHANCE + 1e-6).all()


@pytest.mark.parametrize(
    "lines",
    [
        photons(0.0),
        photons(0.4, width=0.6),
        photons(0.4, count=20),
        NONE,
        replace(photons(0.4), position=np.ones((6000, 3)), direction=np.tile([0.0, 0.0, 1.0], (6000, 1))),
        replace(photons(0.4), straight=np.ones(6000, np.bool_)),
        replace(photons(0.4), rise=np.full(6000, 3.0)),
    ],
    ids=[
        "light from anywhere",
        "a window",
        "hardly any photons",
        "no photons",
        "one photon again and again",
        "light of a lamp",
        "no brighter there",
    ],
)
def test_what_is_no_slit_is_not_found(lines: Lines) -> None:
    assert find(lines, lines, LENDERS, EDGES, CELL, 0) is None


def test_few_photons_tell_of_a_slit_beside_an_edge() -> None:
    """As many as come through the gap above a door, of 6000: 2 of 100, and of half of the floor."""
    some = photons(0.02)
    slits = find(some, NONE, LENDERS, EDGES, CELL, 0)
    assert slits is not None
    assert distance(GAP, slits.ends[0]).max() < 4.0 * WIDTH
    assert find(some, NONE, LENDERS, EDGES[3:], CELL, 0) is None
    assert find(some, NONE, LENDERS, EDGES[:0], CELL, 0) is None


def test_the_shortest_of_edges_that_are_alike_is_taken() -> None:
    longer = GAP + np.array([[-1.0], [2.0]]) * (GAP[1] - GAP[0]) + [WIDTH, 0.0, 0.0]
    slits = find(photons(0.4), NONE, LENDERS, np.concatenate([longer[None], EDGES]), CELL, 0)
    assert slits is not None
    length = np.linalg.norm(slits.ends[:, 1] - slits.ends[:, 0], axis=1)
    assert length == pytest.approx([np.linalg.norm(GAP[1] - GAP[0])], rel=0.02)


def test_importance_has_chances_of_its_own() -> None:
    slits = find(photons(0.1), photons(0.15, seed=1), LENDERS, EDGES, CELL, 0)
    assert slits is not None
    # As much to the slit as comes through it, and again with what is beside it.
    assert 0.17 < np.median(slits.chances[0, 128:]) < 2.0 * 0.1 / HELD + 0.05
    assert 0.28 < np.median(slits.chances[1, 128:]) < 2.0 * 0.15 / HELD + 0.05
    assert np.median(slits.chances[:, :128]) < 0.02
    alone = find(photons(0.1), NONE, LENDERS, EDGES, CELL, 0)
    assert alone is not None
    assert (alone.chances[1] == 0.0).all()


def test_light_of_a_lamp_counts_where_it_comes_through() -> None:
    """Beside it all that comes straight from a lamp is the business of light sampling."""
    some = photons(0.1)
    through = photons(1.0, seed=1).those(photons(1.0, seed=1).region >= 128)
    lamps = [replace(lines, straight=np.ones(len(lines.weight), np.bool_)) for lines in (through, photons(0.0, seed=2))]
    slits = find(together(together(some, lamps[0]), lamps[1]), NONE, LENDERS, EDGES, CELL, 0)
    assert slits is not None
    assert np.median(slits.chances[0, 128:]) == LARGEST_CHANCE
    slits = find(together(some, lamps[1]), NONE, LENDERS, EDGES, CELL, 0)
    assert slits is not None
    assert 0.17 < np.median(slits.chances[0, 128:]) < 2.0 * 0.1 / HELD + 0.05


def test_what_floats_do_not_hold_is_no_slit() -> None:
    for scale, shift in ((1e16, 0.0), (1e-48, 0.0), (1e-9, 1e3)):
        far = turned(photons(0.4), Rotation.identity(), scale, shift)
        assert find(far, NONE, LENDERS, EDGES, CELL, 0) is None


def test_the_order_of_photons_does_not_matter() -> None:
    some = photons(0.3)
    order = np.random.default_rng(1).permutation(len(some.weight))
    ours = find(some, NONE, LENDERS, EDGES, CELL, 0)
    theirs = find(some.those(order), NONE, LENDERS, EDGES, CELL, 0)
    assert ours is not None
    assert theirs is not None
    assert np.allclose(ours.ends, theirs.ends, atol=1e-5)
    assert np.allclose(ours.chances, theirs.chances, atol=1e-5)


def changed(name: str, value: Any) -> dict[str, Array]:
    slits = find(photons(0.4), NONE, LENDERS, EDGES, CELL, 0)
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
        changed("chances", np.full((2, REGIONS, 1), 0.6, np.float32)),
        changed("chances", np.full((2, REGIONS, 1), -0.1, np.float32)),
        changed("chances", np.full((2, REGIONS, 1), np.nan, np.float32)),
        changed("chances", np.zeros((2, REGIONS - 1, 1), np.float32)),
        changed("chances", np.zeros((2, REGIONS, 2), np.float32)),
        changed("chances", np.zeros((2, REGIONS, 1))),
        changed("ends", np.zeros((0, 2, 3), np.float32)) | {"spread": np.zeros(0, np.float32)},
        {"spread": np.ones(1, np.float32)},
        {
            "ends": np.tile(np.eye(3, dtype=np.float32)[:2], (MOST + 1, 1, 1)),
            "spread": np.ones(MOST + 1, np.float32),
            "chances": np.zeros((2, REGIONS, MOST + 1), np.float32),
        },
    ],
)
def test_what_does_not_fit_is_refused(arrays: dict[str, Array]) -> None:
    with pytest.raises(ContextMismatch):
        Slits.from_arrays(arrays, REGIONS)


def test_what_fits_is_taken_over() -> None:
    slits = find(photons(0.4), NONE, LENDERS, EDGES, CELL, 0)
    assert slits is not None
    again = Slits.from_arrays(slits.arrays(), REGIONS)
    assert all(getattr(again, name) is value for name, value in vars(slits).items())
