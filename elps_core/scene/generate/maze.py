"""The maze: n x n rooms, each with a light of the same power [thesis fig. 5.10]."""

from __future__ import annotations

import string
from typing import Annotated

import numpy as np
from pydantic import Field

from elps_core.scene.generate.common import Pixels, SceneBuilder, SceneDescription, generator
from elps_core.scene.generate.mesh import Mesh, box, lathe, merged, smooth
from elps_core.scene.generate.rooms import Opening, Room, passage

SIDE = 4.0
"""Inner side of a room, metres."""
HEIGHT = 2.8
WALL = 0.2
"""Thickness of the walls, metres."""
DOOR = (1.55, 2.65)
"""Where a doorway begins and ends, metres from the corner of the room; every second one is mirrored, so
that doorways of one row do not line up and light turns a corner in every room."""
DOOR_TOP = 2.1
TILES = 8
LIGHT_HALF = 0.5
"""Half the side of a light, metres."""
LIGHT_DROP = 0.01
"""Distance of a light from its ceiling, metres."""
RADIANCE = (16.5, 15.0, 12.6)
"""Of every light: gives the camera's room a mean radiance near 0.3."""
WALL_COLORS = {
    "ivory": (0.74, 0.70, 0.62),
    "terracotta": (0.68, 0.27, 0.15),
    "teal": (0.13, 0.45, 0.47),
    "ochre": (0.75, 0.52, 0.16),
}
VASE = (
    (0.0, 0.0), (0.16, 0.0), (0.17, 0.02), (0.25, 0.22), (0.24, 0.40), (0.12, 0.60), (0.09, 0.70), (0.15, 0.80),
    (0.142, 0.803), (0.078, 0.70), (0.10, 0.60), (0.07, 0.55), (0.0, 0.53),
)  # fmt: skip
"""Outline (radius, height) of the vase, outside and then inside, metres."""
VASE_PLACE = (2.2, 3.25)
SLAB_HALF, SLAB_HEIGHT = 0.55, 0.35
SLAB_PLACE = (1.95, 2.05)
"""Places in the camera's room, metres from its south-west corner."""
SPHERE_RADIUS = 0.42
CAMERA_PLACE = (3.7, 0.3, 1.6)
CAMERA_TARGET = (1.85, 2.15, 0.95)
LATHE_SEGMENTS = 64
CURVE_STEPS = 8


def label(index: int) -> str:
    """The letters of a room: a to z, then aa, ab and so on."""
    letters = ""
    index += 1
    while index:
        index, digit = divmod(index - 1, len(string.ascii_lowercase))
        letters = string.ascii_lowercase[digit] + letters
    return letters


@generator
def maze(rooms: Annotated[int, Field(ge=1, le=16)] = 3, width: Pixels = 512, height: Pixels = 512) -> SceneDescription:
    """A maze of ``rooms`` x ``rooms`` connected rooms, seen from the one at the bottom right.

    Rooms and their lights (``light_a``, ``light_b`` ...) are named row by row from the top left. All
    neighbours are joined by doorways. The camera looks at a glass sphere on a blue slab, and sees a little
    of both neighbouring rooms.

    Raises:
        SettingsRejected: a parameter is out of its range.
    """
    pitch = SIDE + WALL
    plan = {
        (row, column): Room(
            (column * pitch, (rooms - 1 - row) * pitch),
            (column * pitch + SIDE, (rooms - 1 - row) * pitch + SIDE),
            HEIGHT,
        )
        for row in range(rooms)
        for column in range(rooms)
    }
    scene = SceneBuilder()
    for name, reflectance in WALL_COLORS.items():
        scene.diffuse(name, reflectance)
    white = scene.diffuse("white", (0.80, 0.79, 0.76))
    walls: dict[str, list[Mesh]] = {}
    ceilings: list[Mesh] = []
    tiles: tuple[list[Mesh], list[Mesh]] = ([], [])
    for (row, column), room in plan.items():
        from_corner = rooms - 1 - row + rooms - 1 - column
        color = list(WALL_COLORS)[(from_corner + (row < column)) % len(WALL_COLORS)]
        openings = {
            "north": _opening(room.low[0], rooms - 1 - row) if row > 0 else None,
            "south": _opening(room.low[0], rooms - 2 - row) if row < rooms - 1 else None,
            "west": _opening(room.low[1], rooms - 1 - column) if column > 0 else None,
            "east": _opening(room.low[1], rooms - 2 - column) if column < rooms - 1 else None,
        }
        walls.setdefault(color, []).extend(room.wall(side, opening) for side, opening in openings.items())
        ceilings.append(room.ceiling())
        north, west = openings["north"], openings["west"]
        if north:
            ceilings.append(
                passage((north.start, room.high[1], 0), (north.end - north.start, 0, 0), (0, WALL, 0), DOOR_TOP)
            )
        if west:
            ceilings.append(
                passage((room.low[0], west.start, 0), (0, west.end - west.start, 0), (-WALL, 0, 0), DOOR_TOP)
            )
        for group, part in zip(tiles, room.tiles(TILES, TILES), strict=True):
            group.append(part)
        scene.flat(
            "rectangle",
            f"light_{label(row * rooms + column)}",
            (*room.center, HEIGHT - LIGHT_DROP),
            (0.0, LIGHT_HALF, 0.0),
            (LIGHT_HALF, 0.0, 0.0),
            white,
            RADIANCE,
        )
    for color, parts in walls.items():
        scene.mesh(f"walls_{color}", merged(*parts), color)
    scene.mesh("ceilings", merged(*ceilings), white)
    scene.mesh("tiles_dark", merged(*tiles[0]), scene.diffuse("stone_dark", (0.20, 0.18, 0.17)))
    scene.mesh("tiles_light", merged(*tiles[1]), scene.diffuse("stone_light", (0.62, 0.58, 0.52)))
    _still_life(scene, plan[rooms - 1, rooms - 1], (width, height))
    return scene.finish()


def _opening(low: float, walls_from_camera: int) -> Opening:
    start, end = DOOR if walls_from_camera % 2 == 0 else (SIDE - DOOR[1], SIDE - DOOR[0])
    return Opening(low + start, low + end, DOOR_TOP)


def _still_life(scene: SceneBuilder, room: Room, size: tuple[int, int]) -> None:
    corner = np.array([*room.low, 0.0])
    place = np.add(corner, (*SLAB_PLACE, 0.0))
    slab = box((-SLAB_HALF, -SLAB_HALF, 0.0), (SLAB_HALF, SLAB_HALF, SLAB_HEIGHT)).turned(20.0)
    scene.mesh("slab", slab.moved(place), scene.diffuse("blue", (0.07, 0.16, 0.55)))
    scene.sphere(
        "glass_sphere", np.add(place, (0.0, 0.0, SLAB_HEIGHT + SPHERE_RADIUS)), SPHERE_RADIUS, scene.glass("glass")
    )
    vase = lathe(smooth(VASE, CURVE_STEPS), LATHE_SEGMENTS).moved(np.add(corner, (*VASE_PLACE, 0.0)))
    scene.mesh("vase", vase, scene.metal("gold", "Au", 0.15), flat=False)
    scene.camera(np.add(corner, CAMERA_PLACE), np.add(corner, CAMERA_TARGET), fov=58.0, size=size)
