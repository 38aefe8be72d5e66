"""Separate pieces of surfaces that only mirror and refract, which light is aimed at one by one.

Many panes or balls of one glass may be one mesh (:mod:`elps_core.scene.merging`), and the sphere around all would be
as large as the scene. Such a mesh says of each of its faces which piece it belongs to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

_ATTRIBUTE = "face_piece"
"""Name of the number of a face's piece among a mesh's attributes."""


@dataclass(frozen=True)
class Piece:
    """A shape, or consecutive faces of a mesh."""

    shape: mi.Shape
    first: int
    """Number of its first primitive."""
    end: int
    """Number behind its last primitive."""
    centre: NDArray[np.float64]
    """Of the sphere around its bounding box [3]."""
    radius: float


def only_turns(material: mi.BSDF) -> bool:
    """Whether a material mirrors and refracts, and does nothing else."""
    flags = material.flags()
    return bool(mi.has_flag(flags, mi.BSDFFlags.Delta)) and not mi.has_flag(flags, mi.BSDFFlags.Smooth)


def mark_pieces(mesh: mi.Mesh, faces: Sequence[int]) -> None:
    """Have a mesh know its pieces: the first ``faces[0]`` faces, the next ``faces[1]``, and so on."""
    numbers = np.repeat(np.arange(len(faces)), faces)
    # A whole number survives in single precision up to 2^24, ten times the objects that a scene may have.
    mesh.add_attribute(_ATTRIBUTE, 1, numbers.astype(np.float32))


def pieces_of(shape: mi.Shape) -> list[Piece]:
    """The pieces of a shape, most often itself alone."""
    if not (shape.is_mesh() and shape.has_attribute(_ATTRIBUTE)):
        ball = shape.bbox().bounding_sphere()
        centre = np.array(ball.center, np.float64).ravel()
        return [Piece(shape, 0, int(shape.primitive_count()), centre, float(ball.radius))]
    ends = np.nonzero(np.diff(np.asarray(shape.attribute_buffer(_ATTRIBUTE)), append=-1.0))[0] + 1
    corners = np.asarray(shape.vertex_positions_buffer(), np.float64).reshape(-1, 3)
    faces = np.asarray(shape.faces_buffer()).reshape(-1, 3)
    found = []
    for first, end in zip([0, *ends[:-1]], ends, strict=True):
        points = corners[faces[first:end].ravel()]
        low, high = points.min(axis=0), points.max(axis=0)
        found.append(Piece(shape, int(first), int(end), (low + high) / 2.0, float(np.linalg.norm(high - low)) / 2.0))
    return found
