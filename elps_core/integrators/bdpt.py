"""Bidirectional path tracing with all strategies (s, t), t >= 1 [thesis 4.7.3].

A pass traces one eye and one light path per lane, in two kernels: the light kernel walks from the
emitters, joins each vertex to the sensor (t = 1) and stores it; the eye kernel walks from the
sensor, collects emission (s = 0), estimates direct light (s = 1) and joins each vertex to all that
the light path of its lane has stored (s >= 2).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import drjit as dr
import mitsuba as mi

from elps_core.paths import connect
from elps_core.paths.mis import Partial, power
from elps_core.paths.roulette import RouletteRule
from elps_core.paths.stream import Stream
from elps_core.paths.surfaces import Surfaces
from elps_core.paths.vertex import Vertex, VertexStore
from elps_core.paths.walk import Walk, random_walk
from elps_core.sampling.start import StartDensity
from elps_core.scene.sensors import Camera

Splat: TypeAlias = "Callable[[mi.Point2f, mi.Spectrum, mi.Spectrum, mi.Bool], None]"
"""Adds a light path's contribution at a film position, pixels relative to the crop window."""
Deposit: TypeAlias = "Callable[[mi.UInt32, mi.Spectrum, mi.Spectrum, mi.Bool], None]"
"""Adds a contribution to the adjoint image, at the cell where the light vertex lies."""


@dataclass
class _Eye:
    """What the eye walk carries besides its own state."""

    radiance: mi.Spectrum


@dataclass
class _Light:
    """What the light walk carries besides its own state."""

    stored: mi.UInt32


