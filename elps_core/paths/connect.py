"""Joining subpaths: the four kinds of strategy (s, t), s light and t eye vertices.

Each function returns the weighted contribution of one strategy for the lanes that are active and
visible, zero elsewhere. Every contribution is that of the same integrand, seen from the sensor:
scattering uses cosines with shading normals as Mitsuba's ``path`` does, conversions between solid
angle and area use geometric normals.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from elps_core.paths.mis import power, weight
from elps_core.paths.scattering import seen_by_eye, seen_by_light
from elps_core.paths.stream import Stream
from elps_core.paths.surfaces import Surfaces
from elps_core.paths.vertex import Vertex
from elps_core.sampling.start import Start, StartDensity
from elps_core.scene.sensors import Camera, SensorSample

SHADOW = 1.0 - 1e-4
"""Share of the segment from the sensor that is tested for shadows: ends short of the surface itself."""


def hit_emitter(
    scene: mi.Scene, vertex: Vertex, lights: StartDensity, active: mi.Bool
) -> tuple[mi.Spectrum, mi.UInt32]:
    """s = 0: an eye path meets an emitter. Returns the contribution and the emitter's cell."""
    emitter = vertex.si.emitter(scene, active)
    active = active & (emitter != None)  # noqa: E711 (a comparison of arrays of pointers)
    value = emitter.eval(vertex.si, active)
    active = active & (dr.max(value) > 0.0)
    pdf_start, index, cell = lights.pdf(emitter, vertex.si, active)
    cosine = dr.abs(dr.dot(vertex.si.to_world(vertex.si.wi), vertex.si.n))
    pdf_omega = lights.emission.pdf_direction(index, mi.Bool(False), cosine, active)
    others = power(pdf_start) * dr.fma(power(pdf_omega), vertex.partial.dvc, vertex.partial.dvcm)
    # Directly seen light has no other strategy: connecting a light vertex to the sensor is not one.
    mis = dr.select(vertex.depth == 1, 1.0, weight(mi.Float(0.0), others))
    return dr.select(active, vertex.beta * value * mis, 0.0), cell


def connect_light(
    surfaces: Surfaces, vertex: Vertex, lights: StartDensity, stream: Stream, active: mi.Bool
) -> tuple[mi.Spectrum, Start]:
    """s = 1: next event estimation, a fresh light vertex for an eye vertex."""
    start = lights.sample(stream.next_2d(), stream.next_2d(), vertex.si.wavelengths, active)
    point = start.point
    delta = point.si.p - vertex.si.p
    distance2 = dr.squared_norm(delta)
    direction = delta * dr.rsqrt(distance2)
    radiance, cos_light = lights.emission.radiance(point, -direction, active)
    active = active & ((dr.max(radiance) > 0.0) & (cos_light > 0.0) & (distance2 > 0.0))
    wo = vertex.si.to_local(direction)
    active = active & surfaces.may_scatter(vertex.si, wo)
    active = active & ~surfaces.shadowed(vertex.si, point.si.p, active)
    seen = seen_by_eye(vertex.si, wo, active)

    cos_eye = dr.abs(dr.dot(vertex.si.n, direction))
    pdf_omega = start.pdf * distance2 / cos_light
    sum_light = dr.select(point.delta, 0.0, power(seen.pdf / pdf_omega))
    pdf_direction = lights.emission.pdf_direction(point.index, point.delta, cos_light, active)
    # Light paths start with the density of this very sample, so that it cancels in the ratio.
    sum_eye = vertex.partial.other_strategies(pdf_direction * cos_eye / distance2, seen.pdf_rev)
    value = vertex.beta * seen.value * radiance * (weight(sum_light, sum_eye) / pdf_omega)
    return dr.select(active, value, 0.0), start


def connect_vertices(surfaces: Surfaces, eye: Vertex, light: Vertex, active: mi.Bool) -> mi.Spectrum:
    """s >= 2, t >= 2: join an eye vertex and a light vertex."""
    delta = light.si.p - eye.si.p
    distance2 = dr.squared_norm(delta)
    direction = delta * dr.rsqrt(distance2)
    active = active & (distance2 > 0.0)
    wo_eye, wo_light = eye.si.to_local(direction), light.si.to_local(-direction)
    active = active & surfaces.may_scatter(eye.si, wo_eye) & surfaces.may_scatter(light.si, wo_light)
    active = active & ~surfaces.shadowed(eye.si, light.si.p, active)
    cos_eye, cos_light = dr.abs(dr.dot(eye.si.n, direction)), dr.abs(dr.dot(light.si.n, direction))
    at_eye = seen_by_eye(eye.si, wo_eye, active)
    at_light = seen_by_light(light.si, wo_light, cos_light, active)
    inv = dr.rcp(distance2)
    sum_light = light.partial.other_strategies(at_eye.pdf * cos_light * inv, at_light.pdf_rev)
    sum_eye = eye.partial.other_strategies(at_light.pdf * cos_eye * inv, at_eye.pdf_rev)
    scale = inv * weight(sum_light, sum_eye)
    return dr.select(active, eye.beta * at_eye.value * at_light.value * light.beta * scale, 0.0)


def connect_sensor(
    surfaces: Surfaces, vertex: Vertex, camera: Camera, stream: Stream, active: mi.Bool
) -> tuple[mi.Spectrum, SensorSample]:
    """t = 1: join a light vertex to the aperture; the contribution belongs to the sample's film position.

    It is per light path over the whole film: times the number of pixels, it adds to a pixel's mean.
    """
    aperture = stream.next_2d() if camera.has_aperture else mi.Point2f(0.5)
    sample = camera.connect(vertex.si, aperture, active)
    wo = vertex.si.to_local(sample.direction)
    active = active & sample.valid & surfaces.may_scatter(vertex.si, wo)
    # From the near clip plane, as a primary ray comes: a ray that left the surface would start off it by
    # Mitsuba's offset, half a millimetre in a room, and meet the edges of cracks that the sensor sees past.
    length = sample.distance - sample.near
    ray = mi.Ray3f(vertex.si.p + sample.direction * length, -sample.direction)
    ray.maxt = length * SHADOW
    active = active & ~surfaces.scene.ray_test(ray, active)
    cosine = dr.abs(dr.dot(vertex.si.n, sample.direction))
    seen = seen_by_light(vertex.si, wo, cosine, active)
    pdf_area = sample.pdf * cosine / dr.square(sample.distance)
    sum_light = vertex.partial.other_strategies(pdf_area, seen.pdf_rev)
    scale = sample.weight * weight(sum_light, mi.Float(0.0))
    return dr.select(active, vertex.beta * seen.value * scale, 0.0), sample
