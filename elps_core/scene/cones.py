"""The cones that light paths start into: of a lamp far away, the scene is a tiny part of what it lights."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.scene.emitters import POINTS, SURFACES, Light, Matrix

SHARE = 0.5
"""Chance that a light path from a surface far away is aimed at the scene; else it goes wherever the lamp shines."""
NARROW = 0.01
"""1 - cos of the half angle, 8 degrees, of the cone around the scene below which a lamp is far away: 7 radii."""
NARROWEST = 1e-12
"""Least 1 - cos of the half angle, a millionth of a radian: single precision tells two dozen directions across it."""
MARGIN = 1.01
"""Radius of the ball that paths are aimed at, over that around the shapes in it: rounding must not cut the scene."""


class Cones:
    """Directions of light paths, uniform in cones.

    From an emitter without extent a cone holds all light that it sends; if it is far away the whole scene, where that
    is narrower. From the surface of a lamp far away it holds the shapes that are no lamps.

    Args:
        lights: all emitters of a scene.
        scene: the scene.
        centre: of the ball around the whole scene [3].
        radius: of this ball.
    """

    def __init__(self, lights: list[Light], scene: mi.Scene, centre: Matrix, radius: float) -> None:
        rows = np.array([_of_point(light, centre, radius) for light in lights])
        self._rows = on_device(mi.Float, rows)
        self.heights: NDArray[np.float64] = rows[:, 3]
        """1 - cos of the half angle of each emitter's own cone [count]; 2 where it has none."""
        gaps = [_gap(light, centre, radius) for light in lights]
        self.advances = any(gaps)
        """Whether paths of some emitter without extent start close to the scene, and not at the emitter."""
        self._gaps = on_device(mi.Float, gaps)
        box = mi.ScalarBoundingBox3f()
        for shape in scene.shapes():
            if not shape.is_emitter():
                box.expand(shape.bbox())
        ball = box.bounding_sphere()
        middle, around = np.array(ball.center, np.float64).ravel(), MARGIN * float(ball.radius)
        far = [_is_far(light, middle, around) for light in lights]
        self.aims = any(far)
        """Whether paths from some lamp's surface are aimed."""
        if self.aims:
            self._centre, self._radius = mi.Point3f(*map(float, middle)), mi.Float(around)
            dr.make_opaque(self._centre, self._radius)  # Data, not code: scenes share kernels.
            self._shares = on_device(mi.Float, np.where(far, SHARE, 0.0))

    def from_point(self, index: mi.UInt32, u: mi.Point2f, active: mi.Bool) -> mi.Vector3f:
        """A direction from an emitter without extent; density by :meth:`pdf_point`."""
        row = dr.gather(mi.Vector4f, self._rows, index, active)
        return _in_cone(mi.Vector3f(row.x, row.y, row.z), row.w, u)

    def gap(self, index: mi.UInt32, active: mi.Bool) -> mi.Float:
        """Distance from an emitter without extent in which paths meet nothing: single precision would lose there what
        a ray meets close to the scene."""
        return dr.gather(mi.Float, self._gaps, index, active)

    def pdf_point(self, index: mi.UInt32, active: mi.Bool) -> mi.Float:
        """Density of :meth:`from_point` per solid angle."""
        return dr.inv_two_pi * dr.rcp(dr.gather(mi.Vector4f, self._rows, index, active).w)

    def aimed(
        self, index: mi.UInt32, p: mi.Point3f, u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Bool, mi.Vector3f, mi.Point2f]:
        """Whether a path from ``p`` on a lamp's surface is aimed, its direction then, and what is left of ``u``."""
        share = dr.gather(mi.Float, self._shares, index, active)
        chosen = active & (u.x < share)
        left = dr.select(chosen, u.x / share, (u.x - share) / (1.0 - share))
        u = mi.Point2f(dr.clip(left, 0.0, mi.Float(dr.one_minus_epsilon(mi.Float))), u.y)
        return chosen, _in_cone(*self._around(p), u), u

    def mixed(self, pdf: mi.Float, index: mi.UInt32, p: mi.Point3f, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Density of the unit vector ``d`` per solid angle where :meth:`aimed` leaves it to a density ``pdf``."""
        share = dr.gather(mi.Float, self._shares, index, active)
        axis, height = self._around(p)
        inside = 0.5 * dr.squared_norm(d - axis) < height
        return dr.lerp(pdf, dr.select(inside, dr.inv_two_pi * dr.rcp(height), 0.0), share)

    def _around(self, p: mi.Point3f) -> tuple[mi.Vector3f, mi.Float]:
        """The cone from ``p`` around the ball: axis, and 1 - cos of the half angle."""
        away = self._centre - p
        distance = dr.norm(away)
        sine2 = dr.minimum(dr.square(self._radius / distance), 1.0)
        return away / distance, dr.maximum(sine2 / (1.0 + dr.sqrt(1.0 - sine2)), NARROWEST)


def _of_point(light: Light, centre: Matrix, radius: float) -> tuple[float, float, float, float]:
    """Axis and 1 - cos of the half angle of the cone of an emitter without extent."""
    axis = np.array(light.key[3:6]) if light.kind in POINTS and any(light.key[3:6]) else np.array((0.0, 0.0, 1.0))
    height = 1.0 - light.cos_cutoff
    if light.kind in POINTS:
        away = centre - light.position
        around = _height(float(np.linalg.norm(away)), radius)
        if around < min(height, NARROW):
            axis, height = away / np.linalg.norm(away), around
    x, y, z = map(float, axis)
    return x, y, z, float(height)


def _gap(light: Light, centre: Matrix, radius: float) -> float:
    """Distance between an emitter without extent and the ball, where it is far away."""
    distance = float(np.linalg.norm(centre - light.position)) if light.kind in POINTS else 0.0
    return distance - radius if _height(distance, radius) < NARROW else 0.0


def _is_far(light: Light, middle: Matrix, radius: float) -> bool:
    """Whether all of a lamp's surface is far from a ball."""
    if light.kind not in SURFACES:
        return False
    low, high = np.array(light.key[:3]), np.array(light.key[3:6])
    nearest = float(np.linalg.norm((low + high) / 2.0 - middle) - np.linalg.norm(high - low) / 2.0)
    return _height(nearest, radius) < NARROW


def _height(distance: float, radius: float) -> float:
    """1 - cos of the half angle of the cone around a ball; 2 from within it, or where there is none."""
    if not 0.0 < radius < distance < np.inf:
        return 2.0
    sine2 = (radius / distance) ** 2
    return max(float(sine2 / (1.0 + np.sqrt(1.0 - sine2))), NARROWEST)


def _in_cone(axis: mi.Vector3f, height: mi.Float, u: mi.Point2f) -> mi.Vector3f:
    """Uniform in the cone of directions with 1 - cos below ``height``, which may be tiny."""
    disk = mi.warp.square_to_uniform_disk_concentric(u)
    below = height * dr.squared_norm(disk)
    across = disk * dr.safe_sqrt(height * (2.0 - below))
    return mi.Frame3f(mi.Normal3f(axis)).to_world(mi.Vector3f(across.x, across.y, 1.0 - below))