class Bdpt:
    """Bidirectional path tracing of one scene, sensor and start density.

    ``max_depth`` counts segments as Mitsuba does; ``deposit``, where given to :meth:`trace`,
    receives every contribution with the cell of its light vertex, so that the same code that
    renders measures the adjoint image.
    """

    def __init__(
        self, scene: mi.Scene, camera: Camera, lights: StartDensity, *, max_depth: int, roulette: RouletteRule
    ) -> None:
        self.scene = scene
        self.surfaces = Surfaces(scene)
        self.camera = camera
        self.lights = lights
        self.max_depth = max_depth
        self.roulette = roulette
        self.slots = max(0, max_depth - 2)
        """Light vertices stored per lane: deeper ones can only be joined to the sensor."""

    def trace(
        self,
        position: mi.Point2f,
        streams: tuple[Stream, Stream],
        splat: Splat,
        deposit: Deposit | None = None,
        between: Callable[[], None] = lambda: None,
    ) -> tuple[mi.Spectrum, mi.Spectrum]:
        """One pass over all lanes. Returns the radiance of the eye paths through ``position``.

        ``position`` holds film positions in pixels relative to the crop window, one per lane, drawn
        uniformly over the film; ``streams`` the random numbers of the eye and of the light paths.
        Contributions of light paths go to ``splat``, each per light path over the whole film.
        ``between`` is called when the light kernel has run and the eye kernel is about to be built.
        """
        eye_stream, light_stream = streams
        lanes = dr.width(position)
        u_wavelength = eye_stream.next_1d() if mi.is_spectral else mi.Float(0.5)
        aperture = eye_stream.next_2d() if self.camera.has_aperture else mi.Point2f(0.5)
        ray, ray_weight, offset = self.camera.sample_ray(position, u_wavelength, aperture)

        store = VertexStore(lanes, self.slots, tangents=self.surfaces.bends_frames)
        cell = mi.UInt32(0)
        if self.max_depth >= 2:
            cell = self._light_walk(light_stream, ray.wavelengths, ray_weight, lanes, store, splat, deposit)
        between()
        pdf = self.camera.pdf_direction(ray.d)
        walk = Walk(
            ray=ray,
            beta=mi.Spectrum(ray_weight),
            partial=Partial(power(dr.rcp(pdf)), dr.zeros(mi.Float, lanes)),
            eta=dr.ones(mi.Float, lanes),
            depth=dr.zeros(mi.UInt32, lanes),
            offset=offset,
            stream=eye_stream,
            active=dr.full(mi.Bool, True, lanes),
        )
        lane = dr.arange(mi.UInt32, lanes)

        def visit(vertex: Vertex, stream: Stream, eye: _Eye, active: mi.Bool) -> _Eye:
            emitted, hit_cell = connect.hit_emitter(self.scene, vertex, self.lights, active)
            if deposit:
                deposit(hit_cell, emitted, ray.wavelengths, active)
            radiance = eye.radiance + emitted
            smooth = active & mi.has_flag(vertex.si.bsdf().flags(), mi.BSDFFlags.Smooth)
            direct = smooth & (vertex.depth < self.max_depth)
            lit, start = connect.connect_light(self.surfaces, vertex, self.lights, stream, direct)
            if deposit:
                deposit(start.cell, lit, ray.wavelengths, direct)
            radiance = radiance + lit
            if self.slots == 0:
                return _Eye(radiance)

            count = dr.gather(mi.UInt32, store.count, lane, smooth)

            def join(slot: mi.UInt32, total: mi.Spectrum, more: mi.Bool) -> tuple[mi.UInt32, mi.Spectrum, mi.Bool]:
                light = store.read(slot, lane, ray.wavelengths, more)
                # Depths grow with the slot: what follows a vertex that is too deep is too deep.
                more = more & (vertex.depth + light.depth + 1 <= self.max_depth)
                joined = connect.connect_vertices(self.surfaces, vertex, light, more)
                if deposit:
                    deposit(cell, joined, ray.wavelengths, more)
                return slot + 1, total + joined, more & (slot + 1 < count)

            start_state = (dr.zeros(mi.UInt32, lanes), radiance, smooth & (count > 0))
            _, radiance, _ = dr.while_loop(start_state, lambda _s, _t, more: more, join, label="elps connect")
            return _Eye(radiance)

        eye = random_walk(
            self.scene,
            walk,
            visit,
            _Eye(dr.zeros(mi.Spectrum, lanes)),
            mode=mi.TransportMode.Radiance,
            max_depth=self.max_depth,
            roulette=self.roulette,
            label="elps eye walk",
        )
        return eye.radiance, ray.wavelengths

    def _light_walk(
        self,
        stream: Stream,
        wavelengths: mi.Spectrum,
        wavelength_weight: mi.Spectrum,
        lanes: int,
        store: VertexStore,
        splat: Splat,
        deposit: Deposit | None,
    ) -> mi.UInt32:
        """Walk from the lights; fills ``store`` and evaluates it. Returns each lane's start cell."""
        emission = self.lights.emission
        active = dr.full(mi.Bool, True, lanes)
        start = self.lights.sample(stream.next_2d(), stream.next_2d(), wavelengths, active)
        direction = emission.sample_direction(start.point, stream.next_2d(), active)
        radiance, cosine = emission.radiance(start.point, direction, active)
        pdf = emission.pdf_direction(start.point.index, start.point.delta, cosine, active)
        active = active & ((pdf > 0.0) & (dr.max(radiance) > 0.0))
        dvc = dr.select(start.point.delta, 0.0, power(cosine / (start.pdf * pdf)))
        ray = start.point.si.spawn_ray(direction)
        ray.wavelengths = wavelengths
        walk = Walk(
            ray=ray,
            beta=radiance * (cosine / (start.pdf * pdf)),
            partial=Partial(power(dr.rcp(pdf)), dvc),
            eta=dr.ones(mi.Float, lanes),
            depth=dr.zeros(mi.UInt32, lanes),
            offset=dr.zeros(mi.Float, lanes),
            stream=stream,
            active=active,
        )

        def visit(vertex: Vertex, stream: Stream, light: _Light, active: mi.Bool) -> _Light:
            smooth = active & mi.has_flag(vertex.si.bsdf().flags(), mi.BSDFFlags.Smooth)
            seen, sample = connect.connect_sensor(self.surfaces, vertex, self.camera, stream, smooth)
            seen = seen * wavelength_weight
            splat(sample.position, seen, wavelengths, smooth & sample.valid)
            if deposit:
                deposit(start.cell, seen, wavelengths, smooth & sample.valid)
            if self.slots == 0:
                return light
            keep = smooth & (vertex.depth <= self.slots)
            store.write(light.stored, vertex, keep)
            return _Light(light.stored + dr.select(keep, mi.UInt32(1), mi.UInt32(0)))

        light = random_walk(
            self.scene,
            walk,
            visit,
            _Light(dr.zeros(mi.UInt32, lanes)),
            mode=mi.TransportMode.Importance,
            max_depth=self.max_depth - 1,
            roulette=self.roulette,
            label="elps light walk",
        )
        store.count = light.stored
        cell = start.cell
        if deposit:
            dr.eval(store.data, store.count, cell)
        else:
            dr.eval(store.data, store.count)
        return cell
