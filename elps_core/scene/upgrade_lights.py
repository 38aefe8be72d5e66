"""Emitters, sensors, media, textures and shapes of Mitsuba 0.x, as today's. Imports no Mitsuba."""

from __future__ import annotations

from elps_core.scene.markup import Node
from elps_core.scene.rewriting import (
    Rewrite,
    constant,
    element,
    named,
    number_of,
    numbers,
    put,
    refuse,
    take,
    text_of,
    written,
)

SUN_APERTURE = 0.5358
"""Angle of the sun's disk in degrees, of Mitsuba 0.6 and of today."""
LEAST_SUN = 0.1
"""Smallest scale of the sun's radius: 0.6 let it be a point, and today's has an area."""
GROUND_ALBEDO = 0.2
"""Mitsuba 0.6's own where a sky does not say; today's is 0.3."""
SKY_AXES = "0 -1 0 0  0 0 1 0  1 0 0 0  0 0 0 1"
"""Today's sky (south, west, up) -> 0.6's world, where x is east, y is up and -z is north.

A mirror image, as today's axes are left-handed; the sky is symmetric about the plane of zenith and sun.
"""
PLACE_AND_TIME = ("latitude", "longitude", "timezone", "year", "month", "day", "hour", "minute", "second")


def sky(node: Node, rewrite: Rewrite) -> None:
    """``sky``, ``sun`` and ``sunsky``: one plugin today, with z up where 0.6 had y up."""
    kind = node.type
    node.attributes["type"] = "sunsky"
    common = take(node, "scale")
    for part, without in (("sky", "sun"), ("sun", "sky")):
        if kind == without:
            put(node, "float", f"{part}_scale", 0.0)
        elif common is not None and named(node, f"{part}_scale") is None:
            put(node, "float", f"{part}_scale", common.attributes.get("value", ""))
    if named(node, "albedo") is None:
        put(node, "float", "albedo", GROUND_ALBEDO)
    if named(node, "sun_radius_scale") is not None:
        scale = number_of(node, "sun_radius_scale", 1.0)
        take(node, "sun_radius_scale")
        put(node, "float", "sun_aperture", SUN_APERTURE * max(scale, LEAST_SUN))
    if named(node, "sun_direction") is not None:
        for name in PLACE_AND_TIME:
            take(node, name)
    below = number_of(node, "stretch", 1.0) != 1.0 or text_of(node, "extend") == "true"
    for name in ("stretch", "extend"):
        take(node, name)
    to_world = named(node, "to_world")
    if to_world is None:
        to_world = element(node, "transform", {"name": "to_world"})
        node.children.append(to_world)
    to_world.children.insert(0, element(node, "matrix", {"value": SKY_AXES}))
    dark = "; it gives no light from below the horizon, as the file asks" if below else ""
    rewrite.warn(node, f"stands for '{kind}' of Mitsuba 0.x: nearly the same light, y is up{dark}")


def envmap(node: Node, rewrite: Rewrite) -> None:
    """Its gamma matters where the image is not linear."""
    gamma = named(node, "gamma")
    if gamma is not None and numbers(gamma.attributes.get("value", "")) not in ([1.0], [-1.0], [0.0]):
        rewrite.warn(node, "has a gamma of its own: convert the image to a linear EXR, if it is none")


def perspective_with_distortion(node: Node, _: Rewrite) -> None:
    """Without its radial distortion it is a pinhole camera."""
    distortion = named(node, "kc")
    if distortion is not None and any(numbers(distortion.attributes.get("value", "")) or [1.0]):
        refuse(node, "distorts the image, and such a camera has gone from Mitsuba: use 'perspective'")
    node.attributes["type"] = "perspective"


def camera(node: Node) -> None:
    """``<camera>``, of before 0.4: it looked at a mirror image, and its angle was that of the smaller side."""
    transform = named(node, "to_world")
    if transform is not None:
        transform.children.insert(0, element(node, "scale", {"x": "-1"}))
    larger = text_of(node, "map_smaller_side", "true") == "false"
    take(node, "map_smaller_side")
    if node.type in ("perspective", "thinlens"):
        put(node, "string", "fov_axis", "larger" if larger else "smaller")


