"""Gaps that light comes through, such as that beside a door ajar: segments of lines in space that regions aim at.

A gap far narrower than a cell of a table is as wide as the cell to the table, so that most directions from it meet the
door and not the gap. Where in the cell the gap lies changes from one point of a region to the next; where it lies in
space does not. So photons that came through it pass by one line, whichever region they meet.

Any four lines have two others at most that meet all four. Fours of photons of the same neighbourhood are drawn, and
lines that meet them judged by how many of the other photons pass by closely, and not only so as to fill a cell: a
search by random samples, after Fischler and Bolles (1981). Needs no Mitsuba.
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

MOST = 4
"""Slits of a scene."""
FOURS, FIRST_JUDGES, JUDGES, PLACES = 1000, 32, 256, 2
"""Fours of photons in each neighbourhood, other photons that judge what meets them, and lines that are kept."""
FEWEST = 32
"""Photons of a neighbourhood that is searched."""
SURE = 8.0
"""Photons from which on a region counts in full."""
NARROW = 8.0
"""Part of a cell's width, 1 over it, that a slit is narrower than: what fills cells is left to tables."""
WORTHWHILE = 0.01
"""Part of all light that has to come through a slit, the light of each region counting alike. Where there is none, the
best line that meets some by chance gets 0.003 to 0.005."""
STEPS, RELAXED, TIGHTER, FARTHER = 20, 12.0, 0.7, 1.8
"""Steps of the fit, how many times the spread lines count within at first, how that shrinks with each step, and how
much farther steps go: a candidate is several spreads off, and few of its lines would draw it but slowly."""
SPREAD_STEPS = 8
"""Steps of each fit of a spread."""
MIDDLE = 0.9
"""Part of a slit's light between places that tell where it ends: the rest is not to be told from what is around."""
AROUND = 4.0
"""Widths of a cell within which lines take part in a fit."""
RANKING = 4096
"""Lines that tell which candidates are worth a fit, at least as many as half of that where there are."""
TRIED = 4
"""Candidates that a slit is fitted from, each to an end of its own."""
BAND, INSIDE = 9.0, 3.0
"""Times the spread of a slit within which light counts as its, less what is as bright around it."""
WIDEST = 4.0
"""Spreads that a cell is wider than, where a slit is of use."""
HELD = 2.0 / np.pi * (np.arctan(INSIDE) - INSIDE / (BAND - INSIDE) * (np.arctan(BAND) - np.arctan(INSIDE)))
"""Part of a slit's light that is counted so if it falls off as lobes do. Of light that ends at the slit's edges all is
counted, and taken for up to 1.4 times as much: a door's paths had the least variance with chances between the two."""
LARGEST_CHANCE = 0.5
LARGEST = 1e15
"""Coordinates beyond which squares in kernels would leave the range of a float."""
TINY = 1e-12
"""In place of nothing, where something is divided by it."""


@dataclass(frozen=True)
class Lines:
    """Photons, each with the line that it came along; one row each."""

    position: Doubles  # [n, 3]
    direction: Doubles  # [n, 3], unit vectors, to where it came from
    weight: Doubles  # [n], flux
    region: NDArray[np.int64]  # [n]


