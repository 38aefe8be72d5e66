"""Why an image may be black: what a person looks for in a scene that shows nothing, asked of the scene itself."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.errors import SceneRejected
from elps_core.scene.groups import every_shape, numbers
from elps_core.scene.loader import LoadedScene
from elps_core.scene.text import shown

GRID = 32
"""Rays a side that look at what the camera sees."""
DIRECTIONS = 64
"""Rays that tell what a point lies in."""
NEARLY_ALL = 0.9
"""Part of these that leave a closed surface when they begin within; rays through edges are met twice, or not at all."""
MOST_SURFACES = 64
"""Surfaces that a ray is followed through."""
_SUNS = frozenset({"sunsky", "timed_sunsky"})
_NO_EMITTER = "the scene has no emitter: add one"
_SUN_DOWN = "the sun is below the horizon, where it and its sky are black: check its direction, or the time"
_NO_RADIANCE = "the radiance of every emitter is 0: make one brighter"
_CLIPPED = "the near or far clip plane of the camera hides all shapes: check near_clip and far_clip"
_LOOKS_PAST = "the camera looks past all shapes: check its to_world"
_UNLIT = (
    "no light was found on what the camera sees: an area light shines to the side of its normals alone, "
    "and walls may stand between"
)


def reasons(loaded: LoadedScene) -> tuple[str, ...]:
    """Why the chosen camera's image may be black, each with its cure; the likeliest first, and one at least."""
    if not loaded.scene.emitters():
        return (_NO_EMITTER,)
    try:
        dark = not loaded.emission.power.any()
    except SceneRejected:  # emitters that only Mitsuba's integrators know
        dark = False
    if dark:
        suns = all(emitter.type in _SUNS for emitter in loaded.summary.emitters)
        return (_SUN_DOWN if suns else _NO_RADIANCE,)
    around = _shapes_around(loaded)
    if around:
        return tuple(f"the camera stands inside {name}: move it out, or check its to_world" for name in around)
    return (_unseen(loaded) or _UNLIT,)


def _shapes_around(loaded: LoadedScene) -> list[str]:
    """Closed shapes that the camera is inside of, where no emitter is inside of them as well."""
    shapes = every_shape(loaded.scene)
    matrix = np.array(loaded.sensor.world_transform().matrix, np.float64).reshape(4, 4)
    around = _around(loaded.scene, matrix[:3, 3])
    if not around or loaded.scene.environment() is not None:
        return [_called(shape) for shape, number in zip(shapes, numbers(shapes), strict=True) if number in around]
    for emitter in loaded.scene.emitters():
        around -= _around(loaded.scene, np.array(emitter.bbox().center(), np.float64).ravel())
    return [_called(shape) for shape, number in zip(shapes, numbers(shapes), strict=True) if number in around]


def _around(scene: mi.Scene, point: NDArray[np.float64]) -> set[int]:
    """Numbers of the shapes that nearly all rays from a point cross an odd number of times."""
    # No axis: what people make has edges and diagonals along these.
    directions = np.random.default_rng(1).normal(size=(3, DIRECTIONS))
    directions /= np.linalg.norm(directions, axis=0)
    # A kernel for all points.
    ray = mi.Ray3f(
        mi.Point3f(*(on_device(mi.Float, np.full(DIRECTIONS, x, np.float32)) for x in point)),
        mi.Vector3f(*(on_device(mi.Float, row.astype(np.float32)) for row in directions)),
    )
    crossings: dict[int, NDArray[np.int64]] = {}
    for _ in range(MOST_SURFACES):
        si = scene.ray_intersect(ray)
        met = np.array(dr.reinterpret_array(mi.UInt32, si.shape))
        if not met.any():
            break
        for number in np.unique(met[met > 0]):
            crossings.setdefault(int(number), np.zeros(DIRECTIONS, np.int64))[met == number] += 1
        ray = si.spawn_ray(ray.d)
        ray.maxt = dr.select(si.is_valid(), ray.maxt, -1.0)
        dr.eval(ray)
    return {number for number, count in crossings.items() if np.mean(count % 2 == 1) >= NEARLY_ALL}


def _unseen(loaded: LoadedScene) -> str | None:
    """Why the camera sees no shape; None where it sees one, or an environment."""
    if loaded.scene.environment() is not None:
        return None
    place = (np.arange(GRID) + 0.5) / GRID
    x, y = (on_device(mi.Float, axis.ravel().astype(np.float32)) for axis in np.meshgrid(place, place))
    ray, _ = loaded.sensor.sample_ray(0.0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))
    if np.array(loaded.scene.ray_test(ray)).any():
        return None
    ray.o = ray.o - ray.d * (loaded.sensor.near_clip() if hasattr(loaded.sensor, "near_clip") else 0.0)
    ray.maxt = dr.largest(mi.Float)
    return _CLIPPED if np.array(loaded.scene.ray_test(ray)).any() else _LOOKS_PAST


def _called(shape: mi.Shape) -> str:
    return f"'{shown(shape.id())}'" if shape.id() else f"a {shape.class_name().lower()}"
