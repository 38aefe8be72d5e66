"""Emitters as one domain: F maps (emitter, [0,1)^2) to points, F^-1 maps them back [thesis 5.2.1].

``point(index, u)`` is F restricted to one emitter: uniform by area on surfaces. Which emitter, and
which part of it, is the business of :mod:`elps_core.sampling.start`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.errors import SceneRejected

Matrix = np.ndarray[Any, np.dtype[np.floating[Any]]]
KEY_LENGTH = 7
"""Bounding box and area tell emitters apart; a point light has its position and zeros."""
SURFACES = ("rectangle", "sphere", "disk", "cylinder", "mesh")
"""Shapes that may carry an area light: those whose F has an inverse."""
POINTS = ("point", "spot")
"""Emitters without extent."""
POWER_SAMPLES = 32
"""Side of the grid of points (and of directions) over which an emitter's power is averaged."""


@dataclass
class LightPoint:
    """A point on an emitter."""

    index: mi.UInt32  # Which emitter
    emitter: mi.EmitterPtr
    si: mi.SurfaceInteraction3f  # Position, normal, texture coordinates
    pdf: mi.Float  # Density of the point given the emitter, area measure; 1 for a point light
    delta: mi.Bool  # Whether the emitter has no extent


class Emission:
    """All emitters of a scene, in an order that depends on their geometry alone.

    The order in which Mitsuba lists emitters changes between two loads of one scene, so whatever
    is stored per emitter must be keyed by this order.

    Raises:
        SceneRejected: no emitter, or one whose type has no F.
    """

    def __init__(self, scene: mi.Scene) -> None:
        lights = [_describe_shape(shape) for shape in scene.shapes() if shape.is_emitter()]
        on_shapes = len(lights)
        lights += [_describe_point(emitter) for emitter in scene.emitters() if not emitter.get_shape()]
        if not lights:
            raise SceneRejected("the scene has no light: add an emitter")
        lights.sort(key=lambda light: light.key)
        self.count = len(lights)
        self.has_surface = on_shapes > 0
        self.has_point = self.count > on_shapes
        self.keys = np.array([light.key for light in lights], np.float32)
        """One row per emitter, [count, 7], that tells it from the others in any load of the scene."""
        self.kinds = frozenset(light.kind for light in lights)
        self._emitters = mi.EmitterPtr([light.emitter for light in lights])
        ids = dr.reinterpret_array(mi.UInt32, self._emitters).numpy()
        order = np.zeros(int(ids.max()) + 1, np.uint32)
        order[ids] = np.arange(self.count, dtype=np.uint32)
        self._order = mi.UInt32(order)
        self._shapes = mi.UInt32(np.array([_registry_id(light.shape) for light in lights], np.uint32))
        self._point = mi.Bool([light.shape is None for light in lights])
        self._kind = mi.UInt32([light.kind_index for light in lights])
        self._area = mi.Float([light.area for light in lights])
        self._to_local = mi.Float(np.concatenate([light.to_local.ravel() for light in lights]).astype(np.float32))
        self._position = mi.Float(np.concatenate([light.position for light in lights]).astype(np.float32))
        self._cutoff = mi.Float([light.cos_cutoff for light in lights])
        self._build_meshes(lights)
        self.power: NDArray[np.float64] = self._measure_power()
        """Emitted flux of each emitter in units of luminance, [count]."""

    # -- F ---------------------------------------------------------------------------------------

    def point(self, index: mi.UInt32, u: mi.Point2f, wavelengths: mi.Spectrum, active: mi.Bool) -> LightPoint:
        """F: the point of emitter ``index`` at ``u``; density 1 / area on surfaces."""
        emitter = dr.gather(mi.EmitterPtr, self._emitters, index, active)
        delta = dr.gather(mi.Bool, self._point, index, active) if self.has_point else mi.Bool(False)
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(index))
        if self.has_surface:
            shape = dr.reinterpret_array(mi.ShapePtr, dr.gather(mi.UInt32, self._shapes, index, active & ~delta))
            ps = shape.sample_position(0.0, u, active & ~delta)
            si = mi.SurfaceInteraction3f(ps, wavelengths)
            si.shape = shape
        si.wavelengths = wavelengths
        if self.has_point:
            centre = dr.gather(mi.Point3f, self._position, index, active & delta)
            si.p = dr.select(delta, centre, si.p)
            si.n = dr.select(delta, mi.Normal3f(0, 0, 1), si.n)
        si.sh_frame = mi.Frame3f(si.n)
        return LightPoint(index, emitter, si, self.area_density(index, active), delta)

    def area_density(self, index: mi.UInt32, active: mi.Bool) -> mi.Float:
        """Density of F on emitter ``index``, area measure, 1 / m^2 of scene units; 1 for points."""
        return dr.rcp(dr.gather(mi.Float, self._area, index, active))

    # -- F^-1 ------------------------------------------------------------------------------------

    def index_of(self, emitter: mi.EmitterPtr, active: mi.Bool) -> mi.UInt32:
        """Which emitter a pointer names, in this object's order."""
        return dr.gather(mi.UInt32, self._order, dr.reinterpret_array(mi.UInt32, emitter), active)

    def inverse(self, index: mi.UInt32, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Point2f:
        """F^-1: the u of a surface point that a ray met on emitter ``index``."""
        kind = dr.gather(mi.UInt32, self._kind, index, active)
        local = self._local(index, si.p, active)
        u = mi.Point2f(si.uv)
        if "sphere" in self.kinds:
            unit = mi.warp.uniform_sphere_to_square(dr.normalize(mi.Vector3f(local)))
            u = dr.select(kind == SURFACES.index("sphere"), unit, u)
        if "disk" in self.kinds:
            unit = mi.warp.uniform_disk_to_square_concentric(mi.Point2f(local.x, local.y))
            u = dr.select(kind == SURFACES.index("disk"), unit, u)
        if "cylinder" in self.kinds:
            u = dr.select(kind == SURFACES.index("cylinder"), mi.Point2f(si.uv.y, si.uv.x), u)
        if "mesh" in self.kinds:
            is_mesh = kind == SURFACES.index("mesh")
            u = dr.select(is_mesh, self._mesh_inverse(index, si, active & is_mesh), u)
        return dr.clip(u, 0.0, mi.Float(np.float32(1.0) - np.finfo(np.float32).epsneg))

    # -- Emitted radiance ------------------------------------------------------------------------

    def radiance(self, point: LightPoint, direction: mi.Vector3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
        """Emission from ``point`` into the unit vector ``direction``, and the cosine to go with it.

        Radiance and |cos| with the surface normal on surfaces; intensity and 1 for point lights.
        """
        value = dr.zeros(mi.Spectrum)
        cosine = mi.Float(1.0)
        if self.has_surface:
            si = mi.SurfaceInteraction3f(point.si)
            si.wi = si.to_local(direction)
            cosine = dr.select(point.delta, 1.0, dr.maximum(dr.dot(point.si.n, direction), 0.0))
            value = point.emitter.eval(si, active & ~point.delta)
        if self.has_point:
            # At unit distance the irradiance of a point light is its intensity.
            near = mi.Interaction3f(0.0, 0.0, point.si.wavelengths, point.si.p + direction)
            _, intensity = point.emitter.sample_direction(near, mi.Point2f(0.5), active & point.delta)
            value = dr.select(point.delta, intensity, value)
        return value & active, cosine

    def sample_direction(self, point: LightPoint, u: mi.Point2f, active: mi.Bool) -> mi.Vector3f:
        """A direction to start a light path with; density by :meth:`pdf_direction`."""
        direction = point.si.to_world(mi.warp.square_to_cosine_hemisphere(u))
        if self.has_point:
            cutoff = dr.gather(mi.Float, self._cutoff, point.index, active)
            cone = mi.warp.square_to_uniform_cone(u, cutoff)
            axis = mi.Frame3f(mi.Normal3f(self._axis(point.index, active)))
            direction = dr.select(point.delta, axis.to_world(cone), direction)
        return direction

    def pdf_direction(self, index: mi.UInt32, delta: mi.Bool, cosine: mi.Float, active: mi.Bool) -> mi.Float:
        """Solid-angle density of :meth:`sample_direction`, ``cosine`` as :meth:`radiance` gives it."""
        pdf = cosine * dr.inv_pi
        if self.has_point:
            cutoff = dr.gather(mi.Float, self._cutoff, index, active)
            pdf = dr.select(delta, dr.inv_two_pi * dr.rcp(1.0 - cutoff), pdf)
        return pdf

    # -- Tables ----------------------------------------------------------------------------------

    def _local(self, index: mi.UInt32, p: mi.Point3f, active: mi.Bool) -> mi.Point3f:
        rows = [dr.gather(mi.Vector4f, self._to_local, index * 3 + k, active) for k in range(3)]
        return mi.Point3f(*(row.x * p.x + row.y * p.y + row.z * p.z + row.w for row in rows))

    def _axis(self, index: mi.UInt32, active: mi.Bool) -> mi.Vector3f:
        # The third row of the world-to-local map is the local z axis, up to scale.
        row = dr.gather(mi.Vector4f, self._to_local, index * 3 + 2, active)
        return dr.normalize(mi.Vector3f(row.x, row.y, row.z))

    def _build_meshes(self, lights: list[_Light]) -> None:
        """Face tables of all mesh lights, one after the other."""
        vertices, faces, cdf, first_vertex, first_face = [], [], [], [], []
        nv = nf = 0
        for light in lights:
            first_vertex.append(nv)
            first_face.append(nf)
            if light.kind != "mesh":
                continue
            params = mi.traverse(light.shape)
            v = np.array(params["vertex_positions"]).reshape(-1, 3)
            f = np.array(params["faces"]).reshape(-1, 3)
            area = np.linalg.norm(np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]]), axis=1)
            upper = np.cumsum(area.astype(np.float64)) / area.sum(dtype=np.float64)
            cdf.append(np.stack([np.concatenate([[0.0], upper[:-1]]), upper], axis=1))
            vertices.append(v)
            faces.append(f)
            nv += len(v)
            nf += len(f)
        if not faces:
            return
        self._vertices = mi.Float(np.concatenate(vertices).astype(np.float32).ravel())
        self._faces = mi.UInt32(np.concatenate(faces).astype(np.uint32).ravel())
        self._face_cdf = mi.Float(np.concatenate(cdf).astype(np.float32).ravel())
        self._first_vertex = mi.UInt32(first_vertex)
        self._first_face = mi.UInt32(first_face)

    def _mesh_inverse(self, index: mi.UInt32, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Point2f:
        """Mitsuba picks the face with u.y, reuses u.y, and maps the square to the triangle."""
        first = dr.gather(mi.UInt32, self._first_vertex, index, active)
        row = dr.gather(mi.UInt32, self._first_face, index, active) + si.prim_index
        face = [dr.gather(mi.UInt32, self._faces, row * 3 + k, active) + first for k in range(3)]
        p0, p1, p2 = (dr.gather(mi.Point3f, self._vertices, vertex, active) for vertex in face)
        e1, e2, r = p1 - p0, p2 - p0, si.p - p0
        a, b, c = dr.squared_norm(e1), dr.dot(e1, e2), dr.squared_norm(e2)
        d1, d2 = dr.dot(r, e1), dr.dot(r, e2)
        scale = dr.rcp(dr.maximum(a * c - b * b, dr.smallest(mi.Float)))
        barycentric = mi.Point2f((c * d1 - b * d2) * scale, (a * d2 - b * d1) * scale)
        u = mi.warp.uniform_triangle_to_square(dr.clip(barycentric, 0.0, 1.0))
        low, high = (dr.gather(mi.Float, self._face_cdf, row * 2 + k, active) for k in range(2))
        return mi.Point2f(u.x, low + u.y * (high - low))

    def _measure_power(self) -> NDArray[np.float64]:
        """Average emission over a grid on each emitter (textures), times area and solid angle."""
        n = POWER_SAMPLES
        cells = n * n
        i = dr.arange(mi.UInt32, cells * self.count)
        index = i // cells
        u = mi.Point2f(((i % cells) % n + 0.5) / n, ((i % cells) // n + 0.5) / n)
        wavelengths, weight = sample_wavelengths((i % cells + 0.5) / cells)
        point = self.point(index, u, wavelengths, mi.Bool(True))
        # Along the normal: area lights emit alike into all directions; spots over their own cone.
        direction = dr.select(
            point.delta, self.sample_direction(point, mi.Point2f(u.y, u.x), mi.Bool(True)), mi.Vector3f(point.si.n)
        )
        value, _ = self.radiance(point, direction, mi.Bool(True))
        cutoff = dr.gather(mi.Float, self._cutoff, index)
        solid_angle = dr.select(point.delta, dr.two_pi * (1.0 - cutoff), dr.pi)
        flux = luminance(value * weight, wavelengths) * solid_angle / point.pdf
        flux_np = np.array(flux, np.float64).reshape(self.count, cells)
        return np.asarray(np.nan_to_num(flux_np.mean(axis=1), nan=0.0, posinf=0.0), np.float64)


def sample_wavelengths(u: mi.Float) -> tuple[mi.Spectrum, mi.UnpolarizedSpectrum]:
    """Hero wavelengths for ``u`` and their weights; nothing to sample outside spectral variants."""
    if mi.is_spectral:
        wavelengths, weight = mi.sample_rgb_spectrum(mi.sample_shifted(u))
        return wavelengths, weight
    return mi.Color0f(), mi.UnpolarizedSpectrum(1.0)


def luminance(value: mi.UnpolarizedSpectrum, wavelengths: mi.Spectrum) -> mi.Float:
    """Luminance of a spectrum as this variant represents it, for ranking and adjoint measurements."""
    if mi.is_spectral:
        return mi.luminance(value, wavelengths)
    return value.x if mi.is_monochromatic else mi.luminance(value)


@dataclass(frozen=True)
class _Light:
    kind: str
    emitter: Any
    shape: Any
    area: float
    to_local: Matrix  # World to local, [3, 4]
    position: Matrix  # [3]
    cos_cutoff: float
    key: tuple[float, ...]

    @property
    def kind_index(self) -> int:
        return SURFACES.index(self.kind) if self.kind in SURFACES else len(SURFACES)


def _registry_id(shape: Any) -> int:
    return 0 if shape is None else int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


def _describe_shape(shape: Any) -> _Light:
    if _plugin_name(shape.emitter()) != "arealight":
        raise SceneRejected(f"a '{_plugin_name(shape.emitter())}' light is not supported yet: use an 'area' light")
    kind = str(mi.ShapeType(shape.shape_type())).rsplit(".")[-1].lower()
    if kind not in SURFACES:
        raise SceneRejected(f"an area light on a '{kind}' shape is not supported: use {', '.join(SURFACES)}")
    to_local: Matrix = np.eye(4)
    if kind in ("sphere", "disk"):
        to_local = np.linalg.inv(np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4))
    box = shape.bbox()
    area = float(np.array(shape.surface_area()).ravel()[0])
    key = (*box.min, *box.max, area)
    return _Light(kind, shape.emitter(), shape, area, to_local[:3], np.zeros(3), -1.0, tuple(map(float, key)))


def _describe_point(emitter: Any) -> _Light:
    kind = _plugin_name(emitter)
    if kind not in POINTS:
        raise SceneRejected(f"a '{kind}' light is not supported by this integrator yet: use integrator 'mi_path'")
    params = mi.traverse(emitter)
    to_local: Matrix = np.eye(4)
    cos_cutoff = -1.0
    if kind == "spot":
        to_world = np.array(params["to_world"].matrix, np.float64).reshape(4, 4)
        to_local = np.linalg.inv(to_world)
        position = to_world[:3, 3]
        cos_cutoff = float(np.cos(np.radians(np.array(params["cutoff_angle"]).ravel()[0])))
    else:
        position = np.array(params["position"], np.float64).ravel()
    key = (*map(float, position), *(0.0,) * (KEY_LENGTH - 3))
    return _Light(kind, emitter, None, 1.0, to_local[:3], position, cos_cutoff, key)


def _plugin_name(plugin: Any) -> str:
    """The plugin's name in scene files: what its description starts with, in lower case."""
    name = str(plugin.class_name()).lower()
    return {"pointlight": "point", "spotlight": "spot", "constantbackgroundemitter": "constant"}.get(name, name)
