"""Subpaths that are kept whole, vertex by vertex, so that a complete path can hand out particles afterwards."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from elps_core.paths.mis import Heuristic, Partial, Side
from elps_core.paths.vertex import Vertex
from elps_core.paths.walk import Walk

PACKET = 4
"""Floats moved by one gather or scatter."""
STEP_BYTES = 80
"""Upper bound of a kept vertex's size."""


class Tracked(Heuristic):
    """The power heuristic; a vertex's partial sums also tell how it was reached.

    ``Partial.dvc`` holds after the one sum of the heuristic, for the event at the vertex before:
    :class:`Reached` in this order. Densities of a Dirac event count as 1, because in every ratio both
    directions' cancel [pbrt 4th ed., BDPT weights].
    """

    def __init__(self, length: int) -> None:
        super().__init__("power", length)

    @property
    def width(self) -> int:
        """Numbers in :attr:`Partial.dvc`."""
        return 5

    def scatter(
        self,
        partial: Partial,
        cos_out: mi.Float,
        pdf_fwd: mi.Float,
        pdf_rev: mi.Float,
        delta: mi.Bool,
        side: Side,
        first: mi.Bool | None = None,
    ) -> Partial:
        """As :meth:`Heuristic.scatter`."""
        new = super().scatter(Partial(partial.dvcm, partial.dvc[:1]), cos_out, pdf_fwd, pdf_rev, delta, side, first)
        inverse = dr.select(delta, 1.0, dr.rcp(pdf_fwd))
        spread = dr.select(delta, 0.0, cos_out * inverse)
        return Partial(new.dvcm, [*new.dvc, spread, cos_out, inverse, dr.select(delta, 1.0, pdf_rev)])

    def arrive(self, partial: Partial, distance2: mi.Float, cos_in: mi.Float) -> Partial:
        """As :meth:`Heuristic.arrive`."""
        new = super().arrive(Partial(partial.dvcm, partial.dvc[:1]), distance2, cos_in)
        spread, cos_out, inverse, pdf_rev = partial.dvc[1:]
        return Partial(new.dvcm, [*new.dvc, spread, cos_out / distance2, inverse * distance2 / cos_in, pdf_rev])


@dataclass
class Reached:
    """How a vertex was reached from the one before."""

    spread: mi.Float  # Cosine over density of the direction taken there; 0 after a Dirac event
    geometry: mi.Float  # Cosine there over squared distance
    inv_pdf: mi.Float  # One over the area density of this vertex
    pdf_rev: mi.Float  # Solid-angle density of the event there, reversed

    @staticmethod
    def of(partial: Partial) -> Reached:
        """From partial sums of :class:`Tracked`."""
        return Reached(*partial.dvc[1:])

    @property
    def smooth(self) -> mi.Bool:
        """Whether the event before was not a Dirac one."""
        return self.spread != 0.0


@dataclass
class Step:
    """A vertex of a subpath, as it is kept."""

    p: mi.Point3f
    n: mi.Normal3f  # Shading normal
    back: mi.Vector3f  # Unit vector to the vertex before
    beta: mi.UnpolarizedSpectrum
    reached: Reached
    holds: mi.Bool  # Whether it can hold a particle: on a surface that scatters into more than single directions


class StepStore:
    """The vertices of ``rows`` subpaths in memory, at most ``slots`` of each."""

    def __init__(self, rows: int, slots: int) -> None:
        self.slots = slots
        self.channels = dr.size_v(mi.UnpolarizedSpectrum)
        self._packets = -(-(13 + self.channels) // PACKET)
        self._stride = dr.opaque(mi.UInt32, rows)  # Data, not code: one kernel for any number of rows
        self.data = dr.empty(mi.Float, max(1, rows * slots) * self._packets * PACKET)

    def write(self, slot: mi.UInt32, row: mi.UInt32, walk: Walk, vertex: Vertex, active: mi.Bool) -> None:
        """Keep what a walk met, or the direction in which it left the scene."""
        si, reached = vertex.si, Reached.of(vertex.partial)
        holds = si.is_valid() & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Smooth)
        # Whether it holds a particle travels as the sign of a density.
        inverse = dr.select(holds, reached.inv_pdf, -reached.inv_pdf)
        beta = mi.UnpolarizedSpectrum(vertex.beta)
        fields = [
            *si.p, inverse, *si.sh_frame.n, reached.spread, *(-walk.ray.d), reached.geometry, reached.pdf_rev,
            *(beta[k] for k in range(self.channels)),
        ]  # fmt: skip
        fields += [mi.Float(0.0)] * (self._packets * PACKET - len(fields))
        base = (slot * self._stride + row) * self._packets
        for k in range(self._packets):
            dr.scatter(self.data, mi.Vector4f(fields[PACKET * k : PACKET * (k + 1)]), base + k, active)

    def read(self, slot: mi.UInt32, row: mi.UInt32, active: mi.Bool) -> Step:
        """What was kept in a slot."""
        base = (slot * self._stride + row) * self._packets
        f: list[mi.Float] = []
        for k in range(self._packets):
            f += list(dr.gather(mi.Vector4f, self.data, base + k, active))
        return Step(
            p=mi.Point3f(f[0], f[1], f[2]),
            n=mi.Normal3f(f[4], f[5], f[6]),
            back=mi.Vector3f(f[8], f[9], f[10]),
            beta=mi.UnpolarizedSpectrum(f[13 : 13 + self.channels]),
            reached=Reached(spread=f[7], geometry=f[11], inv_pdf=dr.abs(f[3]), pdf_rev=f[12]),
            holds=f[3] > 0.0,
        )
