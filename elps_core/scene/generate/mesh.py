"""Triangle meshes made of a few primitives, and their PLY bytes. Lengths are metres, z points up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Vectors = NDArray[np.float64]

BOX_CORNERS = np.array([[x, y, z] for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)])
"""Corners of the unit cube; the corner (x, y, z) has the index x + 2 y + 4 z."""
BOX_SIDES = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))
"""Corner indices of the six sides, counter-clockwise seen from outside."""

BLENDS = ((0, 1), (0, 2), (1, 1))
"""The three rounds of Barry and Goldman's recursion: offset of the first knot, and width of each blend in knots."""


@dataclass(frozen=True)
class Mesh:
    """Triangles: ``vertices`` is float64 [N, 3], ``faces`` int32 [M, 3], counter-clockwise from the front."""

    vertices: Vectors
    faces: NDArray[np.int32]

    @property
    def area(self) -> float:
        """Surface area in square metres."""
        a, b, c = (self.vertices[self.faces[:, corner]] for corner in range(3))
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)

    def turned(self, degrees: float) -> Mesh:
        """The mesh turned about the z axis through the origin, counter-clockwise seen from above."""
        angle = np.radians(degrees)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
        return Mesh(self.vertices @ turn.T, self.faces)

    def laid(self) -> Mesh:
        """The mesh turned so that what pointed up points to the south (-y)."""
        return Mesh(self.vertices[:, [0, 2, 1]] * (1.0, -1.0, 1.0), self.faces)

    def moved(self, offset: ArrayLike) -> Mesh:
        """The mesh moved by ``offset`` [3]."""
        return Mesh(self.vertices + np.asarray(offset, dtype=np.float64), self.faces)

    def to_ply(self) -> bytes:
        """Binary little-endian PLY with float32 positions and triangles, no normals."""
        header = (
            "ply\nformat binary_little_endian 1.0\n"
            f"element vertex {len(self.vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
            f"element face {len(self.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        )
        faces = np.empty(len(self.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
        faces["count"] = 3
        faces["corners"] = self.faces
        return header.encode("ascii") + self.vertices.astype("<f4").tobytes() + faces.tobytes()


def merged(*meshes: Mesh) -> Mesh:
    """One mesh of all the triangles."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)])
    return Mesh(vertices, faces.astype(np.int32))


def quad(origin: ArrayLike, u: ArrayLike, v: ArrayLike) -> Mesh:
    """The parallelogram ``origin`` + [0, 1] ``u`` + [0, 1] ``v``; its front is where ``u`` x ``v`` points."""
    p, u, v = (np.asarray(vector, dtype=np.float64) for vector in (origin, u, v))
    return Mesh(np.stack([p, p + u, p + u + v, p + v]), np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))


def box(low: ArrayLike, high: ArrayLike) -> Mesh:
    """A solid box between two corners. Sides share no vertices, so that normals stay flat."""
    low, high = (np.asarray(corner, dtype=np.float64) for corner in (low, high))
    # Picking coordinates, not interpolating them, keeps faces that must touch a wall exactly on it.
    corners = np.where(BOX_CORNERS == 1.0, high, low)
    sides = [corners[list(side)] for side in BOX_SIDES]
    return merged(*(Mesh(side, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)) for side in sides))


def grid(rows: int, columns: int, *, closed: bool) -> NDArray[np.int32]:
    """Triangles [M, 3] of a grid of vertices, row by row; ``closed`` joins the last column to the first."""
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns if closed else columns - 1), indexing="ij")
    following = (column + 1) % columns
    a, b = row * columns + column, row * columns + following
    c, d = a + columns, b + columns
    triangles = np.stack([np.stack([a, b, d], axis=-1), np.stack([a, d, c], axis=-1)], axis=-2)
    return triangles.reshape(-1, 3).astype(np.int32)


def tube(path: ArrayLike, radii: ArrayLike, side: ArrayLike, segments: int) -> Mesh:
    """A tube of circles around the points ``path`` [N, 3], of ``radii`` [N], front outside, open ends.

    ``side`` [3] is a direction that is nowhere parallel to the path, for a path in a plane its normal.
    """
    points, widths = np.asarray(path, dtype=np.float64), np.asarray(radii, dtype=np.float64)
    tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    across = np.cross(np.asarray(side, dtype=np.float64), tangents)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    binormals = np.cross(tangents, across)
    angles = np.linspace(0.0, 2.0 * np.pi, segments, endpoint=False)[:, None]
    rings = points[:, None] + widths[:, None, None] * (
        np.cos(angles) * across[:, None] + np.sin(angles) * binormals[:, None]
    )
    return Mesh(rings.reshape(-1, 3), grid(len(points), segments, closed=True))


def lathe(profile: Sequence[tuple[float, float]], segments: int) -> Mesh:
    """The (radius, height) ``profile``, from bottom to top, turned about the z axis; front outside."""
    angles = np.linspace(0.0, 2.0 * np.pi, segments, endpoint=False)
    # A curve through points on the axis may overshoot it.
    turned = [(max(radius, 0.0), height) for radius, height in profile]
    rings = [np.stack([r * np.cos(angles), r * np.sin(angles), np.full(segments, h)], axis=-1) for r, h in turned]
    return Mesh(np.concatenate(rings), grid(len(profile), segments, closed=True))


def smooth(points: Sequence[tuple[float, float]], steps: int) -> list[tuple[float, float]]:
    """A curve through points in a plane, ``steps`` points to each span, without loops.

    Source: centripetal Catmull-Rom splines by the recursion of Barry and Goldman 1988.
    """
    given = np.asarray(points, dtype=np.float64)
    padded = np.concatenate([2 * given[:1] - given[1:2], given, 2 * given[-1:] - given[-2:-1]])
    knots = np.concatenate([[0.0], np.cumsum(np.sqrt(np.linalg.norm(np.diff(padded, axis=0), axis=1)))])
    curve = []
    for span in range(len(given) - 1):
        for t in np.linspace(knots[span + 1], knots[span + 2], steps, endpoint=False):
            row = padded[span : span + 4]
            for first, width in BLENDS:
                low = span + first + np.arange(len(row) - 1)
                share = ((t - knots[low]) / (knots[low + width] - knots[low]))[:, None]
                row = (1 - share) * row[:-1] + share * row[1:]
            curve.append((float(row[0, 0]), float(row[0, 1])))
    return [*curve, (float(given[-1, 0]), float(given[-1, 1]))]
