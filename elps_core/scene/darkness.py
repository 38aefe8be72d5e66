"""Why an image is black, as far as its scene, its camera and its settings tell: one line each, with a cure.

Asked once a chunk has no light at all, which is a second after rendering has begun. A few thousand rays say what the
camera meets, where lamps shine to, and whether a closed surface stands between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.errors import SceneRejected
from elps_core.scene.emission import Emission
from elps_core.scene.groups import every_shape, numbers
from elps_core.scene.loader import LoadedScene
from elps_core.scene.spectrum import sample_wavelengths
from elps_core.scene.text import shown
from elps_core.settings import RenderSettings

Numbers: TypeAlias = "NDArray[np.int64]"

RAYS = 4096
"""Rays from the camera and from lamps: what a thousandth of them meets is not overlooked."""
AROUND = 256
"""Rays from the camera into all directions."""
CLOSED = 0.9
"""Share of the rays from a point that meet a surface an odd number of times, from which on it encloses the point: rays
through edges may count one time too many, and meshes may have pinholes."""
HALF = 0.5
"""Share of a lamp's rays for which it is inside a closed surface: all of them or none, but for a lamp across it."""
MOST_SURFACES = 64
"""Surfaces that are counted along one ray."""
_SKIES = ("sunsky", "timed_sunsky")
_AIMED = ("spot", "projector", "directional")
"""Emitters that may shine past a scene."""
_PLANES = ("PerspectiveCamera", "ThinLensCamera", "OrthographicCamera")
"""Cameras with clip planes."""


def reasons(loaded: LoadedScene, settings: RenderSettings) -> tuple[str, ...]:
    """The likely reasons of the black image of a scene's camera, or the little that is known."""
    if not loaded.summary.emitters:
        return ("the scene has no emitter: add one",)
    if not loaded.summary.shapes:
        return ("the scene has no shapes: there is nothing that light falls on",)
    return tuple(_Search(loaded, settings).lines())


@dataclass(frozen=True)
class _Beams:
    """Rays from lamps."""

    rays: mi.Ray3f
    emitter: Numbers
    """Index of the emitter of each ray [n]; -1 where it carries no light."""
    arrive: bool
    """Whether any ray with light meets a surface."""


