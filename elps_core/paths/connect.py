"""Joining subpaths: the five kinds of strategy (s, t), s light and t eye vertices.

Each method returns the weighted contribution of one strategy for the lanes that are active and
visible, zero elsewhere. Every contribution is that of the same integrand, seen from the sensor:
scattering uses cosines with shading normals as Mitsuba's ``path`` does, conversions between solid
angle and area use geometric normals.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from elps_core.paths.mis import Heuristic, Partial, Ratios, Side
from elps_core.paths.strategies import Strategies
from elps_core.paths.stream import Stream
from elps_core.paths.surfaces import Surfaces
from elps_core.paths.vertex import Vertex
from elps_core.paths.walk import Walk
from elps_core.sampling.direction import Directions
from elps_core.sampling.lights import NOWHERE, RegionLights
from elps_core.sampling.start import Start, StartDensity
from elps_core.scene.sensors import Camera, SensorSample


class Connector:
    """The ways in which one selection of strategies joins subpaths.

    There may be fewer light paths than eye paths, a ``fraction`` of them: their strategies, s >= 2, count in all
    weights with a density that is as much smaller.
    """

    def __init__(
        self,
        scene: mi.Scene,
        camera: Camera,
        lights: StartDensity,
        directions: Directions,
        strategies: Strategies,
        heuristic: Heuristic,
        fraction: mi.Float | float = 1.0,
        region_lights: RegionLights | None = None,
    ) -> None:
        self.scene = scene
        self.surfaces = Surfaces(lights.emission.rays, lights.emission.flags)
        self.camera = camera
        self.lights = lights
        self.directions = directions
        self.strategies = strategies
        self.heuristic = heuristic
        self._fraction = fraction
        # Where frames bend, the two paths through a vertex may see its region from different sides.
        self.region_lights = None if strategies.light_paths and self.surfaces.bends_frames else region_lights
        self._side = heuristic.length + 1
        if strategies.shown is not None:
            table = np.zeros((self._side, self._side), bool)
            for s, t in strategies.shown:
                if max(s, t) < self._side:
                    table[s, t] = True
            # Data, not code: one kernel renders every strategy alone.
            self._shown = mi.Bool(table.ravel())
            dr.eval(self._shown)

    def light_region(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        """The region by which a light is chosen at an eye vertex."""
        if self.region_lights is None:
            return mi.UInt32(NOWHERE)
        # Light may come from the other side of what transmits: light paths would see another region there.
        known = active & ~self.surfaces.flags.transmits(si, active)
        return dr.select(known, self.directions.region(si, si.wi, known), NOWHERE)

    def first_light_vertex(self, vertex: Vertex, cell: mi.UInt32, active: mi.Bool) -> Partial:
        """Partial sums of a light vertex that next event estimation would join to a light of its own choice.

        ``cell`` is where the light path started.
        """
        if self.region_lights is None:
            return vertex.partial
        first = active & (vertex.depth == 1)
        ratio = self.region_lights.ratio(self.light_region(vertex.si, first), cell, first)
        return Partial(vertex.partial.dvcm * self.heuristic.power(ratio), vertex.partial.dvc)

    def hit_emitter(
        self, walk: Walk, vertex: Vertex, region: mi.UInt32, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.UInt32]:
        """s = 0: an eye path meets an emitter, or leaves the scene for its environment.

        ``region`` is that by which a light was chosen at the vertex before. Returns the contribution and the
        emitter's cell.
        """
        active = walk.active if self.lights.emission.has_environment else active
        if not self.strategies.emission:
            active = active & (vertex.depth == 1)
        if not self.strategies.direct:
            active = active & (vertex.depth > 1)
        emission = self.lights.emission
        emitter = emission.emitter(vertex.si, active)
        active = active & (emitter != None)  # noqa: E711 (a comparison of arrays of pointers)
        value, cosine = emission.met(emitter, vertex.si, active)
        active = active & (dr.max(value) > 0.0) & self._is_shown(0, vertex.depth + 1)
        pdf_start, index, cell = self.lights.pdf(emitter, vertex.si, active)
        infinite = ~vertex.si.is_valid() if emission.has_environment else mi.Bool(False)
        nowhere = mi.Bool(False)
        pdf_omega = self.lights.pdf_direction(
            index, cell, vertex.si.p, -walk.ray.d, cosine, active, delta=nowhere, infinite=infinite
        )
        # Next event estimation may choose otherwise than light paths start, of which there may be fewer.
        ratio = self.region_lights.ratio(region, cell, active) if self.region_lights else mi.Float(1.0)
        pdf_omega = pdf_omega * (self._fraction / ratio)
        eye = self._others(vertex, pdf_start * ratio, pdf_omega, "eye", self.strategies.next_event)
        # Directly seen light has no other strategy.
        scale = dr.select(vertex.depth == 1, 1.0, self._weight([], eye))
        return dr.select(active, vertex.beta * value * scale, 0.0), cell

    def connect_light(
        self, vertex: Vertex, region: mi.UInt32, stream: Stream, active: mi.Bool
    ) -> tuple[mi.Spectrum, Start]:
        """s = 1: next event estimation, a fresh light vertex for an eye vertex, chosen by ``region``."""
        emission = self.lights.emission
        u_cell, u_point, wavelengths = stream.next_2d(), stream.next_2d(even=False), vertex.si.wavelengths
        if self.region_lights:
            start, pdf_start = self.region_lights.sample(region, u_cell, u_point, wavelengths, active)
        else:
            start = self.lights.sample(u_cell, u_point, wavelengths, active)
            pdf_start = start.pdf
        point = start.point
        direction, distance2, target = emission.towards(point, vertex.si.p)
        radiance, cos_light = emission.radiance(point, -direction, active)
        active = active & ((dr.max(radiance) > 0.0) & (cos_light > 0.0) & (distance2 > 0.0))
        active = active & self._is_shown(1, vertex.depth + 1)
        wo = vertex.si.to_local(direction)
        active = active & self.surfaces.may_scatter(vertex.si, wo)
        active = active & ~self.surfaces.shadowed(vertex.si, target, point.si, active)
        cos_eye = dr.abs(dr.dot(vertex.si.n, direction))
        seen = self.directions.seen(vertex.si, wo, cos_eye, "eye", active)
        pdf_omega = start.pdf * distance2 / cos_light
        light: Ratios = []
        if self.strategies.emission:
            light = self.heuristic.single(dr.select(point.delta, 0.0, seen.pdf), pdf_omega, "light")
        infinite = point.infinite
        pdf_direction = self.lights.pdf_direction(
            point.index, start.cell, point.si.p, -direction, cos_light, active, delta=point.delta, infinite=infinite
        )
        # Were it not for regions and thinning, the density of the light vertex would cancel in the ratio.
        pdf_light = pdf_direction * cos_eye / distance2 * (self._fraction * pdf_start / start.pdf)
        eye = self._others(vertex, pdf_light, seen.pdf_rev, "eye", False)
        value = vertex.beta * seen.value * radiance * (self._weight(light, eye) / pdf_omega)
        return dr.select(active, value, 0.0), start

    def connect_vertices(self, eye: Vertex, light: Vertex, active: mi.Bool) -> mi.Spectrum:
        """s >= 2, t >= 2: join an eye vertex and a light vertex."""
        delta = light.si.p - eye.si.p
        distance2 = dr.squared_norm(delta)
        direction = delta * dr.rsqrt(distance2)
        active = active & (distance2 > 0.0) & self._is_shown(light.depth + 1, eye.depth + 1)
        wo_eye, wo_light = eye.si.to_local(direction), light.si.to_local(-direction)
        active = active & self.surfaces.may_scatter(eye.si, wo_eye) & self.surfaces.may_scatter(light.si, wo_light)
        end = self.surfaces.leaving.off(light.si, -direction)
        active = active & ~self.surfaces.shadowed(eye.si, end, light.si, active)
        cos_eye, cos_light = dr.abs(dr.dot(eye.si.n, direction)), dr.abs(dr.dot(light.si.n, direction))
        at_eye = self.directions.seen(eye.si, wo_eye, cos_eye, "eye", active)
        at_light = self.directions.seen(light.si, wo_light, cos_light, "light", active)
        inv = dr.rcp(distance2)
        others = self.heuristic.others
        light_side = others(light.partial, at_eye.pdf * cos_light * inv, at_light.pdf_rev, "light")
        eye_side = others(eye.partial, at_light.pdf * cos_eye * inv, at_eye.pdf_rev, "eye")
        scale = inv * self._weight(light_side, eye_side)
        return dr.select(active, eye.beta * at_eye.value * at_light.value * light.beta * scale, 0.0)

    def connect_sensor(self, vertex: Vertex, stream: Stream, active: mi.Bool) -> tuple[mi.Spectrum, SensorSample]:
        """t = 1: join a light vertex to the aperture; the contribution belongs to the sample's film position.

        It is per light path over the whole film: times the number of pixels, it adds to a pixel's mean.
        """
        aperture = stream.next_2d() if self.camera.has_aperture else mi.Point2f(0.5)
        sample = self.camera.connect(vertex.si, aperture, active)
        wo = vertex.si.to_local(sample.direction)
        active = active & sample.valid & self._is_shown(vertex.depth + 1, 1)
        active = active & self.surfaces.may_scatter(vertex.si, wo)
        start = self.surfaces.leaving.along(vertex.si, sample.direction)
        active = active & ~self.hidden(start, vertex.si.p, sample, active)
        cosine = dr.abs(dr.dot(vertex.si.n, sample.direction))
        seen = self.directions.seen(vertex.si, wo, cosine, "light", active)
        light = self._others(vertex, sample.pdf * cosine / sample.distance2, seen.pdf_rev, "light", False)
        eye: Ratios = []
        if self.strategies.aperture:
            pdf_area = seen.pdf * sample.cosine / sample.distance2
            eye = self.heuristic.single(pdf_area, self.camera.pdf_aperture, "eye")
        weight = self._as_rival(light) if self.strategies.rivals else self._weight(light, eye)
        scale = sample.pdf / sample.distance2 * weight
        return dr.select(active, vertex.beta * seen.value * scale, 0.0), sample

    def hit_aperture(self, walk: Walk, active: mi.Bool) -> tuple[mi.Spectrum, SensorSample]:
        """t = 0: the ray of a light path meets the aperture; the contribution as in :meth:`connect_sensor`."""
        sample = self.camera.meet(walk.ray, active & (walk.depth > 0))
        active = sample.valid & self._is_shown(walk.depth + 2, 0)
        active = active & ~self.hidden(walk.ray.o, walk.ray.o, sample, active)
        partial = self.heuristic.arrive(walk.partial, sample.distance2, sample.cosine)
        pdf = self.camera.pdf_aperture
        end = Vertex(mi.SurfaceInteraction3f(), walk.beta, partial, walk.depth)
        light = self._others(end, pdf, sample.pdf, "light", self.strategies.sensor)
        scale = pdf * sample.pdf / sample.cosine * self._weight(light, [])
        return dr.select(active, walk.beta * scale, 0.0), sample

    def hidden(self, start: mi.Point3f, p: mi.Point3f, sample: SensorSample, active: mi.Bool) -> mi.Bool:
        """Whether something stands between ``start``, off the surface point ``p``, and the sensor's near clip plane."""
        # From the surface: where the sensor is far away, a ray from there does not tell what is near the surface.
        end = p + sample.direction * (sample.distance - sample.near)
        return self.surfaces.blocked(self.surfaces.leaving.between(start, end), active)

    def _others(self, vertex: Vertex, pdf_from_other: mi.Float, pdf_rev: mi.Float, side: Side, nearest: bool) -> Ratios:
        """The ratios of one side: of all strategies there, of the nearest where no other exists, or of none.

        ``nearest``: the strategy with one vertex less exists, whether subpaths are joined or not.
        """
        if not (self.strategies.both or nearest):
            return []
        first = None if nearest else vertex.depth == 1
        others = self.heuristic.others
        return others(vertex.partial, pdf_from_other, pdf_rev, side, nearest=not self.strategies.both, first=first)

    def _weight(self, light: Ratios, eye: Ratios) -> mi.Float:
        return self.heuristic.weight(light, eye) if self.strategies.weighted else mi.Float(1.0)

    def _as_rival(self, light: Ratios) -> mi.Float:
        """What turns a light path's contribution f / p into one whose square has the mean of (f / q)^2.

        p is its density, and q that of eye paths: the root of p / q. None where eye paths are the likelier.
        """
        # The heuristic counts powers of q / (fraction p), the greater the likelier eye paths are.
        ratio = sum(light, mi.Float(0.0))
        ratio = dr.sqrt(ratio) if self.heuristic.kind == "power" else ratio
        ratio = ratio * self._fraction
        return dr.select((ratio > 0.0) & (ratio < 1.0), dr.rsqrt(ratio), 0.0)

    def _is_shown(self, s: mi.UInt32 | int, t: mi.UInt32 | int) -> mi.Bool:
        if self.strategies.shown is None:
            return mi.Bool(True)
        return dr.gather(mi.Bool, self._shown, mi.UInt32(s) * self._side + mi.UInt32(t))
