"""The first light vertex: which emitter, and where on it [thesis 5.2.1, 5.3.1].

Uniform, power and adjoint sampling are one mechanism: a table over the unit square that F maps to
the emitters. Its columns are a multiple of the emitters, so that no cell spans two of them. The
same density serves the start of light paths and next event estimation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.scene.emission import Emission, LightPoint

RESOLUTION = 1 << 23
"""Steps of a uniform float32 number. Cell probabilities are whole numbers of them, so that the
probability in the table is exactly the one with which the inversion method draws the cell."""


@dataclass
class Start:
    """A sampled light vertex."""

    point: LightPoint
    pdf: mi.Float  # Density over all emitters, area measure (discrete for a point light)
    cell: mi.UInt32  # Cell of the table it fell into


def quantized(weights: NDArray[np.float64]) -> NDArray[np.int64]:
    """Whole steps of :data:`RESOLUTION`, at least one each, proportional to ``weights`` [n].

    Raises:
        ValueError: more cells than steps.
    """
    n = len(weights)
    if n > RESOLUTION // 2:
        raise ValueError("too many cells for the resolution of a uniform number")
    total = weights.sum()
    share = weights / total if total > 0 else np.full(n, 1.0 / n)
    edges = np.round(np.concatenate([[0.0], np.cumsum(share)]) * (RESOLUTION - n)).astype(np.int64)
    edges[-1] = RESOLUTION - n
    return np.diff(edges) + 1


class StartDensity:
    """A piecewise constant density over F's unit square, drawn by the 2D inversion method.

    ``table`` [rows, columns] holds non-negative weights; ``columns`` is a multiple of the emitters.
    Every cell keeps a positive chance whatever the table says.
    """

    def __init__(self, emission: Emission, table: NDArray[np.floating[Any]]) -> None:
        rows, columns = table.shape
        if columns % emission.count:
            raise ValueError("columns must be a multiple of the emitters")
        self.emission = emission
        self.rows, self.columns = rows, columns
        self.per_emitter = columns // emission.count
        weights = np.maximum(np.nan_to_num(table.astype(np.float64), nan=0.0, posinf=0.0), 0.0)
        column_steps = quantized(weights.sum(axis=0))
        row_steps = np.stack([quantized(weights[:, c]) for c in range(columns)])  # [columns, rows]
        self._column_cdf = mi.Float((np.cumsum(column_steps) / RESOLUTION).astype(np.float32))
        self._row_cdf = mi.Float((np.cumsum(row_steps, axis=1) / RESOLUTION).astype(np.float32).ravel())
        self.probability = (column_steps[:, None] * row_steps).astype(np.float64) / RESOLUTION**2
        """Chance of each cell, [columns, rows]; sums to one."""
        # Per emitter's own unit square: chance of the cell over the cell's area in that square.
        density = self.probability * (rows * self.per_emitter)
        self._density = mi.Float(density.astype(np.float32).ravel())
        by_emitter = density.reshape(emission.count, -1)
        self.flat = bool(np.all(by_emitter.max(axis=1) <= by_emitter.min(axis=1) * (1 + 1e-4)))
        """Whether the density is constant on each emitter, so that F^-1 is not needed."""
        self._mean = mi.Float((by_emitter.mean(axis=1)).astype(np.float32))

    def sample(self, u_cell: mi.Point2f, u_point: mi.Point2f, wavelengths: mi.Spectrum, active: mi.Bool) -> Start:
        """Draw a light vertex: a cell with ``u_cell``, a point in it with ``u_point``."""
        column = _invert(self._column_cdf, mi.UInt32(0), self.columns, u_cell.x, active)
        if self.flat and self.rows == 1:
            row = mi.UInt32(0)
        else:
            row = _invert(self._row_cdf, column * self.rows, self.rows, u_cell.y, active)
        index = column // self.per_emitter
        inside = mi.Float(column - index * self.per_emitter)
        u = mi.Point2f((inside + u_point.x) / self.per_emitter, (mi.Float(row) + u_point.y) / self.rows)
        point = self.emission.point(index, u, wavelengths, active)
        cell = column * self.rows + row
        density = dr.gather(mi.Float, self._density, cell, active)
        return Start(point, density * point.pdf, cell)

    def pdf(
        self, emitter: mi.EmitterPtr, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[mi.Float, mi.UInt32, mi.UInt32]:
        """Density (area measure) with which :meth:`sample` would draw the surface point ``si``.

        Returns it with the emitter's index and the cell.
        """
        index = self.emission.index_of(emitter, active)
        area = self.emission.area_density(index, active)
        if self.flat:
            return dr.gather(mi.Float, self._mean, index, active) * area, index, index * self.per_emitter * self.rows
        u = self.emission.inverse(index, si, active)
        column = index * self.per_emitter + dr.minimum(mi.UInt32(u.x * self.per_emitter), self.per_emitter - 1)
        row = dr.minimum(mi.UInt32(u.y * self.rows), self.rows - 1)
        cell = column * self.rows + row
        return dr.gather(mi.Float, self._density, cell, active) * area, index, cell


def _invert(cdf: mi.Float, first: mi.UInt32, size: int, u: mi.Float, active: mi.Bool) -> mi.UInt32:
    """Index in [0, size) of the first entry of ``cdf[first : first + size]`` that exceeds ``u``."""
    return dr.binary_search(0, size - 1, lambda i: dr.gather(mi.Float, cdf, first + i, active) <= u)


def uniform_table(emission: Emission) -> NDArray[np.float64]:
    """Every emitter alike, points uniform by area."""
    return np.ones((1, emission.count))


def power_table(emission: Emission) -> NDArray[np.float64]:
    """Emitters by emitted flux, points uniform by area."""
    return emission.power[None, :].copy()
