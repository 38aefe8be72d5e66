"""Two rooms and a door ajar: the camera's room has no light of its own [thesis fig. 5.12]."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from elps_core.scene.generate.common import Pixels, SceneBuilder, SceneDescription, generator
from elps_core.scene.generate.mesh import Mesh, box, lathe, merged, smooth, tube
from elps_core.scene.generate.rooms import Opening, Room, passage

HEIGHT = 2.6
WALL = 0.12
"""Thickness of the wall between the rooms, metres."""
NEAR = Room((0.0, 0.0), (4.5, 4.5), HEIGHT)
FAR = Room((0.0, 4.5 + WALL), (4.5, 8.5), HEIGHT)
OPENING = Opening(1.0, 1.9, 2.05)
LEAF = 0.04
"""Thickness of the door leaf, metres."""
CASING = 0.08
"""Width of the casing around the doorway, metres."""
CASING_DEPTH = 0.015
REVEAL = 0.01
"""Distance of the casing from the edge of the doorway, metres: no two surfaces coincide."""
KNOB = ((0.0, 0.0), (0.02, 0.0), (0.01, 0.03), (0.028, 0.05), (0.0, 0.065))
"""Outline (radius, distance from the leaf) of the door knob, metres."""
KNOB_HEIGHT, KNOB_FROM_EDGE = 1.0, 0.07
LIGHT_CENTER = (1.3, 6.7)
LIGHT_HALF = (0.6, 0.4)
LIGHT_DROP = 0.01
RADIANCE = (1550.0, 1470.0, 1320.0)
"""Of the light: gives the image a mean near 0.25 where the door is 9 degrees ajar."""
TABLE_TOP = 0.75
TABLE_CENTER = (2.5, 2.3)
TABLE_HALF = (0.75, 0.42)
TOP_THICKNESS = 0.04
LEG_SIDE = 0.07
LEG_INSET = 0.09
BALL_RADIUS = 0.14
LATHE_SEGMENTS = 64
CURVE_STEPS = 8
TEAPOT = (
    (0.0, 0.0), (0.09, 0.0), (0.10, 0.013), (0.165, 0.09), (0.155, 0.16), (0.105, 0.21), (0.10, 0.22), (0.08, 0.235),
    (0.02, 0.25), (0.016, 0.26), (0.03, 0.276), (0.02, 0.294), (0.0, 0.296),
)  # fmt: skip
"""Outline (radius, height) of the teapot and its lid, metres."""
SPOUT = ((0.12, 0.075), (0.21, 0.11), (0.235, 0.17), (0.28, 0.215))
HANDLE = ((-0.10, 0.165), (-0.215, 0.20), (-0.26, 0.145), (-0.22, 0.085), (-0.12, 0.075))
"""Middle lines (x, height) of the teapot's spout and handle, metres, from and into the body."""
BOWL = (
    (0.0, 0.0), (0.065, 0.0), (0.075, 0.012), (0.135, 0.05), (0.172, 0.105), (0.18, 0.12), (0.172, 0.12), (0.16, 0.105),
    (0.122, 0.062), (0.06, 0.032), (0.0, 0.028),
)  # fmt: skip
"""Outline of the bowl, outside and inside, metres."""


@generator
def door(
    angle: Annotated[float, Field(ge=0.0, le=90.0)] = 9.0,
    crack: Annotated[float, Field(ge=0.0, le=0.05)] = 0.005,
    width: Pixels = 512,
    height: Pixels = 384,
) -> SceneDescription:
    """A table in a dark room, lit through a door that is ``angle`` degrees ajar by a light in the next room.

    ``crack`` is the gap in metres all around the closed leaf. Without it a closed door lets no light pass, nor
    does one that is ajar by less than its thickness (2.5 degrees).

    Raises:
        SettingsRejected: a parameter is out of its range.
    """
    scene = SceneBuilder()
    white = scene.diffuse("white", (0.82, 0.80, 0.76))
    scene.mesh("near_walls", _walls(NEAR, "north"), scene.diffuse("sage", (0.55, 0.66, 0.68)))
    scene.mesh("far_walls", _walls(FAR, "south"), scene.diffuse("cream", (0.80, 0.79, 0.77)))
    frame = passage((OPENING.start, NEAR.high[1], 0), (OPENING.end - OPENING.start, 0, 0), (0, WALL, 0), OPENING.top)
    scene.mesh("trim", merged(NEAR.ceiling(), FAR.ceiling(), frame, _casing()), white)
    planks = [merged(*parts) for parts in zip(NEAR.tiles(18, 3), FAR.tiles(18, 3), strict=True)]
    scene.mesh("planks_dark", planks[0], scene.diffuse("oak_dark", (0.40, 0.26, 0.16)))
    scene.mesh("planks_light", planks[1], scene.diffuse("oak_light", (0.50, 0.34, 0.21)))
    scene.flat(
        "rectangle",
        "light",
        (*LIGHT_CENTER, HEIGHT - LIGHT_DROP),
        (0.0, LIGHT_HALF[1], 0.0),
        (LIGHT_HALF[0], 0.0, 0.0),
        white,
        RADIANCE,
    )
    _door(scene, angle, crack)
    _still_life(scene)
    scene.camera((1.5, 0.6, 1.4), (2.25, 3.2, 0.92), fov=46.0, size=(width, height))
    return scene.finish()


