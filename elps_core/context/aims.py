"""Where mirrors and glass show a lamp: points in space, of which every point of a few regions sees one and the same.

A mirror shows a lamp at one place behind it, and so does, nearly, a ball of glass, wherever one looks from: its
direction changes with every step, its place hardly does. So photons of light that was mirrored or refracted come along
lines that nearly meet in a few points. Regions keep such points, and paths aim at them: tables of directions have cells
by far too coarse for a lamp that is seen through a marble at the other end of a room.

Ruppert et al., "Robust Fitting of Parallax-Aware Mixtures for Path Guiding" (2020), keep points for the same reason.
Needs no Mitsuba.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elps_core.errors import ContextMismatch

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

POINTS = 2
"""Points of a region: each costs time wherever a density is asked for."""
MOST = 128
"""Photons of a group that its points are fitted to, at most."""
STEPS = 12
"""Steps of the fit."""
ON_THE_GLASS = 1e-4
"""What it counts, beside the lines, where on the mirror or the glass they come from: where these are parallel, or meet
nowhere, points lie there."""
PRIOR, USUAL_SPREAD = 2.0, 0.02
"""Photons' worth that a lobe's spread is taken to be as usual, over its distance: few lines that meet by chance do not
make it a point."""
WIDEST = 4.0
"""Cells of a table that light is spread over which the table knows well enough."""
LARGEST = 1e15
"""Coordinates, and roots, beyond which squares and sums in kernels would leave the range of a float."""
TINY = 1e-12
"""In place of nothing, where something is divided by it."""
BORROWED = 4.0
"""Photons that a group's mean counts as in each of its regions."""


@dataclass(frozen=True)
class Photons:
    """Lines of light that was mirrored or refracted, where it met a surface that scatters; one row each."""

    position: Doubles  # [n, 3]
    direction: Doubles  # [n, 3], unit vectors, to where it came from
    distance: Doubles  # [n], to the mirror or the glass there
    weight: Doubles  # [n], W^2 / (m^2 sr), as of :class:`elps_core.particles.caustics.CausticSampler`
    region: NDArray[np.int64]  # [n]


@dataclass(frozen=True)
class Aims:
    """Points that regions are lit through, and how bright."""

    points: Floats
    """[K, POINTS, 4]: place, and its spread squared, per axis across the line of sight."""
    roots: Floats
    """[K, POINTS]: root mean square of radiance times cosine over a region, integrated over directions; in units of its
    irradiance."""

    @staticmethod
    def nowhere(regions: int) -> Aims:
        """Points of so many regions that no light comes from."""
        return Aims(np.zeros((regions, POINTS, 4), np.float32), np.zeros((regions, POINTS), np.float32))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything by name, for a file."""
        return {"points": self.points, "roots": self.roots}

    @staticmethod
    def from_arrays(arrays: Mapping[str, NDArray[Any]], regions: int) -> Aims:
        """What :meth:`arrays` gave, of so many regions.

        Raises:
            ContextMismatch: something is missing, or does not fit the rest.
        """
        points, roots = (arrays.get(name, np.zeros(0)) for name in ("points", "roots"))
        fits = (
            (points.shape, roots.shape) == ((regions, POINTS, 4), (regions, POINTS))
            and points.dtype == roots.dtype == np.float32
            and bool((np.abs(points) < LARGEST).all() and (roots < LARGEST).all())
            and bool((roots >= 0.0).all() and (points[..., 3] > 0.0).all())
        )
        if not fits:
            raise ContextMismatch("the tables of the context are damaged: build it again")
        return Aims(points, roots)


def fit(photons: Photons, areas: Doubles, groups: NDArray[np.integer[Any]], cell: float) -> Aims:
    """Points for each group of regions, by expectation maximisation; regions of a group see the same.

    Regions have ``areas`` [K], in the scene's units squared, and belong to ``groups`` [K]. What points are drawn by has
    the least variance where its density is the root of what weights have summed up. What is seen as wider than
    :data:`WIDEST` times ``cell``, the solid angle of a cell of a table, is left to tables.
    """
    count = int(groups.max()) + 1
    of_group = groups[photons.region].astype(np.int64)
    points, mass, distance = _lobes(photons, of_group, count)
    # Mean over the surface, integrated over directions: of the group, and of each region.
    group = np.bincount(of_group, photons.weight, count) / np.bincount(groups, areas, count)
    met = np.bincount(photons.region, minlength=len(groups))
    own = np.bincount(photons.region, photons.weight, len(groups)) / areas
    squared = (met * own + BORROWED * group[groups]) / (met + BORROWED)
    # Each lobe's root of its part, integrated alike.
    angle = 8.0 * np.pi * points[..., 3] / np.square(distance)
    roots = np.where(angle <= WIDEST * cell, np.sqrt(mass * angle), 0.0)
    found = points[groups], np.sqrt(squared)[:, None] * roots[groups]
    return Aims(*(part.astype(np.float32) for part in found))


def _lobes(photons: Photons, of_group: NDArray[np.int64], count: int) -> tuple[Doubles, Doubles, Doubles]:
    """Points with their spread squared [count, POINTS, 4], each one's part of the weight and its mean distance."""
    number, place, room = _by_group(photons, of_group, count)
    points = np.zeros((count, POINTS, 4))
    points[..., 3] = 1.0
    mass, distance = np.zeros((count, POINTS)), np.ones((count, POINTS))
    if not room:
        return points, mass, distance
    some = np.unique(of_group)
    row = np.searchsorted(some, of_group[number])

    def padded(values: Doubles) -> Doubles:
        result = np.zeros((len(some), room, *values.shape[1:]))
        result[row, place] = values[number]
        return result

    x, line, weight = padded(photons.position), padded(photons.direction), padded(photons.weight)
    weight /= weight.sum(axis=1, keepdims=True)
    from_glass = x + line * padded(photons.distance)[..., None]
    points[some], mass[some], distance[some] = _fitted(x, line, from_glass, weight)
    return points, mass, distance


