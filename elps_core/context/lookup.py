"""Which region a point is in: a table, made on the host and read in kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.context.nearest import PointSet
from elps_core.context.regions import BINS, SIDE_BITS, Floats, Regions, Table
from elps_core.particles.records import Particles

VOXELS = 400_000
"""Voxels of a table, at most; with six bins of 16 bits, 4.6 MiB. Indoors a table of equal voxels needs
550,000 to be as good. Where a house stands on a wide plain, equal voxels lose most of the regions."""
VOXELS_PER_REGION = 200
"""Voxels of a table of few regions; more would hardly be exacter."""
VOXELS_PER_BRICK = 25
"""Voxels of a brick on average. More make bricks so large that empty space gets what a surface beside it
needs; fewer leave too little to give, once every brick has its least."""
LEAST_SIDE = 2
"""Voxels along a brick without region centres: surfaces may pass there that no particle has found."""
MAX_SIDE = (1 << SIDE_BITS) - 1
OFF = 1e-4
"""How far from a surface a ray begins, over its distance from the origin and 1: as far as Mitsuba's own or farther."""
SEARCH_STEPS = 60
"""Halvings of the interval in which a scale is sought: more digits than a float has."""


def table_of(centres: Floats, normals: Floats, alpha: float, low: Floats, high: Floats) -> Table:
    """The table over a box, which may be flat, that finds the nearest centre by (5.16).

    It is exact at the middle of each voxel for normals along an axis. On surfaces that hold m
    centres to a brick those are about 1 / sqrt(m) apart, so a brick has sqrt(m) times as many
    voxels along each side as one with a single centre has.
    """
    voxels = min(VOXELS, VOXELS_PER_REGION * len(centres))
    corner, brick, shape = _grid(low.astype(np.float64), high.astype(np.float64), voxels // VOXELS_PER_BRICK)
    place = np.clip(np.floor((centres - corner) / brick), 0, shape - 1).astype(np.int64)
    number = np.ravel_multi_index(tuple(place.T[::-1]), tuple(shape[::-1]))
    held = np.sqrt(np.bincount(number, minlength=int(shape.prod())))

    def sides(scale: float) -> NDArray[np.int64]:
        return np.clip(np.rint(scale * held), LEAST_SIDE, MAX_SIDE).astype(np.int64)

    side = sides(_largest(lambda scale: int((sides(scale) ** 3).sum()) <= voxels, float(MAX_SIDE)))
    end = np.cumsum(side**3)
    middles = np.empty((end[-1], 3), np.float32)
    corners = corner + brick * np.stack(np.unravel_index(np.arange(len(side)), shape[::-1])[::-1], axis=1)
    for n in np.unique(side):
        voxel = np.stack(np.unravel_index(np.arange(n**3), (n, n, n))[::-1], axis=1)
        (chosen,) = np.nonzero(side == n)
        cells = (end[chosen] - n**3)[:, None] + np.arange(n**3)
        middles[cells] = corners[chosen][:, None] + (voxel + 0.5) * (brick / n)
    words = ((end - side**3) << SIDE_BITS | side).astype(np.uint32)
    x, y, z = corner.tolist()
    return Table((x, y, z), brick, words.reshape(shape[::-1]), _nearest(middles, centres, normals, alpha))


def _nearest(middles: Floats, centres: Floats, normals: Floats, alpha: float) -> NDArray[np.uint16]:
    cells = np.empty((BINS, len(middles)), np.uint16)
    points = PointSet(middles, np.zeros_like(middles), alpha)
    for bin_ in range(BINS):
        normal = np.zeros(3, np.float32)
        normal[bin_ // 2] = 1 - 2 * (bin_ % 2)
        cells[bin_, points.order] = points.facing(normal).nearest(centres, normals)[0]
    return cells


def _grid(
    low: NDArray[np.float64], high: NDArray[np.float64], bricks: int
) -> tuple[NDArray[np.float64], float, NDArray[np.int64]]:
    """Corner, brick and shape (x, y, z) of the finest grid of at most ``bricks`` that covers the box.

    Where the box is flat the grid is one brick thick, with the box in its middle.
    """
    size = high - low
    longest = float(size.max()) or 1.0

    def shape(fineness: float) -> NDArray[np.int64]:
        return np.maximum(np.ceil(size * (fineness / longest) - 1e-6), 1).astype(np.int64)

    fineness = _largest(lambda fineness: int(shape(fineness).prod()) <= bricks, float(bricks))
    brick = longest / fineness
    return (low + high - shape(fineness) * brick) / 2, brick, shape(fineness)


def _largest(fits: Callable[[float], bool], limit: float) -> float:
    """The largest number in [0, ``limit``] that fits, where all smaller ones fit too."""
    low, high = 0.0, limit
    for _ in range(SEARCH_STEPS):
        middle = (low + high) / 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


class RegionLookup:
    """The table of :class:`Regions` in kernels: two reads a query."""

    def __init__(self, regions: Regions) -> None:
        table = regions.table
        self.count = regions.count
        self._bricks = on_device(mi.UInt32, table.bricks)
        # Two regions to a word: kernels have no 16-bit integers.
        pairs = np.zeros(table.cells.size + 1 & ~1, np.uint16)
        pairs[: table.cells.size] = table.cells.ravel()
        self._pairs = on_device(mi.UInt32, pairs.view(np.uint32))
        # Opaque, so that kernels are not compiled anew for another scene.
        self._low = dr.opaque(mi.Point3f, table.low)
        self._scale = dr.opaque(mi.Float, 1.0 / table.brick)
        self._shape = dr.opaque(mi.Vector3i, table.bricks.shape[::-1])
        self._voxels = dr.opaque(mi.Int32, table.cells.shape[1])

    def __call__(self, p: mi.Point3f, n: mi.Vector3f, active: Any = True) -> mi.UInt32:
        """Region of the surface point ``p`` with normal ``n``; 0 where not ``active``.

        Points outside the table's box take the voxel next to them.
        """
        place = (p - self._low) * self._scale
        # Clipped as integers: whatever becomes of a number that is not finite, the index is in range.
        brick = dr.clip(mi.Vector3i(dr.floor(place)), 0, self._shape - 1)
        number = (brick.z * self._shape.y + brick.y) * self._shape.x + brick.x
        word = dr.gather(mi.UInt32, self._bricks, mi.UInt32(number), active)
        side = mi.Int32(word & MAX_SIDE)
        voxel = dr.clip(mi.Vector3i((place - mi.Point3f(brick)) * mi.Float(side)), 0, side - 1)
        index = mi.Int32(word >> SIDE_BITS) + (voxel.z * side + voxel.y) * side + voxel.x
        cell = mi.UInt32(_bin(n) * self._voxels + index)
        pair = dr.gather(mi.UInt32, self._pairs, cell >> 1, active)
        return pair >> ((cell & 1) << 4) & 0xFFFF

    def at(self, si: mi.SurfaceInteraction3f, wi: mi.Vector3f, active: mi.Bool) -> mi.UInt32:
        """Region of a surface point, by the side of the surface that ``wi`` (local) is on."""
        return self(si.p, dr.mulsign(mi.Vector3f(si.sh_frame.n), mi.Frame3f.cos_theta(wi)), active)

    def back(self, particles: Particles) -> tuple[mi.UInt32, mi.Ray3f]:
        """Region of each particle, and the ray back to where it came from."""
        side = mi.Vector3f(particles.normal) * dr.sign(dr.dot(particles.normal, particles.direction))
        # Off the surface, as far as rays are kept from it.
        origin = particles.position + OFF * (1.0 + dr.max(dr.abs(particles.position))) * side
        return self(particles.position, side), mi.Ray3f(origin, particles.direction)


def _bin(n: mi.Vector3f) -> mi.Int32:
    """The axis next to ``n``, of equals the first, and its sign."""
    size = dr.abs(n)
    along_x, along_y = (size.x >= size.y) & (size.x >= size.z), size.y >= size.z
    component = dr.select(along_x, n.x, dr.select(along_y, n.y, n.z))
    axis = dr.select(along_x, mi.Int32(0), dr.select(along_y, mi.Int32(1), mi.Int32(2)))
    return 2 * axis + dr.select(component < 0.0, mi.Int32(1), mi.Int32(0))
