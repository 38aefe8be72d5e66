"""Photons that mirrors and glass have brought: light paths are aimed at such shapes, as by a projection map.

Eye paths meet such light only by chance, and paths that leave a lamp just so seldom meet a small shape.
Jensen, "Realistic Image Synthesis Using Photon Mapping" (2001), aims his caustic photons alike.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from elps_core.arrays import on_device
from elps_core.particles.records import PHOTON, ParticleBuffer, Particles
from elps_core.paths.scattering import Materials
from elps_core.paths.stream import Stream
from elps_core.sampling.start import StartDensity
from elps_core.scene.pieces import only_turns, pieces_of
from elps_core.scene.spectrum import luminance, sample_wavelengths, white

BATCH = 1 << 18
"""Paths side by side."""


@dataclass
class _Path:
    """A light path that mirrors and glass alone have turned so far."""

    ray: mi.Ray3f
    flux: mi.Spectrum
    met: mi.Float
    """Luminance that an eye path finds which takes the same way back, in units of white."""
    depth: mi.UInt32
    stream: Stream
    active: mi.Bool


class CausticSampler:
    """Photons from light paths that first meet a shape which mirrors or refracts, and end where light is scattered.

    Their weights are not those of other photons: each is flux times cosine times the radiance X that an eye path finds
    which takes the same way back, [W^2 / (m^2 sr)]. Such a path chooses by chance whether to be mirrored or refracted,
    and finds the lamp as it is or nothing; so for every f, of such light alone,

        E[sum weight f(x, omega)] = integral of f(x, omega) E[X^2] cos^2 over surface and directions.

    Lamps without extent bring none: eye paths cannot meet what they send.

    Args:
        scene: what is walked in.
        lights: the density of light vertices.
        max_depth: greatest number of segments of a path.
        paths: of a run, a multiple of :data:`BATCH` or less than it.
    """

    def __init__(self, scene: mi.Scene, lights: StartDensity, *, max_depth: int, paths: int) -> None:
        turning = [shape for shape in scene.shapes() if only_turns(shape.bsdf())]
        pieces = [piece for shape in turning for piece in pieces_of(shape)]
        self.count = len(pieces)
        """Separate shapes that light paths are aimed at; where there are none, there is nothing to run."""
        self.paths, self._max_depth = paths, max_depth
        self._scene, self._lights, self._materials = scene, lights, Materials(scene)
        if not pieces:
            return
        self._ids = dr.reinterpret_array(mi.UInt32, mi.ShapePtr([piece.shape for piece in pieces]))
        self._faces = on_device(mi.UInt32, np.array([[piece.first, piece.end] for piece in pieces]))
        spheres = np.array([[*piece.centre, piece.radius] for piece in pieces], np.float32)
        self._spheres = on_device(mi.Float, spheres)
        self._far = dr.opaque(mi.Float, 2.0 * float(scene.bbox().bounding_sphere().radius))
        self._number = dr.opaque(mi.UInt32, self.count)

    def run(self, key: tuple[int, ...]) -> Iterator[Particles]:
        """Batches of photons from the random streams that ``key`` names."""
        if not self.count:
            return
        lanes = min(BATCH, self.paths)
        for batch in range(-(-self.paths // lanes)):
            yield self._batch(Stream.of(lanes, *key, batch), lanes)

    def _batch(self, stream: Stream, lanes: int) -> Particles:
        buffer = ParticleBuffer(lanes)
        share = dr.opaque(mi.Float, 1.0 / self.paths)

        def body(path: _Path) -> _Path:
            si = self._lights.emission.rays.ray_intersect(path.ray, path.active)
            active = path.active & si.is_valid()
            smooth = active & self._materials.flags.smooth(si)
            depth = path.depth + 1
            cosine = dr.abs(mi.Frame3f.cos_theta(si.wi))
            flux = luminance(mi.UnpolarizedSpectrum(path.flux), path.ray.wavelengths) / white()
            buffer.record(si, flux * path.met * cosine * share, depth, PHOTON, smooth & (depth > 1))
            active = active & ~smooth & (depth < self._max_depth)
            event = self._materials.sample_from_light(si, path.stream.next_1d(), path.stream.next_2d(), active)
            active = active & event.delta
            kept = luminance(mi.UnpolarizedSpectrum(event.weight), path.ray.wavelengths) / white()
            ray = self._lights.emission.rays.leaving.ray(si, si.to_world(event.wo))
            return _Path(ray, path.flux * event.weight, path.met * kept, depth, path.stream, active)

        dr.while_loop(
            (self._start(stream, lanes),), lambda path: path.active, lambda path: (body(path),), label="elps caustics"
        )
        dr.eval(buffer.state)
        return buffer.take()

    def _start(self, stream: Stream, lanes: int) -> _Path:
        """Paths that meet the shape first that they are aimed at; others are not active."""
        wavelengths, scale = sample_wavelengths(stream.next_1d() if mi.is_spectral else mi.Float(0.5))
        every = dr.full(mi.Bool, True, lanes)
        start = self._lights.sample(stream.next_2d(), stream.next_2d(), wavelengths, every)
        point = start.point
        which = dr.minimum(mi.UInt32(stream.next_1d() * mi.Float(self._number)), self._number - 1)
        sphere = dr.gather(mi.Vector4f, self._spheres, which)
        centre, radius, u = mi.Point3f(sphere.x, sphere.y, sphere.z), sphere.w, stream.next_2d()
        # A cone around the sphere; all directions from within it.
        away = centre - point.si.p
        distance = dr.norm(away)
        outside = distance > radius
        cos_cone = dr.select(outside, dr.safe_sqrt(1.0 - dr.square(radius / distance)), -1.0)
        axis = mi.Frame3f(dr.select(distance > 0.0, away / distance, mi.Vector3f(0.0, 0.0, 1.0)))
        direction = axis.to_world(mi.warp.square_to_uniform_cone(u, cos_cone))
        leaving = self._lights.emission.rays.leaving
        origin, per_pdf = leaving.off(point.si, direction), dr.two_pi * (1.0 - cos_cone)
        # From infinity the disk across the sphere.
        travels = mi.Vector3f(point.si.n)
        disk = mi.warp.square_to_uniform_disk_concentric(u)
        across = mi.Frame3f(point.si.n).to_world(mi.Vector3f(disk.x, disk.y, 0.0))
        direction = dr.select(point.infinite, travels, direction)
        origin = dr.select(point.infinite, centre + across * radius - travels * self._far, origin)
        per_pdf = dr.select(point.infinite, dr.pi * dr.square(radius), per_pdf)
        radiance, cosine = self._lights.emission.radiance(point, direction, every)
        ray = mi.Ray3f(origin, direction, point.si.time, wavelengths)
        met = self._scene.ray_intersect_preliminary(ray, active=every & ~point.delta & (cosine > 0.0))
        first = met.is_valid() & (dr.reinterpret_array(mi.UInt32, met.shape) == dr.gather(mi.UInt32, self._ids, which))
        # Of many panes that are one mesh, the one that the path is aimed at.
        faces = dr.gather(mi.Vector2u, self._faces, which)
        first &= (met.prim_index >= faces.x) & (met.prim_index < faces.y)
        flux = radiance * scale * (cosine * per_pdf * mi.Float(self._number) / start.pdf)
        bright = luminance(mi.UnpolarizedSpectrum(radiance) * scale, wavelengths) / white()
        return _Path(ray, flux, bright, dr.zeros(mi.UInt32, lanes), stream, first)
