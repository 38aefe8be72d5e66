"""F and its inverse on mesh lights: uniform by area over all triangles of a mesh.

Mitsuba's own sampling leaves out which triangle a point lies on, and gives the interpolated normal
in place of the triangle's: densities per area need the latter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.errors import SceneRejected
from elps_core.sampling.inversion import RESOLUTION, quantized
from elps_core.scene.emitters import Light

MAX_FACES = RESOLUTION // 2
"""Triangles of one mesh light: more could not be told apart by one random number."""
SMALLEST_FACE = 1e-9
"""Share of a mesh's area below which a triangle is left out: far less than a step, and without a safe normal."""


@dataclass
class MeshPoint:
    """A point on a mesh light."""

    p: mi.Point3f
    n: mi.Normal3f  # Of the triangle, on the side that emits
    shading: mi.Normal3f  # Interpolated where the mesh does so
    uv: mi.Point2f
    face: mi.UInt32  # Within its mesh
    pdf: mi.Float  # Area measure


class MeshLights:
    """Triangles of all mesh lights of a scene, one mesh after the other.

    u.y chooses the triangle and, reused, with u.x the point on it. The chance of a triangle is a
    whole number of steps of a random number, so its density is its own and exact.

    Raises:
        SceneRejected: a mesh of more than :data:`MAX_FACES` triangles, or without area.
    """

    def __init__(self, lights: list[Light]) -> None:
        none = _Mesh(None)
        meshes = [_Mesh(light.shape) if light.kind == "mesh" else none for light in lights]
        self.smooth = any(mesh.smooth for mesh in meshes)
        """Whether a mesh interpolates normals: what emits is then the side of the shading normal."""
        self._mapped = any(mesh.mapped for mesh in meshes)
        vertex = np.cumsum([0] + [len(mesh.positions) for mesh in meshes])
        face = np.cumsum([0] + [len(mesh.faces) for mesh in meshes])
        self._positions = _floats([mesh.positions for mesh in meshes])
        self._normals = _floats([mesh.normals for mesh in meshes]) if self.smooth else None
        self._texcoords = _floats([mesh.texcoords for mesh in meshes]) if self._mapped else None
        faces = np.concatenate([mesh.faces + before for mesh, before in zip(meshes, vertex, strict=False)])
        self._faces = on_device(mi.UInt32, faces)
        steps = [mesh.steps() for mesh in meshes]
        self._upper = _floats([np.cumsum(part) / RESOLUTION for part in steps])
        area = np.concatenate([mesh.areas for mesh in meshes])
        chance = np.concatenate(steps) / RESOLUTION
        self._density = _floats([np.divide(chance, area, out=np.zeros(len(area)), where=area > 0)])
        # Of each emitter, mesh or not.
        self._first = on_device(mi.UInt32, face[:-1])
        self._count = on_device(mi.UInt32, np.diff(face))
        self._longest = int(np.diff(face).max())
        self._sign = on_device(mi.Float, [mesh.sign for mesh in meshes])
        self._is_smooth = on_device(mi.Bool, [mesh.smooth for mesh in meshes])
        self._is_mapped = on_device(mi.Bool, [mesh.mapped for mesh in meshes])

    def point(self, index: mi.UInt32, u: mi.Point2f, active: mi.Bool) -> MeshPoint:
        """F on the mesh of emitter ``index``."""
        first = dr.gather(mi.UInt32, self._first, index, active)
        last = dr.gather(mi.UInt32, self._count, index, active) - 1

        def below(i: mi.UInt32) -> mi.Bool:
            return (i < last) & (dr.gather(mi.Float, self._upper, first + dr.minimum(i, last), active) <= u.y)

        face = dr.binary_search(0, self._longest - 1, below)
        low, high = self._range(first, face, active)
        corner = [dr.gather(mi.UInt32, self._faces, (first + face) * 3 + k, active) for k in range(3)]
        inside = dr.clip((u.y - low) / (high - low), 0.0, 1.0)
        b = mi.warp.square_to_uniform_triangle(mi.Point2f(u.x, inside))
        p0, p1, p2 = (dr.gather(mi.Point3f, self._positions, vertex, active) for vertex in corner)
        e1, e2 = p1 - p0, p2 - p0
        normal = mi.Normal3f(dr.normalize(dr.cross(e1, e2)) * dr.gather(mi.Float, self._sign, index, active))
        shading = normal
        if self._normals is not None:
            n0, n1, n2 = (dr.gather(mi.Normal3f, self._normals, vertex, active) for vertex in corner)
            bent = mi.Normal3f(dr.normalize(n0 + (n1 - n0) * b.x + (n2 - n0) * b.y))
            shading = dr.select(dr.gather(mi.Bool, self._is_smooth, index, active), bent, normal)
            # Files may wind a triangle against its normals; Mitsuba emits where the normals point.
            normal = dr.select(dr.dot(normal, shading) < 0.0, -normal, normal)
        uv = mi.Point2f(b)
        if self._texcoords is not None:
            t0, t1, t2 = (dr.gather(mi.Point2f, self._texcoords, vertex, active) for vertex in corner)
            mapped = t0 + (t1 - t0) * b.x + (t2 - t0) * b.y
            uv = dr.select(dr.gather(mi.Bool, self._is_mapped, index, active), mapped, uv)
        pdf = dr.gather(mi.Float, self._density, first + face, active)
        return MeshPoint(p0 + e1 * b.x + e2 * b.y, normal, shading, uv, face, pdf)

    def density(self, index: mi.UInt32, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
        """Density of F at a surface point that a ray met, area measure."""
        first = dr.gather(mi.UInt32, self._first, index, active)
        return dr.gather(mi.Float, self._density, first + si.prim_index, active)

    def inverse(self, index: mi.UInt32, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Point2f:
        """F^-1 of a surface point that a ray met on the mesh of emitter ``index``."""
        first = dr.gather(mi.UInt32, self._first, index, active)
        row = first + si.prim_index
        corner = [dr.gather(mi.UInt32, self._faces, row * 3 + k, active) for k in range(3)]
        p0, p1, p2 = (dr.gather(mi.Point3f, self._positions, vertex, active) for vertex in corner)
        e1, e2, r = p1 - p0, p2 - p0, si.p - p0
        a, b, c = dr.squared_norm(e1), dr.dot(e1, e2), dr.squared_norm(e2)
        d1, d2 = dr.dot(r, e1), dr.dot(r, e2)
        scale = dr.rcp(dr.maximum(a * c - b * b, dr.smallest(mi.Float)))
        barycentric = mi.Point2f((c * d1 - b * d2) * scale, (a * d2 - b * d1) * scale)
        u = mi.warp.uniform_triangle_to_square(dr.clip(barycentric, 0.0, 1.0))
        low, high = self._range(first, si.prim_index, active)
        return mi.Point2f(u.x, low + u.y * (high - low))

    def _range(self, first: mi.UInt32, face: mi.UInt32, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """Where a triangle begins and ends in u.y."""
        row = first + face
        low = dr.gather(mi.Float, self._upper, dr.maximum(row, 1) - 1, active & (face > 0))
        return low, dr.gather(mi.Float, self._upper, row, active)


class _Mesh:
    """Vertices and triangles of one mesh, read from Mitsuba."""

    def __init__(self, shape: Any) -> None:
        params = mi.traverse(shape) if shape is not None else {}
        self.positions = _rows(params, "vertex_positions", 3, 0)
        count = len(self.positions)
        self.faces = _rows(params, "faces", 3, 0).astype(np.int64)
        if len(self.faces) > MAX_FACES:
            raise SceneRejected(f"a mesh light has more than {MAX_FACES} triangles: simplify it")
        self.sign = -1.0 if shape is not None and shape.has_flipped_normals() else 1.0
        normals = _rows(params, "vertex_normals", 3, count)
        self.smooth = bool(np.any(normals)) and not shape.has_face_normals()
        self.normals = self.sign * normals
        self.texcoords = _rows(params, "vertex_texcoords", 2, count)
        self.mapped = shape is not None and bool(shape.has_vertex_texcoords())
        p0, p1, p2 = (self.positions[self.faces[:, k]].astype(np.float64) for k in range(3))
        self.areas: NDArray[np.float64] = 0.5 * np.linalg.norm(np.cross(p1 - p0, p2 - p0), axis=1)
        if shape is not None and not np.any(self.areas):
            raise SceneRejected("a mesh light has no area: remove it or give it triangles")

    def steps(self) -> NDArray[np.int64]:
        """Chance of each triangle in steps of :data:`RESOLUTION`; none where it has hardly any area."""
        steps = np.zeros(len(self.areas), np.int64)
        real = self.areas > SMALLEST_FACE * self.areas.sum()
        if real.any():
            steps[real] = quantized(self.areas[real])
        return steps


def _rows(params: Any, name: str, columns: int, count: int) -> NDArray[np.float64]:
    """A table of a mesh [n, columns]; ``count`` rows of zeros where it has none."""
    values = np.array(params[name]) if name in params else np.zeros(0)
    return values.reshape(-1, columns).astype(np.float64) if values.size else np.zeros((count, columns))


def _floats(parts: list[Any]) -> mi.Float:
    return on_device(mi.Float, np.concatenate(parts))
