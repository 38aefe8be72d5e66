"""Which emitters a scene has: the facts that F needs of each, the order they keep, and what is refused."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from elps_core.arrays import on_device
from elps_core.errors import SceneRejected
from elps_core.scene.spectrum import luminance, luminance_weights, sample_wavelengths

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
AT_ONCE = 32
"""Emitters that one kernel asks for their intensity."""
MANY = 64
"""Emitters of a scene up to which their number may enter the code of kernels. With more of them it is data, so that
kernels are the same for a hundred lamps and for ten thousand, and lamps alike are not told apart by code."""
KEY_LENGTH = 7
"""Numbers that tell an emitter from the others: see :class:`Light`."""
SMALLEST = 1e-20
"""In place of the size of a point, metres."""
CURVE_BITS = 16
"""Of a coordinate along the curve that orders emitters: a fifteenth of a millimetre in a hall of four metres."""

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
    def middle(self) -> Matrix:
        """Where it is [3]: the middle of its bounding box; three infinities at infinity."""
        if self.kind in SURFACES:
            return np.asarray((np.array(self.key[:3]) + np.array(self.key[3:6])) / 2)
        return np.asarray(self.key[:3])

    @property
    def kind_index(self) -> int:
        """Place in :data:`KINDS`."""
        return KINDS.index(self.kind)


def describe_emitters(scene: mi.Scene) -> list[Light]:
    """All emitters of a scene in an order that depends on their geometry and brightness alone.

    The order in which Mitsuba lists emitters changes between two loads of one scene, so whatever
    is stored per emitter must be keyed by this order. Neighbours in it are neighbours in space, as far as a line can
    have it so: emitters follow Morton's curve, those at infinity come last.

    Raises:
        SceneRejected: no emitter, or one that has no F.
    """
    lights = [_describe_surface(shape) for shape in scene.shapes() if shape.is_emitter()]
    lights += _others([emitter for emitter in scene.emitters() if not emitter.get_shape()])
    if not lights:
        raise SceneRejected("the scene has no light: add an emitter")
    places = _along_curve(np.array([light.middle for light in lights]))
    return [light for _, light in sorted(zip(places, lights, strict=True), key=lambda pair: (pair[0], pair[1].key))]


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
    to_world: Matrix = np.eye(4)
    sign = -1.0 if shape.has_flipped_normals() else 1.0
    if kind in ANALYTIC:
        to_world = _matrix(_Parameters(shape)["to_world"])
    to_local = np.linalg.inv(to_world)
    if kind == "cylinder" and np.linalg.det(to_local) < 0.0:
        sign = -sign  # Rays meet a mirrored one from within.
    box = shape.bbox()
    area = _analytic_area(kind, to_world) if kind in ANALYTIC else _number(shape.surface_area())
    key = (*map(float, box.min), *map(float, box.max), area)
    return Light(kind, shape.emitter(), shape, area, to_local[:3], np.zeros(3), sign, -1.0, key)


def _analytic_area(kind: str, to_world: Matrix) -> float:
    """Of the image of a shape's local form; Mitsuba does not take spheres and cylinders that are squeezed."""
    x, y, z = to_world[:3, :3].T
    across = np.sqrt(max((x @ x) * (y @ y) - (x @ y) ** 2, 0.0))
    if kind == "rectangle":
        return float(4.0 * across)
    if kind == "disk":
        return float(np.pi * across)
    radius = np.linalg.norm(x)
    return float(4.0 * np.pi * radius**2 if kind == "sphere" else 2.0 * np.pi * radius * np.linalg.norm(z))


def _others(emitters: list[Any]) -> list[Light]:
    """Emitters that no shape carries."""
    lights = [_describe_other(emitter) for emitter in emitters]
    some = [k for k, light in enumerate(lights) if light.kind in (*POINTS, DIRECTIONAL)]
    for k, bright in zip(some, _intensities([lights[k] for k in some]), strict=True):
        lights[k] = replace(lights[k], key=(*lights[k].key[:-1], bright))
    return lights


def _describe_other(emitter: Any) -> Light:
    """All but the brightness in the key."""
    kind = _plugin_name(emitter)
    if kind not in KINDS:
        raise SceneRejected(f"a '{kind}' light is not supported by this integrator: use integrator 'mi_path'")
    params = _Parameters(emitter)
    to_world: Matrix = _matrix(params["to_world"]) if "to_world" in params else np.eye(4)
    to_local = np.linalg.inv(to_world)[:3]
    place: Matrix = np.zeros(3)
    first: Matrix = np.full(3, np.inf)
    then: Matrix = np.zeros(3)
    cutoff = -1.0
    if kind == DIRECTIONAL:
        place = then = _unit(to_world[:3, 2])
    elif kind in POINTS:
        place = _numbers(params["position"]) if kind == "point" else to_world[:3, 3]
        first, then = place, np.zeros(3) if kind == "point" else _unit(to_local[2, :3])
        if kind == "projector":
            cutoff = 0.0  # It lights nothing behind its own plane, which any affine map keeps.
        elif kind == "spot" and _keeps_angles(to_world):
            cutoff = float(np.cos(np.radians(_number(params["cutoff_angle"]))))
    key = (*map(float, first), *map(float, then), 0.0)
    return Light(kind, emitter, None, 1.0, to_local, place, 1.0, cutoff, key)


