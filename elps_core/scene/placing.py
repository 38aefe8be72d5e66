"""Scenes that stand far from the origin, or are very small or large: moved and scaled before Mitsuba makes them.

Single precision and the offsets of rays are made for a room near the origin. A similarity p -> s (p - c) of everything
that has a place or a length brings any scene there. It is put into a parsed scene, whose numbers are double, so that
c and the place of an object cancel before they are rounded. Radiance stays what it is, so that images do.

The similarity follows from the bounding boxes of the shapes alone: all cameras of a scene share it, and so do contexts.
s is a power of two and c a multiple of one, so that coordinates that single precision holds stay exact.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
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
MOST_REMOTE = 1e4
"""Distance of a camera or a lamp, over the scene's size, up to which images are held to be right."""
COARSE = 4096.0
"""Distance of a mesh from the origin of its own file, over its size: there, steps of single precision are 1/4000 of
it."""
_POINTS = {"sphere": ("center",), "cylinder": ("p0", "p1")}
"""Shape -> its parameters that are points before its to_world."""
_CENTRAL = frozenset({"perspective", "thinlens", "radiancemeter"})
"""Sensors whose to_world may hold no scale."""
_LENGTHS = ("near_clip", "far_clip", "focus_distance", "aperture_radius")
"""Lengths of a sensor that are no part of its to_world."""
_CLIPS = {"near_clip": 0.01, "far_clip": 10000.0}
"""Mitsuba's own, where a sensor does not say."""
_INTENSITY = {"point": "intensity", "spot": "intensity", "projector": "scale"}
"""Lamp without extent -> what its light is in proportion to."""
_SUMS = {"uniform": "value", "d65": "scale"}
"""Spectrum -> its parameter that it is in proportion to."""
_CURVES = frozenset({"BSplineCurve", "LinearCurve"})
"""Shapes whose radii come with their file, and are not scaled by their to_world."""


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
        return self.scale != 1.0 or any(self.centre)

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


def measured(shapes: Iterable[mi.Shape]) -> Placement:
    """The placement of a scene of these ``shapes``, which stand where the scene file puts them.

    What most shapes have in common counts: neither an endless floor nor a ball for a sun makes a room small.
    """
    boxes = [shape.bbox() for shape in shapes if shape.class_name() != "ShapeGroup"]
    corners = np.array([[list(box.min), list(box.max)] for box in boxes], np.float64).reshape(-1, 2, 3)
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    sizes = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    corners, sizes = corners[sizes > 0.0], sizes[sizes > 0.0]
    if not len(sizes):
        return Placement((0.0, 0.0, 0.0), 1.0, 1.0)
    typical = _middle(sizes)
    middles = corners[sizes <= ALIKE * typical].mean(axis=1)
    centre = np.array([_middle(axis) for axis in middles.T])
    size = max(typical, 2.0 * _middle(np.linalg.norm(middles - centre, axis=1)))
    usual = USUAL_SIZES[0] <= size <= USUAL_SIZES[1]
    if usual and 1.0 + np.abs(centre).max() <= FAR_OFF * size:
        return Placement((0.0, 0.0, 0.0), 1.0, size)
    step = 2.0 ** np.floor(np.log2(size))
    x, y, z = (float(step * np.round(c / step)) for c in centre)
    scale = 1.0 if usual else 2.0 ** float(np.round(np.log2(GOAL / size)))
    return Placement((x, y, z), scale, size)


