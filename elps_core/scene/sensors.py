"""Sensors: rays from the film, the density of their directions, and connections to the aperture."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from elps_core.errors import SceneRejected

SUPPORTED = ("PerspectiveCamera", "ThinLensCamera")


@dataclass
class SensorSample:
    """A connection from a surface point to a point on the aperture."""

    direction: mi.Vector3f  # Unit vector from the surface point towards the aperture
    distance: mi.Float  # To the aperture
    near: mi.Float  # Length of the end of the segment that lies before the near clip plane
    position: mi.Point2f  # On the film, pixels, relative to the crop window
    weight: mi.Float  # Importance We |cos| / distance^2 / density of the aperture point
    pdf: mi.Float  # Solid-angle density of the primary ray through that direction, whole film
    valid: mi.Bool


class Camera:
    """A perspective or thin-lens sensor of Mitsuba, with the densities that bidirectional weights need.

    The film is sampled uniformly, so that the direction density given the aperture point is
    1 / (A cos^3), A the area of the film's image on the plane at unit distance.

    Raises:
        SceneRejected: any other sensor type.
    """

    def __init__(self, sensor: mi.Sensor) -> None:
        name = sensor.class_name()
        if name not in SUPPORTED:
            raise SceneRejected("the sensor type is not supported by this integrator: use 'perspective' or 'thinlens'")
        self.sensor = sensor
        self.has_aperture = name == "ThinLensCamera"
        params = mi.traverse(sensor)
        to_world = params["to_world"]
        self.axis = dr.normalize(to_world @ mi.Vector3f(0, 0, 1))
        self.near_clip = mi.Float(sensor.near_clip())
        film = sensor.film()
        self.size = mi.ScalarVector2u(film.crop_size())
        self.offset = mi.ScalarPoint2i(film.crop_offset())
        self._scale = mi.ScalarVector2f(1.0 / self.size.x, 1.0 / self.size.y)
        self._inv_area = mi.Float(1.0 / self._image_area())

    def _image_area(self) -> float:
        """Area of the film's image at unit distance along the axis, from rays through its corners."""
        corners = []
        for x, y in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)):
            ray, _ = self.sensor.sample_ray(0.0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5, 0.5))
            corners.append(mi.Vector3f(ray.d) / dr.dot(ray.d, self.axis))
        return float(dr.norm(dr.cross(corners[1] - corners[0], corners[2] - corners[0]))[0])

    def sample_ray(
        self, position: mi.Point2f, u_wavelength: mi.Float, u_aperture: mi.Point2f
    ) -> tuple[mi.Ray3f, mi.Spectrum, mi.Float]:
        """Primary ray through a film position in pixels, relative to the crop window.

        Returns the ray, the weight of its wavelengths, and the distance from the aperture to the
        ray's origin, which Mitsuba moves to the near clip plane.
        """
        ray, weight = self.sensor.sample_ray(
            self.sensor.shutter_open(), u_wavelength, position * self._scale, u_aperture
        )
        return ray, weight, self.near_clip / dr.dot(ray.d, self.axis)

    def pdf_direction(self, direction: mi.Vector3f) -> mi.Float:
        """Solid-angle density of a primary ray's direction given its aperture point."""
        cosine = dr.dot(direction, self.axis)
        return dr.select(cosine > 0.0, self._inv_area * dr.rcp(cosine * cosine * cosine), 0.0)

    def connect(self, si: mi.SurfaceInteraction3f, u_aperture: mi.Point2f, active: mi.Bool) -> SensorSample:
        """Connect a surface point to the sensor (strategy t = 1)."""
        ds, weight = self.sensor.sample_direction(si, u_aperture, active)
        pdf = self.pdf_direction(-ds.d)
        # The importance is a density over the film: the same for all wavelengths.
        value = weight[0] if dr.size_v(weight) > 0 else weight
        valid = active & (ds.pdf > 0.0) & (value > 0.0) & (pdf > 0.0)
        near = self.near_clip / dr.maximum(-dr.dot(ds.d, self.axis), dr.epsilon(mi.Float))
        return SensorSample(ds.d, ds.dist, near, ds.uv, value, pdf, valid & (ds.dist > near))