def _along_curve(places: Matrix) -> list[int]:
    """Where points [n, 3] are along Morton's curve through their bounding box; beyond its end at infinity."""
    finite = np.isfinite(places).all(axis=1)
    code = np.full(len(places), 1 << (3 * CURVE_BITS), np.int64)
    if finite.any():
        above = places[finite] - places[finite].min(axis=0)
        # One scale for all axes: in a flat hall height counts as little as it is.
        steps = (above / max(float(above.max()), SMALLEST) * ((1 << CURVE_BITS) - 1)).astype(np.int64)
        bits = [(steps[:, axis] >> bit & 1) << (3 * bit + axis) for bit in range(CURVE_BITS) for axis in range(3)]
        code[finite] = np.sum(bits, axis=0)
    return [int(place) for place in code]


def _keeps_angles(to_world: Matrix) -> bool:
    """Whether a map turns, moves and scales alike in all directions, so that cones stay cones."""
    sizes = np.linalg.svd(to_world[:3, :3], compute_uv=False)
    return bool(sizes.max() <= sizes.min() * (1 + 1e-4))


def intensity_of(point: Any) -> Matrix | None:
    """Intensity of a point light by channel, where its parameters tell it; None where it is a spectrum."""
    if mi.is_spectral or mi.is_polarized:
        return None
    params = mi.traverse(point)
    if "intensity.value" not in params:
        return None
    value = params["intensity.value"]
    return np.array([_first(channel) for channel in ([value] if isinstance(value, mi.Float) else value)])


def _intensities(lights: list[Light]) -> list[float]:
    """Luminances at unit distance along the axes; along z where there is none."""
    found = np.zeros(len(lights))
    asked = []
    for k, light in enumerate(lights):
        intensity = intensity_of(light.emitter) if light.kind == "point" else None
        if intensity is None:
            asked.append(k)
        else:
            found[k] = intensity @ luminance_weights() if len(intensity) > 1 else intensity[0]
    for start in range(0, len(asked), AT_ONCE):
        some = asked[start : start + AT_ONCE]
        found[some] = _asked_intensities([lights[k] for k in some])
    return [float(each) for each in found]


def _asked_intensities(lights: list[Light]) -> Matrix:
    axes = np.array([light.key[3:6] for light in lights])
    axes[~axes.any(axis=1)] = (0.0, 0.0, 1.0)
    places = np.array([light.position if light.kind in POINTS else np.zeros(3) for light in lights])
    # Far enough away for single precision to tell the direction.
    away = 1.0 + np.abs(places).max(axis=1)
    position = places + away[:, None] * axes
    wavelengths, weight = sample_wavelengths(dr.full(mi.Float, 0.5, len(lights)))
    near = mi.Interaction3f(0.0, 0.0, wavelengths, mi.Point3f(*(on_device(mi.Float, row) for row in position.T)))

    def ask(emitter: Any, near: mi.Interaction3f) -> mi.Spectrum:
        return emitter.sample_direction(near, mi.Point2f(0.5))[1]

    value = dr.switch(dr.arange(mi.UInt32, len(lights)), [partial(ask, light.emitter) for light in lights], near)
    return np.asarray(np.array(luminance(value * weight, wavelengths), np.float64) * away**2)


class _Parameters(mi.TraversalCallback):
    """An object's own parameters, not those of its parts: a few lamps' worth of what ``mi.traverse`` looks at."""

    def __init__(self, plugin: Any) -> None:
        super().__init__()
        self._plugin = plugin
        self._found: dict[str, tuple[Any, Any]] = {}
        plugin.traverse(self)

    def put(self, name: str, value: Any, _flags: int, kind: Any = None) -> None:
        self._found[name] = (value, kind)

    def __contains__(self, name: str) -> bool:
        return name in self._found

    def __getitem__(self, name: str) -> Any:
        return mi.get_property(*self._found[name], self._plugin)


def _plugin_name(plugin: Any) -> str:
    """The plugin's name in scene files."""
    name = str(plugin.class_name())
    return _PLUGINS.get(name, name.lower())


def _unit(vector: Matrix) -> Matrix:
    return np.asarray(vector / np.linalg.norm(vector))


def _matrix(transform: Any) -> Matrix:
    """Read number by number: an array of literals would be compiled, for each lamp anew."""
    matrix = transform.matrix
    return np.array([[_first(matrix[row, column]) for column in range(4)] for row in range(4)])


def _numbers(vector: Any) -> Matrix:
    return np.array([_first(value) for value in vector])


def _number(value: Any) -> float:
    return float(np.array(value).ravel()[0])


def _first(value: Any) -> float:
    return float(value) if isinstance(value, float) else float(value[0])
