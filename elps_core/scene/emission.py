"""Emitters as one domain: F maps (emitter, [0,1)^2) to points, F^-1 maps them back [thesis 5.2.1].

``point(index, u)`` is F restricted to one emitter: uniform by area on surfaces, by radiance over the
directions of an environment. Which emitter, and which part of it, is the business of
:mod:`elps_core.sampling.start`.

A point at infinity is a direction. A light path that starts there takes its first ray from a disk
across the whole scene, perpendicular to the direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.scene.cones import Cones
from elps_core.scene.emitters import (
    ANALYTIC,
    DIRECTIONAL,
    ENVIRONMENTS,
    KINDS,
    POINTS,
    SURFACES,
    common_time,
    describe_emitters,
)
from elps_core.scene.environment import Environment
from elps_core.scene.groups import MaterialFlags, every_shape, local_reach, numbers
from elps_core.scene.leaving import Leaving
from elps_core.scene.meeting import Meeting
from elps_core.scene.meshlight import MeshLights
from elps_core.scene.radiance import Radiance
from elps_core.scene.shapelight import ShapeLights
from elps_core.scene.spectrum import luminance, luminance_weights, sample_wavelengths

POWER_SAMPLES, FEWEST_SAMPLES = 32, 8
"""Side of the grid of points (and of directions) over which an emitter's power is averaged; the least, of many."""
POWER_LANES = 1 << 22
"""Points of all grids together: 64 MB of results, and a tenth of a second."""
DISK_MARGIN = 1.001
"""The disk's radius over that of the scene's bounding sphere: rounding must not cut the scene."""


@dataclass
class LightPoint:
    """A point on an emitter, or the direction of one at infinity."""

    index: mi.UInt32  # Which emitter
    emitter: mi.EmitterPtr
    si: mi.SurfaceInteraction3f  # Position, normals, texture coordinates; at infinity n is where the light travels to
    pdf: mi.Float  # Density given the emitter: area on surfaces, solid angle of an environment, else discrete and 1
    delta: mi.Bool  # Whether the emitter has no extent: no ray meets it by chance
    infinite: mi.Bool  # Whether it is at infinity


