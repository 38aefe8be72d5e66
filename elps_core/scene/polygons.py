"""Cut polygons into triangles. Imports no Mitsuba."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Triangle = tuple[int, int, int]


def triangles(corners: NDArray[np.float64]) -> list[Triangle]:
    """Triangles of one polygon, as numbers of its corners, turning as it does.

    A fan from the first corner where the polygon is convex, else ears are cut off one by one. What crosses itself, or
    has no area, is cut somehow.

    Args:
        corners: positions in order, [n, 3], n of 3 or more.
    """
    count = len(corners)
    fan = [(0, k, k + 1) for k in range(1, count - 1)]
    if count == 3:
        return fan
    following = np.roll(corners, -1, axis=0)
    normal = np.cross(corners, following).sum(axis=0)  # Newell's
    length = float(np.linalg.norm(normal))
    if not np.isfinite(length) or length == 0.0:
        return fan
    flat = _projected(corners, normal / length)
    turns = _turns(flat, list(range(count)))
    return fan if min(turns) >= 0.0 else _ears(flat)


def _projected(corners: NDArray[np.float64], normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """The corners in a plane that sees the polygon turn left, [n, 2]."""
    x = np.cross(normal, np.eye(3)[int(np.abs(normal).argmin())])
    x /= np.linalg.norm(x)
    return np.stack([corners @ x, corners @ np.cross(normal, x)], axis=-1)


def _turn(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]) -> float:
    """Twice the area of a triangle; negative where it turns right."""
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def _turns(flat: NDArray[np.float64], ring: Sequence[int]) -> list[float]:
    return [_turn(flat[ring[k - 1]], flat[ring[k]], flat[ring[(k + 1) % len(ring)]]) for k in range(len(ring))]


def _ears(flat: NDArray[np.float64]) -> list[Triangle]:
    ring, found = list(range(len(flat))), []
    while len(ring) > 3:
        turns = _turns(flat, ring)
        ears = [k for k, turn in enumerate(turns) if turn > 0.0 and not _holds_another(flat, ring, k)]
        cut = ears[0] if ears else int(np.argmax(turns))
        found.append((ring[cut - 1], ring[cut], ring[(cut + 1) % len(ring)]))
        del ring[cut]
    return [*found, (ring[0], ring[1], ring[2])]


def _holds_another(flat: NDArray[np.float64], ring: Sequence[int], k: int) -> bool:
    """Whether another corner lies in the triangle that would be cut off at ``ring[k]``."""
    ends = ring[k - 1], ring[k], ring[(k + 1) % len(ring)]
    a, b, c = (flat[end] for end in ends)
    return any(
        _turn(a, b, p) >= 0.0 and _turn(b, c, p) >= 0.0 and _turn(c, a, p) >= 0.0
        for p in (flat[other] for other in ring if other not in ends)
    )