def _walls(room: Room, open_side: str) -> Mesh:
    sides = ("south", "north", "west", "east")
    return merged(*(room.wall(side, OPENING if side == open_side else None) for side in sides))


def _door(scene: SceneBuilder, angle: float, crack: float) -> None:
    """The leaf turns into the camera's room about its edge on the left, where it is flush with the wall."""
    hinge = (OPENING.start + crack, NEAR.high[1], 0.0)
    width = OPENING.end - OPENING.start - 2 * crack
    leaf = box((0, 0, crack), (width, LEAF, OPENING.top - crack))
    knob = lathe(smooth(KNOB, CURVE_STEPS), LATHE_SEGMENTS).laid().moved((width - KNOB_FROM_EDGE, 0, KNOB_HEIGHT))
    paint, brass = scene.diffuse("paint", (0.72, 0.70, 0.66)), scene.metal("brass", "Au", 0.25)
    scene.mesh("door_leaf", leaf.turned(-angle).moved(hinge), paint)
    scene.mesh("door_knob", knob.turned(-angle).moved(hinge), brass, flat=False)


def _casing() -> Mesh:
    front, back = NEAR.high[1] - CASING_DEPTH, NEAR.high[1] + REVEAL
    left, right, top = OPENING.start - REVEAL, OPENING.end + REVEAL, OPENING.top + REVEAL
    return merged(
        box((left - CASING, front, 0), (left, back, top)),
        box((right, front, 0), (right + CASING, back, top)),
        box((left - CASING, front, top), (right + CASING, back, top + CASING)),
    )


def _teapot() -> Mesh:
    spout, handle = smooth(SPOUT, CURVE_STEPS), smooth(HANDLE, CURVE_STEPS)
    widths = np.linspace(0.042, 0.018, len(spout))
    widths[-1] = 0.0  # closed: the inside of an open tube is a black hole
    return merged(
        lathe(smooth(TEAPOT, CURVE_STEPS), LATHE_SEGMENTS),
        tube([(x, 0, z) for x, z in spout], widths, (0, 1, 0), 24),
        tube([(x, 0, z) for x, z in handle], np.full(len(handle), 0.014), (0, 1, 0), 16),
    )


def _table() -> Mesh:
    """A table around the z axis."""
    half_x, half_y = TABLE_HALF
    leg_x, leg_y = half_x - LEG_INSET, half_y - LEG_INSET
    corner = np.array([LEG_SIDE / 2, LEG_SIDE / 2, 0.0])
    feet = [np.array([x, y, 0.0]) for x in (-leg_x, leg_x) for y in (-leg_y, leg_y)]
    # Legs end inside the top: no two surfaces coincide.
    legs = [box(foot - corner, foot + np.add(corner, (0, 0, TABLE_TOP - TOP_THICKNESS / 2))) for foot in feet]
    return merged(box((-half_x, -half_y, TABLE_TOP - TOP_THICKNESS), (half_x, half_y, TABLE_TOP)), *legs)


def _still_life(scene: SceneBuilder) -> None:
    center = np.array([*TABLE_CENTER, 0.0])
    scene.mesh("table", _table().moved(center), scene.diffuse("walnut", (0.42, 0.23, 0.11)))
    center[2] = TABLE_TOP
    teapot = _teapot().turned(-35).moved(np.add(center, (-0.42, 0.10, 0)))
    scene.mesh("teapot", teapot, scene.metal("copper", "Cu", 0.12), flat=False)
    scene.sphere("glass_ball", np.add(center, (-0.01, -0.12, BALL_RADIUS)), BALL_RADIUS, scene.glass("glass"))
    bowl = np.add(center, (0.46, 0.0, 0))
    glaze, orange = scene.diffuse("glaze", (0.08, 0.24, 0.52)), scene.diffuse("orange", (0.80, 0.33, 0.05))
    scene.mesh("bowl", lathe(smooth(BOWL, CURVE_STEPS), LATHE_SEGMENTS).moved(bowl), glaze, flat=False)
    scene.sphere("orange_left", np.add(bowl, (-0.05, -0.01, 0.115)), 0.068, orange)
    scene.sphere("orange_right", np.add(bowl, (0.07, 0.02, 0.115)), 0.062, orange)
