"""Gaps that light comes through, such as that beside a door ajar: segments of lines in space that regions aim at.

A gap far narrower than a cell of a table is as wide as the cell to the table, so that most directions from it meet the
door and not the gap. Where in the cell the gap lies changes from one point of a region to the next; where it lies in
space does not. So photons that came through it pass by one line, whichever region they meet; and so do eye paths that
went through it from the other side. Needs no Mitsuba.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elps_core.context.segments import INSIDE, TINY, Segment, beside
from elps_core.errors import ContextMismatch

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

MOST = 6
"""Slits of a scene."""
SURE = 8.0
"""Photons from which on a region counts in full."""
BRIGHTER = 8.0
"""Times as bright it is where photons come from that are searched for slits: few others come through any."""
SEARCHED = 8192
"""Photons that are searched, at least half as many where there are."""
CERTAIN = 0.01
"""How much likelier a slit has to make these photons, the light of each region counting alike: the mean logarithm, by
light. Of the gaps around a door that is ajar by 3 degrees each has 0.014 to 0.6; where it stands open by 60, nothing
has more than 0.007."""
ALIKE = 0.95
"""Of the greatest likelihood: the shortest one is taken of those that have so much."""
WIDER = 4.0
"""Times its spread that the lobe has in which half of the directions to a slit lie: its frame is bright, too."""
BAND = 9.0
"""Times the spread of a slit, beside :data:`INSIDE`: what is as bright around it is not its light."""
WIDEST = 4.0
"""Spreads that a cell is wider than, where a slit is of use."""
HELD = 2.0 / np.pi * (np.arctan(INSIDE) - INSIDE / (BAND - INSIDE) * (np.arctan(BAND) - np.arctan(INSIDE)))
"""Part of a slit's light that is counted so if it falls off as lobes do. Of light that ends at the slit's edges all is
counted, and taken for up to 1.4 times as much: a door's paths had the least variance with chances between the two."""
LARGEST_CHANCE, ROUNDING = 0.5, 1e-6
LARGEST = 1e15
"""Coordinates beyond which squares in kernels would leave the range of a float."""


@dataclass(frozen=True)
class Lines:
    """Photons or importons, each with the line that it came along; one row each."""

    position: Doubles  # [n, 3]
    direction: Doubles  # [n, 3], unit vectors, to where it came from
    weight: Doubles  # [n], flux
    region: NDArray[np.int64]  # [n]
    rise: Doubles  # [n], how many times as bright it is where it came from
    straight: NDArray[np.bool_]  # [n], from a lamp

    def those(self, chosen: NDArray[np.bool_]) -> Lines:
        """Those chosen [n]."""
        return Lines(*(part[chosen] for part in vars(self).values()))


NONE = Lines(*(np.zeros((0, 3)),) * 2, np.zeros(0), np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.bool_))


