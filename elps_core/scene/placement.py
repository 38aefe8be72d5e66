"""Where a scene stands and how large it is, and where it is to be moved to.

Single precision and the offsets of rays are made for a room near the origin. A similarity p -> s (p - c) brings any
scene there. It follows from the bounding boxes of the shapes alone: all cameras of a scene share it, and so do its
contexts. s is a power of two and c a multiple of one, so that coordinates that single precision holds stay exact.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.scene.text import shown

Matrix = NDArray[np.float64]

USUAL_SIZES = (0.1, 1000.0)
"""Sizes in the scene's own units that are left as they are: from a drawer in metres to a room in centimetres."""
GOAL = 4.0
"""Size, to the next power of two, of scenes that are scaled: that of a room in metres."""
FAR_OFF = 10.0
"""Distance from the origin, over the scene's size, from which on a scene is moved. Mitsuba moves origins of rays off
surfaces by 9e-5 (1 + |p|): there, a thousandth of the scene's size."""
ALIKE = 16.0
"""A shape that is larger than a typical one by this factor tells nothing of where a scene is: an endless floor."""
APPROACH = 10.0
"""Distance of a camera, over the radius of the ball around all shapes, from which on its near clip plane is moved."""
MARGIN = 1.01
"""Radius of the ball that near clip planes are moved up to, over that around all shapes: rounding must not cut them."""
FRAME_ANGLE = 45.0
"""Field of view of a camera that has to see all of a scene, in degrees: that of the human eye, and Mitsuba's own."""
_PLANES = frozenset({"PerspectiveCamera", "ThinLensCamera", "OrthographicCamera"})
"""Cameras that have a near clip plane."""
MOST_REMOTE = 1e4
"""Distance of a camera or a lamp, over the scene's size, up to which images are held to be right."""
COARSE = 4096.0
"""Distance of a mesh from the origin of its own file, over its size: there, steps of single precision are 1/4000 of
it."""


@dataclass(frozen=True)
class Placement:
    """The similarity p -> scale (p - centre), and how large the scene was before it."""

    centre: tuple[float, float, float]
    scale: float
    size: float
    """In the scene's own units, of what there is most of."""

    @property
    def moves(self) -> bool:
        """Whether it changes anything."""
        return not self.puts_as(UNMOVED)

    def puts_as(self, other: Placement) -> bool:
        """Whether it does the same as another one."""
        return (self.centre, self.scale) == (other.centre, other.scale)

    @property
    def placed_size(self) -> float:
        """Size of the scene as it is rendered."""
        return self.scale * self.size

    def matrix(self) -> Matrix:
        """The similarity in homogeneous coordinates [4, 4]."""
        found = self.scale * np.eye(4)
        found[:3, 3] = -self.scale * np.array(self.centre)
        found[3, 3] = 1.0
        return found


UNMOVED = Placement((0.0, 0.0, 0.0), 1.0, 1.0)


def measured(shapes: Iterable[mi.Shape], within: Placement = UNMOVED) -> Placement:
    """The placement of a scene of these ``shapes``, which stand where the placement ``within`` has moved them to.

    What most shapes have in common counts: neither an endless floor nor a ball for a sun makes a room small.
    """
    boxes = [shape.bbox() for shape in shapes if shape.class_name() != "ShapeGroup"]
    corners = np.array([[list(box.min), list(box.max)] for box in boxes], np.float64).reshape(-1, 2, 3)
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    sizes = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    corners, sizes = corners[sizes > 0.0], sizes[sizes > 0.0]
    if not len(sizes):
        return UNMOVED
    typical = middle_of(sizes)
    middles = corners[sizes <= ALIKE * typical].mean(axis=1)
    centre = np.array([middle_of(axis) for axis in middles.T])
    size = max(typical, 2.0 * middle_of(np.linalg.norm(middles - centre, axis=1)))
    usual = USUAL_SIZES[0] <= size <= USUAL_SIZES[1]
    for enough in (UNMOVED, within):
        if usual and 1.0 + np.abs(centre + within.centre - enough.centre).max() <= FAR_OFF * size:
            return Placement(enough.centre, 1.0, size)
    scale = 1.0 if usual else 2.0 ** float(np.round(np.log2(GOAL / size)))
    return Placement(in_steps(centre + within.centre, size), scale, size)