def place(state: Any, placement: Placement) -> Placement:
    """Put a placement into a parsed scene whose references are resolved.

    Returns: the placement that was put in: one that only moves, where a lamp's intensity cannot be scaled.
    """
    if not all(_scalable(state, node) for node in state.nodes):
        placement = Placement(placement.centre, 1.0, placement.size)
    _unshare(state)
    # They stay where they are, and their instances move.
    grouped = {index for node in state.nodes if node.props.plugin_name() == "shapegroup" for _, index in _parts(node)}
    for number in range(len(state.nodes)):
        node = state.nodes[number]
        kind, props = node.type, node.props
        if kind == mi.ObjectType.Shape and number not in grouped and props.plugin_name() != "shapegroup":
            _place_shape(props, placement)
        elif kind == mi.ObjectType.Volume and props.plugin_name() == "gridvolume":
            _set_to_world(props, placement.matrix() @ _to_world(props))
        elif kind == mi.ObjectType.Sensor:
            _place_sensor(props, placement)
        elif kind == mi.ObjectType.Emitter and props.plugin_name() in _INTENSITY:
            _place_lamp(state, props, placement)
        elif kind == mi.ObjectType.Medium:
            props["scale"] = float(props.get("scale", 1.0)) / placement.scale
        elif kind == mi.ObjectType.BSDF and props.plugin_name() == "bumpmap":
            # Of a displacement in the scene's units.
            props["scale"] = float(props.get("scale", 1.0)) * placement.scale
    return placement


def place_made(shapes: Iterable[mi.Shape], placement: Placement) -> None:
    """Scale what only files say of shapes that are already made: the radii of curves."""
    for shape in shapes:
        if placement.scale != 1.0 and shape.class_name() in _CURVES:
            parameters = mi.traverse(shape)
            points = np.array(parameters["control_points"], np.float32).reshape(-1, 4)
            points[:, 3] *= placement.scale
            parameters["control_points"] = on_device(type(parameters["control_points"]), points)
            parameters.update()


def file_maps(state: Any) -> dict[str, Matrix]:
    """Parameters of a parsed scene that are meshes from files -> their to_world."""
    nodes = {name: state.nodes[index] for name, index in _parts(state.root)}
    return {
        name: _to_world(node.props)
        for name, node in nodes.items()
        if node.type == mi.ObjectType.Shape and "filename" in node.props
    }