@dataclass(frozen=True)
class Slits:
    """Segments that light comes through, and how much of each region's light and importance does."""

    ends: Floats
    """[M, 2, 3]"""
    spread: Floats
    """[M]: half of the light passes by nearer than that."""
    chances: Floats
    """[2, K, M]: part of a region's light through each and from close to it, and of its importance; half of all at
    most."""

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything by name, for a file."""
        return {"ends": self.ends, "spread": self.spread, "chances": self.chances}

    @staticmethod
    def from_arrays(arrays: Mapping[str, NDArray[Any]], regions: int) -> Slits:
        """What :meth:`arrays` gave, of so many regions.

        Raises:
            ContextMismatch: something is missing, or does not fit the rest.
        """
        ends, spread, chances = (arrays.get(name, np.zeros(0)) for name in ("ends", "spread", "chances"))
        count = len(spread)
        fits = (
            1 <= count <= MOST
            and (ends.shape, spread.shape, chances.shape) == ((count, 2, 3), (count,), (2, regions, count))
            and ends.dtype == spread.dtype == chances.dtype == np.float32
            and _can_be_seen(ends, spread)
            and bool((chances >= 0.0).all() and (chances.sum(axis=-1) <= LARGEST_CHANCE + ROUNDING).all())
        )
        if not fits:
            raise ContextMismatch("the tables of the context are damaged: build it again")
        return Slits(ends, spread, chances)


def find(
    photons: Lines,
    importons: Lines,
    lenders: NDArray[np.integer[Any]],
    edges: Doubles,
    cell: float,
    seed: int,
) -> Slits | None:
    """Slits that some regions are lit through; None where there are none.

    They are looked for beside ``edges`` [n, 2, 3]. Photons of regions of one of the groups ``lenders`` [K] are taken to
    get as much through them. ``cell`` is the solid angle of a cell of a table.

    What comes straight from a lamp tells of no slit, since lamps are small themselves. Through slits it counts as any
    light does: points on a lamp are drawn in vain where all but a strip of it is hidden.
    """
    through = photons.those(~photons.straight & (photons.rise > BRIGHTER))
    if not len(through.weight):
        return None
    middle = photons.position.mean(axis=0)
    size = float(np.ptp(photons.position, axis=0).max()) or 1.0
    some, lit, seen = (_Rays.of(lines, middle, size, len(lenders)) for lines in (through, photons, importons))
    width = float(np.sqrt(cell))
    found = _search(some, (edges - middle) / size, width, seed)
    ends = np.array([[size * slit.first + middle, size * slit.second + middle] for slit in found], np.float32)
    spread = np.array([size * slit.spread for slit in found], np.float32)
    if not found or not _can_be_seen(ends, spread):
        return None
    parts = np.array([[_part(slit, rays, lenders, width)[lenders] for slit in found] for rays in (lit, seen)])
    chances = parts.transpose(0, 2, 1)
    chances *= LARGEST_CHANCE / np.maximum(chances.sum(axis=-1, keepdims=True), LARGEST_CHANCE)
    return Slits(ends, spread, chances.astype(np.float32))


@dataclass(frozen=True)
class _Rays:
    """Lines in an order of their own, in units of the scene."""

    x: Doubles
    line: Doubles
    light: Doubles
    """Of a sum of 1; regions that many have met count alike."""
    region: NDArray[np.int64]
    straight: NDArray[np.bool_]

    @staticmethod
    def of(lines: Lines, middle: Doubles, size: float, regions: int) -> _Rays:
        # Particles come in no order.
        order = np.lexsort((lines.direction[:, 0], lines.position[:, 0], lines.weight))
        region, weight = lines.region[order], lines.weight[order]
        light = weight / np.maximum(np.bincount(region, weight, regions)[region], 1e-300)
        light *= np.minimum(1.0, np.bincount(region, minlength=regions)[region] / SURE)
        light /= max(float(light.sum()), 1e-300)
        return _Rays(
            (lines.position[order] - middle) / size, lines.direction[order], light, region, lines.straight[order]
        )


def _search(lit: _Rays, edges: Doubles, width: float, seed: int) -> list[Segment]:
    """Slits one after the other, each by the light that those before have not."""
    few = slice(None, None, -(-len(lit.light) // SEARCHED))
    x, line, left = lit.x[few], lit.line[few], lit.light[few]
    left = left / max(float(left.sum()), 1e-300)
    found: list[Segment] = []
    while len(found) < MOST:
        fits = beside(edges, x, line, left, width, np.random.default_rng([seed, len(found)]))
        best = max((fit.likelihood for fit in fits), default=0.0)
        if best < CERTAIN:
            break
        # Edges of the same gap.
        slit = min((fit for fit in fits if fit.likelihood >= ALIKE * best), key=lambda fit: fit.length)
        found.append(slit)
        passing = slit.passed_by(x, line)
        left = np.where(passing.within(slit.length) & (passing.miss < INSIDE * WIDER * slit.spread), 0.0, left)
    return found


def _part(slit: Segment, rays: _Rays, groups: NDArray[np.integer[Any]], width: float) -> Doubles:
    """Of what each of the ``groups`` gets, what comes through a slit, and again with what comes from beside it."""
    passing, group, count = slit.passed_by(rays.x, rays.line), groups[rays.region], int(groups.max()) + 1
    there = (passing.far > TINY) & (passing.along > 0.0) & (passing.along < slit.length)

    def each(values: Doubles | NDArray[np.bool_]) -> Doubles:
        return np.bincount(group, rays.light * values, count).astype(np.float64)

    both = np.zeros(count)
    for spread in (slit.spread, WIDER * slit.spread):
        inside = there & (passing.miss < INSIDE * spread)
        around = there & ~inside & (passing.miss < BAND * spread)
        # What else comes straight from a lamp is not to be found by directions.
        through, total = each(inside - INSIDE / (BAND - INSIDE) * around) / HELD, each(inside | ~rays.straight)
        far = each(inside * passing.far) / np.maximum(each(inside), 1e-300)
        part = np.clip(through / np.maximum(total, 1e-300), 0.0, 1.0)
        both += np.where(WIDEST * spread < width * far, part, 0.0)  # A table knows of what fills much of a cell.
    return both


def _can_be_seen(ends: Floats, spread: Floats) -> bool:
    """Whether all of it has a direction and a width, within the range of a float."""
    within = (np.abs(ends) < LARGEST).all() and (np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > 0.0).all()
    return bool(within and ((spread > 0.0) & (spread < LARGEST)).all())