class _Search:
    """Looks for reasons in one scene."""

    def __init__(self, loaded: LoadedScene, settings: RenderSettings) -> None:
        self._scene, self._sensor, self._settings = loaded.scene, loaded.sensor, settings
        self._random = np.random.default_rng(0)
        try:
            self._emission: Emission | None = loaded.emission
        except SceneRejected:  # Lamps that Mitsuba's integrators alone know: nothing is said of them.
            self._emission = None

    def lines(self) -> list[str]:
        """Reasons, each with its cure."""
        rays = self._camera_rays()
        si = self._scene.ray_intersect(rays)
        if not dr.any(si.is_valid()):
            return [self._nothing_met(rays)]
        if self._settings.integrator == "mi_depth":  # It shows no light.
            return []
        if self._settings.longest == 1:
            return ["max_depth is 1, which shows lamps alone, and the camera sees none: make it 2 or more"]
        emission = self._emission
        if emission is not None and not emission.power.any():
            return [self._no_power(emission)]
        found = []
        if emission is not None:
            beams = self._beams(emission)
            if (between := self._shut_off(emission, rays, beams)) is not None:
                return [between]
            if not beams.arrive:
                found.append(
                    "the lamps shine past all shapes, or out of the scene: turn them round (area lights shine to the "
                    "side of their normals alone: 'flip_normals' of their shape)"
                )
        if (surfaces := self._no_reflection(si)) is not None:
            found.append(surfaces)
        return found or [
            "no path was found from a lamp to what the camera sees: something shuts them off from each other, "
            "max_depth is too small, or such paths are so rare that it takes more samples"
        ]

    def _uniform(self) -> mi.Point2f:
        return mi.Point2f(*(on_device(mi.Float, self._random.random(RAYS, np.float32)) for _ in range(2)))

    def _camera_rays(self) -> mi.Ray3f:
        rays, _ = self._sensor.sample_ray(float(self._sensor.shutter_open()), 0.5, self._uniform(), mi.Point2f(0.5))
        return mi.Ray3f(rays)

    def _nothing_met(self, rays: mi.Ray3f) -> str:
        """Why the camera sees no surface."""
        if self._sensor.class_name() in _PLANES:
            matrix = np.array(self._sensor.world_transform().matrix, np.float64).reshape(4, 4)
            origin, axis = mi.Point3f(matrix[:3, 3]), mi.Vector3f(matrix[:3, 2])
            clipped = dr.dot(rays.o - origin, axis) / dr.dot(rays.d, axis)
            met = self._scene.ray_intersect(mi.Ray3f(rays.o - clipped * rays.d, rays.d))
            if dr.any(met.is_valid() & (met.t < clipped)):
                return "the camera's 'near_clip' lies beyond all that it would see: make it smaller"
            if dr.any(met.is_valid()):
                return "the camera's 'far_clip' lies in front of all that it would see: make it larger"
        if self._settings.hide_emitters and self._scene.environment() is not None:
            return "the camera sees nothing but the surroundings, which 'hide_emitters' hides: turn it to the shapes"
        return "the camera looks past all shapes: turn it to them, or move it (by its 'to_world')"

    def _no_power(self, emission: Emission) -> str:
        """Why no lamp gives light."""
        if emission.kinds & set(_SKIES):
            sky = mi.traverse(self._scene.environment())
            if any(float(np.array(sky[name]).ravel()[0]) > 0.0 for name in ("sun_scale", "sky_scale")):
                return (
                    "the sun is below the horizon, and the sky without light: change its direction, or time and place "
                    "(z is up, unless its 'to_world' turns it)"
                )
        if emission.kinds & set(_AIMED):
            return "no lamp gives light to the scene: raise radiance or intensity, or turn the lamps to it"
        return (
            "no lamp gives light: raise their radiance or intensity, which are 0 (or read from an image or attribute "
            "that is)"
        )

    def _beams(self, emission: Emission) -> _Beams:
        able = np.flatnonzero(emission.power)
        emitter = self._random.choice(able, RAYS)
        wavelengths, _ = sample_wavelengths(on_device(mi.Float, self._random.random(RAYS, np.float32)))
        point = emission.point(on_device(mi.UInt32, emitter), self._uniform(), wavelengths, mi.Bool(True))
        rays = emission.first_ray(point, self._uniform(), mi.Bool(True))
        radiance, cosine = emission.radiance(point, rays.d, mi.Bool(True))
        shine = _lanes(dr.any(radiance > 0.0) & (cosine > 0.0), RAYS)
        arrive = _lanes(self._scene.ray_intersect(rays).is_valid(), RAYS)
        return _Beams(rays, np.where(shine, emitter, -1), bool((shine & arrive).any()))

    def _shut_off(self, emission: Emission, camera: mi.Ray3f, beams: _Beams) -> str | None:
        """What is said of a closed surface that no light passes, between the camera and all lamps; None without one."""
        directions = self._random.normal(size=(3, AROUND)).astype(np.float32)
        around = dr.normalize(mi.Vector3f(*(on_device(mi.Float, axis) for axis in directions)))
        lane = dr.arange(mi.UInt32, AROUND)
        origin = mi.Point3f(*(dr.gather(mi.Float, dr.zeros(mi.Float, RAYS) + axis, lane) for axis in camera.o))
        shapes = every_shape(self._scene)
        by_camera, by_lamps = self._inside(mi.Ray3f(origin, around)), self._inside(beams.rays)
        for number, shape in zip(numbers(shapes).tolist(), shapes, strict=True):
            if (number in by_camera or number in by_lamps) and not _lets_light_through(shape):
                holds_camera = bool(by_camera.get(number, np.zeros(1)).mean() >= CLOSED)
                emitter = beams.emitter
                if shape.is_emitter():  # Its own rays begin on it, and go out.
                    own = int(emission.index_of(mi.EmitterPtr(shape.emitter()), mi.Bool(True))[0])
                    emitter = np.where(emitter == own, -1, emitter)
                held = _held(emitter, by_lamps.get(number, np.zeros(RAYS, bool)))
                if holds_camera and not held.any():
                    return (
                        f"the camera is inside a closed surface, {_called(shape)}, with no lamp in there: move the "
                        "camera out of it"
                    )
                if not holds_camera and held.size and held.all() and not shape.is_emitter():
                    return f"all lamps are inside a closed surface, {_called(shape)}: move them out of it"
        return None

    def _inside(self, rays: mi.Ray3f) -> dict[int, NDArray[np.bool_]]:
        """For each shape that rays meet, by its number: which rays [n] meet it an odd number of times."""
        count, active = dr.width(rays), mi.Bool(True)
        odd: dict[int, NDArray[np.bool_]] = {}
        for _ in range(MOST_SURFACES):
            si = self._scene.ray_intersect(rays, active)
            valid = _lanes(si.is_valid(), count)
            if not valid.any():
                break
            met = np.where(valid, _lanes(dr.reinterpret_array(mi.UInt32, si.shape), count), 0)
            for number in np.unique(met[valid]).tolist():
                odd[number] = odd.get(number, np.zeros(count, bool)) ^ (met == number)
            rays, active = si.spawn_ray(rays.d), si.is_valid()
            dr.eval(rays, active)
        return odd

    def _no_reflection(self, si: mi.SurfaceInteraction3f) -> str | None:
        """What is said where nothing that the camera sees reflects or lets light through; None where something does."""
        if self._reflects(si):
            return None
        si.wi.z = -si.wi.z
        if self._reflects(si):
            return (
                "the camera sees nothing but the backs of surfaces, which materials of one side leave black: turn "
                "their normals ('flip_normals'), or put the materials into a 'twosided'"
            )
        return "all that the camera sees has black materials: raise their reflectance"

    def _reflects(self, si: mi.SurfaceInteraction3f) -> bool:
        u = on_device(mi.Float, self._random.random(RAYS, np.float32))
        _, weight = si.bsdf().sample(mi.BSDFContext(), si, u, self._uniform(), si.is_valid())
        return bool(dr.any(si.is_valid() & dr.any(weight > 0.0)))


def _lets_light_through(shape: mi.Shape) -> bool:
    passing = int(mi.BSDFFlags.Transmission) | int(mi.BSDFFlags.Null)
    material = shape.bsdf()
    return material is None or bool(int(material.flags()) & passing)


def _called(shape: mi.Shape) -> str:
    return f"'{shown(shape.id())}'" if shape.id() else f"a {shape.class_name().lower()}"


def _held(emitter: Numbers, odd: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """For each emitter that has rays with light: whether it is inside.

    Args:
        emitter: of each ray [n]; -1 where it has no light.
        odd: whether it meets the surface an odd number of times [n].
    """
    lit = emitter >= 0
    count = np.bincount(emitter[lit])
    inside = np.bincount(emitter[lit & odd], minlength=len(count))
    return np.asarray((inside > HALF * count)[count > 0])


def _lanes(values: Any, count: int) -> NDArray[Any]:
    """An array of a kernel [count], also where it is one number for all lanes."""
    return np.broadcast_to(np.array(values), count)