def homogeneous(node: Node, _: Rewrite) -> None:
    """Scattering and absorption as extinction and albedo.

    Raises:
        SceneRejected: they are curves or textures, or a preset's.
    """
    parts = [take(node, name) for name in ("sigma_s", "sigma_a")]
    if parts != [None, None]:
        values = [constant(part) for part in parts]
        if None in values:
            refuse(node, "needs sigma_s and sigma_a, each one number or three: give sigma_t and albedo instead")
        scattering, absorption = (value * (3 // len(value)) for value in values if value is not None)
        total = [s + a for s, a in zip(scattering, absorption, strict=True)]
        put(node, "rgb", "sigma_t", total)
        put(node, "rgb", "albedo", [s / t if t else 0.0 for s, t in zip(scattering, total, strict=True)])
    if named(node, "sigma_t") is None or named(node, "material") is not None:
        refuse(node, "names a preset, or nothing, and presets have gone from Mitsuba: give sigma_t and albedo")
    _fit_extinction(node)


def _fit_extinction(node: Node) -> None:
    """Today's ``<rgb>`` ends at 1 here: what is above goes into ``scale``."""
    extinction = constant(named(node, "sigma_t"))
    if extinction is None or len(extinction) == 1:
        if extinction is not None:
            put(node, "float", "sigma_t", extinction)
        return
    largest = max(extinction)
    if largest > 1.0:
        put(node, "rgb", "sigma_t", [value / largest for value in extinction])
        put(node, "float", "scale", largest * number_of(node, "scale", 1.0))


def heterogeneous(node: Node, _: Rewrite) -> None:
    """Raises SceneRejected where it has the fibres of 0.6."""
    if named(node, "orientation") is not None:
        refuse(node, "has an orientation, which has gone from Mitsuba: use the phase function 'sggx'")


def gridvolume(node: Node, _: Rewrite) -> None:
    """0.6 put the grid where its file says, unless the scene gave corners."""
    corners = [take(node, name) for name in ("min", "max")]
    if None not in corners:
        low, high = ([numbers(c.attributes.get(axis, "")) for axis in "xyz"] for c in corners if c is not None)
        if any(len(value) != 1 for value in low + high):
            refuse(node, "needs three numbers in each of min and max")
        size = {axis: written(b[0] - a[0]) for axis, a, b in zip("xyz", low, high, strict=True)}
        place = {axis: written(a[0]) for axis, a in zip("xyz", low, strict=True)}
        transform = named(node, "to_world")
        if transform is None:
            transform = element(node, "transform", {"name": "to_world"})
            node.children.append(transform)
        transform.children[:0] = [element(node, "scale", size), element(node, "translate", place)]
    elif named(node, "use_grid_bbox") is None:
        put(node, "boolean", "use_grid_bbox", "true")


def mixture_phase(node: Node, _: Rewrite) -> None:
    """Two phase functions are a blend of today."""
    weights = take(node, "weights")
    values = numbers(weights.attributes.get("value", "")) if weights is not None else []
    if len(values) != 2 or not sum(values) > 0.0:
        refuse(node, "must mix two phase functions: replace it by nested 'blendphase'")
    node.attributes["type"] = "blendphase"
    put(node, "float", "weight", values[1] / sum(values))


def vertex_colors(node: Node, _: Rewrite) -> None:
    """The colours of a mesh file's vertices, under the name that Mitsuba's readers give them."""
    node.attributes["type"] = "mesh_attribute"
    put(node, "string", "name", "vertex_color")


def scaled_texture(node: Node, rewrite: Rewrite) -> None:
    """Nothing multiplies a texture today: the factor goes into what is multiplied, where that is colours.

    An image stays as it is, for its owner to deal with.

    Raises:
        SceneRejected: the scale is no constant.
    """
    factor = constant(named(node, "scale")) if named(node, "scale") is not None else [1.0]
    inner = [child for child in node.children if child.attributes.get("name") != "scale"]
    if factor is None or len(inner) != 1:
        refuse(node, "needs a constant scale and one thing to scale")
    source = rewrite.target(inner[0])
    name = node.attributes.get("name", "")
    if (value := constant(source)) is not None:
        node.tag = "rgb"
        node.attributes = {"name": name, "value": written(_product(value, factor))}
        node.children = []
        return
    colours = _checkers(source, factor) if source.type == "checkerboard" else {}
    if colours or min(factor) == max(factor) == 1.0:
        changed = rewrite.copy(source, name)
        for colour, value in colours.items():
            put(changed, "rgb", colour, value)
        identity = {key: value for key, value in node.attributes.items() if key == "id"}
        node.attributes, node.children = changed.attributes | identity, changed.children


def _checkers(node: Node, factor: list[float]) -> dict[str, list[float]]:
    """The scaled colours of a checkerboard; none where they are no constants, or too bright for a texture."""
    found: dict[str, list[float]] = {}
    for name, default in (("color0", 0.4), ("color1", 0.2)):
        value = constant(named(node, name)) if named(node, name) is not None else [default]
        if value is None or max(found.setdefault(name, _product(value, factor))) > 1.0:
            return {}
    return found


def _product(a: list[float], b: list[float]) -> list[float]:
    return [x * y for x, y in zip(a * (3 // len(a)), b * (3 // len(b)), strict=True)]


def shape(node: Node) -> None:
    """0.6 let light pass where a shape bounds a medium and has no material."""
    names = {child.attributes.get("name") for child in node.children}
    media = names & {"interior", "exterior"}
    if media and all(c.tag not in ("bsdf", "ref") or c.attributes.get("name") in media for c in node.children):
        node.children.append(element(node, "bsdf", {"type": "null"}))
