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


@dataclass
class Met:
    """What a ray has met; fields as in Mitsuba's interactions."""

    p: mi.Point3f
    n: mi.Normal3f
    shading: mi.Normal3f
    uv: mi.Point2f
    dp_du: mi.Vector3f
    dp_dv: mi.Vector3f
    shape: mi.UInt32  # The number behind Mitsuba's pointer


class ShapeLights:
    """Tables of the maps between local and world space of all lights, in their order."""

    def __init__(self, lights: list[Light]) -> None:
        self._kinds = frozenset(light.kind for light in lights)
        blank: Matrix = np.array([[0.0, 0.0, 0.0, 1.0]])
        to_local = np.stack([np.vstack([light.to_local, blank]) for light in lights])
        to_local[[light.kind not in ANALYTIC for light in lights]] = np.eye(4)
        to_world = np.linalg.inv(to_local)
        sign = np.array([light.sign for light in lights])
        self._to_local = on_device(mi.Float, to_local[:, :3])
        self._to_world = on_device(mi.Float, to_world[:, :3])
        self._sign = on_device(mi.Float, sign)
        # Normals turn with the transposed inverse: its rows are the columns of the map to local space.
        turns = np.zeros((len(lights), 3, 4))
        turns[:, :, :3] = sign[:, None, None] * to_local[:, :3, :3].transpose(0, 2, 1)
        self._normals = on_device(mi.Float, turns)

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

    def met(
        self, index: mi.UInt32, kind: mi.UInt32, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool
    ) -> Met:
        """What a ray meets on light ``index``: as Mitsuba's shapes tell it."""
        p, x, y = ray(hit.t), hit.prim_uv.x, hit.prim_uv.y
        one, none = mi.Float(1.0), mi.Float(0.0)
        normal, uv = mi.Vector3f(0.0, 0.0, 1.0), mi.Point2f(x, y)
        du, dv = mi.Vector3f(2.0, 0.0, 0.0), mi.Vector3f(0.0, 2.0, 0.0)
        if "disk" in self._kinds:
            here, r = kind == KINDS.index("disk"), dr.norm(hit.prim_uv)
            turn = dr.atan2(y, x) * dr.inv_two_pi
            cos, sin = dr.select(r > 0.0, x / r, one), dr.select(r > 0.0, y / r, none)
            uv = dr.select(here, mi.Point2f(r, dr.select(turn < 0.0, turn + 1.0, turn)), uv)
            du = dr.select(here, mi.Vector3f(cos, sin, 0.0), du)
            dv = dr.select(here, mi.Vector3f(-y, x, 0.0) * dr.two_pi, dv)
        if self._kinds & {"rectangle", "sphere", "cylinder"}:
            local = mi.Point3f(*self._apply(self._to_local, index, p, 1.0, active))
        if "rectangle" in self._kinds:
            flat = kind == KINDS.index("rectangle")
            uv = dr.select(flat, mi.Point2f(0.5 * local.x + 0.5, 0.5 * local.y + 0.5), uv)
        if self._kinds & {"sphere", "cylinder"}:
            turn = dr.atan2(local.y, local.x) * dr.inv_two_pi
            turn = dr.select(turn < 0.0, turn + 1.0, turn)
            around = mi.Vector3f(-local.y, local.x, 0.0) * dr.two_pi
        if "sphere" in self._kinds:
            here = kind == KINDS.index("sphere")
            ball = dr.normalize(mi.Vector3f(local))
            r = dr.norm(mi.Vector2f(local.x, local.y))
            cos, sin = dr.select(r > 0.0, local.x / r, one), dr.select(r > 0.0, local.y / r, none)
            normal = dr.select(here, ball, normal)
            uv = dr.select(here, mi.Point2f(turn, dr.safe_acos(ball.z) * dr.inv_pi), uv)
            du = dr.select(here, around, du)
            dv = dr.select(here, mi.Vector3f(local.z * cos, local.z * sin, -r) * dr.pi, dv)
            onto = mi.Point3f(*self._apply(self._to_world, index, mi.Point3f(ball), 1.0, active))
            p = dr.select(here, onto, p)
        if "cylinder" in self._kinds:
            here = kind == KINDS.index("cylinder")
            outwards = mi.Vector3f(local.x, local.y, 0.0)
            normal = dr.select(here, outwards, normal)
            uv = dr.select(here, mi.Point2f(turn, local.z), uv)
            du, dv = dr.select(here, around, du), dr.select(here, mi.Vector3f(0.0, 0.0, 1.0), dv)
            out = outwards * dr.rsqrt(dr.maximum(dr.squared_norm(outwards), dr.smallest(mi.Float)))
            onto = mi.Point3f(*self._apply(self._to_world, index, mi.Point3f(out.x, out.y, local.z), 1.0, active))
            p = dr.select(here, onto, p)
        n = dr.normalize(mi.Normal3f(*self._apply(self._normals, index, mi.Point3f(normal), 0.0, active)))
        du, dv = (mi.Vector3f(*self._apply(self._to_world, index, mi.Point3f(v), 0.0, active)) for v in (du, dv))
        shading = n
        if "rectangle" in self._kinds:
            # Mitsuba's own are two triangles, whose normals a mirrored map turns round.
            wound = dr.normalize(mi.Normal3f(dr.cross(du, dv))) * dr.gather(mi.Float, self._sign, index, active)
            n = dr.select(flat, wound, n)
        return Met(p, n, shading, uv, du, dv, dr.reinterpret_array(mi.UInt32, hit.shape))

    @staticmethod
    def _apply(table: mi.Float, index: mi.UInt32, v: mi.Point3f, w: float, active: mi.Bool) -> list[mi.Float]:
        rows = [dr.gather(mi.Vector4f, table, index * 3 + k, active) for k in range(3)]
        return [row.x * v.x + row.y * v.y + row.z * v.z + row.w * w for row in rows]
