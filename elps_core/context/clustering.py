"""Regions from particles: k-means with the distance of [thesis (5.16)]."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from elps_core.context.lookup import table_of
from elps_core.context.nearest import PointSet
from elps_core.context.regions import MAX_REGIONS, Floats, Regions

TURN_LENGTH = 0.2
"""The length that weighs as much as a right angle between normals, as a share of the size of the box that
holds the middle half of the particles along each axis: the same with and without a plain around the house.
Between a third of it and three times as much, tables predicted the light of unseen samples equally well."""
OUTLIERS = 0.001
"""Share of the particles that the table leaves out at either end of each axis: a few that got far away must
not coarsen it for all others."""
MAX_ITERATIONS = 10
LEAST_GAIN = 0.01
"""Share by which an iteration must improve the mean distance to be followed by another."""


def build_regions(
    position: NDArray[np.floating[Any]],
    normal: NDArray[np.floating[Any]],
    count: int,
    seed: int,
    *,
    alpha: float | None = None,
) -> Regions:
    """Divide what surface particles cover into at most ``count`` regions [thesis 5.2.3].

    ``position`` [n, 3], in the scene's unit, and ``normal`` [n, 3], unit length, are those of particles of
    one kind, whose density decides how small the regions are. There are fewer regions than asked for
    where there are fewer distinct particles. ``alpha``, per unit of length, is the distance's; without
    it follows from the particles' spread. Same particles and seed, same regions.

    Raises:
        ValueError: no particles, shapes that do not fit, values that are not finite, normals that are
            not of unit length, or a ``count`` or ``alpha`` out of range.
    """
    position, normal = (np.asarray(part, np.float32) for part in (position, normal))
    _check(position, normal, count, alpha)
    low, first, third, high = np.quantile(position, [OUTLIERS, 0.25, 0.75, 1.0 - OUTLIERS], axis=0)
    if alpha is None:
        size = float(np.linalg.norm(third - first)) or float(np.linalg.norm(high - low)) or 1.0
        alpha = 1.0 / (TURN_LENGTH * size)
    points = PointSet(position, normal, alpha)
    centres, normals, _ = k_means(points, count, np.random.default_rng(seed))
    return Regions(centres, normals, alpha, table_of(centres, normals, alpha, low, high))


def k_means(points: PointSet, count: int, rng: np.random.Generator) -> tuple[Floats, Floats, list[float]]:
    """Centres [k, 3], their normals [k, 3] and the mean distance (5.16) before each iteration and at the end.

    Starts from particles drawn at random. A centre moves to the mean of its particles' positions and of
    their normals, but only if that lowers the sum of their distances: (5.16) is linear in the
    distance of positions, and what the mean minimizes is its square. So the mean distance never
    rises. Centres without particles move to particles drawn in proportion to their distance;
    those that are left without in the end are dropped.
    """
    first = rng.choice(len(points.order), min(count, len(points.order)), replace=False)
    centres, normals = points.position[first], points.normal[first]
    history: list[float] = []
    while True:
        index, distance = points.nearest(centres, normals)
        history.append(float(distance.mean(dtype=np.float64)))
        converged = len(history) > 1 and history[-1] >= (1.0 - LEAST_GAIN) * history[-2]
        if converged or len(history) > MAX_ITERATIONS:
            used = np.bincount(index, minlength=len(centres)) > 0
            return centres[used], normals[used], history
        position, normal = _means(points, index, normals)
        gain = np.bincount(index, distance - points.distance(position, normal, index), len(centres))
        better = gain[:, None] > 0.0
        centres, normals = np.where(better, position, centres), np.where(better, normal, normals)
        _fill_empty(points, centres, normals, index, distance, rng)


def groups_of(regions: Regions, count: int, seed: int) -> NDArray[np.uint32]:
    """Gather neighbouring regions into at most ``count`` groups, by k-means of their centres.

    Returns the group of each region [regions.count]; groups are numbered from 0 without gaps.

    Raises:
        ValueError: ``count`` is not positive.
    """
    if count < 1:
        raise ValueError("the number of groups must be positive")
    points = PointSet(regions.centres, regions.normals, regions.alpha)
    centres, normals, _ = k_means(points, count, np.random.default_rng(seed))
    result = np.empty(regions.count, np.uint32)
    result[points.order] = points.nearest(centres, normals)[0]
    return result


def _means(points: PointSet, index: NDArray[np.uint32], normals: Floats) -> tuple[Floats, Floats]:
    """Mean position and direction of mean normal of each region, the old normal where they cancel."""
    count = len(normals)
    members = np.maximum(np.bincount(index, minlength=count), 1)[:, None]

    def mean(values: Floats) -> NDArray[np.float64]:
        return np.stack([np.bincount(index, axis, count) for axis in values.T], axis=1) / members

    normal = mean(points.normal)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    unit = np.divide(normal, length, out=normals.astype(np.float64), where=length > 1e-6)
    return mean(points.position).astype(np.float32), unit.astype(np.float32)


def _fill_empty(
    points: PointSet,
    centres: Floats,
    normals: Floats,
    index: NDArray[np.uint32],
    distance: Floats,
    rng: np.random.Generator,
) -> None:
    """Move centres without particles, in place, to particles that are far from their own centre."""
    empty = np.flatnonzero(np.bincount(index, minlength=len(centres)) == 0)
    chance = distance.astype(np.float64)
    empty = empty[: np.count_nonzero(chance)]
    if len(empty):
        chosen = rng.choice(len(chance), len(empty), replace=False, p=chance / chance.sum())
        centres[empty], normals[empty] = points.position[chosen], points.normal[chosen]


def _check(position: Floats, normal: Floats, count: int, alpha: float | None) -> None:
    if position.ndim != 2 or position.shape[1:] != (3,) or normal.shape != position.shape or not len(position):
        raise ValueError("positions and normals must be arrays [n, 3] of at least one particle")
    if not (np.isfinite(position).all() and np.isfinite(normal).all()):
        raise ValueError("positions and normals of particles must be finite")
    if np.abs(np.linalg.norm(normal, axis=1) - 1.0).max() > 1e-3:
        raise ValueError("normals of particles must have unit length")
    if not 1 <= count <= MAX_REGIONS:
        raise ValueError(f"the number of regions must be between 1 and {MAX_REGIONS}")
    if alpha is not None and not 0.0 < alpha < np.inf:
        raise ValueError("alpha must be positive and finite")
