"""F and F^-1 over area lights on rectangles, spheres, disks and cylinders: uniform by area.

Mitsuba's own sampling of positions cannot be asked through pointers to shapes: the call would have to
compile for every shape of the scene, and curves and instances have none.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from elps_core.arrays import on_device
from elps_core.scene.emitters import ANALYTIC, KINDS, Light, Matrix


@dataclass
class ShapePoint:
    """A point on a light; fields as in Mitsuba's interactions."""

    p: mi.Point3f
    n: mi.Normal3f
    uv: mi.Point2f


class ShapeLights:
    """Tables of the maps between local and world space of all lights, in their order."""

    def __init__(self, lights: list[Light]) -> None:
        self._kinds = frozenset(light.kind for light in lights)
        blank: Matrix = np.eye(4)
        to_local = [np.vstack([light.to_local, blank[3:]]) if light.kind in ANALYTIC else blank for light in lights]
        self._to_local = on_device(mi.Float, [m[:3] for m in to_local])
        to_world = [np.linalg.inv(matrix)[:3] for matrix in to_local]
        self._to_world = on_device(mi.Float, to_world)
        # Normals turn with the transposed inverse: its rows are the columns of the map to local space.
        turns = [light.sign * matrix[:3, :3].T for light, matrix in zip(lights, to_local, strict=True)]
        rows = np.concatenate([np.hstack([turn, np.zeros((3, 1))]).ravel() for turn in turns])
        self._normals = on_device(mi.Float, rows)

    def point(self, index: mi.UInt32, kind: mi.UInt32, u: mi.Point2f, active: mi.Bool) -> ShapePoint:
        """F: the point at ``u`` of light ``index``, of the ``kind`` that :data:`KINDS` counts; density 1 / area."""
        local, normal, uv = mi.Point3f(2.0 * u.x - 1.0, 2.0 * u.y - 1.0, 0.0), mi.Vector3f(0.0, 0.0, 1.0), mi.Point2f(u)
        if "sphere" in self._kinds:
            here = kind == KINDS.index("sphere")
            ball = mi.warp.square_to_uniform_sphere(u)
            local, normal = dr.select(here, mi.Point3f(ball), local), dr.select(here, ball, normal)
            uv = dr.select(here, mi.Point2f(u.x, dr.acos(dr.clip(ball.z, -1.0, 1.0)) * dr.inv_pi), uv)
        if "disk" in self._kinds:
            here = kind == KINDS.index("disk")
            at = mi.warp.square_to_uniform_disk_concentric(u)
            local = dr.select(here, mi.Point3f(at.x, at.y, 0.0), local)
            turn = dr.atan2(at.y, at.x) * dr.inv_two_pi
            uv = dr.select(here, mi.Point2f(dr.norm(at), dr.select(turn < 0.0, turn + 1.0, turn)), uv)
        if "cylinder" in self._kinds:
            here = kind == KINDS.index("cylinder")
            sin, cos = dr.sincos(dr.two_pi * u.y)
            local = dr.select(here, mi.Point3f(cos, sin, u.x), local)
            normal = dr.select(here, mi.Vector3f(cos, sin, 0.0), normal)
            uv = dr.select(here, mi.Point2f(u.y, u.x), uv)
        p = mi.Point3f(*self._apply(self._to_world, index, local, 1.0, active))
        n = mi.Normal3f(*self._apply(self._normals, index, mi.Point3f(normal), 0.0, active))
        return ShapePoint(p, dr.normalize(n), uv)

    def inverse(self, index: mi.UInt32, kind: mi.UInt32, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Point2f:
        """F^-1: the u of what a ray met on light ``index``, not clipped to [0, 1)."""
        u = mi.Point2f(si.uv)
        if "sphere" in self._kinds or "disk" in self._kinds:
            local = mi.Point3f(*self._apply(self._to_local, index, si.p, 1.0, active))
            ball = mi.warp.uniform_sphere_to_square(dr.normalize(mi.Vector3f(local)))
            disk = mi.warp.uniform_disk_to_square_concentric(mi.Point2f(local.x, local.y))
            u = dr.select(kind == KINDS.index("sphere"), ball, u)
            u = dr.select(kind == KINDS.index("disk"), disk, u)
        if "cylinder" in self._kinds:
            u = dr.select(kind == KINDS.index("cylinder"), mi.Point2f(si.uv.y, si.uv.x), u)
        return u

    @staticmethod
    def _apply(table: mi.Float, index: mi.UInt32, v: mi.Point3f, w: float, active: mi.Bool) -> list[mi.Float]:
        rows = [dr.gather(mi.Vector4f, table, index * 3 + k, active) for k in range(3)]
        return [row.x * v.x + row.y * v.y + row.z * v.z + row.w * w for row in rows]
