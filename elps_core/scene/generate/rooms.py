"""Rooms seen from inside: walls with doorways, the passages through them, tiled floors.

All surfaces face into the rooms and are one-sided: what leaves through the hairline between two
triangles ends on the black back of the next room, so that light passes by doorways only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from elps_core.scene.generate.mesh import Mesh, merged, quad


@dataclass(frozen=True)
class Opening:
    """A doorway in a wall: from ``start`` to ``end`` along the wall's axis (x or y), ``top`` above the floor."""

    start: float
    end: float
    top: float


@dataclass(frozen=True)
class Room:
    """The inside of a box: the floor's corners (x, y), and the height of the ceiling; the floor is at z = 0."""

    low: tuple[float, float]
    high: tuple[float, float]
    height: float

    @property
    def center(self) -> tuple[float, float]:
        """The middle of the floor."""
        return (self.low[0] + self.high[0]) / 2, (self.low[1] + self.high[1]) / 2

    def wall(self, side: str, opening: Opening | None = None) -> Mesh:
        """The wall at the ``south`` (low y), ``north``, ``west`` (low x) or ``east``, facing inwards."""
        (x0, y0), (x1, y1) = self.low, self.high
        corner, direction, axis = {
            "south": ((x1, y0), -1.0, 0),
            "north": ((x0, y1), 1.0, 0),
            "west": ((x0, y0), 1.0, 1),
            "east": ((x1, y1), -1.0, 1),
        }[side]
        length = self.high[axis] - self.low[axis]

        def part(start: float, end: float, bottom: float) -> Mesh:
            # Absolute coordinates along the axis, so that touching parts share them exactly.
            first, last = (start, end) if direction > 0 else (end, start)
            origin = np.array([*corner, bottom])
            origin[axis] = first
            along = np.zeros(3)
            along[axis] = last - first
            return quad(origin, along, (0.0, 0.0, self.height - bottom))

        low = self.low[axis]
        if opening is None:
            return part(low, low + length, 0.0)
        return merged(
            part(low, opening.start, 0.0),
            part(opening.end, low + length, 0.0),
            part(opening.start, opening.end, opening.top),
        )

    def ceiling(self) -> Mesh:
        """The ceiling, facing down."""
        width, depth = self.high[0] - self.low[0], self.high[1] - self.low[1]
        return quad((*self.low, self.height), (0.0, depth, 0.0), (width, 0.0, 0.0))

    def tiles(self, columns: int, rows: int) -> tuple[Mesh, Mesh]:
        """The floor as a chequered pattern: the dark and the light tiles."""
        xs = np.linspace(self.low[0], self.high[0], columns + 1)
        ys = np.linspace(self.low[1], self.high[1], rows + 1)
        groups: tuple[list[Mesh], list[Mesh]] = ([], [])
        for i in range(columns):
            for j in range(rows):
                tile = quad((xs[i], ys[j], 0.0), (xs[i + 1] - xs[i], 0.0, 0.0), (0.0, ys[j + 1] - ys[j], 0.0))
                groups[(i + j) % 2].append(tile)
        return merged(*groups[0]), merged(*groups[1])


def passage(origin: ArrayLike, along: ArrayLike, through: ArrayLike, top: float) -> Mesh:
    """Sides, lintel and threshold of a doorway: the footprint ``origin`` + ``along`` x ``through`` up to ``top``.

    ``along`` lies in the wall, ``through`` crosses it, and ``along`` x ``through`` points up.
    """
    p, a, t = (np.asarray(vector, dtype=np.float64) for vector in (origin, along, through))
    up = np.array([0.0, 0.0, top])
    return merged(quad(p, t, up), quad(p + a + t, -t, up), quad(p + up, t, a), quad(p, a, t))
