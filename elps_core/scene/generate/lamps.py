"""Many small lamps on the shelves of a hall: each lights its own compartment, and a little of all else."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from elps_core.scene.generate.common import Color, Pixels, SceneBuilder, SceneDescription, generator
from elps_core.scene.generate.mesh import Mesh, Vectors, box, merged, tube
from elps_core.scene.generate.rooms import Room

LampShapes = Literal["mixed", "sphere", "rectangle", "point"]

HALL = Room((0.0, 0.0), (16.0, 20.0), 4.6)
"""The inside of the hall; shelves run from south to north."""
TILES = (16, 20)
RACKS = 6
"""Shelves that stand free in the hall, each with two sides."""
RACK_Y = (4.6, 17.8)
"""Where shelves begin and end along the hall, metres."""
RACK_DEPTH, RACK_TOP = 0.45, 2.25
"""Of one side of a shelf, and its height, metres."""
LEVELS = 4
"""Boards above each other that carry lamps."""
BAY = 1.2
"""Width of a compartment, metres."""
BOARD = 0.025
"""Thickness of boards, metres."""
PILLAR_RADIUS, PILLAR_SIDES = 0.22, 24
PILLARS_X, PILLARS_Y = (5.33, 10.67), (2.4, 8.0, 13.6, 18.8)
CAMERA, TARGET, VIEW = (7.2, 0.5, 3.6), (8.6, 9.0, 0.7), 56.0
"""Where the camera stands and what it looks at, metres, and its field of view, degrees: along aisles, from above."""
SPHERE_RADIUS, SQUARE_HALF = 0.028, 0.035
"""Of a lamp, metres: a few hundredths of its compartment."""
FLUX = 2200.0
"""Of all lamps together, in power per channel of a white one: the hall is equally bright however many there are."""
COLORS: tuple[Color, ...] = (
    (1.0, 0.78, 0.52), (1.0, 0.92, 0.80), (0.72, 0.86, 1.0), (1.0, 0.55, 0.40), (0.62, 1.0, 0.78),
)  # fmt: skip
"""Of lamps, of equal luminance to within a third."""
MOST = 100_000
"""Lamps of one scene: as many as Mitsuba loads in a minute."""
GOLDEN = 0.6180339887498949
"""Steps of this size along a shelf are never in step with its compartments."""


@generator
def lamps(
    lamps: Annotated[int, Field(ge=1, le=MOST)] = 2000,
    shapes: LampShapes = "mixed",
    width: Pixels = 512,
    height: Pixels = 320,
) -> SceneDescription:
    """A hall of shelves on which ``lamps`` small lamps stand, evenly spread: the more there are, the weaker each is.

    ``mixed`` are spheres and squares alternately; ``point`` lamps have no extent.

    Raises:
        SettingsRejected: a parameter is out of its range.
    """
    scene = SceneBuilder()
    white = scene.diffuse("white", (0.74, 0.72, 0.68))
    wood = scene.diffuse("wood", (0.50, 0.32, 0.17))
    black = scene.diffuse("black", (0.03, 0.03, 0.03))
    walls = merged(HALL.ceiling(), *(HALL.wall(side) for side in ("south", "north", "west", "east")))
    scene.mesh("walls", walls, white)
    dark, light = HALL.tiles(*TILES)
    scene.mesh("tiles_dark", dark, scene.diffuse("stone_dark", (0.19, 0.18, 0.18)))
    scene.mesh("tiles_light", light, scene.diffuse("stone_light", (0.58, 0.55, 0.50)))
    scene.mesh("racks", merged(*(_rack(x) for x in _rack_places())), wood)
    scene.mesh("pillars", merged(*(_pillar(x, y) for x in PILLARS_X for y in PILLARS_Y)), white, flat=False)
    on_board, under_next = np.array([0.0, 0.0, SPHERE_RADIUS]), np.array([0.0, 0.0, _level_height() - 2 * BOARD])
    for number in range(lamps):
        place, color = _place(number, lamps), COLORS[number * 3 % len(COLORS)]
        flux = FLUX / lamps
        kind = shapes if shapes != "mixed" else ("sphere", "rectangle")[number % 2]
        name = f"lamp_{number}"
        if kind == "sphere":
            radiance = _times(color, flux / (np.pi * 4 * np.pi * SPHERE_RADIUS**2))
            scene.sphere(name, place + on_board, SPHERE_RADIUS, black, radiance=radiance)
        elif kind == "rectangle":
            radiance = _times(color, flux / (np.pi * 4 * SQUARE_HALF**2))
            scene.flat("rectangle", name, place + under_next, (0, SQUARE_HALF, 0), (SQUARE_HALF, 0, 0), black, radiance)
        else:
            scene.point_light(name, place + on_board, flux / (4 * np.pi))
    scene.camera(CAMERA, TARGET, fov=VIEW, size=(width, height))
    return scene.finish()


def _rack_places() -> list[float]:
    """x of the middle of each shelf."""
    pitch = (HALL.high[0] - HALL.low[0]) / RACKS
    return [HALL.low[0] + pitch * (k + 0.5) for k in range(RACKS)]


def _level_height() -> float:
    return RACK_TOP / LEVELS


def _rack(x: float) -> Mesh:
    """A shelf with a back in its middle, boards, and sides between its compartments."""
    (start, end), half = RACK_Y, BOARD / 2
    parts = [box((x - half, start, 0.0), (x + half, end, RACK_TOP))]
    heights = [level * _level_height() for level in range(LEVELS + 1)]
    parts += [box((x - RACK_DEPTH, start, z), (x + RACK_DEPTH, end, z + BOARD)) for z in heights]
    sides = np.linspace(start, end, round((end - start) / BAY) + 1)
    parts += [box((x - RACK_DEPTH, y - half, 0.0), (x + RACK_DEPTH, y + half, RACK_TOP)) for y in sides]
    return merged(*parts)


def _pillar(x: float, y: float) -> Mesh:
    path = [(x, y, z) for z in np.linspace(0.0, HALL.height, 3)]
    return tube(path, [PILLAR_RADIUS] * 3, (0.0, 1.0, 0.0), PILLAR_SIDES)


def _place(number: int, count: int) -> Vectors:
    """Where a lamp stands on its board [3]: places of one board are even, those of different boards are not in step."""
    boards = RACKS * 2 * LEVELS
    board, along = number % boards, number // boards
    on_board = -(-(count - board) // boards)
    rack, side, level = board // (2 * LEVELS), board // LEVELS % 2, board % LEVELS
    start, end = RACK_Y
    y = start + (end - start) * ((along + board * GOLDEN % 1.0) / on_board)
    bays = round((end - start) / BAY)
    # Off the sides of its compartment, whose thickness it would else stand in.
    bay = min(int((y - start) / (end - start) * bays), bays - 1)
    low, width = start + (end - start) * bay / bays, (end - start) / bays
    margin = BOARD + SQUARE_HALF
    y = low + margin + (y - low) * (1.0 - 2.0 * margin / width)
    depth = RACK_DEPTH * (0.35 + 0.4 * (number * GOLDEN % 1.0))
    x = _rack_places()[rack] + (depth if side else -depth)
    return np.array([x, y, level * _level_height() + BOARD])


def _times(color: Color, factor: float) -> Color:
    red, green, blue = (channel * factor for channel in color)
    return red, green, blue