def _by_group(photons: Photons, of_group: NDArray[np.int64], count: int) -> tuple[Any, Any, int]:
    """Numbers of the photons that count, each one's place in its group, and how many places there are."""
    # Photons come in the order in which threads were done: an order of their own, the same in each run.
    order = np.lexsort((*photons.direction.T, *photons.position.T, photons.weight))
    order = order[np.argsort(of_group[order], kind="stable")]
    first = np.concatenate([[0], np.cumsum(np.bincount(of_group, minlength=count))[:-1]])
    size = np.bincount(of_group, minlength=count)[of_group[order]]
    place = np.arange(len(order)) - first[of_group[order]]
    # Of more than there is room for, evenly spaced ones.
    step = np.maximum(1, -(-size // MOST))
    kept = place % step == 0
    number, place = order[kept], place[kept] // step[kept]
    return number, place, int(place.max(initial=-1)) + 1


def _fitted(x: Doubles, line: Doubles, from_glass: Doubles, weight: Doubles) -> tuple[Doubles, Doubles, Doubles]:
    """As of :func:`_lobes`, for photons [groups, n, 3] of ``weight`` [groups, n], of sum 1."""
    line = line / np.maximum(np.linalg.norm(line, axis=-1, keepdims=True), TINY)
    across = np.eye(3) - line[..., :, None] * line[..., None, :]
    # Of each photon: what is across its line, its place across the line, and where it left the glass.
    moments = np.concatenate([across.reshape(*weight.shape, 9), (across @ x[..., None])[..., 0], from_glass], axis=-1)
    part = _seeds(line, weight)
    for _ in range(STEPS):
        mass = part.sum(axis=-1)
        points = _meeting(part @ moments, mass)
        towards = [points[..., axis, None] - x[:, None, :, axis] for axis in range(3)]  # [groups, POINTS, n] each
        far = np.maximum(np.sqrt(sum(np.square(along) for along in towards)), TINY)
        # Angle, squared
        off = 2.0 - 2.0 * sum(along * line[:, None, :, axis] for axis, along in enumerate(towards)) / far
        each = np.maximum(mass, TINY)
        mean = (part * far).sum(axis=-1) / each
        spread = 0.5 * (part * off * np.square(far)).sum(axis=-1) / each
        records = np.square(each) / np.maximum(np.square(part).sum(axis=-1), TINY**2)
        known = spread * records + PRIOR * np.square(USUAL_SPREAD * mean)
        squared = np.maximum(known / (records + PRIOR), TINY)
        sharp = np.square(far) / squared[..., None]
        log = np.log(np.maximum(mass[..., None] * sharp, 1e-300)) - 0.5 * sharp * off
        part = np.exp(log - log.max(axis=1, keepdims=True))
        part *= weight[:, None] / part.sum(axis=1, keepdims=True)
    return np.concatenate([points, squared[..., None]], axis=-1), mass, np.maximum(mean, TINY)


def _seeds(line: Doubles, weight: Doubles) -> Doubles:
    """Whose photons are whose at first [groups, POINTS, n]: by directions that are far from each other."""
    group = np.arange(len(line))
    chosen = weight.argmax(axis=1)
    apart = [np.square(line - line[group, chosen][:, None]).sum(axis=-1)]
    while len(apart) < POINTS:
        chosen = (np.min(apart, axis=0) * weight).argmax(axis=1)
        apart.append(np.square(line - line[group, chosen][:, None]).sum(axis=-1))
    nearest = np.argmin(apart, axis=0)
    found: Doubles = weight[:, None] * (nearest[:, None] == np.arange(POINTS)[:, None])
    return found


def _meeting(moments: Doubles, mass: Doubles) -> Doubles:
    """Points [groups, POINTS, 3] that lines pass by next, by the sums of photons' moments [groups, POINTS, 15].

    Each photon counts by its part in a point, whose parts are ``mass`` [groups, POINTS] together.
    """
    left, right, glass = moments[..., :9].reshape(*mass.shape, 3, 3), moments[..., 9:12], moments[..., 12:]
    pull = (ON_THE_GLASS * mass + 1e-30)[..., None, None] * np.eye(3)
    return np.asarray(np.linalg.solve(left + pull, (right + ON_THE_GLASS * glass)[..., None])[..., 0], np.float64)
