"""bdpt has the expected image of Mitsuba's path tracer, on every kind of scene and with every start density.

Each test states the smallest relative bias of the mean that it would find with a chance of 95%; a test that
could not find its bound is no proof, and fails.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elps_core.scene.generate import cornell, door, maze, write
from elps_core.scene.loader import load_scene
from tests.agreement import compare

Array = np.ndarray[Any, Any]

SIZE = (24, 24)
DEPTH = 6


def load(folder: Path, scene: Any, size: tuple[int, int] = SIZE) -> Any:
    write(scene, folder / "scene.zip")
    return load_scene(folder / "scene.zip", "llvm_ad_rgb", size=size).scene


def noise_table(emission: Any) -> Array:
    """An adversary: a table that knows nothing of the scene, its densities ten to one."""
    return np.random.default_rng(7).random((16, 4 * emission.count)) ** 2 + 0.1


# The bounds are wide because the light is in view, and the jitter of its edges is most of the variance; the
# validation run (tests/benchmarks/validation.py) has the samples to go below half a percent.
# Pairs: every light shape once, and glass and rough gold with a flat, a round and a faceted light.
CORNELLS = [
    ("boxes", "rectangle", 0.03),
    ("boxes", "disk", 0.03),
    ("boxes", "cylinder", 0.03),
    ("spheres", "rectangle", 0.03),
    ("spheres", "sphere", 0.03),
    ("spheres", "mesh", 0.03),
]


@pytest.mark.parametrize(("objects", "shape", "bound"), CORNELLS)
def test_cornell_with_every_light_and_material(
    mi: Any,
    tmp_path: Path,
    render_bdpt: Callable[..., Array],
    render_path: Callable[..., Array],
    objects: str,
    shape: str,
    bound: float,
) -> None:
    scene = load(tmp_path, cornell(objects=objects, light_shape=shape))
    # A table with structure makes F and its inverse matter, which a constant one does not.
    images = render_bdpt(scene, images=10, spp=256, max_depth=DEPTH, table=noise_table)
    agreement = compare(images, render_path(scene, images=10, spp=1024, max_depth=DEPTH), block=8)
    assert agreement.agrees, agreement
    assert agreement.detectable < bound, agreement


@pytest.mark.parametrize("light_sampling", ["power", "adjoint"])
def test_maze_with_glass_and_rough_gold(
    mi: Any, tmp_path: Path, render_bdpt: Callable[..., Array], render_path: Callable[..., Array], light_sampling: str
) -> None:
    scene = load(tmp_path, maze(rooms=2))
    table = None if light_sampling == "power" else adjoint_table(scene)
    images = render_bdpt(scene, images=10, spp=128, max_depth=DEPTH, table=table)
    agreement = compare(images, render_path(scene, images=10, spp=512, max_depth=DEPTH), block=8)
    assert agreement.agrees, agreement
    assert agreement.detectable < 0.03, agreement


def test_door_with_glass_and_rough_metal(
    mi: Any, tmp_path: Path, render_bdpt: Callable[..., Array], render_path: Callable[..., Array]
) -> None:
    scene = load(tmp_path, door(angle=60))
    images = render_bdpt(scene, images=10, spp=256, max_depth=DEPTH)
    agreement = compare(images, render_path(scene, images=10, spp=2048, max_depth=DEPTH), block=8)
    assert agreement.agrees, agreement
    assert agreement.detectable < 0.04, agreement


def adjoint_table(scene: Any) -> Callable[[Any], Array]:
    from elps_core.context.adjoint import STEPS, AdjointMeasurement, start_table
    from elps_core.scene.sensors import Camera
    from elps_core.settings import ContextSettings

    def table(emission: Any) -> Array:
        measured = AdjointMeasurement(scene, Camera(scene.sensors()[0]), emission, ContextSettings(resolution=16))
        for _ in range(STEPS):
            measured.step()
        return start_table(measured.image(), emission, 0.05, 0.75)

    return table


def material_scene(mi: Any, camera: dict[str, Any], bsdf: dict[str, Any]) -> Any:
    """A ball of the material on a floor, a wall behind it, one light in front."""
    place = mi.ScalarTransform4f
    grey = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}}
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": camera,
            "floor": {"type": "rectangle", "to_world": place().rotate([1, 0, 0], -90) @ place().scale(3), "bsdf": grey},
            "wall": {"type": "rectangle", "to_world": place().translate([0, 1, -1.5]) @ place().scale(3), "bsdf": grey},
            "ball": {"type": "sphere", "center": [0, 0.6, 0], "radius": 0.6, "bsdf": bsdf},
            "light": {
                "type": "rectangle",
                "to_world": place().translate([1, 2.5, 1.5]) @ place().rotate([1, 0, 0], 120) @ place().scale(0.5),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 12.0}},
            },
        }
    )


@pytest.mark.parametrize(
    "material",
    [
        {"type": "roughconductor", "alpha": 0.15},
        {"type": "roughconductor", "alpha_u": 0.05, "alpha_v": 0.4},
        {"type": "roughdielectric", "alpha": 0.2},
        {"type": "plastic"},
        {"type": "roughplastic", "alpha": 0.1},
        {"type": "principled", "roughness": 0.4, "metallic": 0.5},
        {"type": "bumpmap"},
        {"type": "normalmap", "bsdf": {"type": "roughconductor", "alpha": 0.3}},
        {"type": "mask", "opacity": 0.5, "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}},
    ],
    ids=lambda material: f"{material['type']}{'-anisotropic' if 'alpha_u' in material else ''}",
)
def test_materials_and_shading_frames(
    mi: Any,
    camera_dict: Callable[..., dict[str, Any]],
    render_bdpt: Callable[..., Array],
    render_path: Callable[..., Array],
    material: dict[str, Any],
) -> None:
    if material["type"] == "normalmap":
        rng = np.random.default_rng(9)
        bent = np.stack(
            [0.5 + 0.2 * rng.random((8, 8)), 0.5 + 0.2 * rng.random((8, 8)), np.full((8, 8), 0.95)], axis=-1
        )
        material = {
            **material,
            "normalmap": {"type": "bitmap", "raw": True, "data": mi.TensorXf(bent.astype(np.float32))},
        }
    if material["type"] == "bumpmap":
        waves = 0.2 * np.sin(np.arange(64) / 3.0)[:, None] * np.cos(np.arange(64) / 4.0)[None, :] + 0.5
        texture = {"type": "bitmap", "raw": True, "data": mi.TensorXf(waves[..., None].astype(np.float32))}
        material = {"type": "bumpmap", "map": texture, "scale": 0.5, "bsdf": {"type": "diffuse"}}
    scene = material_scene(mi, camera_dict([0, 1.5, 4], [0, 0.6, 0]), material)
    images = render_bdpt(scene, images=10, spp=256, max_depth=5)
    agreement = compare(images, render_path(scene, images=10, spp=768, max_depth=5), block=8)
    assert agreement.agrees, agreement
    assert agreement.detectable < 0.015, agreement


@pytest.mark.parametrize("case", ["crop", "gaussian", "near clip", "thin lens"])
def test_films_and_sensors(
    mi: Any,
    camera_dict: Callable[..., dict[str, Any]],
    render_bdpt: Callable[..., Array],
    render_path: Callable[..., Array],
    case: str,
) -> None:
    film: dict[str, Any] = {}
    if case == "crop":
        film = {"crop_offset_x": 5, "crop_offset_y": 9, "crop_width": 20, "crop_height": 16}
    if case == "gaussian":
        film = {"rfilter": {"type": "gaussian"}}
    camera = camera_dict([0, 1.5, 4], [0, 0.6, 0], **film)
    if case == "near clip":
        camera["near_clip"] = 3.6  # Cuts into the ball.
    if case == "thin lens":
        camera |= {"type": "thinlens", "aperture_radius": 0.15, "focus_distance": 4.0}
    scene = material_scene(mi, camera, {"type": "roughconductor", "alpha": 0.3})
    images = render_bdpt(scene, images=10, spp=256, max_depth=5)
    agreement = compare(images, render_path(scene, images=10, spp=768, max_depth=5), block=8)
    assert agreement.agrees, agreement
    assert agreement.detectable < 0.015, agreement
