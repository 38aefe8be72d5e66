"""Edges of a scene's meshes: where the gaps end that light comes through."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]

LONG = 1.0 / 64.0
"""Part of the scene's size from which on edges count."""
SHARP = 0.966
"""Cosine between the normals of two faces above which their edge is none: 15 degrees. A rounded edge has a few."""
MOST = 2048
"""Edges of a scene: the longest ones."""


def edges(scene: mi.Scene) -> Doubles:
    """Edges [n, 2, 3] of all meshes, the longest first: between faces that make an angle, or at the end of one."""
    box = scene.bbox()
    size = max((float(box.max[axis] - box.min[axis]) for axis in range(3)), default=0.0)
    found = [_sharp(shape, LONG * size) for shape in scene.shapes() if shape.is_mesh()]
    every = np.concatenate(found) if found else np.zeros((0, 2, 3))
    longest: Doubles = every[np.argsort(-_length(every), kind="stable")[:MOST]]
    return longest


def _sharp(mesh: mi.Mesh, shortest: float) -> Doubles:
    corners = np.asarray(mesh.vertex_positions_buffer(), np.float64).reshape(-1, 3)
    faces = np.asarray(mesh.faces_buffer(), np.int64).reshape(-1, 3)
    # Short ones first of all: few edges of a fine mesh are long.
    pairs = np.concatenate([faces[:, [side, (side + 1) % 3]] for side in range(3)])
    face = np.tile(np.arange(len(faces)), 3)
    kept = _length(corners[pairs]) > shortest
    face = face[kept]
    ends: Doubles = corners[pairs[kept]]
    if not len(ends):
        return ends
    a, b, c = (corners[faces[face, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    # Faces that have no vertex in common may have corners at the same places.
    _, place = np.unique(ends.reshape(-1, 3), axis=0, return_inverse=True)
    between = np.sort(place.reshape(-1, 2), axis=1)
    order = np.lexsort(between.T)
    new = (np.diff(between[order], axis=0, prepend=-1) != 0).any(axis=1)
    first = np.nonzero(new)[0]
    faces_of = np.diff(np.append(first, len(order)))
    other = order[np.minimum(first + 1, len(order) - 1)]
    flat = (faces_of == 2) & ((normal[order[first]] * normal[other]).sum(axis=1) > SHARP)
    sharp: Doubles = ends[order[first[~flat]]]
    return sharp


def _length(ends: Doubles) -> Doubles:
    length: Doubles = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    return length
