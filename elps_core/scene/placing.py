"""Put a placement into a parsed scene, before Mitsuba makes it.

Everything that has a place or a length is moved and scaled (:mod:`elps_core.scene.placement`). Numbers of a parsed
scene are double, so that c and the place of an object cancel before they are rounded. Radiance stays what it is, so
that images do.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import mitsuba as mi
import numpy as np

from elps_core.arrays import on_device
from elps_core.scene.placement import UNMOVED, Matrix, Placement, in_steps, middle_of

ROUGH = 1000.0
"""Distance of most shapes from the origin, over their size, from which on their boxes are not measured there: Mitsuba
takes a rectangle that is rounded so far for a skewed one."""
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


def rough(state: Any) -> Placement:
    """A placement that shapes can be measured in, from what a parsed scene says of them but not their files."""
    props = [state.nodes[number].props for number in _standing(state)]
    try:
        maps = [_pulled(each)[0] for each in props]
        radii = [float(each.get("radius", 1.0)) for each in props]
    except (TypeError, ValueError, RuntimeError):  # a parameter of another kind: Mitsuba refuses it, and says where
        return UNMOVED
    if not maps:
        return UNMOVED
    sizes = [np.linalg.norm(each[:3, :3]) * radius for each, radius in zip(maps, radii, strict=True)]
    size = middle_of(np.array(sizes))
    centre = np.array([middle_of(axis) for axis in np.array([each[:3, 3] for each in maps]).T])
    if not 0.0 < size * ROUGH < np.abs(centre).max() < np.inf:
        return UNMOVED
    return Placement(in_steps(centre, size), 1.0, size)


def place(state: Any, placement: Placement) -> Placement:
    """Put a placement into a parsed scene whose references are resolved.

    Returns: the placement that was put in: one that only moves, where a lamp's intensity cannot be scaled.
    """
    if not all(_scalable(state, node) for node in state.nodes):
        placement = Placement(placement.centre, 1.0, placement.size)
    _unshare(state)
    standing = set(_standing(state))
    for number in range(len(state.nodes)):
        node = state.nodes[number]
        kind, props = node.type, node.props
        if number in standing:
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
    nodes = {name: state.nodes[index] for name, index in parts_of(state.root)}
    return {
        name: _to_world(node.props)
        for name, node in nodes.items()
        if node.type == mi.ObjectType.Shape and "filename" in node.props
    }


def _place_shape(props: mi.Properties, placement: Placement) -> None:
    matrix, points = _pulled(props)
    for name, point in points.items():
        _set_point(props, name, point)
    _set_to_world(props, placement.matrix() @ matrix)


def _pulled(props: mi.Properties) -> tuple[Matrix, dict[str, Matrix]]:
    """A shape's to_world and its points, the first pulled into the map: there it meets c in double precision."""
    matrix = _to_world(props)
    points = {name: _point(props, name) for name in _POINTS.get(props.plugin_name(), ()) if name in props}
    origin = next(iter(points.values()), np.zeros(3))
    pull = np.eye(4)
    pull[:3, 3] = origin
    return matrix @ pull, {name: point - origin for name, point in points.items()}


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


def _standing(state: Any) -> list[int]:
    """Nodes that are shapes of the scene. Parts of groups are none: they stay where they are, and instances move."""
    groups = [node for node in state.nodes if node.props.plugin_name() == "shapegroup"]
    grouped = {index for group in groups for _, index in parts_of(group)}
    return [
        number
        for number, node in enumerate(state.nodes)
        if node.type == mi.ObjectType.Shape and node.props.plugin_name() != "shapegroup" and number not in grouped
    ]


def _unshare(state: Any) -> None:
    """Give lamps spectra of their own, and shape groups copies of the shapes that stand in the scene as well."""
    alone = {index for node in state.nodes if node.props.plugin_name() != "shapegroup" for _, index in parts_of(node)}
    for number in range(len(state.nodes)):
        kind = state.nodes[number].props.plugin_name()
        for name, index in parts_of(state.nodes[number]):
            if (kind == "shapegroup" and index in alone) or name == _INTENSITY.get(kind):
                copy, original = mi.parser.SceneNode(), state.nodes[index]
                copy.type, copy.props = original.type, mi.Properties(original.props)
                copy.offset, copy.file_index = original.offset, original.file_index
                state.nodes.append(copy)
                # The list may have moved: what was taken from it before is not to be touched.
                state.nodes[number].props[name] = mi.Properties.ResolvedReference(len(state.nodes) - 1)


def parts_of(node: Any) -> list[tuple[str, int]]:
    """Parameters of a node that are other nodes, with their numbers."""
    resolved, props = mi.Properties.Type.ResolvedReference, node.props
    return [(name, props[name].index()) for name in props.keys() if props.type(name) == resolved]  # noqa: SIM118


def _to_world(props: mi.Properties) -> Matrix:
    return np.array(props["to_world"].matrix, np.float64) if _is_put(props) else np.eye(4)


def _set_to_world(props: mi.Properties, matrix: Matrix) -> None:
    if _is_put(props) or "to_world" not in props:
        props["to_world"] = mi.ScalarAffineTransform4d(matrix)


def _is_put(props: mi.Properties) -> bool:
    """Whether there is a transformation of that name; anything else is left as it is, for Mitsuba to refuse."""
    return "to_world" in props and props.type("to_world") == mi.Properties.Type.Transform


def _moved(matrix: Matrix, placement: Placement) -> Matrix:
    """A map whose origin is moved with the scene, and whose axes stay as long as they are."""
    found = matrix.copy()
    found[:3, 3] = (placement.matrix() @ matrix[:, 3])[:3]
    return found


def _point(props: mi.Properties, name: str) -> Matrix:
    return np.array([float(value) for value in props[name]])


def _set_point(props: mi.Properties, name: str, point: Matrix) -> None:
    props[name] = mi.ScalarPoint3d(*(float(value) for value in point))