def coarse_meshes(parts: mi.Properties, maps: dict[str, Matrix]) -> tuple[str, ...]:
    """A warning if meshes stand so far from the origins of their files that single precision bends them.

    ``parts`` are a scene's parameters as they are made, ``maps`` to_world of those that are meshes from files.
    """
    found = []
    for name, part in parts.objects():
        if name in maps and abs(np.linalg.det(maps[name][:3, :3])) > 0.0:
            box = part.bbox()
            low, high = (np.array([*corner, 1.0]) for corner in (box.min, box.max))
            back = np.linalg.inv(maps[name])
            if np.linalg.norm((back @ (low + high) / 2.0)[:3]) > COARSE * np.linalg.norm((back @ (high - low))[:3]):
                found.append(part.id())
    if not found:
        return ()
    return (
        f"{len(found)} meshes, such as '{shown(found[0])}', lie so far from the origin of their own files that single "
        "precision bends them: move their vertices to the origin and put the place into to_world",
    )


def remote(scene: mi.Scene, placement: Placement) -> tuple[str, ...]:
    """Warnings about cameras and lamps, of a scene that has been made so, too far away for single precision."""
    most = MOST_REMOTE * placement.placed_size
    lines = []
    for what, ends in (("a camera", scene.sensors()), ("a lamp", scene.emitters())):
        boxes = [end.bbox() for end in ends]
        places = np.array([[list(box.min), list(box.max)] for box in boxes], np.float64).reshape(-1, 2, 3)
        places = places[np.isfinite(places).all(axis=(1, 2))].mean(axis=1)
        if (np.linalg.norm(places, axis=1) > most).any():
            lines.append(
                f"{what} is more than {MOST_REMOTE:,.0f} times the scene's size away: single precision may not be "
                "enough for it: move it closer"
            )
    return tuple(lines)


def approach(scene: mi.Scene) -> None:
    """Move the near clip planes of cameras far away up to the scene: what rays meet is rounded as their length is."""
    ball = scene.bbox().bounding_sphere()
    centre, radius = np.array(ball.center, np.float64).ravel(), MARGIN * float(ball.radius)
    for sensor in scene.sensors():
        if sensor.class_name() not in _PLANES or not 0.0 < radius < np.inf:
            continue
        matrix = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
        unit = float(np.linalg.norm(matrix[:3, 2]))
        gap = float((centre - matrix[:3, 3]) @ matrix[:3, 2]) / unit - radius
        near, far = float(sensor.near_clip()), float(sensor.far_clip())
        if APPROACH * radius < gap < far and gap / unit > near:
            parameters = mi.traverse(sensor)
            parameters["near_clip"] = gap / unit
            # Of parallel rays the range from the near clip plane on counts.
            parameters["far_clip"] = far + (gap / unit - gap) if sensor.class_name() == "OrthographicCamera" else far
            parameters.update()


def frame(scene: mi.Scene) -> None:
    """Put the only camera where it sees all shapes: in front of the least z and looking along z, as Mitsuba 2 did."""
    corners = np.array([scene.bbox().min, scene.bbox().max], np.float64)
    if not scene.shapes() or not np.isfinite(corners).all():
        return
    parameters = mi.traverse(scene.sensors()[0])
    extent = float((corners[1] - corners[0]).max())
    distance = float(extent / (2.0 * np.tan(np.radians(FRAME_ANGLE) / 2.0)))
    x, y, _ = corners.mean(axis=0)
    place = mi.ScalarAffineTransform4d().translate([x, y, corners[0, 2] - distance])
    parameters["x_fov"] = FRAME_ANGLE
    parameters["to_world"] = mi.Transform4f(place.matrix)
    parameters["near_clip"], parameters["far_clip"] = distance / 100.0, distance + 5.0 * extent
    parameters.update()


def in_steps(centre: Matrix, size: float) -> tuple[float, float, float]:
    """A point in multiples of a power of two, so that coordinates lose no digit to it."""
    step = 2.0 ** np.floor(np.log2(size))
    x, y, z = (float(step * np.round(c / step)) for c in centre)
    return x, y, z


def middle_of(values: Matrix) -> float:
    """The median; of an even number the lower one, as a scene that is taken to be too small renders right as well."""
    return float(np.sort(values)[(len(values) - 1) // 2])
