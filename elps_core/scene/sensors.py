"""Sensors: rays from the film, the density of their directions, and connections to the aperture."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from elps_core.errors import SceneRejected

SUPPORTED = {"PerspectiveCamera": "perspective", "ThinLensCamera": "thinlens", "OrthographicCamera": "orthographic"}


@dataclass
class PrimaryRay:
    """A ray from the film into the scene."""

    position: mi.Point2f  # On the film, pixels relative to the crop window
    ray: mi.Ray3f
    weight: mi.Spectrum  # Of its wavelengths
    pdf: mi.Float  # Solid-angle density of the direction given the aperture point; area density of parallel rays
    cosine: mi.Float  # With the sensor's axis
    offset: mi.Float  # Distance from the aperture to the ray's origin, which Mitsuba moves to the near clip plane


@dataclass
class SensorSample:
    """A segment between a surface point and a point on the aperture."""

    direction: mi.Vector3f  # Unit vector from the surface point towards the aperture
    distance: mi.Float  # To the aperture
    distance2: mi.Float  # Its square, 1 for parallel rays: what densities are divided by
    near: mi.Float  # Length of the end of the segment that lies before the near clip plane
    position: mi.Point2f  # On the film, pixels, relative to the crop window
    cosine: mi.Float  # With the sensor's axis
    pdf: mi.Float  # Density of the primary ray through that direction, as in PrimaryRay
    valid: mi.Bool


class Camera:
    """A perspective, thin-lens or orthographic sensor of Mitsuba, with the densities that weights need.

    The film is sampled uniformly, so that the direction density given the aperture point is
    1 / (A cos^3), A the area of the film's image on the plane at unit distance. An orthographic
    sensor's rays are parallel: what has a density is the point of the film plane, 1 / (its area).

    The importance We is normalised to the film: We |cos| = density of the aperture point times
    density of the direction, so that the mean over the film is the mean over primary rays.

    Raises:
        SceneRejected: any other sensor type.
    """

    def __init__(self, sensor: mi.Sensor) -> None:
        kind = SUPPORTED.get(sensor.class_name())
        if kind is None:
            names = "', '".join(SUPPORTED.values())
            raise SceneRejected(f"the sensor type is not supported by this integrator: use '{names}'")
        self.sensor = sensor
        self.parallel = kind == "orthographic"
        params = mi.traverse(sensor)
        to_world = params["to_world"]
        self.has_aperture = kind == "thinlens" and float(params["aperture_radius"][0]) > 0.0
        self._radius = mi.Float(params["aperture_radius"]) if self.has_aperture else mi.Float(1.0)
        self.axis = dr.normalize(to_world @ mi.Vector3f(0, 0, 1))
        self._to_local = to_world.inverse()
        self.near_clip, self._far_clip = mi.Float(sensor.near_clip()), mi.Float(sensor.far_clip())
        film = sensor.film()
        self.size = mi.ScalarVector2u(film.crop_size())
        self.offset = mi.ScalarPoint2i(film.crop_offset())
        self._scale = mi.ScalarVector2f(1.0 / self.size.x, 1.0 / self.size.y)
        corners = [sensor.sample_ray(0.0, 0.5, mi.Point2f(*at), mi.Point2f(0.5))[0] for at in ((0, 0), (1, 0), (0, 1))]
        # The film's image: its corner and edges, at unit distance or on the near plane of parallel rays.
        points = [mi.Vector3f(ray.o) if self.parallel else ray.d / dr.dot(ray.d, self.axis) for ray in corners]
        self._corner, self._across, self._down = points[0], points[1] - points[0], points[2] - points[0]
        area = float(dr.norm(dr.cross(self._across, self._down))[0])
        if not self.parallel:
            # From the angle: through a long lens the corners' directions are all but one in single precision.
            side = 2.0 * np.tan(np.radians(float(np.ravel(params["x_fov"])[0])) / 2.0) / int(film.size().x)
            area = float(side**2) * int(self.size.x) * int(self.size.y)
        self._inv_area = mi.Float(1.0 / area)
        # Data, not code: else the first pass and the second one are different kernels.
        plane = (self._corner, self._across, self._down, self._inv_area)
        dr.make_opaque(self.axis, self._to_local, *plane, self._radius, self.near_clip, self._far_clip)

    def sample_ray(self, position: mi.Point2f, u_wavelength: mi.Float, u_aperture: mi.Point2f) -> PrimaryRay:
        """Primary ray through a film position in pixels, relative to the crop window."""
        ray, weight = self.sensor.sample_ray(
            self.sensor.shutter_open(), u_wavelength, position * self._scale, u_aperture
        )
        cosine = dr.dot(ray.d, self.axis)
        return PrimaryRay(position, ray, weight, self._pdf(cosine), cosine, self.near_clip / cosine)

    @property
    def pdf_aperture(self) -> mi.Float:
        """Area density of the aperture point; infinite where a light path cannot meet the aperture."""
        return dr.rcp(dr.pi * dr.square(self._radius)) if self.has_aperture else mi.Float(dr.inf)

    def _pdf(self, cosine: mi.Float) -> mi.Float:
        if self.parallel:
            return self._inv_area
        return dr.select(cosine > 0.0, self._inv_area * dr.rcp(cosine * cosine * cosine), 0.0)

    def connect(self, si: mi.SurfaceInteraction3f, u_aperture: mi.Point2f, active: mi.Bool) -> SensorSample:
        """Connect a surface point to the sensor (strategy t = 1)."""
        if self.parallel:
            return self._project(si.p, active)
        ds, _ = self.sensor.sample_direction(si, u_aperture, active)
        cosine = -dr.dot(ds.d, self.axis)
        pdf = self._pdf(cosine)
        depth = ds.dist * cosine
        near = self.near_clip / dr.maximum(cosine, dr.epsilon(mi.Float))
        # Mitsuba's own importance is that of a film around the optical axis: zero for a part of a shifted one.
        inside = (ds.uv.x >= 0.0) & (ds.uv.y >= 0.0) & (ds.uv.x < int(self.size.x)) & (ds.uv.y < int(self.size.y))
        valid = active & inside & (ds.pdf > 0.0) & (pdf > 0.0) & (depth > self.near_clip) & (depth < self._far_clip)
        return SensorSample(ds.d, ds.dist, dr.square(ds.dist), near, ds.uv, cosine, pdf, valid)

    def meet(self, ray: mi.Ray3f, active: mi.Bool) -> SensorSample:
        """The segment from a ray's origin to where it meets the aperture (strategy t = 0)."""
        start = self._to_local @ ray.o
        step = self._to_local @ ray.d
        at = start - step * (start.z / step.z)
        lens = mi.Point2f(at.x, at.y) / self._radius
        inside = active & (step.z < 0.0) & (start.z > 0.0) & (dr.squared_norm(lens) < 1.0)
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.p = ray.o
        # Mitsuba draws the aperture point from a square: the one that is mapped to where the ray ends.
        return self.connect(si, mi.warp.uniform_disk_to_square_concentric(lens), inside)

    def _project(self, p: mi.Point3f, active: mi.Bool) -> SensorSample:
        """Connect along the one direction of parallel rays."""
        delta = p - self._corner
        x, y = (dr.dot(delta, edge) / dr.squared_norm(edge) for edge in (self._across, self._down))
        # The corner lies on the near plane.
        distance = dr.dot(delta, self.axis)
        valid = (
            active
            & (distance > 0.0)
            & (distance < self._far_clip - self.near_clip)
            & (x >= 0.0)
            & (x < 1.0)
            & (y >= 0.0)
            & (y < 1.0)
        )
        position = mi.Point2f(x, y) / self._scale
        one = mi.Float(1.0)
        return SensorSample(-self.axis, distance, one, mi.Float(0.0), position, one, self._inv_area, valid)
