"""Regions from particles: k-means with the distance of [thesis (5.16)]."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elps_core.context.lookup import table_of
from elps_core.context.nearest import PointSet
from elps_core.context.regions import MAX_REGIONS, Floats, Regions
from elps_core.errors import ContextMismatch
from elps_core.paths.stream import key_seed

Array = NDArray[np.floating[Any]]

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


def build_regions(position: Array, normal: Array, count: int, seed: int, *, alpha: float | None = None) -> Regions:
    """Divide what surface particles cover into at most ``count`` regions [thesis 5.2.3].

    ``position`` [n, 3], in the scene's unit, and ``normal`` [n, 3], unit length, are those of particles of
    one kind, whose density decides how small the regions are. There are fewer regions than asked for
    where there are fewer distinct particles. ``alpha``, per unit of length, is the distance's; without
    it follows from the particles' spread. Same particles and seed, same regions.

    Raises:
        ValueError: no particles, shapes that do not fit, values that are not finite, normals that are
            not of unit length, or a ``count``, ``seed`` or ``alpha`` out of range.
    """
    clustering = Clustering(position, normal, count, seed, alpha=alpha)
    while not clustering.finished:
        clustering.step()
    return clustering.result()


class Clustering:
    """:func:`build_regions` in steps, of the same arguments: it can be saved after each and taken up elsewhere.

    There are at most :data:`MAX_ITERATIONS` + 2 steps: iterations of k-means, and then the table. However
    often it was interrupted, the regions are the same.
    """

    def __init__(self, position: Array, normal: Array, count: int, seed: int, *, alpha: float | None = None) -> None:
        position, normal = (np.asarray(part, np.float32) for part in (position, normal))
        _check(position, normal, count, seed, alpha)
        self._seed = seed
        self._points = PointSet(position, normal, _alpha(position) if alpha is None else alpha)
        self._means = _drawn(self._points, count, seed)
        self._regions: Regions | None = None

    @property
    def finished(self) -> bool:
        """Whether all steps are taken."""
        return self._regions is not None

    def step(self) -> None:
        """Take the next step, if one is left."""
        if not self._means.settled:
            self._means = _improved(self._points, self._means, self._seed)
        elif self._regions is None:
            low, high = np.quantile(self._points.position, [OUTLIERS, 1.0 - OUTLIERS], axis=0)
            centres, normals, alpha = self._means.centres, self._means.normals, self._points.alpha
            self._regions = Regions(centres, normals, alpha, table_of(centres, normals, alpha, low, high))

    def result(self) -> Regions:
        """The regions.

        Raises:
            RuntimeError: steps are left.
        """
        if self._regions is None:
            raise RuntimeError("the regions are not finished: take the steps that are left")
        return self._regions

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything, by name, to go on with it elsewhere: the particles (24 bytes each) and what has come of them."""
        state: dict[str, NDArray[Any]] = {
            "position": self._points.position,
            "normal": self._points.normal,
            "alpha": np.array([self._points.alpha], np.float64),
            "seed": np.array([self._seed], np.uint64),
            "centres": self._means.centres,
            "normals": self._means.normals,
            "history": np.array(self._means.history, np.float64),
        }
        return state if self._regions is None else state | self._regions.arrays()

    @staticmethod
    def from_arrays(arrays: Mapping[str, NDArray[Any]]) -> Clustering:
        """Go on where :meth:`arrays` was taken.

        Raises:
            ContextMismatch: arrays that do not belong together, or something missing.
        """
        try:
            particles, means = (arrays["position"], arrays["normal"]), (arrays["centres"], arrays["normals"])
            history, seed, alpha = arrays["history"], int(arrays["seed"][0]), float(arrays["alpha"][0])
            _check(*means, len(means[0]), seed, alpha)
            result = Clustering(*particles, len(means[0]), seed, alpha=alpha)
            result._means = Means(*means, tuple(history.tolist()))
            fits = (
                {part.dtype for part in (*particles, *means)} == {np.dtype(np.float32)}
                and history.ndim == 1
                and len(history) <= MAX_ITERATIONS + 1
                and np.isfinite(history).all()
            )
        except (KeyError, ValueError, IndexError, TypeError):
            fits = False
        if not fits:
            raise ContextMismatch("the saved state of the context does not fit: measure it again")
        if "cells" in arrays:
            result._regions = Regions.from_arrays(arrays)
        return result


