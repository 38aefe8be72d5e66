"""What becomes of an entry of the corpus: here, and in Mitsuba alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.errors import SceneRejected
from elps_core.scene.loader import LoadedScene, load_scene
from tests.corpus.entry import Entry

VARIANT = "scalar_rgb"
ROUNDING = 1e-4
"""Relative: single precision keeps seven digits, and transformations of a few steps lose two."""


def here(entry: Entry, folder: Path) -> LoadedScene | str:
    """The scene, or why it is refused."""
    try:
        return load_scene(entry.pack(folder), VARIANT, defines=entry.defines)
    except SceneRejected as error:
        return str(error)


def in_mitsuba(entry: Entry, folder: Path) -> Any:
    """The scene that plain Mitsuba makes of the files, or why it makes none."""
    mi.set_variant(VARIANT)
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        return mi.load_file(str(entry.write(folder)), **entry.defines, optimize=False, parallel=False)
    except (RuntimeError, ValueError, TypeError) as error:
        return str(error).split("\n")[-1]
    finally:
        mi.set_log_level(level)


@dataclass(frozen=True)
class Contents:
    """What both must have made alike."""

    triangles: int
    smooth: int
    """Shapes that are no meshes."""
    emitters: int
    sensors: int
    bounds: NDArray[np.float64]
    """Bounding box as its two corners, seen from the first camera, in the scene's own units [2, 3]; seen from its own
    corner where the file has no camera."""

    def differences(self, other: Contents) -> list[str]:
        """Lines that say in what the two differ."""
        counts = ("triangles", "smooth", "emitters", "sensors")
        lines = [
            f"{name}: {mine} here, {theirs} in Mitsuba"
            for name in counts
            if (mine := getattr(self, name)) != (theirs := getattr(other, name))
        ]
        size = np.abs(other.bounds).max()
        if not np.allclose(self.bounds, other.bounds, rtol=0.0, atol=ROUNDING * size):
            lines.append(f"bounds: {self.bounds.tolist()} here, {other.bounds.tolist()} in Mitsuba")
        return lines


def contents(scene: Any, cameras: int, emitters: int, scale: float = 1.0) -> Contents:
    """Count what is in a scene.

    Args:
        scene: a Mitsuba scene.
        cameras: how many of its cameras come from the file: all, or none.
        emitters: the same of its emitters: a scene without any is given one that is black.
        scale: how much larger it is than its file says.
    """
    shapes = scene.shapes()
    meshes = [shape for shape in shapes if shape.is_mesh()]
    corners = np.array([scene.bbox().min, scene.bbox().max], np.float64) if shapes else np.zeros((2, 3))
    eye = corners[0]
    if shapes and cameras:
        eye = np.array(scene.sensors()[0].world_transform().matrix, np.float64).reshape(4, 4)[:3, 3]
    return Contents(
        sum(int(mesh.face_count()) for mesh in meshes),
        len(shapes) - len(meshes),
        len(scene.emitters()) if emitters else 0,
        len(scene.sensors()) if cameras else 0,
        (corners - eye) / scale,
    )


def differences(loaded: LoadedScene, theirs: Any) -> list[str]:
    """In what a scene that both load differs."""
    ends = len(theirs.sensors()), len(theirs.emitters())
    return contents(loaded.scene, *ends, loaded.scale).differences(contents(theirs, *ends))
