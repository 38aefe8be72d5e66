"""Particles: photons and importons as one record, kept on the device, as arrays of numpy on demand.

A particle is a weighted ray (x, omega): a surface point and the direction where light or importance
comes from. A set of them represents the light of a scene when for every W [thesis (5.8), (5.9)]

    E[sum weight W(x, omega)] = integral of W(x, omega) L_i(x, omega) |cos| over surface and directions

and its importance when the same holds with the emitted radiance in place of W, so that this sum is
the mean of the film. Weights are luminances: of a photon its flux, of an importon what a white
source of light there gives to the film.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.settings import MAX_DEPTH

PHOTON, IMPORTON = 0, 1
"""Values of ``kind``."""
PACKET = 4
"""Floats moved by one gather or scatter."""
PACKETS = 3
"""Of a record: position and weight, normal and a word for the rest, direction and room to spare."""
RECORD_BYTES = 4 * PACKET * PACKETS
DEPTH_BITS = MAX_DEPTH.bit_length()
"""Low bits of the word that hold the depth; the rest is the kind."""

Floats = NDArray[np.float32]
Worth: TypeAlias = "Callable[[mi.Point2f], mi.Float]"
"""What importance counts at a film position, in pixels relative to the crop window."""


def everywhere(position: mi.Point2f) -> mi.Float:  # noqa: ARG001
    """Importance that counts alike on the whole film."""
    return mi.Float(1.0)


@dataclass(frozen=True)
class ParticleArrays:
    """Particles on the host; all arrays have one row for each."""

    position: Floats  # [n, 3]
    normal: Floats  # [n, 3], shading normals, unit length
    direction: Floats  # [n, 3], unit vectors away from the surface, to where the particle comes from
    weight: Floats
    depth: NDArray[np.uint16]
    kind: NDArray[np.uint8]


@dataclass
class Particles:
    """Particles on the device, one per lane; arrays are read from memory where they are used."""

    position: mi.Point3f
    normal: mi.Normal3f  # Shading normal, unit length, as the surface has it: not turned to the particle's side
    direction: mi.Vector3f  # World space, away from the surface to where the particle comes from, unit length
    weight: mi.Float
    depth: mi.UInt32  # Segments between the light (photons) or the sensor (importons) and the particle
    kind: mi.UInt32
    count: int

    def __len__(self) -> int:
        return self.count

    def of(self, kind: int) -> Particles:
        """Those of one kind, in the same order."""
        return self._where(self.kind == kind) if self.count else self

    def deeper(self, depth: int) -> Particles:
        """Those of a ``depth`` or more, in the same order."""
        return self._where(self.depth >= depth) if self.count and depth > 1 else self

    def _where(self, wanted: mi.Bool) -> Particles:
        chosen = dr.compress(wanted)
        count = dr.width(chosen)
        if count == 0:
            return _none()
        dr.eval(self)
        taken = {name: dr.gather(type(field), field, chosen) for name, field in vars(self).items() if name != "count"}
        return Particles(**taken, count=count)

    def arrays(self) -> ParticleArrays:
        """A copy on the host."""
        dr.eval(self.position, self.normal, self.direction, self.weight, self.depth, self.kind)

        def vectors(value: Any) -> Floats:
            return np.array(value, np.float32).reshape(3, -1).T.copy()

        return ParticleArrays(
            position=vectors(self.position),
            normal=vectors(self.normal),
            direction=vectors(self.direction),
            weight=np.array(self.weight, np.float32).reshape(-1),
            depth=np.array(self.depth).astype(np.uint16).reshape(-1),
            kind=np.array(self.kind).astype(np.uint8).reshape(-1),
        )


class ParticleSampler(Protocol):
    """A way to make particles."""

    def run(self, key: tuple[int, ...]) -> Iterator[Particles]:
        """Batches of particles from the random streams that ``key`` names.

        All batches of one run together represent the light and the importance of the scene; runs with
        different keys are independent.
        """
        ...


class ParticleBuffer:
    """Where kernels put particles: memory for a fixed number, filled without gaps.

    :meth:`add` may be called inside of loops, so from the visit of any walk. Each place in the code that calls it
    needs a ``port`` of its own, with room for ``capacity`` particles, because a kernel counts up one
    counter from one place only. Another kernel may go on with a port after ``dr.eval(buffer.state)``.
    What finds no room is left out and counted: a caller who must not lose any asks for enough.
    """

    def __init__(self, capacity: int, *, ports: int = 1) -> None:
        self.capacity = capacity
        self.ports = ports
        self._room = dr.opaque(mi.UInt32, capacity)  # Data, not code: one kernel for buffers of any size
        self._clear()

    def _clear(self) -> None:
        # An array for each packet: a second scatter to one array would have the first one done at once.
        self._data = [[dr.empty(mi.Float, self.capacity * PACKET) for _ in range(PACKETS)] for _ in range(self.ports)]
        self._counters = [dr.opaque(mi.UInt32, 0, 1) for _ in range(self.ports)]

    @property
    def state(self) -> list[Any]:
        """What kernels write to."""
        return [self._data, self._counters]

    def add(
        self,
        position: mi.Point3f,
        normal: mi.Normal3f,
        direction: mi.Vector3f,
        weight: mi.Float,
        depth: mi.UInt32,
        kind: int,
        active: mi.Bool,
        *,
        port: int = 0,
    ) -> None:
        """Keep the particles of the active lanes, except those without weight, or with one that is no number."""
        active = active & (weight > 0.0) & dr.isfinite(weight)
        slot = dr.scatter_inc(self._counters[port], dr.zeros(mi.UInt32, dr.width(active)), active)
        active = active & (slot < self._room)
        word = dr.reinterpret_array(mi.Float, depth | (kind << DEPTH_BITS))
        rows = ((*position, weight), (*normal, word), (*direction, mi.Float(0.0)))
        for data, row in zip(self._data[port], rows, strict=True):
            dr.scatter(data, mi.Vector4f(*row), slot, active)

    def record(
        self,
        si: mi.SurfaceInteraction3f,
        weight: mi.Float,
        depth: mi.UInt32,
        kind: int,
        active: mi.Bool,
        *,
        port: int = 0,
    ) -> None:
        """Keep what a walk brings to the surface point ``si`` from where it came."""
        self.add(si.p, si.sh_frame.n, si.to_world(si.wi), weight, depth, kind, active, port=port)

    @property
    def counts(self) -> list[int]:
        """Particles kept, by port."""
        return [min(int(counter[0]), self.capacity) for counter in self._counters]

    @property
    def lost(self) -> int:
        """Particles that found no room."""
        return sum(max(0, int(counter[0]) - self.capacity) for counter in self._counters)

    def take(self) -> Particles:
        """All particles so far; the buffer is empty again, in other memory."""
        counts, data = self.counts, self._data
        self._clear()
        total = sum(counts)
        if total == 0:
            return _none()
        number = dr.arange(mi.UInt32, total)
        packets = [dr.zeros(mi.Vector4f, total) for _ in range(PACKETS)]
        first = 0
        for count, of_port in zip(counts, data, strict=True):
            start, end = (dr.opaque(mi.UInt32, edge) for edge in (first, first + count))
            here = (number >= start) & (number < end)
            packets = [
                dr.select(here, dr.gather(mi.Vector4f, packet, number - start, here), other)
                for packet, other in zip(of_port, packets, strict=True)
            ]
            first += count
        where, facing, coming = packets
        word = dr.reinterpret_array(mi.UInt32, facing.w)
        return Particles(
            mi.Point3f(where.x, where.y, where.z),
            mi.Normal3f(facing.x, facing.y, facing.z),
            mi.Vector3f(coming.x, coming.y, coming.z),
            where.w,
            word & ((1 << DEPTH_BITS) - 1),
            word >> DEPTH_BITS,
            total,
        )


def _none() -> Particles:
    """No particles."""
    return Particles(mi.Point3f(), mi.Normal3f(), mi.Vector3f(), mi.Float(), mi.UInt32(), mi.UInt32(), 0)