@dataclass(frozen=True)
class Means:
    """What k-means has come to."""

    centres: Floats  # [k, 3]
    normals: Floats  # [k, 3], unit length
    history: tuple[float, ...] = ()  # Mean distance (5.16) before each iteration, and at the end

    @property
    def settled(self) -> bool:
        """Whether no iteration is left."""
        last = self.history[-2:]
        return len(self.history) > MAX_ITERATIONS or (len(last) > 1 and last[1] >= (1.0 - LEAST_GAIN) * last[0])


def k_means(points: PointSet, count: int, seed: int) -> Means:
    """At most ``count`` means of points.

    Starts from particles drawn at random. A centre moves to the mean of its particles' positions and of
    their normals, but only if that lowers the sum of their distances: (5.16) is linear in the
    distance of positions, and what the mean minimizes is its square. So the mean distance never
    rises. Centres without particles move to particles drawn in proportion to their distance;
    those that are left without in the end are dropped.
    """
    means = _drawn(points, count, seed)
    while not means.settled:
        means = _improved(points, means, seed)
    return means


def groups_of(regions: Regions, count: int, seed: int) -> NDArray[np.uint32]:
    """Gather neighbouring regions into at most ``count`` groups, by k-means of their centres.

    Returns the group of each region [regions.count]; groups are numbered from 0 without gaps.

    Raises:
        ValueError: ``count`` is not positive.
    """
    if count < 1:
        raise ValueError("the number of groups must be positive")
    points = PointSet(regions.centres, regions.normals, regions.alpha)
    means = k_means(points, count, seed)
    result = np.empty(regions.count, np.uint32)
    result[points.order] = points.nearest(means.centres, means.normals)[0]
    return result


def _alpha(position: Floats) -> float:
    low, first, third, high = np.quantile(position, [OUTLIERS, 0.25, 0.75, 1.0 - OUTLIERS], axis=0)
    size = float(np.linalg.norm(third - first)) or float(np.linalg.norm(high - low)) or 1.0
    return 1.0 / (TURN_LENGTH * size)


def _drawn(points: PointSet, count: int, seed: int) -> Means:
    """Where k-means starts."""
    n = len(points.order)
    chosen = np.random.default_rng(key_seed(seed, 0)).choice(n, min(count, n), replace=False)
    return Means(points.position[chosen], points.normal[chosen])


def _improved(points: PointSet, means: Means, seed: int) -> Means:
    """After one more iteration, or, if it is not worth it, without the centres that have no particles."""
    centres, normals = means.centres, means.normals
    index, distance = points.nearest(centres, normals)
    history = (*means.history, float(distance.mean(dtype=np.float64)))
    if Means(centres, normals, history).settled:
        used = np.bincount(index, minlength=len(centres)) > 0
        return Means(centres[used], normals[used], history)
    position, normal = _means(points, index, normals)
    gain = np.bincount(index, distance - points.distance(position, normal, index), len(centres))
    better = gain[:, None] > 0.0
    result = Means(np.where(better, position, centres), np.where(better, normal, normals), history)
    _fill_empty(points, result, index, distance, seed)
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


def _fill_empty(points: PointSet, means: Means, index: NDArray[np.uint32], distance: Floats, seed: int) -> None:
    """Move centres without particles, in place, to particles that are far from their own centre."""
    empty = np.flatnonzero(np.bincount(index, minlength=len(means.centres)) == 0)
    chance = distance.astype(np.float64)
    empty = empty[: np.count_nonzero(chance)]
    if len(empty):
        # Random numbers of its own for each iteration, so that no state of a generator has to be saved.
        rng = np.random.default_rng(key_seed(seed, len(means.history)))
        chosen = rng.choice(len(chance), len(empty), replace=False, p=chance / chance.sum())
        means.centres[empty], means.normals[empty] = points.position[chosen], points.normal[chosen]


def _check(position: Floats, normal: Floats, count: int, seed: int, alpha: float | None) -> None:
    if position.ndim != 2 or position.shape[1:] != (3,) or normal.shape != position.shape or not len(position):
        raise ValueError("positions and normals must be arrays [n, 3] of at least one particle")
    if not (np.isfinite(position).all() and np.isfinite(normal).all()):
        raise ValueError("positions and normals of particles must be finite")
    if np.abs(np.linalg.norm(normal, axis=1) - 1.0).max() > 1e-3:
        raise ValueError("normals of particles must have unit length")
    if not 1 <= count <= MAX_REGIONS:
        raise ValueError(f"the number of regions must be between 1 and {MAX_REGIONS}")
    if not 0 <= seed < 1 << 64:
        raise ValueError("the seed must have at most 64 bits and no sign")
    if alpha is not None and not 0.0 < alpha < np.inf:
        raise ValueError("alpha must be positive and finite")
