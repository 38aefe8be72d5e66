"""Points behind mirrors and glass: found where lines meet, as bright as photons say, and whole or refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from elps_core.context.aims import POINTS, Aims, Photons, fit
from elps_core.errors import ContextMismatch

Array = np.ndarray[Any, Any]
LAMPS = np.array([[0.0, 0.0, 5.0], [4.0, 1.0, 3.0]])
SPREAD = 0.05


def photons(count: int, lamps: Array, *, distance: float = 1.0, seed: int = 0) -> Photons:
    """On the floor of two groups of four regions, 10 apart, from near the ``lamps``."""
    rng = np.random.default_rng(seed)
    region = rng.integers(8, size=count)
    position = np.stack([rng.random(count) + 10.0 * (region // 4), rng.random(count), np.zeros(count)], axis=1)
    towards = lamps[rng.integers(len(lamps), size=count)] + SPREAD * rng.normal(size=(count, 3)) - position
    direction = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return Photons(position, direction, np.full(count, distance), np.full(count, 1.0 / count), region)


GROUPS = np.repeat([0, 1], 4)
AREAS, CELL, WHOLE = np.full(8, 0.25), 0.006, 4.0 * np.pi


def test_points_lie_where_lines_meet_however_far_the_glass() -> None:
    aims = fit(photons(400, LAMPS), AREAS, GROUPS, WHOLE)
    for region in range(8):
        middle = np.array([0.5 + 10.0 * (region // 4), 0.5, 0.0])

        def seen(place: Array, middle: Array = middle) -> Array:
            return (place - middle) / np.linalg.norm(place - middle, axis=-1, keepdims=True)

        off = np.linalg.norm(seen(aims.points[region, :, None, :3]) - seen(LAMPS), axis=-1)
        assert off.min(axis=0).max() < 0.02
    # Of the distance lines tell less, and the less the farther it is.
    away = np.linalg.norm(aims.points[0, :, None, :3] - LAMPS, axis=-1)
    assert away.min(axis=0).max() < 0.35
    assert np.sqrt(aims.points[..., 3]) == pytest.approx(SPREAD, rel=0.5)


def test_parallel_lines_meet_on_the_glass() -> None:
    line = np.array([0.6, 0.0, 0.8])
    some = photons(200, LAMPS)
    parallel = Photons(some.position, np.tile(line, (200, 1)), np.full(200, 2.0), some.weight, some.region)
    aims = fit(parallel, AREAS, GROUPS, WHOLE)
    middle = np.array([0.5, 0.5, 0.0]) + 2.0 * line
    points, roots = aims.points[:4], aims.roots[:4]
    assert (roots.sum(axis=1) > 0.0).all()
    assert np.abs(points[..., :3] - middle)[roots > 0.0].max() < 0.6


def test_roots_are_what_the_least_noise_asks_for() -> None:
    """Of a normal spot of squared light Q: the integral of its root is sqrt(Q 8 pi spread^2 / distance^2).

    Points that share it each ask for the root of a half, which is up to sqrt(2) times that.
    """
    aims = fit(photons(4000, LAMPS[:1]), AREAS, GROUPS, CELL)
    distance = np.linalg.norm(LAMPS[0] - [0.5, 0.5, 0.0])
    root = np.sqrt(0.5 * 8.0 * np.pi) * SPREAD / distance
    assert (aims.roots[:4].sum(axis=1) > 0.8 * root).all()
    assert (aims.roots[:4].sum(axis=1) < 1.7 * root).all()


def test_groups_without_photons_have_no_points() -> None:
    some = photons(100, LAMPS)
    here = some.region < 4
    aims = fit(Photons(*(values[here] for values in vars(some).values())), AREAS, GROUPS, CELL)
    assert (aims.roots[:4].sum(axis=1) > 0.0).all()
    assert (aims.roots[4:] == 0.0).all()
    assert np.isfinite(aims.points).all()


def test_what_is_wider_than_cells_is_left_to_tables() -> None:
    near = photons(400, LAMPS[:1] * [1.0, 1.0, 0.1])
    assert fit(near, AREAS, GROUPS, CELL).roots[:4].max() == 0.0
    assert (fit(near, AREAS, GROUPS, WHOLE).roots[:4] > 0.0).all()


def test_the_order_of_photons_does_not_matter() -> None:
    some = photons(1000, LAMPS)
    order = np.random.default_rng(1).permutation(1000)
    other = Photons(*(values[order] for values in vars(some).values()))
    ours, theirs = fit(some, AREAS, GROUPS, CELL), fit(other, AREAS, GROUPS, CELL)
    assert np.array_equal(ours.points, theirs.points)
    assert np.allclose(ours.roots, theirs.roots, rtol=1e-5)


def changed(name: str, value: Any) -> dict[str, Array]:
    return fit(photons(100, LAMPS), AREAS, GROUPS, CELL).arrays() | {name: value}


@pytest.mark.parametrize(
    "arrays",
    [
        changed("points", np.ones((7, POINTS, 4), np.float32)),
        changed("points", np.zeros((8, POINTS, 4), np.float32)),
        changed("points", np.full((8, POINTS, 4), np.nan, np.float32)),
        changed("points", np.full((8, POINTS, 4), 1e30, np.float32)),
        changed("roots", np.full((8, POINTS), np.inf, np.float32)),
        changed("roots", -np.ones((8, POINTS), np.float32)),
        changed("roots", np.ones((8, POINTS))),
        {"roots": np.ones((8, POINTS), np.float32)},
    ],
)
def test_what_does_not_fit_is_refused(arrays: dict[str, Array]) -> None:
    with pytest.raises(ContextMismatch):
        Aims.from_arrays(arrays, 8)


def test_what_fits_is_taken_over() -> None:
    aims = fit(photons(100, LAMPS), AREAS, GROUPS, CELL)
    again = Aims.from_arrays(aims.arrays(), 8)
    assert again.points is aims.points
    assert again.roots is aims.roots
