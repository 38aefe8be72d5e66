"""Tools for changing a scene file's tree in place, and for telling what was changed. Imports no Mitsuba."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import NoReturn

from elps_core.errors import SceneRejected
from elps_core.scene.markup import Node
from elps_core.scene.text import few, shown

MAX_COPIED = 100_000
"""Elements that one upgrade may write a second time: references let a few lines ask for any number."""
MAX_LISTED = 12
"""Names that one warning lists; a reader looks no further."""
MAX_FLOAT = 3.4028234e38
"""Largest number in single precision; what is beyond it is left to the check of the values, which refuses it."""

_NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_SEPARATORS = re.compile(r"[,;\s]+")


class Rewrite:
    """What one upgrade knows: the elements by their ids, and what it has to tell."""

    def __init__(self, root: Node) -> None:
        self._by_id: dict[str, Node] = {}
        self._warned: dict[tuple[str, str], list[Node]] = {}
        self._left_out: dict[tuple[str, str], list[Node]] = {}
        self._copied = 0
        todo = [root]
        while todo:
            node = todo.pop()
            if node.tag != "ref" and "id" in node.attributes:
                self._by_id.setdefault(node.attributes["id"], node)
            todo.extend(reversed(node.children))

    def warn(self, node: Node, text: str) -> None:
        """Tell about an element; what is said of several alike is told once."""
        self._warned.setdefault((label(node), text), []).append(node)

    def leave_out(self, owner: Node, children: Iterable[Node]) -> None:
        """Take parameters off their object, as ones that today's Mitsuba does not know."""
        out = {id(child): child for child in children}
        owner.children = [child for child in owner.children if id(child) not in out] if out else owner.children
        for child in out.values():
            name = child.attributes.get("name") or f"<{child.tag}>"
            self._left_out.setdefault((shown(name), label(owner)), []).append(owner)

    def target(self, node: Node) -> Node:
        """The element itself, or the one that a reference names (the reference, where that is unknown)."""
        return self._by_id.get(node.attributes.get("id", ""), node) if node.tag == "ref" else node

    def copy(self, node: Node, name: str) -> Node:
        """The element a second time, without ids, as the parameter ``name``.

        Raises:
            SceneRejected: more was copied than a scene needs.
        """
        self._copied += 1
        if self._copied > MAX_COPIED:
            raise SceneRejected(f"{node} is used too often to be brought to today's format: write the scene for it")
        attributes = {key: value for key, value in node.attributes.items() if key != "id" or node.tag == "ref"}
        if name:
            attributes["name"] = name
        parts = [self.copy(child, child.attributes.get("name", "")) for child in node.children]
        return element(node, node.tag, attributes, parts)

    def warnings(self) -> list[str]:
        """One line for each thing to tell, in the order in which they were met."""
        lines = [f"{nodes[0]}{_others(nodes)} {text}" for (_, text), nodes in self._warned.items()]
        if self._left_out:
            names = [f"{name} of {nodes[0]}{_others(nodes)}" for (name, _), nodes in self._left_out.items()]
            rest = f" and {len(names) - MAX_LISTED} others" if len(names) > MAX_LISTED else ""
            lines.append(f"left out, as today's Mitsuba does not know it: {', '.join(names[:MAX_LISTED])}{rest}")
        return few(lines)


def element(owner: Node, tag: str, attributes: dict[str, str], children: Sequence[Node] = ()) -> Node:
    """A new element, which stands where ``owner`` does in the file."""
    return Node(tag, attributes, owner.line, list(children), owner.file)


def _others(nodes: list[Node]) -> str:
    return f" and {len(nodes) - 1} more" if len(nodes) > 1 else ""


def label(node: Node) -> str:
    """The element without its line."""
    return f"<{shown(node.tag)}" + (f' type="{shown(node.type)}">' if node.type else ">")


def refuse(node: Node, text: str) -> NoReturn:
    """Refuse the scene for what one element is.

    Raises:
        SceneRejected: always.
    """
    raise SceneRejected(f"{node} {text}")


def named(node: Node, name: str) -> Node | None:
    """The child that is the parameter ``name``, whatever its tag, or None."""
    return next((child for child in node.children if child.attributes.get("name") == name), None)


def take(node: Node, name: str) -> Node | None:
    """Remove the parameter ``name`` and return it; None where there is none."""
    found = named(node, name)
    if found is not None:
        node.children = [child for child in node.children if child is not found]
    return found


def rename(node: Node, old: str, new: str) -> None:
    """Give the parameter ``old`` another name, unless the object has that one, too."""
    found = named(node, old)
    if found is not None and named(node, new) is None:
        found.attributes["name"] = new


def put(node: Node, tag: str, name: str, value: str | float | Sequence[float]) -> None:
    """Set the parameter ``name``, in place of one that is there; numbers are written in single precision."""
    take(node, name)
    node.children.append(element(node, tag, {"name": name, "value": written(value)}))


def written(value: str | float | Sequence[float]) -> str:
    """A value as a scene file holds it."""
    if isinstance(value, str):
        return value
    return ", ".join(f"{number:.9g}" for number in ([value] if isinstance(value, int | float) else value))


def text_of(node: Node, name: str, default: str = "") -> str:
    """The text of a parameter in lower case, as Mitsuba 0.x compares it."""
    found = named(node, name)
    return found.attributes.get("value", default).strip().lower() if found else default


def numbers(text: str) -> list[float]:
    """The numbers in a text that holds nothing else; none where one is too large."""
    words = [word for word in _SEPARATORS.split(text) if word]
    found = [float(word) for word in words] if all(_NUMBER.fullmatch(word) for word in words) else []
    return found if all(abs(value) <= MAX_FLOAT for value in found) else []


def constant(node: Node | None) -> list[float] | None:
    """One number or three of a parameter that is a constant; None of a texture, a curve or nothing."""
    if node is None or node.tag not in ("float", "integer", "rgb", "spectrum") or node.type:
        return None
    found = numbers(node.attributes.get("value", ""))
    return found if len(found) in (1, 3) else None


def number_of(node: Node, name: str, default: float) -> float:
    """The single number of a parameter, or the default where the object has none.

    Raises:
        SceneRejected: it has one that is no single number.
    """
    found = named(node, name)
    if found is None:
        return default
    value = constant(found)
    if value is None or len(value) != 1:
        refuse(found, f"in {node} must be a single number: replace it by one")
    return value[0]