def coarse_meshes(parts: mi.Properties, maps: dict[str, Matrix]) -> tuple[str, ...]:
    """A warning if meshes stand so far from the origins of their files that single precision bends them.

    ``parts`` are a scene's parameters as they are made without a placement, ``maps`` those of :func:`file_maps`.
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
    """Warnings about cameras and lamps of a scene that is made that are too far away for single precision."""
    middle = np.zeros(3) if placement.moves else np.array(placement.centre)
    most = MOST_REMOTE * placement.placed_size
    lines = []
    for what, ends in (("a camera", scene.sensors()), ("a lamp", scene.emitters())):
        boxes = [end.bbox() for end in ends]
        places = np.array([[list(box.min), list(box.max)] for box in boxes], np.float64).reshape(-1, 2, 3)
        places = places[np.isfinite(places).all(axis=(1, 2))].mean(axis=1)
        if (np.linalg.norm(places - middle, axis=1) > most).any():
            lines.append(
                f"{what} is more than {MOST_REMOTE:,.0f} times the scene's size away: single precision may not be "
                "enough for it: move it closer"
            )
    return tuple(lines)


def _place_shape(props: mi.Properties, placement: Placement) -> None:
    matrix = _to_world(props)
    names = [name for name in _POINTS.get(props.plugin_name(), ()) if name in props]
    if names:
        # Pulled into the matrix, where they meet the centre in double precision.
        origin = _point(props, names[0])
        matrix = matrix @ _translation(origin)
        for name in names:
            _set_point(props, name, _point(props, name) - origin)
    _set_to_world(props, placement.matrix() @ matrix)


def _place_sensor(props: mi.Properties, placement: Placement) -> None:
    kind = props.plugin_name()
    if kind in _CENTRAL and "origin" not in props:
        _set_to_world(props, _moved(_to_world(props), placement))
    for name in ("origin", "target"):
        if name in props and props.type(name) == mi.Properties.Type.Vector:
            _set_point(props, name, (placement.matrix() @ [*_point(props, name), 1.0])[:3])
    if kind == "orthographic":
        _set_to_world(props, placement.matrix() @ _to_world(props))
        # The near clip plane is measured before to_world, and the range from there on behind it.
        near, far = (float(props.get(name, usual)) for name, usual in _CLIPS.items())
        props["near_clip"], props["far_clip"] = near, near + placement.scale * (far - near)
    elif kind in _CENTRAL and kind != "radiancemeter":
        for name in _LENGTHS:
            if name in props or name in _CLIPS:
                props[name] = placement.scale * float(props.get(name, _CLIPS.get(name)))


def _place_lamp(state: Any, props: mi.Properties, placement: Placement) -> None:
    if "position" in props:
        _set_point(props, "position", (placement.matrix() @ [*_point(props, "position"), 1.0])[:3])
    else:
        _set_to_world(props, _moved(_to_world(props), placement))
    if placement.scale != 1.0:
        _scale_value(state, props, _INTENSITY[props.plugin_name()], placement.scale**2)


def _scalable(state: Any, node: Any) -> bool:
    """Whether the light of a lamp without extent can be scaled by a number in the scene; True of all other objects."""
    name = _INTENSITY.get(node.props.plugin_name())
    if node.type != mi.ObjectType.Emitter or name is None or name not in node.props:
        return True
    if node.props.type(name) != mi.Properties.Type.ResolvedReference:
        return True
    return state.nodes[node.props[name].index()].props.plugin_name() in _SUMS


def _scale_value(state: Any, props: mi.Properties, name: str, factor: float) -> None:
    """Multiply a number, a colour or a spectrum; one that is not given is 1."""
    kinds, value = mi.Properties.Type, props.get(name, 1.0)
    kind = props.type(name) if name in props else kinds.Float
    if kind == kinds.ResolvedReference:
        spectrum = state.nodes[value.index()].props
        _scale_value(state, spectrum, _SUMS[spectrum.plugin_name()], factor)
    elif kind == kinds.Spectrum:
        scaled = [factor * each for each in value.values]
        props[name] = type(value)(scaled[0]) if value.is_uniform() else type(value)(value.wavelengths, scaled)
    else:
        props[name] = type(value)(value * factor)


def _unshare(state: Any) -> None:
    """Give lamps spectra of their own, and shape groups copies of the shapes that stand in the scene as well."""
    alone = {index for node in state.nodes if node.props.plugin_name() != "shapegroup" for _, index in _parts(node)}
    for number in range(len(state.nodes)):
        kind = state.nodes[number].props.plugin_name()
        for name, index in _parts(state.nodes[number]):
            if (kind == "shapegroup" and index in alone) or name == _INTENSITY.get(kind):
                copy, original = mi.parser.SceneNode(), state.nodes[index]
                copy.type, copy.props = original.type, mi.Properties(original.props)
                copy.offset, copy.file_index = original.offset, original.file_index
                state.nodes.append(copy)
                # The list may have moved: what was taken from it before is not to be touched.
                state.nodes[number].props[name] = mi.Properties.ResolvedReference(len(state.nodes) - 1)


def _parts(node: Any) -> list[tuple[str, int]]:
    """Parameters of a node that are other nodes, with their numbers."""
    resolved, props = mi.Properties.Type.ResolvedReference, node.props
    return [(name, props[name].index()) for name in props.keys() if props.type(name) == resolved]  # noqa: SIM118


def _to_world(props: mi.Properties) -> Matrix:
    return np.array(props["to_world"].matrix, np.float64) if "to_world" in props else np.eye(4)


def _set_to_world(props: mi.Properties, matrix: Matrix) -> None:
    props["to_world"] = mi.AffineTransform4d(matrix)


def _moved(matrix: Matrix, placement: Placement) -> Matrix:
    """A map whose origin is moved with the scene, and whose axes stay as long as they are."""
    found = matrix.copy()
    found[:3, 3] = (placement.matrix() @ matrix[:, 3])[:3]
    return found


def _translation(offset: Matrix) -> Matrix:
    found = np.eye(4)
    found[:3, 3] = offset
    return found


def _point(props: mi.Properties, name: str) -> Matrix:
    return np.array([float(value) for value in props[name]])


def _set_point(props: mi.Properties, name: str, point: Matrix) -> None:
    props[name] = mi.ScalarPoint3d(*(float(value) for value in point))


def _middle(values: Matrix) -> float:
    """The median; of an even number the lower one, as a scene that is taken to be too small renders right as well."""
    return float(np.sort(values)[(len(values) - 1) // 2])
