"""Segments that lines pass by closely, near edges of the scene. Needs no Mitsuba.

A gap ends where surfaces do. So what may be a gap is known, however few of the lines come through it: edges are judged
by how many lines pass by closely, and not only so as to fill a cell of a table, and segments are fitted to these.

Lengths are in units of the scene, so that they are of the order of 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]

JUDGES, TRIED, BEYOND = 1024, 12, 0.02
"""Lines that judge edges, edges that a segment is fitted near, and how far beyond their ends lines pass by, over their
length."""
LEAST = 0.5
"""Part of an edge's length that a segment beside it has: others have turned away."""
FEWEST = 10
"""Lines that a segment is fitted to, at least."""
NARROW = 8.0
"""Part of a cell's width, 1 over it, within which lines pass by closely: what fills cells is left to tables."""
STEPS, RELAXED, TIGHTER, FARTHER = 20, 12.0, 0.7, 1.8
"""Steps of the fit, how many times the spread lines count within at first, how that shrinks with each step, and how
much farther steps go: a candidate is several spreads off, and few of its lines would draw it but slowly."""
SPREAD_STEPS = 8
"""Steps of each fit of a spread."""
INSIDE = 3.0
"""Spreads within which a line surely passes by."""
MIDDLE = 0.9
"""Part of the lines between places that tell where a segment ends: the rest is not to be told from what is around."""
AROUND = 4.0
"""Widths of a cell within which lines take part in a fit."""
TINY = 1e-12
"""In place of nothing, where something is divided by it."""


@dataclass(frozen=True)
class Passing:
    """How lines pass by another one."""

    miss: Doubles
    """Distance."""
    far: Doubles
    """Of the nearest point from where the line begins; negative behind it."""
    along: Doubles
    """Of the nearest point along the other."""

    @property
    def angle(self) -> Doubles:
        """That the other is seen away from the line; more than any is, behind."""
        return np.where(self.far > TINY, self.miss / np.maximum(self.far, TINY), np.inf)

    def within(self, length: Doubles | float) -> NDArray[np.bool_]:
        """Whether they do between the ends of another one of that ``length``, or not far beyond them."""
        within: NDArray[np.bool_] = (self.along > -BEYOND * length) & (self.along < (1.0 + BEYOND) * length)
        return within


@dataclass(frozen=True)
class Segment:
    """A segment that lines pass by closely."""

    first: Doubles
    second: Doubles
    spread: float = 0.0
    likelihood: float = 0.0
    """Logarithm of how much likelier lines are that pass by like this, times their light."""

    @property
    def length(self) -> float:
        """Between its ends."""
        return float(np.linalg.norm(self.second - self.first))

    def passed_by(self, x: Doubles, line: Doubles) -> Passing:
        """How lines from ``x`` pass by it; along it from its first end on."""
        return _passing(self.first, (self.second - self.first) / self.length, x, line)


def beside(
    edges: Doubles, x: Doubles, line: Doubles, light: Doubles, width: float, rng: np.random.Generator
) -> list[Segment]:
    """Segments fitted near those of the ``edges`` [n, 2, 3] that most lines pass by closely.

    Lines begin at ``x`` [n, 3] and go along the unit vectors ``line`` [n, 3]; each counts as its ``light`` [n] says.
    ``width`` is that of a cell, in radians.
    """
    if not len(edges) or not light.sum() > 0.0:
        return []
    length = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1, keepdims=True)
    judges = rng.choice(len(light), JUDGES, p=light / light.sum())
    passing = _passing(edges[:, :1], (edges[:, 1:] - edges[:, :1]) / length[:, None], x[judges], line[judges])
    angle = np.where(passing.within(length), passing.angle, np.inf)
    score = (angle < width / NARROW).sum(axis=1) - (angle < width).sum(axis=1) / NARROW
    found = []
    for best in np.argsort(-score, kind="stable")[:TRIED]:
        edge = Segment(*edges[best])
        here = edge.passed_by(x, line).within(edge.length)
        if score[best] > 0.0 and (fit := fitted(edge, x[here], line[here], light[here], width)):
            # Where the light is brightest more lines pass by, and few of them may not tell of the rest.
            along = fit.second - fit.first
            first, second = (fit.first + along * ((end - fit.first) @ along) for end in edges[best])
            segment = replace(fit, first=first, second=second)
            if segment.length > LEAST * edge.length:
                found.append(segment)
    return found