@dataclass(frozen=True)
class Slits:
    """Segments that light comes through, and how much of each region's."""

    ends: Floats
    """[M, 2, 3]"""
    spread: Floats
    """[M]: half of the light passes by nearer than that."""
    which: NDArray[np.uint32]
    """[K]: the slit that a region is lit through."""
    chances: Floats
    """[K]: part of the region's light, a half at most."""

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything by name, for a file."""
        return {"ends": self.ends, "spread": self.spread, "which": self.which, "chances": self.chances}

    @staticmethod
    def from_arrays(arrays: Mapping[str, NDArray[Any]], regions: int) -> Slits:
        """What :meth:`arrays` gave, of so many regions.

        Raises:
            ContextMismatch: something is missing, or does not fit the rest.
        """
        ends, spread, which, chances = (arrays.get(n, np.zeros(0)) for n in ("ends", "spread", "which", "chances"))
        count = len(spread)
        fits = (
            1 <= count <= MOST
            and (ends.shape, spread.shape, which.shape, chances.shape)
            == ((count, 2, 3), (count,), (regions,), (regions,))
            and ends.dtype == spread.dtype == chances.dtype == np.float32
            and which.dtype == np.uint32
            and bool((np.abs(ends) < LARGEST).all() and (np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > 0.0).all())
            and bool(((spread > 0.0) & (spread < LARGEST)).all() and (which < count).all())
            and bool(((chances >= 0.0) & (chances <= LARGEST_CHANCE)).all())
        )
        if not fits:
            raise ContextMismatch("the tables of the context are damaged: build it again")
        return Slits(ends, spread, which, chances)


@dataclass(frozen=True)
class _Passing:
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


@dataclass(frozen=True)
class _Segment:
    """A slit, lengths in units of the scene."""

    first: Doubles
    second: Doubles
    spread: float
    likelihood: float
    """Logarithm of how much likelier photons are that pass by like this, times their light."""

    @property
    def length(self) -> float:
        return float(np.linalg.norm(self.second - self.first))

    def passed_by(self, x: Doubles, line: Doubles) -> _Passing:
        """How lines from ``x`` pass by it; along it from its first end on."""
        return _passing(self.first, (self.second - self.first) / self.length, x, line)


def find(
    lines: Lines, neighbourhoods: NDArray[np.integer[Any]], lenders: NDArray[np.integer[Any]], cell: float, seed: int
) -> Slits | None:
    """Slits that some regions are lit through; None where there are none.

    Photons of regions of one of the ``neighbourhoods`` [K] are taken to see the same slits; those of one of the smaller
    groups ``lenders`` [K], to get as much through them. ``cell`` is the solid angle of a cell of a table.
    """
    order = np.lexsort((*lines.direction.T, *lines.position.T, lines.weight))  # Photons come in no order
    region, weight = lines.region[order], lines.weight[order]
    if not len(region):
        return None
    middle, size = lines.position.mean(axis=0), float(np.ptp(lines.position, axis=0).max()) or 1.0
    x, line = (lines.position[order] - middle) / size, lines.direction[order]
    count = len(neighbourhoods)
    light = weight / np.maximum(np.bincount(region, weight, count)[region], 1e-300)
    light *= np.minimum(1.0, np.bincount(region, minlength=count)[region] / SURE)
    light /= light.sum()
    width = float(np.sqrt(cell))
    pool = _candidates(x, line, light, neighbourhoods[region], width, np.random.default_rng(seed))
    found: list[_Segment] = []
    left, step = light.copy(), -(-len(light) // RANKING)
    few = slice(None, None, step)
    while len(found) < MOST:
        gains = np.array(
            [_gain(_passing(*candidate, x[few], line[few]), left[few] * step, width) for candidate in pool]
        )
        promising = [pool[best] for best in np.argsort(-gains)[:TRIED] if gains[best] >= WORTHWHILE]
        found_near = (_fitted(point, direction, x, line, left, width) for point, direction in promising)
        fits = [fit for fit in found_near if fit]
        slit = max(fits, key=lambda fit: fit.likelihood, default=None)
        if slit is None or _gain(slit.passed_by(x, line), left, width) < WORTHWHILE:
            break
        found.append(slit)
        left = np.where(slit.passed_by(x, line).miss < INSIDE * slit.spread, 0.0, left)
    if not found:
        return None
    parts = np.stack([_part(slit, x, line, light, lenders[region], int(lenders.max()) + 1, width) for slit in found])
    chances = np.minimum(parts.max(axis=0), LARGEST_CHANCE)[lenders]
    return Slits(
        np.array([[size * slit.first + middle, size * slit.second + middle] for slit in found], np.float32),
        np.array([size * slit.spread for slit in found], np.float32),
        parts.argmax(axis=0)[lenders].astype(np.uint32),
        chances.astype(np.float32),
    )


def _candidates(
    x: Doubles, line: Doubles, light: Doubles, group: NDArray[Any], width: float, rng: np.random.Generator
) -> list[tuple[Doubles, Doubles]]:
    """Of each neighbourhood the lines, a point and a direction each, that most of its photons pass by closely."""
    found = []
    for number in np.unique(group):
        here = np.nonzero(group == number)[0]
        if len(here) < FEWEST:
            continue
        chance = light[here] / light[here].sum()
        fours = rng.choice(here, (FOURS, 4), p=chance)
        judges = rng.choice(here, JUDGES, p=chance)
        point, direction = _meeting(x[fours], line[fours])
        if not len(point):
            continue
        # A few judges tell which ones are worth the time of all.
        for some, kept in ((judges[:FIRST_JUDGES], FOURS // 8), (judges, FOURS)):
            angle = _passing(point[:, None], direction[:, None], x[some], line[some]).angle
            close, about = angle < width / NARROW, angle < width
            better = np.argsort(about.sum(axis=1) / NARROW - close.sum(axis=1), kind="stable")[:kept]
            point, direction, close, about = point[better], direction[better], close[better], about[better]
        for _ in range(PLACES):
            best = int((close.sum(axis=1) - about.sum(axis=1) / NARROW).argmax())
            found.append((point[best], direction[best]))
            # The next one by what this one has not.
            others = ~close[best]
            close, about = close & others, about & others
    return found


def _meeting(x: Doubles, line: Doubles) -> tuple[Doubles, Doubles]:
    """Lines that meet all of four: points [n, 3] and unit directions [n, 3], from fours [m, 4, 3].

    In Plücker's coordinates (direction, moment) lines meet where a product of both is zero: four such equations leave a
    plane, and that a direction is across its moment two lines of it.
    """
    _, _, rows = np.linalg.svd(np.concatenate([np.cross(x, line), line], axis=-1))
    first, second = rows[:, 4], rows[:, 5]

    def product(one: Doubles, other: Doubles) -> Doubles:
        found: Doubles = (one[:, :3] * other[:, 3:]).sum(axis=1)
        return found

    a, b, c = product(first, first), product(first, second) + product(second, first), product(second, second)
    root = b * b - 4.0 * a * c
    q = -0.5 * (b + np.copysign(np.sqrt(np.maximum(root, 0.0)), b))
    found = []
    with np.errstate(divide="ignore", invalid="ignore"):
        for step in (q / c, a / q):
            both = first + step[:, None] * second
            direction, moment = both[:, :3], both[:, 3:]
            length = np.linalg.norm(direction, axis=1, keepdims=True)
            good = (root > 0.0) & (length[:, 0] > TINY * np.linalg.norm(both, axis=1)) & np.isfinite(both).all(axis=1)
            direction, moment = (direction / length)[good], (moment / length)[good]
            found.append((np.cross(direction, moment), direction))
    point, direction = (np.concatenate(part) for part in zip(*found, strict=True))
    return point, direction


def _passing(point: Doubles, direction: Doubles, x: Doubles, line: Doubles) -> _Passing:
    """How lines from ``x`` along the unit vectors ``line`` pass by the line through ``point`` along ``direction``."""
    away, across = point - x, np.cross(direction, line)
    squared = np.maximum(np.square(across).sum(axis=-1), TINY)
    return _Passing(
        np.abs((away * across).sum(axis=-1)) / np.sqrt(squared),
        -(np.cross(away, direction) * across).sum(axis=-1) / squared,
        -(np.cross(away, line) * across).sum(axis=-1) / squared,
    )


def _gain(passing: _Passing, light: Doubles, width: float) -> float:
    """Part of the light that passes by closely, less what would if it filled cells."""
    angle = passing.angle
    return float(light @ ((angle < width / NARROW) - (angle < width) / NARROW))


def _fitted(
    point: Doubles, direction: Doubles, x: Doubles, line: Doubles, light: Doubles, width: float
) -> _Segment | None:
    """The segment near a candidate that photons pass by most closely; None where that is by chance.

    Distances are taken to be Cauchy's beside others that are spread evenly; least squares with weights by the former.
    """
    spread, likelihood = 0.0, 0.0
    near = np.nonzero(_passing(point, direction, x, line).angle < AROUND * width)[0]
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
    surely = (passing.miss < INSIDE * spread) & (passing.angle < width)
    if surely.sum() < FEWEST:
        return None
    low, high = _middle(passing.along[surely], light[surely])
    if not high > low:
        return None
    beyond = 0.5 * (1.0 - MIDDLE) / MIDDLE * (high - low)
    return _Segment(point + (low - beyond) * direction, point + (high + beyond) * direction, spread, likelihood)


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


def _part(
    slit: _Segment,
    x: Doubles,
    line: Doubles,
    light: Doubles,
    group: NDArray[Any],
    count: int,
    width: float,
) -> Doubles:
    """Of the light of each of ``count`` groups, what comes through a slit; nothing where that fills much of a cell."""
    passing = slit.passed_by(x, line)
    there = (passing.far > TINY) & (passing.along > 0.0) & (passing.along < slit.length)
    inside = there & (passing.miss < INSIDE * slit.spread)
    around = there & ~inside & (passing.miss < BAND * slit.spread)

    def each(values: Doubles | NDArray[np.bool_]) -> Doubles:
        return np.bincount(group, light * values, count).astype(np.float64)

    through, total = each(inside - INSIDE / (BAND - INSIDE) * around) / HELD, each(np.ones_like(light))
    far = each(inside * passing.far) / np.maximum(each(inside), 1e-300)
    part = np.clip(through / np.maximum(total, 1e-300), 0.0, 1.0)
    return np.where(WIDEST * slit.spread < width * far, part, 0.0)
