"""One path of a chosen length, made by one strategy (s, t): two walks whose ends are joined.

Unlike the connections of a renderer, which want one weighted number, this one keeps what each side needs to hand out
particles of its own: what arrives at its end from the other side, and how likely the other side's
walk would have gone on along it.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from elps_core.integrators.bdpt import Bdpt
from elps_core.particles.records import Worth, everywhere
from elps_core.particles.subpaths import StepStore, Tracked
from elps_core.paths.mis import Ratios, Side
from elps_core.paths.roulette import RouletteRule
from elps_core.paths.strategies import bdpt as all_strategies
from elps_core.paths.stream import Stream
from elps_core.paths.vertex import Vertex
from elps_core.paths.walk import Walk, random_walk
from elps_core.sampling.start import Start, StartDensity
from elps_core.scene.sensors import Camera, SensorSample
from elps_core.scene.spectrum import luminance

HEAD_NUMBERS = 6
"""Numbers before the eye walk at most: strategy, film position, wavelength, aperture."""
START_NUMBERS = 6
"""Numbers before the light walk: point on an emitter, first direction."""
STEP_NUMBERS = 3
"""Numbers that a walk takes at a vertex: lobe and direction. It ends by its length alone."""


@dataclass
class Branch:
    """One side of a path: its own subpath, and what comes to it from the other one."""

    steps: mi.UInt32  # Vertices kept, without the first one
    vertices: mi.UInt32  # Vertices wanted, with the first one
    fewer: mi.Float  # Squared density ratios of the strategies with fewer vertices on this side, to this one
    more: mi.Float  # The same of those with fewer on the other side
    arriving: mi.Float  # Times the inverse density of the end: what arrives there from the other side
    carried: mi.UnpolarizedSpectrum  # Over beta of the next vertex: what arrives from it, per spread and density
    toward: mi.Vector3f  # From the end to the other side, unit length
    pdf_end: mi.Float  # Area density of the end, as the other side would go on to it
    pdf_next: mi.Float  # Solid-angle density of the vertex before the end, likewise


@dataclass
class Origin:
    """The first light vertex, where it lies on a surface."""

    p: mi.Point3f
    n: mi.Normal3f
    inv_pdf: mi.Float
    holds: mi.Bool


@dataclass
class Joined:
    """A path, whole or not."""

    length: mi.UInt32  # Segments wanted
    joined: mi.Bool  # Whether nothing stands between the two sides
    light: Branch
    eye: Branch
    origin: Origin
    emitted: mi.UnpolarizedSpectrum  # By the first light vertex towards the second: what beta of light walks leaves out
    wavelengths: mi.Spectrum
    target: mi.Float  # Luminance of f / p, weighted: its mean over all states is the mean of the film


@dataclass
class _End:
    vertex: Vertex
    steps: mi.UInt32
    reached: mi.Bool  # Whether the subpath has all its vertices; the last segment may leave the scene
    solid: mi.Bool  # Whether it ends at a surface


@dataclass
class _Hit:
    """An eye path that meets an emitter."""

    active: mi.Bool
    radiance: mi.UnpolarizedSpectrum
    pdf_start: mi.Float  # Density of light paths that start there
    pdf_omega: mi.Float  # And of their first direction
    fewer: mi.Float  # Squared density ratios of the strategies with fewer eye vertices


class PathJoiner:
    """Makes paths of up to ``max_depth`` segments, keeping their vertices in two stores.

    Importance counts ``worth`` by where on the film it comes from, and so does the target.
    """

    def __init__(
        self, scene: mi.Scene, camera: Camera, lights: StartDensity, *, max_depth: int, worth: Worth = everywhere
    ) -> None:
        self.scene, self.camera, self.lights = scene, camera, lights
        self.max_depth = max_depth
        self._worth = worth
        self._walks = Bdpt(
            scene,
            camera,
            lights,
            max_depth=max_depth,
            roulette=RouletteRule("none", 1),
            strategies=all_strategies(),  # No light path looks for the aperture.
        )
        self._walks.heuristic = self.heuristic = Tracked(max_depth + 1)
        self._surfaces = self._walks.connector.surfaces

    def join(
        self,
        streams: tuple[Stream, Stream],
        length: mi.UInt32,
        stores: tuple[StepStore, StepStore],
        row: mi.UInt32,
    ) -> Joined:
        """A path of ``length`` segments per lane, from numbers for the eye and for the light walk.

        The strategy is drawn from the k + 2 that the length k allows [thesis 5.2.2]. Vertices go to
        ``stores`` (light, eye), in ``row``.
        """
        eye_stream, light_stream = streams
        lanes = dr.width(length)
        choices = length + 2
        s = dr.minimum(mi.UInt32(eye_stream.next_1d() * mi.Float(choices)), length + 1)
        t = length + 1 - s

        position = eye_stream.next_2d() * mi.Point2f(self.camera.size)
        u_wavelength = eye_stream.next_1d() if mi.is_spectral else mi.Float(0.5)
        aperture = eye_stream.next_2d() if self.camera.has_aperture else mi.Point2f(0.5)
        primary = self.camera.sample_ray(position, u_wavelength, aperture)
        wavelengths = primary.ray.wavelengths
        scale = mi.UnpolarizedSpectrum(primary.weight)

        active = dr.full(mi.Bool, True, lanes)
        start = self.lights.sample(light_stream.next_2d(), light_stream.next_2d(), wavelengths, active)
        first = self._walks.light_start(start, light_stream)
        # What is emitted stays apart from what is scattered: importons do not ask for the light's colour.
        emission, point = self.lights.emission, start.point
        emitted, cosine = emission.radiance(point, first.ray.d, active)
        delta, infinite = point.delta, point.infinite
        pdf = emission.pdf_direction(
            point.index, point.si.p, first.ray.d, cosine, active, delta=delta, infinite=infinite
        )
        first.beta = dr.select(first.active, mi.Spectrum(cosine / (start.pdf * pdf)), 0.0)
        light = self._walk(first, s, "light", stores[0], row)
        # The second loop would have the first one's scatters done, and the first walk made again for its end.
        dr.eval(light, emitted, stores[0].data)
        seen = self._walks.eye_start(primary, eye_stream)
        seen.beta = seen.beta * self._worth(position)
        eye = self._walk(seen, t, "eye", stores[1], row)
        return self._connect(s, t, start, emitted, light, eye, aperture, scale, wavelengths)

    def _walk(self, start: Walk, vertices: mi.UInt32, side: Side, store: StepStore, row: mi.UInt32) -> _End:
        """Walk until the subpath has that many vertices, and keep all but the first."""
        start.active = start.active & (vertices >= 2)
        lanes = dr.width(vertices)
        si = dr.zeros(mi.SurfaceInteraction3f, lanes)
        si.wavelengths = start.ray.wavelengths
        none = dr.zeros(mi.Bool, lanes)
        vertex = Vertex(si, dr.zeros(mi.Spectrum, lanes), start.partial, dr.zeros(mi.UInt32, lanes))

        def visit(walk: Walk, vertex: Vertex, end: _End, active: mi.Bool) -> _End:
            store.write(walk.depth, row, walk, vertex, walk.active)
            last = walk.active & (walk.depth + 2 == vertices)
            new: _End = dr.select(last, _End(vertex, end.steps, walk.active, active), end)
            new.steps = dr.select(walk.active, vertex.depth, end.steps)
            return new

        end: _End = random_walk(
            self.lights.emission.rays,
            start,
            visit,
            _End(vertex, dr.zeros(mi.UInt32, lanes), none, none),
            side=side,
            max_depth=vertices - 1,
            roulette=self._walks.roulette,
            heuristic=self.heuristic,
            directions=self._walks.directions,
            label=f"elps particles {side} walk",
        )
        return end

    def _connect(
        self,
        s: mi.UInt32,
        t: mi.UInt32,
        start: Start,
        emitted: mi.Spectrum,
        light: _End,
        eye: _End,
        aperture: mi.Point2f,
        scale: mi.UnpolarizedSpectrum,
        wavelengths: mi.Spectrum,
    ) -> Joined:
        """Join the ends; ``emitted`` is what the light walk's first ray carries, ``scale`` what wavelengths weigh."""
        emission, point, others = self.lights.emission, start.point, self.heuristic.others
        light_si, eye_si, materials = light.vertex.si, eye.vertex.si, self._walks.directions.materials
        from_lamp, at_film = s == 1, t == 1
        hit = self._hit(s, t, eye)

        # The segment, from the eye's end to the light's.
        delta = mi.Vector3f(light_si.p - eye_si.p)
        distance2 = dr.squared_norm(delta)
        to_lamp, lamp_distance2, target = emission.towards(point, eye_si.p)
        light_ready = light.solid & self._surfaces.flags.smooth(light_si)
        eye_ready = eye.solid & self._surfaces.flags.smooth(eye_si)
        sample = self.camera.connect(light_si, aperture, light_ready & at_film)
        direction = dr.select(from_lamp, mi.Vector3f(to_lamp), delta * dr.rsqrt(distance2))
        direction = dr.select(at_film, mi.Vector3f(-sample.direction), direction)
        distance2 = dr.select(at_film, sample.distance2, dr.select(from_lamp, lamp_distance2, distance2))
        ready = (light_ready | from_lamp) & (eye_ready | (at_film & sample.valid))
        # No lamp is joined to the sensor: that light is seen directly.
        ready = ready & (distance2 > 0.0) & ~(from_lamp & at_film) & (s >= 1) & (t >= 1)

        # What both ends make of it: scattering, or else emission and importance.
        at_eye = materials.seen_by_eye(eye_si, eye_si.to_local(direction), ready & ~at_film)
        cos_eye = dr.abs(dr.dot(eye_si.n, direction))
        importance = mi.UnpolarizedSpectrum(sample.pdf * self._worth(sample.position))
        to_light = dr.select(at_film, importance, mi.UnpolarizedSpectrum(at_eye.value))
        pdf_light = dr.select(at_film, sample.pdf, at_eye.pdf)

        cos_light = dr.abs(dr.dot(light_si.n, direction))
        at_light = materials.seen_by_light(light_si, light_si.to_local(-direction), cos_light, ready & ~from_lamp)
        lamp, lamp_cosine = emission.radiance(point, -direction, ready & from_lamp)
        delta, infinite = point.delta, point.infinite
        lamp_pdf = emission.pdf_direction(
            point.index, point.si.p, -direction, lamp_cosine, from_lamp, delta=delta, infinite=infinite
        )
        no_surface = point.delta | point.infinite
        # Importance reaches the back of a lamp, too.
        lamp_side = dr.select(no_surface, 1.0, dr.abs(dr.dot(point.si.n, direction)))
        cos_light = dr.select(from_lamp, lamp_side, cos_light)
        emitted = mi.UnpolarizedSpectrum(dr.select(from_lamp, lamp, emitted))
        to_eye = dr.select(from_lamp, mi.UnpolarizedSpectrum(lamp_cosine), mi.UnpolarizedSpectrum(at_light.value))
        pdf_eye = dr.select(from_lamp, lamp_pdf, at_light.pdf)

        # Particles want to know of both directions, even where the whole path carries nothing.
        eye_passes = ready & (dr.max(to_light) > 0.0)
        light_passes = ready & (dr.max(to_eye) > 0.0) & (~from_lamp | (dr.max(emitted) > 0.0))
        joined = eye_passes | light_passes
        end = self._surfaces.leaving.off(light_si, -direction)
        flags, target = self._surfaces.flags, dr.select(from_lamp, target, end)
        at_round = dr.select(from_lamp, flags.round(point.si, joined), flags.round(light_si, joined))
        joined = joined & ~self._blocked(eye_si, light_si, target, at_round, sample, at_film, joined)
        eye_passes, light_passes = joined & eye_passes, joined & light_passes
        inverse = dr.select(joined, dr.rcp(distance2), 0.0)

        # Densities of walks that would have gone on along the segment; none does where nothing is scattered.
        pdf_light = dr.select(eye_passes, pdf_light * cos_light * inverse, 0.0)
        pdf_eye = dr.select(light_passes & ~at_film, pdf_eye * cos_eye * inverse, 0.0)
        light_rev = dr.select(light_passes & ~from_lamp, at_light.pdf_rev, 0.0)
        eye_rev = dr.select(eye_passes & ~at_film, at_eye.pdf_rev, 0.0)
        lamp_density = dr.select(point.delta, dr.inf, start.pdf)
        light_fewer = _sum(others(light.vertex.partial, pdf_light, light_rev, "light"))
        light_fewer = dr.select(from_lamp, dr.square(pdf_light / lamp_density), light_fewer)
        light_fewer = dr.select(joined, light_fewer, 0.0)
        eye_fewer = _sum(others(eye.vertex.partial, pdf_eye, eye_rev, "eye"))
        eye_fewer = dr.select(joined & ~at_film, eye_fewer, hit.fewer)

        beta_light = dr.select(
            from_lamp, mi.UnpolarizedSpectrum(dr.rcp(start.pdf)), mi.UnpolarizedSpectrum(light.vertex.beta)
        )
        beta_eye = dr.select(at_film, scale, mi.UnpolarizedSpectrum(eye.vertex.beta))
        between = dr.select(joined, beta_eye * to_light * to_eye * beta_light * inverse, 0.0)
        whole = dr.select(hit.active, mi.UnpolarizedSpectrum(eye.vertex.beta) * hit.radiance, between * emitted)
        target_value = luminance(whole, wavelengths) * mi.Float(s + t + 1) / (1.0 + light_fewer + eye_fewer)
        return Joined(
            length=s + t - 1,
            joined=joined | hit.active,
            light=Branch(
                steps=light.steps,
                vertices=mi.UInt32(s),
                fewer=light_fewer,
                more=eye_fewer,
                arriving=luminance(beta_eye * to_light, wavelengths) * cos_light * inverse,
                carried=between,
                toward=-direction,
                pdf_end=pdf_light,
                pdf_next=light_rev,
            ),
            eye=Branch(
                steps=eye.steps,
                vertices=mi.UInt32(t),
                fewer=eye_fewer,
                more=light_fewer,
                arriving=luminance(emitted * beta_light * to_eye * scale, wavelengths) * cos_eye * inverse,
                carried=whole * scale,  # Eye paths start with the weight of their wavelengths.
                toward=direction,
                pdf_end=dr.select(hit.active, hit.pdf_start, pdf_eye),
                pdf_next=dr.select(hit.active, hit.pdf_omega, eye_rev),
            ),
            origin=Origin(
                point.si.p, point.si.sh_frame.n, dr.rcp(start.pdf), ~no_surface & self._surfaces.flags.smooth(point.si)
            ),
            emitted=emitted * scale,
            wavelengths=wavelengths,
            target=dr.select(dr.isfinite(target_value) & (s + t > 2), dr.maximum(target_value, 0.0), 0.0),
        )

    def _hit(self, s: mi.UInt32, t: mi.UInt32, eye: _End) -> _Hit:
        """s = 0: the eye path's own end is the light vertex."""
        emission, si = self.lights.emission, eye.vertex.si
        active = (s == 0) & (eye.reached if emission.has_environment else eye.solid)
        emitter = emission.emitter(si, active)
        active = active & (emitter != None)  # noqa: E711 (a comparison of arrays of pointers)
        radiance = mi.UnpolarizedSpectrum(emission.seen(emitter, si, active))
        pdf_start, index, _ = self.lights.pdf(emitter, si, active)
        cosine = dr.abs(dr.dot(si.to_world(si.wi), si.n))
        back = mi.Vector3f(si.to_world(si.wi))
        pdf_omega = emission.pdf_direction(
            index, si.p, back, cosine, active, delta=mi.Bool(False), infinite=~si.is_valid()
        )
        pdf_omega = dr.select(dr.max(radiance) > 0.0, pdf_omega, 0.0)
        fewer = _sum(self.heuristic.others(eye.vertex.partial, pdf_start, pdf_omega, "eye"))
        # Paths of one segment have no other strategy.
        return _Hit(active, radiance, pdf_start, pdf_omega, dr.select(active & (t > 2), fewer, 0.0))

    def _blocked(
        self,
        eye: mi.SurfaceInteraction3f,
        light: mi.SurfaceInteraction3f,
        target: mi.Point3f,
        at_round: mi.Bool,
        sample: SensorSample,
        at_film: mi.Bool,
        active: mi.Bool,
    ) -> mi.Bool:
        """Whether something stands between the ends. One ray for all strategies."""
        leaving = self._surfaces.leaving
        start = leaving.off(eye, target - eye.p)
        # At the film from the surface to the sensor's near clip plane.
        start = dr.select(at_film, leaving.along(light, sample.direction), start)
        end = dr.select(at_film, light.p + sample.direction * (sample.distance - sample.near), target)
        return self._surfaces.blocked(leaving.between(start, end, at_round & ~at_film), active)


def _sum(ratios: Ratios) -> mi.Float:
    return sum(ratios, mi.Float(0.0))
