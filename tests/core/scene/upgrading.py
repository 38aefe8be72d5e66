"""Helpers of the tests of older scene files: from a text to what it becomes, and to what Mitsuba makes of that."""

from __future__ import annotations

from typing import Any
from xml.parsers import expat

import mitsuba as mi
import numpy as np

from elps_core.scene.markup import Node, write
from elps_core.scene.upgrade import Version, upgrade

OLD = (0, 6, 0)
TODAY = (3, 0, 0)
VARIANT = "scalar_rgb"


def tree(text: str) -> Node:
    """A file's elements, unchecked."""
    opened: list[Node] = []
    roots: list[Node] = []
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        node = Node(tag, attributes, parser.CurrentLineNumber)
        (opened[-1].children if opened else roots).append(node)
        opened.append(node)

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: opened.pop()
    parser.Parse(text, True)
    return roots[0]


def upgraded(text: str, version: Version = OLD) -> tuple[Node, list[str]]:
    root = tree(text)
    return root, upgrade(root, {"": version})


def one(text: str, version: Version = OLD) -> Node:
    """The only element inside a scene, upgraded."""
    (node,) = upgraded(f'<scene version="0.6.0">{text}</scene>', version)[0].children
    return node


def told(text: str, version: Version = OLD) -> list[str]:
    return upgraded(f'<scene version="0.6.0">{text}</scene>', version)[1]


def shape_of(node: Node) -> Any:
    """Element, attributes and children, without lines and in an order that does not matter to Mitsuba."""
    parts = [shape_of(child) for child in node.children]
    properties = sorted((part for part in parts if "type" not in part[1] and part[0] != "ref"), key=repr)
    objects = [part for part in parts if "type" in part[1] or part[0] == "ref"]
    return node.tag, dict(node.attributes), properties if node.tag != "transform" else parts, objects


def same(old: str, new: str, version: Version = OLD) -> None:
    """``old`` becomes the element ``new``."""
    assert shape_of(one(old, version)) == shape_of(tree(new))


def made(node: Node) -> Any:
    """What Mitsuba makes of an upgraded object, with unknown parameters refused."""
    node.attributes["version"] = "3.0.0"
    return mi.load_string(write(node, {})[0])


def reflected(bsdf: Any, wi: tuple[float, float, float], wo: tuple[float, float, float]) -> float:
    """BSDF times cosine, green, for directions that are given without their length."""
    directions = [np.array(d, float) / np.linalg.norm(d) for d in (wi, wo)]
    si = mi.SurfaceInteraction3f()
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.wi = mi.Vector3f(*directions[0])
    return float(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(*directions[1]))[1])


SLANTED = ((0.6, 0.0, 0.8), (-0.3, 0.4, 0.7))
