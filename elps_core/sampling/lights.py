"""Next event estimation by region: which light to ask for, as seen from there.

A table for each region says how much light comes straight from each piece of the emitters. It is mixed
with the density of light paths' first vertices, which knows finer pieces and all regions.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.context.field import STEPS, PackedInversion
from elps_core.errors import ContextMismatch
from elps_core.sampling.start import Start, StartDensity

NOWHERE = 0xFFFFFFFF
"""In place of a region: lights are chosen as light paths start."""
MOST_PIECES = 64
"""Pieces of all emitters in a region's table; with more emitters there are no tables."""
SHARE = 0.75
"""Chance of a light by the region's table."""


def pieces(lights: StartDensity) -> int:
    """Pieces that the emitters' unit square is cut into, along its columns: a multiple of the emitters, 0 for none."""
    count = lights.emission.count
    most = 1 if lights.flat else lights.per_emitter  # Where it is flat nobody asks for more than the emitter.
    fitting = [k for k in range(1, most + 1) if lights.per_emitter % k == 0 and k * count <= MOST_PIECES]
    return max(fitting, default=0) * count


class RegionLights:
    """A density of light points for every region: Dirac, area or solid angle, as of :class:`StartDensity`."""

    def __init__(self, lights: StartDensity, table: NDArray[np.float32]) -> None:
        """``table`` [regions, pieces] holds weights; one without any weight counts as even."""
        regions, count = table.shape
        if count != pieces(lights) or not count:
            raise ContextMismatch("the context belongs to a scene with other lights: build it again for this scene")
        self.lights = lights
        self._per_emitter = count // lights.emission.count
        values = on_device(mi.Float, table)
        self._pieces = PackedInversion(lambda index: dr.gather(mi.Float, values, index), regions, count)
        self._share = dr.opaque(mi.Float, SHARE)

    def sample(
        self,
        region: mi.UInt32,
        u_cell: mi.Point2f,
        u_point: mi.Point2f,
        wavelengths: mi.Spectrum,
        active: mi.Bool,
    ) -> tuple[Start, mi.Float]:
        """A light vertex for a point in ``region``, with the mixture's density.

        Returns also the density with which a light path would start there.
        """
        lights = self.lights
        share = dr.select(region == NOWHERE, 0.0, self._share)
        by_region = u_cell.x < share
        here = active & by_region
        piece, inside = self._pieces.sample(region, u_cell.x / self._share, here)
        index = piece // self._per_emitter
        u = mi.Point2f((mi.Float(piece - index * self._per_emitter) + inside) / self._per_emitter, u_cell.y)
        rest = mi.Point2f((u_cell.x - share) / (1.0 - share), u_cell.y)
        start = lights.sample(rest, u_point, wavelengths, active, dr.select(by_region, index, lights.nowhere), u)
        pdf_start = start.pdf
        start.pdf = pdf_start * self.ratio(region, start.cell, active)
        return start, pdf_start

    def ratio(self, region: mi.UInt32, cell: mi.UInt32, active: mi.Bool) -> mi.Float:
        """Density with which :meth:`sample` draws a point in ``cell``, over that with which light paths start there."""
        active = active & (region != NOWHERE)
        piece = cell // (self.lights.rows * (self.lights.per_emitter // self._per_emitter))
        by_region = mi.Float(self._pieces.steps(region, piece, active)) * (self._per_emitter / STEPS)
        by_start = self.lights.density(cell, active)
        return dr.select(active, 1.0 + self._share * (by_region / by_start - 1.0), 1.0)
