"""What textures read of the shapes that they lie on, and what these do not have: Mitsuba takes 0, or makes it up.

The textures of a shape are known before it is made, and what it has only afterwards.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import mitsuba as mi

from elps_core.scene.placing import parts_of
from elps_core.scene.text import shown

_ATTRIBUTE = "mesh_attribute"
_IMAGES = frozenset({"bitmap", "checkerboard"})
"""Textures over coordinates of a surface."""


class Reads(NamedTuple):
    """What the textures of one shape read of it."""

    attributes: frozenset[str]
    """Names."""
    coordinates: bool
    """Whether one of them lies over texture coordinates."""


def read(state: Any) -> dict[str, Reads]:
    """Parameters of a parsed scene that are shapes, its references resolved -> what textures read of them."""
    nodes, found = state.nodes, {}
    for name, number in parts_of(state.root):
        if nodes[number].type != mi.ObjectType.Shape:
            continue
        below, rest = set[int](), [number]
        while rest:
            each = rest.pop()
            if each not in below:
                below.add(each)
                rest += [index for _, index in parts_of(nodes[each])]
        kinds = [(nodes[each].props.plugin_name(), nodes[each].props) for each in sorted(below)]
        found[name] = Reads(
            frozenset(props["name"] for kind, props in kinds if kind == _ATTRIBUTE and "name" in props),
            any(kind in _IMAGES for kind, _ in kinds),
        )
    return found


def missing(parts: mi.Properties, reads: dict[str, Reads]) -> tuple[str, ...]:
    """A line for each shape that lacks what its textures read of it.

    Args:
        parts: a scene's parameters as they are made.
        reads: what :func:`read` told before.
    """
    lines = []
    for name, part in parts.objects():
        if not isinstance(part, mi.Shape) or part.class_name() in ("ShapeGroup", "Instance"):
            continue
        wanted = reads.get(name, Reads(frozenset(), coordinates=False))
        called = f"shape '{shown(part.id())}'" if part.id() else f"a shape of the kind {part.class_name()}"
        lines += [
            f"{called} has no attribute '{shown(attribute)}', which a texture reads: it is taken for 0, which is black"
            for attribute in sorted(wanted.attributes)
            if not part.has_attribute(attribute)
        ]
        if wanted.coordinates and part.is_mesh() and not part.has_vertex_texcoords():
            lines.append(f"{called} has no texture coordinates: its textures lie on each triangle anew")
    return tuple(lines)