def _passing(point: Doubles, direction: Doubles, x: Doubles, line: Doubles) -> Passing:
    """How lines from ``x`` along the unit vectors ``line`` pass by the line through ``point`` along ``direction``."""
    away, across = point - x, np.cross(direction, line)
    squared = np.maximum(np.square(across).sum(axis=-1), TINY)
    return Passing(
        np.abs((away * across).sum(axis=-1)) / np.sqrt(squared),
        -(np.cross(away, direction) * across).sum(axis=-1) / squared,
        -(np.cross(away, line) * across).sum(axis=-1) / squared,
    )


def fitted(candidate: Segment, x: Doubles, line: Doubles, light: Doubles, width: float) -> Segment | None:
    """The line near a candidate that lines pass by most closely, a unit of it; None where that is by chance.

    Distances are taken to be Cauchy's beside others that are spread evenly; least squares with weights by the former.
    """
    point, direction = candidate.first, (candidate.second - candidate.first) / candidate.length
    spread, likelihood = 0.0, 0.0
    near = np.nonzero((_passing(point, direction, x, line).angle < AROUND * width) & (light > 0.0))[0]
    x, line, light = x[near], line[near], light[near]
    for step in range(STEPS):
        passing = _passing(point, direction, x, line)
        near = np.nonzero(passing.angle < (width if step < 2 else 0.5 * width))[0]
        if len(near) < FEWEST:
            return None
        miss, far, along, shine = passing.miss[near], passing.far[near], passing.along[near], light[near]
        spread, likelihood = _spread(miss, 0.5 * width * far, shine, spread)
        surely = miss < INSIDE * spread
        low, high = _middle(along[surely], shine[surely])
        if not high > low:
            return None
        # The nearest points of each line to the segment lie in proportion between its ends, which are to be found.
        share = (along - low) / (high - low)
        across = np.cross(direction, line[near])
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), TINY)
        rows = np.concatenate([(1.0 - share)[:, None] * across, share[:, None] * across], axis=1)
        ends = np.concatenate([point + low * direction, point + high * direction])
        weight = shine / (1.0 + np.square(miss / (spread * max(1.0, RELAXED * TIGHTER**step))))
        normal = (rows * weight[:, None]).T @ rows
        # Along the segment anything fits.
        normal += 1e-6 * np.trace(normal) * np.eye(6)
        off = (across * x[near]).sum(axis=1) - rows @ ends
        ends = ends + FARTHER * np.linalg.solve(normal, (rows * weight[:, None]).T @ off)
        point, direction = ends[:3], ends[3:] - ends[:3]
        direction = direction / max(float(np.linalg.norm(direction)), TINY)
    passing = _passing(point, direction, x, line)
    if ((passing.miss < INSIDE * spread) & (passing.angle < width)).sum() < FEWEST:
        return None
    return Segment(point, point + direction, spread, likelihood)


def _spread(miss: Doubles, reach: Doubles, light: Doubles, spread: float) -> tuple[float, float]:
    """The likeliest scale of Cauchy's distribution for distances up to ``reach``, beside others that are even.

    It, from ``spread`` on or 0, and the logarithm of how much likelier it is than that all are even.
    """
    scale, part, even = spread or max(float(np.quantile(miss, 0.3)), TINY), 0.5, 1.0 / np.maximum(reach, TINY)
    likelihood = 0.0
    for _ in range(SPREAD_STEPS):
        peak = part * scale / (np.square(miss) + np.square(scale)) * (2.0 / np.pi)
        both = peak + (1.0 - part) * even
        mine = light * peak / both
        likelihood = float(light @ np.log(both / even))
        part = float(np.clip(mine.sum() / light.sum(), 1e-3, 1.0 - 1e-3))
        fit = 2.0 * (mine * np.square(scale) / (np.square(miss) + np.square(scale))).sum() / max(mine.sum(), 1e-300)
        scale = float(np.clip(scale / max(fit, 0.1), 1e-6, 1.0))
    return scale, likelihood


def _middle(values: Doubles, light: Doubles) -> tuple[float, float]:
    """Where :data:`MIDDLE` of the light lies between."""
    if not len(values):
        return 0.0, 0.0
    order = np.argsort(values)
    below = np.cumsum(light[order]) / max(float(light.sum()), 1e-300)
    low, high = np.minimum(np.searchsorted(below, [0.5 - 0.5 * MIDDLE, 0.5 + 0.5 * MIDDLE]), len(order) - 1)
    return float(values[order[low]]), float(values[order[high]])
