"""A Cornell box: the smallest scene with indirect light, with every shape of light to choose."""

from __future__ import annotations

from typing import Literal

import numpy as np

from elps_core.scene.generate.common import Color, Pixels, SceneBuilder, SceneDescription, generator
from elps_core.scene.generate.mesh import box, lathe, merged
from elps_core.scene.generate.rooms import Room

LightShape = Literal["rectangle", "sphere", "disk", "cylinder", "mesh"]
Objects = Literal["boxes", "spheres"]

BOX = Room((-1.0, -1.0), (1.0, 1.0), 2.0)
"""The inside of the box; its south side is open, towards the camera."""
FLUX = (23.0, 20.0, 15.0)
"""Of the light, whatever its shape, in power per channel."""
HALF_X, HALF_Y = 0.25, 0.2
"""Half sides of the rectangular light, and the size of the others."""
LIGHT_DROP = 0.01
"""Distance of flat lights from the ceiling."""
LAMP_HEIGHT = 1.7
"""Where lights with a volume hang."""
LAMP_RADIUS = 0.16
LAMP_SEGMENTS = 24
CYLINDER_RADIUS = 0.06


@generator
def cornell(
    objects: Objects = "boxes",
    light_shape: LightShape = "rectangle",
    width: Pixels = 256,
    height: Pixels = 256,
) -> SceneDescription:
    """A Cornell box with two ``boxes``, or with ``spheres``: one of glass, one of rough metal.

    The light emits the same flux whatever its shape. ``mesh`` is a double cone in a PLY file.

    Raises:
        SettingsRejected: a parameter is unknown or out of its range.
    """
    scene = SceneBuilder()
    white = scene.diffuse("white", (0.73, 0.71, 0.68))
    floor = merged(*BOX.tiles(1, 2))
    scene.mesh("white_walls", merged(floor, BOX.ceiling(), BOX.wall("north")), white)
    scene.mesh("red_wall", BOX.wall("west"), scene.diffuse("red", (0.61, 0.06, 0.05)))
    scene.mesh("green_wall", BOX.wall("east"), scene.diffuse("green", (0.12, 0.42, 0.10)))
    _light(scene, light_shape, white)
    if objects == "boxes":
        scene.mesh("tall_box", box((-0.3, -0.3, 0), (0.3, 0.3, 1.2)).turned(18).moved((-0.34, 0.3, 0)), white)
        scene.mesh("short_box", box((-0.3, -0.3, 0), (0.3, 0.3, 0.6)).turned(-17).moved((0.36, -0.35, 0)), white)
    else:
        scene.sphere("metal_sphere", (-0.42, 0.25, 0.42), 0.42, scene.metal("copper", "Cu", 0.15))
        scene.sphere("glass_sphere", (0.42, -0.3, 0.42), 0.42, scene.glass("glass"))
    scene.camera((0, -4.9, 1), (0, 0, 1), fov=28.7, size=(width, height))
    return scene.finish()


def _light(scene: SceneBuilder, shape: LightShape, material: str) -> None:
    ceiling = (0.0, 0.0, BOX.height - LIGHT_DROP)
    lamp = (0.0, 0.0, LAMP_HEIGHT)
    if shape == "rectangle":
        radiance = _radiance(4 * HALF_X * HALF_Y)
        scene.flat("rectangle", "light", ceiling, (0, HALF_Y, 0), (HALF_X, 0, 0), material, radiance)
    elif shape == "disk":
        radiance = _radiance(np.pi * HALF_X**2)
        scene.flat("disk", "light", ceiling, (0, HALF_X, 0), (HALF_X, 0, 0), material, radiance)
    elif shape == "sphere":
        scene.sphere("light", lamp, LAMP_RADIUS, material, radiance=_radiance(4 * np.pi * LAMP_RADIUS**2))
    elif shape == "cylinder":
        radiance = _radiance(2 * np.pi * CYLINDER_RADIUS * 2 * HALF_X)
        scene.cylinder(
            "light", (-HALF_X, 0, LAMP_HEIGHT), (HALF_X, 0, LAMP_HEIGHT), CYLINDER_RADIUS, material, radiance
        )
    else:
        cone = lathe([(0.0, -LAMP_RADIUS), (LAMP_RADIUS, 0.0), (0.0, LAMP_RADIUS)], LAMP_SEGMENTS)
        scene.mesh("light", cone.moved(lamp), material, radiance=_radiance(cone.area))


def _radiance(area: float) -> Color:
    """Radiance of a one-sided diffuse light of ``area`` that emits FLUX."""
    red, green, blue = (flux / (np.pi * area) for flux in FLUX)
    return float(red), float(green), float(blue)
