"""F and its inverse for light from all around: a piecewise constant density over the directions.

Directions are (t, phi): t = 1 - cos(theta) from a pole, phi around it. Both carry solid angle
uniformly, dOmega = dt dphi, so that a cell's density per solid angle is its chance over its size.
Near the pole t keeps the precision that a cosine loses, which a sun at the zenith needs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.sampling.inversion import RESOLUTION, cumulative, interval, quantized
from elps_core.scene.sky import Grid, grid_of, luminance_at

Table = NDArray[np.float64]

UNIFORM_SHARE = 0.01
"""Share of the density that is uniform, so that light that the table's samples missed is drawn as well."""


@dataclass
class _Place:
    """Where a direction lies in the table."""

    t: mi.Float
    phi: mi.Float
    row: mi.UInt32
    column: mi.UInt32


class Environment:
    """The emitter around a scene; directions are unit vectors from the scene towards it.

    ``kind`` is the plugin's name, ``time`` the moment at which the scene is seen.
    """

    def __init__(self, emitter: Any, kind: str, time: float) -> None:
        grid = grid_of(emitter, kind, time)
        self._rows, self._columns = len(grid.t) - 1, len(grid.phi) - 1
        self._x, self._y, self._z = (mi.Vector3f(*map(float, axis)) for axis in grid.axes)
        dr.make_opaque(self._x, self._y, self._z)  # Data, not code: scenes share kernels.
        self._t, self._phi = on_device(mi.Float, grid.t), on_device(mi.Float, grid.phi)
        size = np.diff(grid.t.astype(np.float64))[:, None] * np.diff(grid.phi.astype(np.float64))
        light = self._measure(emitter, time, grid) * size
        self.mean = float(light.sum() / size.sum())
        """Mean luminance over all directions."""
        share = size / size.sum()
        if self.mean > 0.0:
            share = (1.0 - UNIFORM_SHARE) * light / light.sum() + UNIFORM_SHARE * share
        rows, columns = quantized(share.sum(axis=1)), quantized(share)
        self._row_cdf = on_device(mi.Float, cumulative(rows))
        self._column_cdf = on_device(mi.Float, cumulative(columns))
        density = rows[:, None].astype(np.float64) * columns / RESOLUTION**2 / size
        self._density = on_device(mi.Float, density)

    def sample(self, u: mi.Point2f, active: mi.Bool) -> tuple[mi.Vector3f, mi.Float]:
        """F: the direction at ``u``, and its density per solid angle."""
        row = interval(self._row_cdf, mi.UInt32(0), self._rows, u.y, active)
        first = row * (self._columns + 1)
        column = interval(self._column_cdf, first, self._columns, u.x, active)
        t = _across(u.y, self._row_cdf, row, self._t, row, active)
        phi = _across(u.x, self._column_cdf, first + column, self._phi, column, active)
        density = dr.gather(mi.Float, self._density, row * self._columns + column, active)
        return self._direction(t, phi), density

    def density(self, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Density of F at ``direction``, per solid angle."""
        place = self._place(direction, active)
        return dr.gather(mi.Float, self._density, place.row * self._columns + place.column, active)

    def inverse(self, direction: mi.Vector3f, active: mi.Bool) -> mi.Point2f:
        """F^-1: the u of a direction."""
        place = self._place(direction, active)
        first = place.row * (self._columns + 1) + place.column
        return mi.Point2f(
            _across(place.phi, self._phi, place.column, self._column_cdf, first, active),
            _across(place.t, self._t, place.row, self._row_cdf, place.row, active),
        )

    def _direction(self, t: mi.Float, phi: mi.Float) -> mi.Vector3f:
        sin, cos = dr.sincos(phi)
        radius = dr.safe_sqrt(t * (2.0 - t))
        return self._x * (radius * cos) + self._y * (radius * sin) + self._z * (1.0 - t)

    def _place(self, direction: mi.Vector3f, active: mi.Bool) -> _Place:
        x, y, z = (dr.dot(axis, direction) for axis in (self._x, self._y, self._z))
        t = dr.select(z > 0.0, dr.fma(x, x, y * y) / (1.0 + z), 1.0 - z)
        phi = dr.atan2(y, x)
        phi = dr.select(phi < 0.0, phi + dr.two_pi, phi)
        row = interval(self._t, mi.UInt32(0), self._rows, t, active)
        return _Place(t, phi, row, interval(self._phi, mi.UInt32(0), self._columns, phi, active))

    def _measure(self, emitter: Any, time: float, grid: Grid) -> Table:
        """Mean luminance of each cell [rows, columns], never below zero."""
        cells = self._rows * self._columns
        row = dr.arange(mi.UInt32, cells) // self._columns
        column = dr.arange(mi.UInt32, cells) - row * self._columns
        t0, t1 = dr.gather(mi.Float, self._t, row), dr.gather(mi.Float, self._t, row + 1)
        phi0, phi1 = dr.gather(mi.Float, self._phi, column), dr.gather(mi.Float, self._phi, column + 1)
        total = dr.zeros(mi.Float, cells)
        dr.make_opaque(total)  # The first point, too
        points = grid.samples**2
        for k in range(points):
            # Opaque, so that all points share one kernel.
            inside = [(k % grid.samples + 0.5) / grid.samples, (k // grid.samples + 0.5) / grid.samples]
            a, b, u = (dr.opaque(mi.Float, x) for x in (*inside, (k + 0.5) / points))
            direction = self._direction(dr.lerp(t0, t1, a), dr.lerp(phi0, phi1, b))
            total = total + dr.maximum(luminance_at(emitter, direction, time, u), 0.0)
            dr.eval(total)
        mean = np.array(total, np.float64).reshape(self._rows, self._columns) / points
        return np.asarray(np.nan_to_num(mean, nan=0.0, posinf=0.0))


def _across(x: mi.Float, edges: mi.Float, i: mi.UInt32, others: mi.Float, j: mi.UInt32, active: mi.Bool) -> mi.Float:
    """``x`` from the interval after ``edges[i]`` carried over linearly to the one after ``others[j]``."""
    low, high = dr.gather(mi.Float, edges, i, active), dr.gather(mi.Float, edges, i + 1, active)
    start, end = dr.gather(mi.Float, others, j, active), dr.gather(mi.Float, others, j + 1, active)
    return dr.lerp(start, end, dr.clip((x - low) / (high - low), 0.0, 1.0))
