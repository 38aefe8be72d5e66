"""Checks of a scene that Mitsuba has made: numbers that only it can compute."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from elps_core.errors import SceneRejected
from elps_core.scene.text import shown

if TYPE_CHECKING:
    import mitsuba as mi

MAX_FILTER_RADIUS = 32.0
"""Pixels; the film's border and the cost of a splat grow with it. Filters in use reach 2 to 4."""


def triangles(shapes: Iterable[mi.Shape]) -> int:
    """Count the triangles of all meshes; check that their vertices are finite and their indices valid.

    Raises:
        SceneRejected: a mesh with vertices that are not finite, or faces without vertices.
    """
    count = 0
    for shape in shapes:
        if shape.is_mesh():
            count += int(shape.face_count())
            _check_mesh(shape)
    return count


def check_bounds(scene: mi.Scene) -> None:
    """Refuse a scene whose bounding box is not finite.

    Raises:
        SceneRejected: so it is.
    """
    bounds = scene.bbox()
    corners = np.array([bounds.min, bounds.max], dtype=np.float64)
    if scene.shapes() and not (np.isfinite(corners).all() and (corners[0] <= corners[1]).all()):
        raise SceneRejected("the scene's bounding box is not finite: check the transforms of its shapes")


def _check_mesh(mesh: mi.Mesh) -> None:
    label = f"mesh '{shown(mesh.id())}'" if mesh.id() else "a mesh"
    vertices = np.asarray(mesh.vertex_positions_buffer())
    faces = np.asarray(mesh.faces_buffer())
    if not np.isfinite(vertices).all():
        raise SceneRejected(f"{label} has vertices that are not finite numbers")
    if faces.size and int(faces.max()) >= vertices.size // 3:
        raise SceneRejected(f"{label} has faces that name vertices it does not have")


def check_sensor(sensor: mi.Sensor, name: str) -> tuple[int, int]:
    """Check a camera; return the (width, height) of its image in pixels, crop window applied.

    Raises:
        SceneRejected: its transform is not finite or cannot be inverted, its film is empty, or its
            reconstruction filter too wide.
    """
    matrix = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
    if not np.isfinite(matrix).all():
        raise SceneRejected(f"{name}: the camera's transform is not finite")
    # Scaled to unit columns first: a camera may be small without being flat.
    axes = matrix[:3, :3] / np.maximum(np.linalg.norm(matrix[:3, :3], axis=0), np.finfo(np.float32).tiny)
    if abs(float(np.linalg.det(axes))) < 1e-6:  # single precision resolves no more
        raise SceneRejected(f"{name}: the camera's transform cannot be inverted: check its axes and scale")
    film = sensor.film()
    width, height = (int(n) for n in film.crop_size())
    if width < 1 or height < 1:
        raise SceneRejected(f"{name}: the film has no pixels")
    if not film.rfilter().radius() <= MAX_FILTER_RADIUS:
        raise SceneRejected(f"{name}: the reconstruction filter is wider than {MAX_FILTER_RADIUS:.0f} pixels")
    return width, height
