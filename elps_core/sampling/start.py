"""The first light vertex: which emitter, and where on it [thesis 5.2.1, 5.3.1].

Uniform, power and adjoint sampling are one mechanism: a table over the unit square that F maps to
the emitters. Its columns are a multiple of the emitters, so that no cell spans two of them. The
same density serves the start of light paths and next event estimation.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.sampling.departures import Departures
from elps_core.sampling.inversion import RESOLUTION, cumulative, drawn, quantized
from elps_core.scene.emission import Emission, LightPoint
from elps_core.scene.emitters import MANY


@dataclass
class Start:
    """A sampled light vertex."""

    point: LightPoint
    pdf: mi.Float  # Density over all emitters, in the point's own measure: see LightPoint
    cell: mi.UInt32  # Cell of the table it fell into


class StartDensity:
    """A piecewise constant density over F's unit square, drawn by the 2D inversion method.

    ``table`` [rows, columns] holds non-negative weights; ``columns`` is a multiple of the emitters.
    Every cell keeps a positive chance whatever the table says. Which cell an eye path has met is told where the density
    asks for it, or the caller does by ``cells``; else some cell of the emitter stands for all of them.
    """

    def __init__(self, emission: Emission, table: NDArray[np.floating[Any]], *, cells: bool = False) -> None:
        rows, columns = table.shape
        if columns % emission.count:
            raise ValueError("columns must be a multiple of the emitters")
        self.emission = emission
        self.rows, self.columns = rows, columns
        self.per_emitter = columns // emission.count
        # Of many emitters the size of the table is data, not code: see MANY.
        self.many = emission.count > MANY
        self._rows = dr.opaque(mi.UInt32, rows) if self.many else rows
        self._columns = dr.opaque(mi.UInt32, columns) if self.many else columns
        self._count = dr.opaque(mi.UInt32, emission.count) if self.many else mi.UInt32(emission.count)
        weights = np.maximum(np.nan_to_num(table.astype(np.float64), nan=0.0, posinf=0.0), 0.0)
        column_steps = quantized(weights.sum(axis=0))
        row_steps = quantized(np.ascontiguousarray(weights.T))  # [columns, rows]
        self._column_cdf = on_device(mi.Float, cumulative(column_steps))
        self._column_steps = column_steps
        self._row_cdf = on_device(mi.Float, cumulative(row_steps))
        self.probability = (column_steps[:, None] * row_steps).astype(np.float64) / RESOLUTION**2
        """Chance of each cell, [columns, rows]; sums to one."""
        # Per emitter's own unit square: chance of the cell over the cell's area in that square.
        density = self.probability * (rows * self.per_emitter)
        self._density = on_device(mi.Float, density)
        by_emitter = density.reshape(emission.count, -1)
        even = bool(np.all(by_emitter.max(axis=1) <= by_emitter.min(axis=1) * (1 + 1e-4)))
        self.flat = even and not cells
        """Whether the density is constant on each emitter, and F^-1 is not needed."""
        self._mean = on_device(mi.Float, by_emitter.mean(axis=1))
        self._departures: Departures | None = None

    def departing(self, departures: Departures) -> StartDensity:
        """The same points, and first directions by ``departures``."""
        other = copy(self)
        other._departures = departures
        return other

    def of_emitters(self) -> StartDensity:
        """The same chance of each emitter, with its points as F draws them.

        The part of a lamp that lights most of the image is not the part that lights a given point: next event
        estimation by cells had up to a third more variance (a door ajar, a classroom) and nowhere less.
        """
        return (
            self
            if self.flat and self.rows == 1
            else StartDensity(self.emission, self.steps()[None, :].astype(np.float64))
        )

    def sample(
        self,
        u_cell: mi.Point2f,
        u_point: mi.Point2f,
        wavelengths: mi.Spectrum,
        active: mi.Bool,
        given: mi.UInt32 | None = None,
        u_given: mi.Point2f | None = None,
    ) -> Start:
        """Draw a light vertex: a cell with ``u_cell``, a point in it with ``u_point``.

        Where an emitter is ``given`` (less than the emitters there are), its point at ``u_given`` is taken
        instead, with the density that drawing it would have had.
        """
        column, x = drawn(self._column_cdf, mi.UInt32(0), self._columns, u_cell.x, u_point.x, active)
        if self.flat and self.rows == 1 and not self.many:
            row, y = mi.UInt32(0), u_cell.y
        else:
            row, y = drawn(self._row_cdf, column * (self._rows + 1), self._rows, u_cell.y, u_point.y, active)
        index = column // self.per_emitter
        inside = mi.Float(column - index * self.per_emitter)
        u = mi.Point2f((inside + x) / self.per_emitter, (mi.Float(row) + y) / mi.Float(self._rows))
        cell = column * self._rows + row
        if given is not None and u_given is not None:
            chosen = given < self._count
            index, u = dr.select(chosen, given, index), dr.select(chosen, u_given, u)
            cell = dr.select(chosen, self.cell(given, u_given), cell)
        point = self.emission.point(index, u, wavelengths, active)
        density = dr.gather(mi.Float, self._density, cell, active)
        return Start(point, density * point.pdf, cell)

    def pdf(
        self, emitter: mi.EmitterPtr, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[mi.Float, mi.UInt32, mi.UInt32]:
        """Density with which :meth:`sample` would draw the point of ``emitter`` that a ray met.

        ``si`` is the surface point, measure area; or, where it is not valid, what a ray has left
        behind that left the scene: ``si.wi`` is minus its direction in world space, measure solid
        angle. Returns the density with the emitter's index and the cell.
        """
        index = self.emission.index_of(emitter, active)
        pdf = self.emission.density(index, si, active)
        if self.flat:
            return dr.gather(mi.Float, self._mean, index, active) * pdf, index, index * self.per_emitter * self._rows
        u = self.emission.inverse(index, si, active)
        cell = self.cell(index, u)
        return dr.gather(mi.Float, self._density, cell, active) * pdf, index, cell

    def first_ray(self, start: Start, u: mi.Point2f, active: mi.Bool) -> mi.Ray3f:
        """The first ray of a light path from ``start``; density by :meth:`pdf_direction`."""
        point = start.point
        if self._departures is None:
            return self.emission.first_ray(point, u, active)
        from_surface = active & ~(point.delta | point.infinite)
        by_table, direction, u = self._departures.choose(start.cell, u, from_surface)
        ray = self.emission.first_ray(point, u, active)
        ray.d = dr.select(by_table, direction, ray.d)
        ray.o = dr.select(by_table, self.emission.rays.leaving.off(point.si, direction), ray.o)
        return ray

    def pdf_direction(
        self,
        index: mi.UInt32,
        cell: mi.UInt32,
        p: mi.Point3f,
        direction: mi.Vector3f,
        cosine: mi.Float,
        active: mi.Bool,
        *,
        delta: mi.Bool,
        infinite: mi.Bool,
    ) -> mi.Float:
        """Density of :meth:`first_ray` given its point ``p`` in ``cell``; measure, ``cosine``: as of the emission."""
        emission = self.emission
        pdf = emission.pdf_direction(index, p, direction, cosine, active, delta=delta, infinite=infinite)
        if self._departures is None:
            return pdf
        return self._departures.mixed(pdf, cell, direction, active & ~(delta | infinite))

    def cell(self, index: mi.UInt32, u: mi.Point2f) -> mi.UInt32:
        """The cell of emitter ``index`` that holds the point of its unit square."""
        column = index * self.per_emitter + dr.minimum(mi.UInt32(u.x * self.per_emitter), self.per_emitter - 1)
        return column * self._rows + dr.minimum(mi.UInt32(u.y * mi.Float(self._rows)), self._rows - 1)

    def steps(self) -> NDArray[np.int64]:
        """Chance of each emitter [count] in steps of :data:`RESOLUTION`."""
        return np.asarray(self._column_steps.reshape(self.emission.count, -1).sum(axis=1))

    def density(self, cell: mi.UInt32, active: mi.Bool) -> mi.Float:
        """Density over its emitter's unit square, over all emitters, in a cell."""
        return dr.gather(mi.Float, self._density, cell, active)

    @property
    def nowhere(self) -> mi.UInt32:
        """An index that is no emitter's."""
        return self._count


def uniform_table(emission: Emission) -> NDArray[np.float64]:
    """Every emitter alike, points as F draws them: uniform by area, the sky by its radiance."""
    return np.ones((1, emission.count))


def power_table(emission: Emission) -> NDArray[np.float64]:
    """Emitters by emitted flux, points as F draws them: uniform by area, the sky by its radiance."""
    return emission.power[None, :].copy()
