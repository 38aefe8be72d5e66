"""The cells into which the directions of an environment are divided: where its radiance changes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.scene.spectrum import luminance, sample_wavelengths

Vectors = NDArray[np.float64]

MAX_ROWS = 512
"""Bound of a table's rows, and half of that of its columns: at 1024 a draw takes twice as long, out of the caches."""
SKY_ROWS = 64
"""Rows of a sky without its sun, an even number: its horizon is an edge."""
SAMPLES = 4
"""Points along each side of a cell at which radiance is taken, at least."""
SUN_CELLS = 8
"""Cells across a sun's disk."""
SUN_EDGE = 0.05
"""Share of the central luminance at which a sun ends: its rim has more, the sky around it far less."""
SUN_RADII = (1e-4, 0.2)
"""Angular radii, radians, between which a sun is looked for; the real one has 0.0047."""
PADDING = 2
"""Columns that Mitsuba adds to an environment map so that it closes around the pole."""
SEARCH_ROWS = 512
"""Rows of the grid of directions on which a sun is looked for: half a degree must not be missed."""


@dataclass(frozen=True)
class Grid:
    """Edges of cells in (t, phi), and the frame that these refer to."""

    t: NDArray[np.float32]  # 1 - cos(theta), ascending from 0 to 2
    phi: NDArray[np.float32]  # Ascending from 0 to 2 pi
    axes: Vectors  # Rows: world directions of (theta, phi) = (90 degrees, 0), (90, 90) and theta = 0
    samples: int  # Along each side of a cell


def grid_of(emitter: Any, kind: str, time: float) -> Grid:
    """The cells for an environment emitter; ``kind`` is its plugin's name."""
    if kind == "constant":
        return _grid(np.array([0.0, np.pi]), np.array([0.0, 2 * np.pi]), np.eye(3), 1)
    params = mi.traverse(emitter)
    turn = _rotation(np.array(params["to_world"].matrix, np.float64).reshape(4, 4)[:3, :3])
    if kind == "envmap":
        height, width = params["data"].shape[0], params["data"].shape[1] - PADDING
        return _image_grid(height, width, turn)
    given = np.array(params["sun_direction"], np.float64).ravel() if "sun_direction" in params else None
    return _sky_grid(emitter, time, turn, given)


def luminance_at(emitter: Any, direction: mi.Vector3f, time: float, u: mi.Float) -> mi.Float:
    """Luminance that arrives from ``direction``, at the wavelengths that ``u`` chooses."""
    wavelengths, weight = sample_wavelengths(u)
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(direction))
    si.wi, si.time, si.wavelengths = -direction, time, wavelengths
    return luminance(emitter.eval(si) * weight, wavelengths)


def _image_grid(height: int, width: int, turn: Vectors) -> Grid:
    """Cells between the centres of texels, among which Mitsuba interpolates: columns half a texel from the
    image's edge, first and last row at the poles."""
    rows, columns = min(height - 1, MAX_ROWS), min(width, 2 * MAX_ROWS)
    shift = np.pi / width
    sin, cos = np.sin(shift), np.cos(shift)
    local = np.array([[sin, 0.0, -cos], [cos, 0.0, sin], [0.0, 1.0, 0.0]])
    samples = max(SAMPLES, -(-height // rows), -(-width // columns))
    return _grid(np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, columns + 1), local @ turn.T, samples)


def _sky_grid(emitter: Any, time: float, turn: Vectors, given: Vectors | None) -> Grid:
    """Coarse cells, and fine ones around the sun, which lies opposite of where phi begins."""
    up = turn[:, 2]
    centre = _brightest(emitter, time, up) if given is None else given / np.linalg.norm(given)
    away = centre @ up * up - centre
    if np.linalg.norm(away) < 1e-3:
        away = turn[:, 0]
    x = away / np.linalg.norm(away)
    axes = np.stack([x, np.cross(up, x), up])
    theta, phi = np.linspace(0, np.pi, SKY_ROWS + 1), np.linspace(0, 2 * np.pi, 2 * SKY_ROWS + 1)
    radius = _sun_radius(emitter, time, centre)
    if radius > 0.0:
        height = np.arccos(np.clip(centre @ up, -1.0, 1.0))
        across = np.linspace(-1.0, 1.0, SUN_CELLS + 1)
        theta = np.union1d(theta, np.clip(height + radius * across, 0.0, np.pi))
        if np.sin(height) > np.sin(radius):
            phi = np.union1d(phi, np.pi + np.arcsin(np.sin(radius) / np.sin(height)) * across)
    return _grid(theta, phi, axes, SAMPLES)


def _brightest(emitter: Any, time: float, up: Vectors) -> Vectors:
    """Centre of the brightest spot of a sky."""
    side = _perpendicular(up)
    theta, phi = np.meshgrid(
        (np.arange(SEARCH_ROWS) + 0.5) * np.pi / SEARCH_ROWS, np.arange(2 * SEARCH_ROWS) * np.pi / SEARCH_ROWS
    )
    plane = np.cos(phi.ravel())[:, None] * side + np.sin(phi.ravel())[:, None] * np.cross(up, side)
    directions = np.sin(theta.ravel())[:, None] * plane + np.cos(theta.ravel())[:, None] * up
    found = directions[int(_luminances(emitter, time, directions).argmax())]
    # Around it, finer: the centre of what is at least half as bright.
    first = _perpendicular(found)
    steps = np.linspace(-1, 1, SEARCH_ROWS) * (2 * np.pi / SEARCH_ROWS)
    a, b = (part.ravel()[:, None] for part in np.meshgrid(steps, steps))
    near = found + a * first + b * np.cross(found, first)
    near /= np.linalg.norm(near, axis=1)[:, None]
    values = _luminances(emitter, time, near)
    centre = near[values >= 0.5 * values.max()].mean(axis=0)
    return np.asarray(centre / np.linalg.norm(centre))


def _sun_radius(emitter: Any, time: float, centre: Vectors) -> float:
    """Angular radius of a bright disk around ``centre``, radians; 0 where there is none."""
    aside = _perpendicular(centre)
    angles = np.concatenate([[0.0], np.geomspace(*SUN_RADII, SEARCH_ROWS)])
    values = _luminances(emitter, time, np.cos(angles)[:, None] * centre + np.sin(angles)[:, None] * aside)
    outside = np.flatnonzero(values < SUN_EDGE * values[0])
    return float(angles[outside[0]]) if len(outside) else 0.0


def _luminances(emitter: Any, time: float, directions: Vectors) -> NDArray[np.float32]:
    values = luminance_at(emitter, mi.Vector3f(directions.T.astype(np.float32)), time, mi.Float(0.5))
    return np.asarray(np.nan_to_num(np.array(values)))


def _grid(theta: Vectors, phi: Vectors, axes: Vectors, samples: int) -> Grid:
    t = (2.0 * np.sin(0.5 * theta) ** 2).astype(np.float32)
    # Edges that single precision does not tell apart would make empty cells.
    return Grid(np.unique(t), np.unique(phi.astype(np.float32)), axes, samples)


def _perpendicular(axis: Vectors) -> Vectors:
    other = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    return np.asarray(other / np.linalg.norm(other))


def _rotation(matrix: Vectors) -> Vectors:
    """The orthogonal part of a linear map."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)
