"""Where and what together: the field of incident light (or importance) as a density of directions.

Directions are drawn by inversion, rows first and then columns, so that a small step of the random
numbers is a small step of the direction, as mutations want it. What is drawn and what is evaluated
are the same whole numbers: whatever a table says, the density is exact.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.context.directional import BELOW_ONE, EqualAreaMap
from elps_core.context.encoding import DirectionalTables
from elps_core.context.lookup import RegionLookup
from elps_core.errors import ContextMismatch

STEPS = 1 << 16
"""Probabilities are whole numbers of 1 / STEPS, at least one each. A uniform float32 number has 2^23 values, so at
least 128 of them fall into each cell and place the direction inside it."""
MOST_CELLS = 1 << 10
"""Rows or columns of a table, at most: the least probability of each then takes 1.6 % of the whole."""
PACKET = 8
"""Numbers of 16 bits that are read at once."""
_WORDS = PACKET // 2
_HALF_VALUE = STEPS / (1 << 24)
"""Half the distance of two uniform numbers, in steps: keeps drawn points off the edges of cells."""
_LARGEST = 1e30
"""Weights beyond it are cut, so that sums of them stay finite."""


class PackedInversion:
    """Many piecewise constant densities on [0, 1), of ``size`` cells of equal width each.

    Cumulated probabilities in 16 bits, two to a word, under a sparser and sparser index of every
    eighth: a search reads one packet of eight on each level, two for 64 cells. In a kernel that does
    nothing else, a direction takes 7 to 22 ns by it, 13 to 70 ns by binary search and 4 to 17 ns by alias
    tables; in a guided path tracer alias tables were no faster, and small steps become large ones in them.

    ``weight`` maps indices density * size + cell to weights; what is not positive and finite is
    nothing, and a density without any weight is uniform.
    """

    def __init__(self, weight: Callable[[mi.UInt32], mi.Float], count: int, size: int) -> None:
        if not 1 <= size <= MOST_CELLS:
            raise ValueError(f"a table has 1 to {MOST_CELLS} rows and columns")
        self.size = size
        self.total, edges = _packed_edges(weight, count, size)
        self._levels = [edges]  # Of lower edges: all, every eighth, every 64th ...
        self._sizes = [size]
        while self._sizes[-1] > PACKET:
            self._levels.append(_every_eighth(self._levels[-1], self._sizes[-1], count))
            self._sizes.append(_packets(self._sizes[-1]))
        dr.eval(self._levels)

    @property
    def nbytes(self) -> int:
        """Bytes of device memory."""
        return 4 * int(sum(dr.width(level) for level in self._levels) + dr.width(self.total))

    def sample(self, density: mi.UInt32, u: mi.Float, active: mi.Bool | bool) -> tuple[mi.UInt32, mi.Float]:
        """The cell that holds ``u`` of the cumulated density, and where in it, in [0, 1)."""
        scaled = u * STEPS
        step = dr.minimum(mi.UInt32(scaled), STEPS - 1)
        cell, low, high = mi.UInt32(0), mi.UInt32(0), mi.UInt32(STEPS)
        for edges, size in zip(reversed(self._levels), reversed(self._sizes), strict=True):
            words = dr.gather(mi.Vector4u, edges, density * _packets(size) + cell, active)
            inside = mi.UInt32(0)
            for word in words:
                for edge in (word & 0xFFFF, word >> 16):
                    below = edge <= step
                    inside = inside + dr.select(below, mi.UInt32(1), mi.UInt32(0))
                    low = dr.maximum(low, dr.select(below, edge, 0))
                    high = dr.minimum(high, dr.select(below, STEPS, edge))
            cell = dr.minimum(cell * PACKET + inside - 1, size - 1)
        inside = (scaled - mi.Float(low) + _HALF_VALUE) / mi.Float(high - low)
        return cell, dr.clip(inside, 0.0, BELOW_ONE)

    def steps(self, density: mi.UInt32, cell: mi.UInt32, active: mi.Bool | bool) -> mi.UInt32:
        """Probability of a cell, as a multiple of 1 / :data:`STEPS`."""
        words = _packets(self.size) * _WORDS

        def edge(index: mi.UInt32, active: mi.Bool) -> mi.UInt32:
            word = dr.gather(mi.UInt32, self._levels[0], density * words + (index >> 1), active)
            return (word >> ((index & 1) << 4)) & 0xFFFF

        inner = cell < self.size - 1
        return dr.select(inner, edge(cell + 1, inner & active), STEPS) - edge(cell, mi.Bool(active))


class DirectionalField:
    """Incident radiance (or importance) times cosine in every region, for samplers to ask.

    Regions are numbers as :attr:`region` finds them. Densities cover the whole sphere: directions
    below the surface are the caller's to drop. Every direction of every region has a positive one.
    """

    def __init__(self, region: RegionLookup | None, tables: DirectionalTables) -> None:
        count, rows, columns = tables.shape
        if region and count != region.count:
            raise ContextMismatch("the context's tables belong to other regions: build it again")
        self.region = region
        """Region of a point with a normal, in kernels; None where a region is something else."""
        self.map = EqualAreaMap(rows, columns)
        self._columns = PackedInversion(_decoder(tables), count * rows, columns)
        self._rows = PackedInversion(lambda index: dr.gather(mi.Float, self._columns.total, index), count, rows)
        self._irradiance = on_device(mi.Float, tables.irradiance)
        self._evidence = on_device(mi.UInt32, tables.evidence)

    def sample(self, region: mi.UInt32, u: mi.Point2f, active: mi.Bool | bool = True) -> tuple[mi.Vector3f, mi.Float]:
        """A direction, as a unit vector in world space, and its density per solid angle.

        The density is that of :meth:`pdf` for this very vector; what is not used costs nothing.
        """
        row, v = self._rows.sample(region, u.y, active)
        column, h = self._columns.sample(region * self.map.rows + row, u.x, active)
        direction = self.map.direction(row, column, mi.Point2f(h, v))
        return direction, self.pdf(region, direction, active)

    def pdf(self, region: mi.UInt32, direction: mi.Vector3f, active: mi.Bool | bool = True) -> mi.Float:
        """Density per solid angle with which :meth:`sample` draws the unit vector ``direction``."""
        row, column, _ = self.map.locate(direction)
        in_row = self._rows.steps(region, row, active)
        in_column = self._columns.steps(region * self.map.rows + row, column, active)
        scale = self.map.cells / (4.0 * np.pi * STEPS**2)
        return dr.select(active, mi.Float(in_row) * mi.Float(in_column) * scale, 0.0)

    def irradiance(self, region: mi.UInt32, active: mi.Bool | bool = True) -> mi.Float:
        """Radiance (or importance) times cosine over all directions; times :meth:`pdf` it is that of one direction."""
        return dr.gather(mi.Float, self._irradiance, region, active)

    def evidence(self, region: mi.UInt32, active: mi.Bool | bool = True) -> mi.UInt32:
        """Number of records other than zero that the region's table rests on."""
        return dr.gather(mi.UInt32, self._evidence, region, active)

    def probabilities(self, region: int) -> NDArray[np.float64]:
        """Exact chance [rows, columns] of every cell of one region's table, as it is sampled."""
        row = dr.repeat(dr.arange(mi.UInt32, self.map.rows), self.map.columns)
        column = dr.tile(dr.arange(mi.UInt32, self.map.columns), self.map.rows)
        which = dr.opaque(mi.UInt32, region)
        in_row = self._rows.steps(which, row, True)
        in_column = self._columns.steps(which * self.map.rows + row, column, True)
        chance = np.array(in_row, np.float64) * np.array(in_column, np.float64) / STEPS**2
        return np.asarray(chance.reshape(self.map.rows, self.map.columns))

    @property
    def nbytes(self) -> int:
        """Bytes of device memory of the tables, the regions' own apart."""
        return self._rows.nbytes + self._columns.nbytes + 8 * int(dr.width(self._irradiance))


