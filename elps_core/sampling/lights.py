"""Next event estimation by region: which light to ask for, as seen from there.

A table for each region says how much light comes straight from each piece of the emitters. It is mixed
with the density of light paths' first vertices, which knows finer pieces and all regions.

A piece is a part of one emitter's unit square; or, where there are more emitters than pieces, a run of them. Emitters
are numbered along a curve through space, so that those of a run are neighbours. Which of them it is, and where on it,
is drawn as light paths start.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.context.field import STEPS, PackedInversion
from elps_core.errors import ContextMismatch
from elps_core.sampling.inversion import RESOLUTION
from elps_core.sampling.start import Start, StartDensity
from elps_core.scene.emitters import MANY

NOWHERE = 0xFFFFFFFF
"""In place of a region: lights are chosen as light paths start."""
MOST_PIECES = MANY
"""Pieces of all emitters in a region's table: one of them each at least, where there are not more."""
SHARE = 0.75
"""Chance of a light by the region's table."""
_HIGH, _LOW = 1 << 24, 1 << 8
"""Of two random numbers, steps that make up one of 32 bits."""


def pieces(lights: StartDensity) -> int:
    """Pieces that the emitters' unit square is cut into, along its columns."""
    if lights.many:
        return MOST_PIECES
    count = lights.emission.count
    most = 1 if lights.flat else lights.per_emitter  # Where it is flat nobody asks for more than the emitter.
    return max(k for k in range(1, most + 1) if lights.per_emitter % k == 0 and k * count <= MOST_PIECES) * count


def runs(lights: StartDensity) -> NDArray[np.int64]:
    """Where runs of many emitters begin, and the last one ends [pieces + 1]; they are of equal length within one."""
    return np.arange(MOST_PIECES + 1) * lights.emission.count // MOST_PIECES


class PieceOf:
    """Which piece a cell of the start density belongs to."""

    def __init__(self, lights: StartDensity) -> None:
        cells = lights.rows * lights.columns
        self._size, self._table = cells // pieces(lights), None
        if lights.many:
            of_emitter = np.repeat(np.arange(MOST_PIECES), np.diff(runs(lights)))
            self._table = on_device(mi.UInt32, np.repeat(of_emitter, cells // lights.emission.count))

    def __call__(self, cell: mi.UInt32, active: mi.Bool | bool = True) -> mi.UInt32:
        """The piece that holds ``cell``."""
        if self._table is None:
            return cell // self._size
        return dr.gather(mi.UInt32, self._table, cell, active)


class RegionLights:
    """A density of light points for every region: Dirac, area or solid angle, as of :class:`StartDensity`."""

    def __init__(self, lights: StartDensity, table: NDArray[np.float32]) -> None:
        """``table`` [regions, pieces] holds weights; one without any weight counts as even.

        Where ``lights`` draws whole emitters, the table's pieces of each count together.
        """
        count = pieces(lights)
        regions, finer = table.shape
        if not count or not finer or finer % count:
            raise ContextMismatch("the context belongs to a scene with other lights: build it again for this scene")
        table = table.reshape(regions, count, finer // count).sum(axis=2)
        self.lights = lights
        self._per_emitter = max(1, count // lights.emission.count)
        values = on_device(mi.Float, table)
        self._pieces = PackedInversion(lambda index: dr.gather(mi.Float, values, index), regions, count)
        self._share = dr.opaque(mi.Float, SHARE)
        self._piece_of = PieceOf(lights)
        if lights.many:
            steps = np.add.reduceat(lights.steps(), runs(lights)[:-1])
            self._steps = on_device(mi.UInt32, steps)
            self._before = on_device(mi.UInt32, np.cumsum(steps) - steps)

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
        rest = mi.Point2f((u_cell.x - share) / (1.0 - share), u_cell.y)
        if lights.many:
            across, fine = self._within(piece, inside, u_point.x, here)
            rest.x = dr.select(by_region, across, rest.x)
            u_point = mi.Point2f(dr.select(by_region, fine, u_point.x), u_point.y)
            start = lights.sample(rest, u_point, wavelengths, active)
        else:
            index = piece // self._per_emitter
            u = mi.Point2f((mi.Float(piece - index * self._per_emitter) + inside) / self._per_emitter, u_cell.y)
            start = lights.sample(rest, u_point, wavelengths, active, dr.select(by_region, index, lights.nowhere), u)
        pdf_start = start.pdf
        start.pdf = pdf_start * self.ratio(region, start.cell, active)
        return start, pdf_start

    def ratio(self, region: mi.UInt32, cell: mi.UInt32, active: mi.Bool) -> mi.Float:
        """Density with which :meth:`sample` draws a point in ``cell``, over that with which light paths start there."""
        active = active & (region != NOWHERE)
        piece = self._piece_of(cell, active)
        by_region = mi.Float(self._pieces.steps(region, piece, active)) * (self._per_emitter / STEPS)
        if self.lights.many:
            by_start = mi.Float(dr.gather(mi.UInt32, self._steps, piece, active)) / RESOLUTION
        else:
            by_start = self.lights.density(cell, active)
        return dr.select(active, 1.0 + self._share * (by_region / by_start - 1.0), 1.0)

    def _within(self, piece: mi.UInt32, inside: mi.Float, u: mi.Float, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """A number that draws an emitter of ``piece`` from all of them, and what fills the step that it is rounded to.

        It is a whole step, and each step of the piece is as likely as the others to within 1 / 512: a random number
        of 24 bits would miss some where a piece has nearly all steps.
        """
        steps = dr.gather(mi.UInt32, self._steps, piece, active)
        before = dr.gather(mi.UInt32, self._before, piece, active)
        fine = inside * _LOW
        low = dr.minimum(mi.UInt32(fine), _LOW - 1)
        random = dr.minimum(mi.UInt32(u * _HIGH), _HIGH - 1) * _LOW + low
        step = before + dr.mul_hi(random, steps)
        return mi.Float(step) / RESOLUTION, fine - mi.Float(low)
