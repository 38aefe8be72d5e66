"""The inside of a closed sphere: scenes whose image is known in closed form."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from elps_core.scene.generate.common import Pixels, SceneBuilder, SceneDescription, generator

CAMERA = (0.3, -0.2, 0.1)
"""Off the centre, where the point light is; by symmetry the image does not depend on it."""
TARGET = (1.0, 0.4, 0.2)
POINT_INTENSITY = np.pi
"""Gives the unit sphere the irradiance pi, and so a reflected radiance that equals its albedo."""


@generator
def sphere(
    albedo: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.5,
    light: Literal["emission", "point"] = "emission",
    radiance: Annotated[float, Field(gt=0.0, le=1e6)] = 1.0,
    width: Pixels = 32,
    height: Pixels = 32,
) -> SceneDescription:
    """The inside of a unit sphere, Lambertian of ``albedo``; ``emission`` and ``point`` name the light.

    Every pixel of an image of at most d segments has the same radiance: with ``emission`` the sphere emits
    ``radiance`` and the image is radiance * sum of albedo^i for i = 0 .. d-1; with ``point`` a light of intensity
    pi * ``radiance`` hangs in the centre and the sum goes over i = 1 .. d-1.

    Raises:
        SettingsRejected: a parameter is out of its range.
    """
    scene = SceneBuilder()
    wall = scene.diffuse("wall", (albedo, albedo, albedo))
    emitted = (radiance, radiance, radiance) if light == "emission" else None
    scene.sphere("sphere", (0.0, 0.0, 0.0), 1.0, wall, inside=True, radiance=emitted)
    if light == "point":
        scene.point_light("light", (0.0, 0.0, 0.0), POINT_INTENSITY * radiance)
    scene.camera(CAMERA, TARGET, fov=60.0, size=(width, height))
    return scene.finish()
