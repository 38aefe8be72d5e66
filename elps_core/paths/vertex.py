"""The vertex record: what a surface vertex must remember to be connected to later."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from elps_core.paths.mis import Partial
from elps_core.settings import MAX_DEPTH

DEPTH_BITS = MAX_DEPTH.bit_length()
"""Low bits of the packed word that hold the depth; the rest is the shape."""
PACKET = 4
"""Floats moved by one gather or scatter; wider packets brought nothing."""


@dataclass
class Vertex:
    """A surface vertex of a subpath, before it scatters."""

    si: mi.SurfaceInteraction3f  # Position, normals, incident direction (local, towards the predecessor)
    beta: mi.Spectrum  # Throughput: contribution / density up to this vertex
    partial: Partial  # Partial sums of the weights
    depth: mi.UInt32  # Segments between the subpath's start and this vertex


class VertexStore:
    """Light vertices of one pass in global memory: ``slots`` records for each of ``lanes`` lanes.

    Records are arrays of structures, about 100 bytes each. A kernel writes them, the next one
    reads them: never both in one kernel.
    """

    def __init__(self, lanes: int, slots: int, *, tangents: bool, ratios: int = 1) -> None:
        """An empty store.

        Args:
            lanes: walks side by side.
            slots: vertices of each.
            tangents: keep the position's derivatives by u and v, which normal and bump maps ask for.
            ratios: numbers in a vertex's :attr:`Partial.dvc`.
        """
        self.ratios = ratios
        self.lanes = lanes
        self.tangents = tangents
        self.slots = slots
        self._stride = dr.opaque(mi.UInt32, lanes)  # Data, not code: one kernel for all lane counts
        self.channels = dr.size_v(mi.UnpolarizedSpectrum)
        self.packets = -(-(19 + ratios + self.channels + (6 if tangents else 0)) // PACKET)
        self.data = dr.empty(mi.Float, max(1, lanes * slots) * self.packets * PACKET)
        self.count = dr.zeros(mi.UInt32, lanes)

    def write(self, slot: mi.UInt32, lane: mi.UInt32, vertex: Vertex, active: mi.Bool) -> None:
        """Store ``vertex`` as that of ``lane`` in ``slot`` (less than ``slots``)."""
        si = vertex.si
        shape = dr.reinterpret_array(mi.UInt32, si.shape)
        packed = dr.reinterpret_array(mi.Float, (shape << DEPTH_BITS) | vertex.depth)
        prim = dr.reinterpret_array(mi.Float, si.prim_index)
        # The tangent is kept as its angle in the plane of the normal, one float in place of three.
        s0, t0 = mi.coordinate_system(si.sh_frame.n)
        angle = dr.atan2(dr.dot(si.sh_frame.s, t0), dr.dot(si.sh_frame.s, s0))
        fields = [
            *si.p, packed,
            *si.n, prim,
            *si.sh_frame.n, angle,
            *si.wi, *si.uv,
            vertex.partial.dvcm, *vertex.partial.dvc,
            si.time,
            *(vertex.beta[i] for i in range(self.channels)),
        ]  # fmt: skip
        if self.tangents:
            fields += [*si.dp_du, *si.dp_dv]
        fields += [mi.Float(0.0)] * (self.packets * PACKET - len(fields))
        base = (slot * self._stride + lane) * self.packets
        for k in range(self.packets):
            dr.scatter(self.data, mi.Vector4f(fields[PACKET * k : PACKET * (k + 1)]), base + k, active)

    def read(self, slot: mi.UInt32, lane: mi.UInt32, wavelengths: mi.Spectrum, active: mi.Bool) -> Vertex:
        """The vertex that ``lane`` stored in ``slot``, ready for BSDF evaluation."""
        base = (slot * self._stride + lane) * self.packets
        f: list[mi.Float] = []
        for k in range(self.packets):
            f += list(dr.gather(mi.Vector4f, self.data, base + k, active))
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.p = mi.Point3f(f[0], f[1], f[2])
        word = dr.reinterpret_array(mi.UInt32, f[3])
        si.shape = dr.reinterpret_array(mi.ShapePtr, word >> DEPTH_BITS)
        si.n = mi.Normal3f(f[4], f[5], f[6])
        si.prim_index = dr.reinterpret_array(mi.UInt32, f[7])
        normal = mi.Normal3f(f[8], f[9], f[10])
        s0, t0 = mi.coordinate_system(normal)
        sin, cos = dr.sincos(f[11])
        tangent = s0 * cos + t0 * sin
        si.sh_frame = mi.Frame3f(tangent, dr.cross(normal, tangent), normal)
        si.wi = mi.Vector3f(f[12], f[13], f[14])
        si.uv = mi.Point2f(f[15], f[16])
        partial, rest = Partial(f[17], f[18 : 18 + self.ratios]), f[18 + self.ratios :]
        si.time = rest[0]
        si.t = 0.0
        si.wavelengths = wavelengths
        beta = mi.UnpolarizedSpectrum(rest[1 : 1 + self.channels])
        if self.tangents:
            rest = rest[1 + self.channels :]
            si.dp_du, si.dp_dv = mi.Vector3f(rest[:3]), mi.Vector3f(rest[3:6])
        return Vertex(si, beta, partial, word & ((1 << DEPTH_BITS) - 1))