def _decoder(tables: DirectionalTables) -> Callable[[mi.UInt32], mi.Float]:
    """The value of a cell, by its index, from the tables as they are stored."""
    stored = np.ascontiguousarray(tables.values).reshape(-1)
    cells = int(np.prod(tables.shape[1:]))
    if tables.encoding == "float32":
        values = on_device(mi.Float, stored)
        return lambda index: dr.gather(mi.Float, values, index)
    if tables.encoding == "float16":  # The factor is the same for a whole table, and normalised away
        halves = on_device(mi.Float16, stored)
        return lambda index: mi.Float(dr.gather(mi.Float16, halves, index))
    codes = on_device(mi.UInt8, stored)
    step = on_device(mi.Float, tables.scale[:, 1])

    def decode(index: mi.UInt32) -> mi.Float:
        code = mi.Float(dr.gather(mi.UInt8, codes, index))
        octaves = dr.gather(mi.Float, step, index // cells) * (code - 1.0)  # The first value is normalised away
        return dr.select(code > 0.0, dr.exp2(octaves), 0.0)

    return decode


def _packets(size: int) -> int:
    return -(-size // PACKET)


def _packed_edges(weight: Callable[[mi.UInt32], mi.Float], count: int, size: int) -> tuple[mi.Float, mi.UInt32]:
    """Sums of weights [count], and lower edges of all cells in steps, two to a word, padded to whole packets."""

    def clean(index: mi.UInt32, inside: mi.Bool | bool) -> mi.Float:
        value = weight(dr.select(inside, index, 0))
        return dr.select(inside & (value > 0.0), dr.minimum(value, _LARGEST), 0.0)

    words = _packets(size) * _WORDS
    density = dr.arange(mi.UInt32, count)
    first = density * size
    _, total = dr.while_loop(
        (mi.UInt32(0), dr.zeros(mi.Float, count)),
        lambda cell, _: cell < size,
        lambda cell, so_far: (cell + 1, so_far + clean(first + cell, True)),
        label="sum of a density",
    )
    edges = dr.empty(mi.UInt32, count * words)
    some = total > 1.0 / _LARGEST
    scale = dr.select(some, (STEPS - size) / dr.select(some, total, 1.0), 0.0)
    even = dr.select(some, 0.0, (STEPS - size) / size)

    def write(word: mi.UInt32, so_far: mi.Float, last: mi.UInt32) -> tuple[mi.UInt32, mi.Float, mi.UInt32]:
        pair = []
        for cell in (2 * word, 2 * word + 1):
            edge = mi.UInt32(so_far * scale + mi.Float(cell) * even + 0.5) + cell
            last = dr.select(cell < size, edge, last)  # Padding repeats the last edge, which changes no search
            so_far = so_far + clean(first + cell, cell < size)
            pair.append(last)
        dr.scatter(edges, pair[0] | (pair[1] << 16), density * words + word)
        return word + 1, so_far, last

    start = (mi.UInt32(0), dr.zeros(mi.Float, count), dr.zeros(mi.UInt32, count))
    dr.while_loop(start, lambda word, *_: word < words, write, label="edges of a density")
    dr.eval(total, edges)
    return total, edges


def _every_eighth(edges: mi.UInt32, size: int, count: int) -> mi.UInt32:
    """The first edge of each packet of ``edges``, packed and padded alike."""
    packets, words = _packets(size), _packets(_packets(size)) * _WORDS
    index = dr.arange(mi.UInt32, count * words)
    density, word = index // words, index % words

    def first(packet: mi.UInt32) -> mi.UInt32:
        packet = dr.minimum(packet, packets - 1)
        return dr.gather(mi.UInt32, edges, (density * packets + packet) * _WORDS) & 0xFFFF

    return first(2 * word) | (first(2 * word + 1) << 16)