class Emission:
    """All emitters of a scene, in the order of :func:`elps_core.scene.emitters.describe_emitters`.

    Raises:
        SceneRejected: no emitter, or one that is not supported.
    """

    def __init__(self, scene: mi.Scene, extent: float = 1.0) -> None:
        """``extent`` is how large the scene is: see :class:`elps_core.scene.leaving.Leaving`."""
        self._scene = scene  # Pointers to emitters do not keep them alive.
        lights = describe_emitters(scene)
        self.count = len(lights)
        self._kinds = np.array([light.kind for light in lights])
        self._areas = np.array([light.area for light in lights])
        self.kinds = frozenset(light.kind for light in lights)
        self.has_surface = not self.kinds.isdisjoint(SURFACES)
        self.has_point = not self.kinds.isdisjoint(POINTS)
        self.has_directional = DIRECTIONAL in self.kinds
        self.has_environment = not self.kinds.isdisjoint(ENVIRONMENTS)
        """Whether rays that leave the scene meet light."""
        self.has_infinite = self.has_directional or self.has_environment
        self.time = common_time(scene, lights)
        """The moment at which everything is seen, as Mitsuba counts it."""
        self._emitters = mi.EmitterPtr([light.emitter for light in lights])
        ids = dr.reinterpret_array(mi.UInt32, self._emitters).numpy()
        order = np.zeros(int(ids.max()) + 1, np.uint32)
        order[ids] = np.arange(self.count, dtype=np.uint32)
        self._order = on_device(mi.UInt32, order)
        shapes = every_shape(scene)
        of = numbers(shapes)
        carried = np.zeros(int(of.max(initial=0)) + 1, np.uint32)
        carried[numbers([light.shape for light in lights if light.shape is not None])] = ids[
            [light.shape is not None for light in lights]
        ]
        self._of_shape = on_device(mi.UInt32, carried)
        self._shapes = mi.ShapePtr([light.shape for light in lights])
        self._kind = on_device(mi.UInt32, [light.kind_index for light in lights])
        self._area = on_device(mi.Float, self._areas)
        self._position = on_device(mi.Float, [light.position for light in lights])
        self._radiance = Radiance(lights)
        self._on_shapes = ShapeLights(lights)
        self.flags = MaterialFlags(scene)
        """Of the materials in the scene, lamps' own included."""
        self.rays = Meeting(scene, lights, self._on_shapes, Leaving(max(extent, local_reach(scene))))
        """What rays meet in the scene, lamps included."""
        self._meshes = MeshLights(lights) if "mesh" in self.kinds else None
        sphere = scene.bbox().bounding_sphere()
        self._centre, self._radius = mi.Point3f(sphere.center), mi.Float(DISK_MARGIN * sphere.radius)
        centre, radius = np.array(sphere.center, np.float64).ravel(), DISK_MARGIN * float(sphere.radius)
        self._cones = Cones(lights, scene, centre, radius)
        dr.make_opaque(self._centre, self._radius)  # Data, not code: scenes share kernels.
        surround = [light for light in lights if light.kind in ENVIRONMENTS]
        self._around = dr.opaque(mi.UInt32, int(ids[lights.index(surround[0])]) if surround else 0)
        self._environment = Environment(surround[0].emitter, surround[0].kind, self.time) if surround else None
        self.keys = np.array([light.key for light in lights], np.float32)
        """One row per emitter, [count, KEY_LENGTH], that tells it from the others in any load of the scene."""
        if self._environment:
            self.keys[lights.index(surround[0]), -1] = self._environment.mean
        self.power: NDArray[np.float64] = self._measure_power()
        """Emitted flux of each emitter in units of luminance, [count]; of those at infinity, that
        through the disk across the scene, and of those far away without extent, into the cone around it."""

    # -- F ---------------------------------------------------------------------------------------

    def point(self, index: mi.UInt32, u: mi.Point2f, wavelengths: mi.Spectrum, active: mi.Bool) -> LightPoint:
        """F: the point of emitter ``index`` at ``u``, with its density given the emitter."""
        emitter = dr.gather(mi.EmitterPtr, self._emitters, index, active)
        kind = dr.gather(mi.UInt32, self._kind, index, active)
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(index))
        pdf = dr.rcp(dr.gather(mi.Float, self._area, index, active))
        if self.has_surface:
            si.shape = dr.gather(mi.ShapePtr, self._shapes, index, active & (kind < len(SURFACES)))
        if not self.kinds.isdisjoint(ANALYTIC):
            there = self._on_shapes.point(index, kind, u, active & (kind < len(ANALYTIC)))
            si.p, si.n, si.uv = there.p, there.n, there.uv
        si.sh_frame = mi.Frame3f(si.n)
        if self._meshes:
            on_mesh = kind == KINDS.index("mesh")
            met = self._meshes.point(index, u, active & on_mesh)
            si.p, si.n = dr.select(on_mesh, met.p, si.p), dr.select(on_mesh, met.n, si.n)
            si.uv, si.prim_index = dr.select(on_mesh, met.uv, si.uv), dr.select(on_mesh, met.face, 0)
            si.sh_frame = mi.Frame3f(dr.select(on_mesh, met.shading, si.n))
            pdf = dr.select(on_mesh, met.pdf, pdf)
        delta, infinite = mi.Bool(False), mi.Bool(False)
        if self.has_point:
            delta = (kind >= KINDS.index(POINTS[0])) & (kind <= KINDS.index(POINTS[-1]))
            si.p = dr.select(delta, dr.gather(mi.Point3f, self._position, index, active & delta), si.p)
            si.n = dr.select(delta, mi.Normal3f(0, 0, 1), si.n)
        if self.has_directional:
            directional = kind == KINDS.index(DIRECTIONAL)
            si.n = dr.select(directional, dr.gather(mi.Normal3f, self._position, index, active & directional), si.n)
            delta, infinite = delta | directional, directional
        if self._environment:
            around = kind > KINDS.index(DIRECTIONAL)
            direction, density = self._environment.sample(u, active & around)
            si.n = dr.select(around, mi.Normal3f(-direction), si.n)
            pdf = dr.select(around, density, pdf)
            infinite = infinite | around
        si.time, si.wavelengths = self.time, wavelengths
        return LightPoint(index, emitter, si, pdf, delta, infinite)

    def density(self, index: mi.UInt32, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
        """Density of F on emitter ``index`` at what a ray met, per area.

        Where ``si`` is not valid, the ray left the scene into direction ``-si.wi`` (world space), and
        the density is per solid angle.
        """
        pdf = dr.rcp(dr.gather(mi.Float, self._area, index, active))
        if self._meshes:
            on_mesh = dr.gather(mi.UInt32, self._kind, index, active) == KINDS.index("mesh")
            pdf = dr.select(on_mesh, self._meshes.density(index, si, active & on_mesh), pdf)
        if self._environment:
            around = ~si.is_valid()
            pdf = dr.select(around, self._environment.density(-si.wi, active & around), pdf)
        return pdf

    # -- F^-1 ------------------------------------------------------------------------------------

    def emitter(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.EmitterPtr:
        """The emitter that a ray has met, where it left the scene the environment; None where there is none."""
        number = dr.gather(mi.UInt32, self._of_shape, dr.reinterpret_array(mi.UInt32, si.shape), active)
        if self._environment:
            number = dr.select(active & ~si.is_valid(), self._around, number)
        return dr.reinterpret_array(mi.EmitterPtr, number)

    def index_of(self, emitter: mi.EmitterPtr, active: mi.Bool) -> mi.UInt32:
        """Which emitter a pointer names, in this object's order."""
        return dr.gather(mi.UInt32, self._order, dr.reinterpret_array(mi.UInt32, emitter), active)

    def inverse(self, index: mi.UInt32, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Point2f:
        """F^-1: the u of what a ray met on emitter ``index``; ``si`` as for :meth:`density`."""
        kind = dr.gather(mi.UInt32, self._kind, index, active)
        u = mi.Point2f(si.uv)
        if not self.kinds.isdisjoint(ANALYTIC):
            on_shape = kind < len(ANALYTIC)
            u = dr.select(on_shape, self._on_shapes.inverse(index, kind, si, active & on_shape), u)
        if self._meshes:
            on_mesh = kind == KINDS.index("mesh")
            u = dr.select(on_mesh, self._meshes.inverse(index, si, active & on_mesh), u)
        if self._environment:
            around = ~si.is_valid()
            u = dr.select(around, self._environment.inverse(-si.wi, active & around), u)
        return dr.clip(u, 0.0, mi.Float(np.float32(1.0) - np.finfo(np.float32).epsneg))

    # -- Emitted light ---------------------------------------------------------------------------

    def radiance(self, point: LightPoint, direction: mi.Vector3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
        """Emission from ``point`` into the unit vector ``direction``, and the cosine to go with it.

        Radiance and the cosine with the geometric normal on surfaces (0 on the back); intensity and 1
        for emitters without extent; at infinity radiance, or irradiance of a directional emitter, and 1.
        """
        value = dr.zeros(mi.Spectrum)
        cosine = mi.Float(1.0)
        if self.has_surface:
            cosine = dr.maximum(dr.dot(point.si.n, direction), 0.0)
            cosine = dr.select(point.delta | point.infinite, 1.0, cosine)
        if self.has_surface or self._environment:
            si = mi.SurfaceInteraction3f(point.si)
            # An environment is asked with world directions, as a ray that leaves the scene asks it.
            si.wi = dr.select(point.infinite, direction, si.to_local(direction))
            value = self._radiance.seen(point.index, si, active & ~point.delta)
        if self.has_point or self.has_directional:
            # Far enough away for single precision to tell the direction; 1 at infinity, where p is the origin.
            away = 1.0 + dr.max(dr.abs(point.si.p))
            near = mi.Interaction3f(0.0, self.time, point.si.wavelengths, point.si.p + direction * away)
            intensity = self._radiance.sent(point.index, near, away, active & point.delta)
            value = dr.select(point.delta, intensity, value)
        return value & active, cosine

    def seen(self, emitter: mi.EmitterPtr, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Spectrum:
        """Radiance of ``emitter`` towards a ray that met it; ``si`` as for :meth:`density`."""
        return self._radiance.seen(self.index_of(emitter, active), si, active)

    def met(self, emitter: mi.EmitterPtr, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
        """Radiance of ``emitter`` towards a ray that met it, and the cosine: what :meth:`radiance` gives
        for the same point and direction. ``si`` as for :meth:`density`."""
        value = self.seen(emitter, si, active)
        # The side that emits is that of the shading normal, whichever way a triangle is wound or a shape mirrored.
        cosine = dr.mulsign(dr.dot(si.to_world(si.wi), si.n), dr.dot(si.n, si.sh_frame.n))
        cosine = dr.select(si.is_valid(), dr.maximum(cosine, 0.0), 1.0)
        return value & (active & (cosine > 0.0)), cosine

    # -- First rays and connections --------------------------------------------------------------

    def first_ray(self, point: LightPoint, u: mi.Point2f, active: mi.Bool) -> mi.Ray3f:
        """The first ray of a light path from ``point``; density by :meth:`pdf_direction`."""
        n = mi.Vector3f(point.si.n)
        frame = mi.Frame3f(point.si.n)
        direction, origin = n, point.si.p
        if self.has_surface:
            aimed, towards, left = False, n, u
            if self._cones.aims:
                on_surface = active & ~(point.delta | point.infinite)
                aimed, towards, left = self._cones.aimed(point.index, point.si.p, u, on_surface)
            direction = frame.to_world(mi.warp.square_to_cosine_hemisphere(left))
            direction = dr.select(aimed, towards, direction)
            origin = self.rays.leaving.off(point.si, direction)
        if self.has_point:
            at_point = point.delta & ~point.infinite
            direction = dr.select(at_point, self._cones.from_point(point.index, u, active), direction)
            start = point.si.p + direction * self.gap(point, active) if self._cones.advances else point.si.p
            origin = dr.select(at_point, start, origin)
        if self.has_infinite:
            disk = mi.warp.square_to_uniform_disk_concentric(u)
            start = self._centre + (frame.to_world(mi.Vector3f(disk.x, disk.y, 0.0)) - n) * self._radius
            direction, origin = dr.select(point.infinite, n, direction), dr.select(point.infinite, start, origin)
        return mi.Ray3f(origin, direction, self.time, point.si.wavelengths)

    def gap(self, point: LightPoint, active: mi.Bool) -> mi.Float:
        """Distance from ``point`` to the origin of :meth:`first_ray`, but from infinity."""
        return self._cones.gap(point.index, active) if self._cones.advances else mi.Float(0.0)

    def pdf_direction(
        self,
        index: mi.UInt32,
        p: mi.Point3f,
        direction: mi.Vector3f,
        cosine: mi.Float,
        active: mi.Bool,
        *,
        delta: mi.Bool,
        infinite: mi.Bool,
    ) -> mi.Float:
        """Density of :meth:`first_ray` given its point ``p``, ``cosine`` as :meth:`radiance` gives it.

        Solid angle of the direction; at infinity area of the origin on the disk.
        """
        pdf = cosine * dr.inv_pi
        if self._cones.aims:
            pdf = self._cones.mixed(pdf, index, p, direction, active)
        if self.has_point:
            pdf = dr.select(delta, self._cones.pdf_point(index, active), pdf)
        if self.has_infinite:
            pdf = dr.select(infinite, dr.inv_pi * dr.rcp(dr.square(self._radius)), pdf)
        return pdf

    def towards(self, point: LightPoint, p: mi.Point3f) -> tuple[mi.Vector3f, mi.Float, mi.Point3f]:
        """Where ``point`` is seen from ``p``: unit direction, squared distance, end of the shadow ray.

        At infinity the squared distance is 1, so that densities stay those of directions, and the
        shadow ray ends outside the scene.
        """
        delta = point.si.p - p
        distance2 = dr.squared_norm(delta)
        direction, target = delta * dr.rsqrt(distance2), point.si.p
        if self.has_surface:
            off = self.rays.leaving.off(point.si, -direction)
            target = dr.select(point.delta, target, off)
        if self.has_infinite:
            direction = dr.select(point.infinite, -mi.Vector3f(point.si.n), direction)
            distance2 = dr.select(point.infinite, 1.0, distance2)
            target = dr.select(point.infinite, p + direction * (2.0 * self._radius), target)
        return direction, distance2, target

    # -- Tables ----------------------------------------------------------------------------------

    def _measure_power(self) -> NDArray[np.float64]:
        """Average emission over a grid on each emitter, times its area and solid angle; closed forms where they are."""
        known = self._radiance.known
        # Light of a surface into all directions of a half space, and of a point into those of its cone.
        around = np.where(np.isin(self._kinds, SURFACES), np.pi * self._areas, 2.0 * np.pi * self._cones.heights)
        bright = self._radiance.values @ (np.ones(1) if mi.is_monochromatic else luminance_weights())
        power: NDArray[np.float64] = np.where(known, around * bright, 0.0)
        if not known.all():
            power[~known] = self._measured_power(np.flatnonzero(~known))
        return power

    def _measured_power(self, emitters: NDArray[np.int64]) -> NDArray[np.float64]:
        side = int(np.clip(np.sqrt(POWER_LANES / len(emitters)), FEWEST_SAMPLES, POWER_SAMPLES))
        cells, side = side**2, dr.opaque(mi.UInt32, side)
        i = dr.arange(mi.UInt32, cells * len(emitters))
        place = i // dr.opaque(mi.UInt32, cells)
        cell = i - place * dr.opaque(mi.UInt32, cells)
        index = dr.gather(mi.UInt32, on_device(mi.UInt32, emitters), place)
        row = cell // side
        u = mi.Point2f(mi.Float(cell - row * side) + 0.5, mi.Float(row) + 0.5) / mi.Float(side)
        wavelengths, weight = sample_wavelengths((mi.Float(cell) + 0.5) / dr.opaque(mi.Float, cells))
        active = mi.Bool(True)
        point = self.point(index, u, wavelengths, active)
        # Along the normal: area lights emit alike into all directions; others over their own cone.
        direction = mi.Vector3f(point.si.sh_frame.n)
        around = self.first_ray(point, mi.Point2f(u.y, u.x), active).d
        direction = dr.select(point.delta | point.infinite, around, direction)
        value, _ = self.radiance(point, direction, active)
        delta, infinite = point.delta, point.infinite
        one = self.pdf_direction(index, point.si.p, direction, mi.Float(1.0), active, delta=delta, infinite=infinite)
        # Wherever a surface's paths are aimed, it shines into all directions.
        one = dr.select(delta | infinite, one, dr.inv_pi)
        flux = np.array(luminance(value * weight, wavelengths) / (point.pdf * one), np.float64)
        return np.asarray(np.nan_to_num(flux.reshape(len(emitters), cells).mean(axis=1), nan=0.0, posinf=0.0))
