"""Which emitters a scene has: the facts that F needs of each, the order they keep, and what is refused."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from elps_core.errors import SceneRejected
from elps_core.scene.spectrum import luminance, sample_wavelengths

Matrix = np.ndarray[Any, np.dtype[np.floating[Any]]]

ANALYTIC = ("rectangle", "sphere", "disk", "cylinder")
"""Shapes that Mitsuba samples for us."""
SURFACES = (*ANALYTIC, "mesh")
"""Shapes that may carry an area light: those whose F has an inverse."""
POINTS = ("point", "spot", "projector")
"""Emitters without extent."""
DIRECTIONAL = "directional"
"""Light from one direction, at infinity."""
ENVIRONMENTS = ("constant", "envmap", "sunsky", "timed_sunsky")
"""Light from all around; a scene has one of them at most."""
KINDS = (*SURFACES, *POINTS, DIRECTIONAL, *ENVIRONMENTS)
KEY_LENGTH = 7
"""Numbers that tell an emitter from the others: see :class:`Light`."""

_PLUGINS = {
    "AreaLight": "area",
    "ConstantBackgroundEmitter": "constant",
    "DirectionalArea": "directionalarea",
    "DirectionalEmitter": "directional",
    "EnvironmentMapEmitter": "envmap",
    "PointLight": "point",
    "Projector": "projector",
    "SpotLight": "spot",
    "SunskyEmitter": "sunsky",
    "TimedSunskyEmitter": "timed_sunsky",
}
"""Mitsuba's class -> the name that scene files use."""


@dataclass(frozen=True)
class Light:
    """One emitter, described once when a scene is prepared."""

    kind: str  # One of KINDS
    emitter: Any
    shape: Any  # None where no shape carries it
    area: float  # Of the surface; 1 without one
    to_local: Matrix  # World to local, [3, 4]; its third row is the axis of what has one
    position: Matrix  # [3]; of a directional emitter, where its light travels to; zero on surfaces
    sign: float  # -1 where the normals of a shape point inwards
    cos_cutoff: float  # Of the cone around the axis that holds all light of an emitter without extent
    key: tuple[float, ...]
    """Surfaces: bounding box and area. Emitters without extent: position, axis and intensity. At
    infinity: three infinities, then direction and brightness."""

    @property
    def kind_index(self) -> int:
        """Place in :data:`KINDS`."""
        return KINDS.index(self.kind)


def describe_emitters(scene: mi.Scene) -> list[Light]:
    """All emitters of a scene in an order that depends on their geometry and brightness alone.

    The order in which Mitsuba lists emitters changes between two loads of one scene, so whatever
    is stored per emitter must be keyed by this order.

    Raises:
        SceneRejected: no emitter, or one that has no F.
    """
    lights = [_describe_surface(shape) for shape in scene.shapes() if shape.is_emitter()]
    lights += [_describe_other(emitter) for emitter in scene.emitters() if not emitter.get_shape()]
    if not lights:
        raise SceneRejected("the scene has no light: add an emitter")
    return sorted(lights, key=lambda light: light.key)


def common_time(scene: mi.Scene, lights: list[Light]) -> float:
    """The moment at which the scene is seen: when its sensors' shutters open.

    Raises:
        SceneRejected: a light that changes with time, and sensors that do not share one moment.
    """
    sensors = scene.sensors()
    times = {float(sensor.shutter_open()) for sensor in sensors}
    moving = any(float(sensor.shutter_open_time()) > 0.0 for sensor in sensors) or len(times) > 1
    if moving and any(light.kind == "timed_sunsky" for light in lights):
        raise SceneRejected(
            "a 'timed_sunsky' light needs one moment: give every sensor the same shutter_open and shutter_close"
        )
    return min(times, default=0.0)


def _describe_surface(shape: Any) -> Light:
    plugin = _plugin_name(shape.emitter())
    if plugin != "area":
        raise SceneRejected(f"a '{plugin}' light is not supported by this integrator: use an 'area' or 'spot' light")
    kind = str(mi.ShapeType(shape.shape_type())).rsplit(".")[-1].lower()
    if kind not in SURFACES:
        raise SceneRejected(f"an area light on a '{kind}' shape is not supported: use {', '.join(SURFACES)}")
    to_local: Matrix = np.eye(4)
    sign = -1.0 if shape.has_flipped_normals() else 1.0
    if kind in ANALYTIC:
        to_local = np.linalg.inv(_matrix(mi.traverse(shape)["to_world"]))
    if kind == "cylinder" and np.linalg.det(to_local) < 0.0:
        sign = -sign  # Rays meet a mirrored one from within.
    box = shape.bbox()
    area = _number(shape.surface_area())
    key = (*map(float, box.min), *map(float, box.max), area)
    return Light(kind, shape.emitter(), shape, area, to_local[:3], np.zeros(3), sign, -1.0, key)


def _describe_other(emitter: Any) -> Light:
    kind = _plugin_name(emitter)
    if kind not in KINDS:
        raise SceneRejected(f"a '{kind}' light is not supported by this integrator: use integrator 'mi_path'")
    params = mi.traverse(emitter)
    to_world: Matrix = _matrix(params["to_world"]) if "to_world" in params else np.eye(4)
    to_local = np.linalg.inv(to_world)[:3]
    place: Matrix = np.zeros(3)
    key: tuple[float, ...]
    cutoff = -1.0
    if kind in ENVIRONMENTS:
        key = (*(np.inf,) * 3, *(0.0,) * 4)
    elif kind == DIRECTIONAL:
        place = _unit(to_world[:3, 2])
        key = (*(np.inf,) * 3, *map(float, place), _intensity(emitter, np.zeros(3), place))
    else:
        place = np.array(params["position"], np.float64).ravel() if kind == "point" else to_world[:3, 3]
        axis: Matrix = np.zeros(3) if kind == "point" else _unit(to_local[2, :3])
        if kind == "projector":
            cutoff = 0.0  # It lights nothing behind its own plane, which any affine map keeps.
        elif kind == "spot" and _keeps_angles(to_world):
            cutoff = float(np.cos(np.radians(_number(params["cutoff_angle"]))))
        key = (*map(float, place), *map(float, axis), _intensity(emitter, place, axis))
    return Light(kind, emitter, None, 1.0, to_local, place, 1.0, cutoff, key)


def _keeps_angles(to_world: Matrix) -> bool:
    """Whether a map turns, moves and scales alike in all directions, so that cones stay cones."""
    sizes = np.linalg.svd(to_world[:3, :3], compute_uv=False)
    return bool(sizes.max() <= sizes.min() * (1 + 1e-4))


def _intensity(emitter: Any, position: Matrix, axis: Matrix) -> float:
    """Luminance at unit distance along the axis; along z where there is none."""
    direction = axis if axis.any() else np.array([0.0, 0.0, 1.0])
    wavelengths, weight = sample_wavelengths(mi.Float(0.5))
    near = mi.Interaction3f(0.0, 0.0, wavelengths, mi.Point3f(*map(float, position + direction)))
    _, value = emitter.sample_direction(near, mi.Point2f(0.5))
    return _number(luminance(value * weight, wavelengths))


def _plugin_name(plugin: Any) -> str:
    """The plugin's name in scene files."""
    name = str(plugin.class_name())
    return _PLUGINS.get(name, name.lower())


def _unit(vector: Matrix) -> Matrix:
    return np.asarray(vector / np.linalg.norm(vector))


def _matrix(transform: Any) -> Matrix:
    return np.array(transform.matrix, np.float64).reshape(4, 4)


def _number(value: Any) -> float:
    return float(np.array(value).ravel()[0])
