"""A scene file as a tree of elements: which may stand where, and how the tree is written. Imports no Mitsuba."""

from __future__ import annotations

from dataclasses import dataclass, field
from xml.sax.saxutils import quoteattr

from elps_core.errors import SceneRejected
from elps_core.scene import plugins
from elps_core.scene.text import shown


@dataclass
class Node:
    """One element of a scene file."""

    tag: str
    attributes: dict[str, str]
    line: int
    """Line of its file, from 1."""
    children: list[Node] = field(default_factory=list)
    file: str = ""
    """Name of the included file that it stands in; empty in the scene file itself."""

    @property
    def type(self) -> str:
        """The plugin's name, or an empty string."""
        return self.attributes.get("type", "")

    @property
    def is_object(self) -> bool:
        """Whether the element makes an object: a plugin or the scene itself."""
        return self.tag == "scene" or (
            self.tag in plugins.PLUGINS and (self.tag != "spectrum" or "type" in self.attributes)
        )

    def property(self, tag: str, name: str) -> Node | None:
        """The child ``<tag name="name">``, or None."""
        return next((c for c in self.children if c.tag == tag and c.attributes.get("name") == name), None)

    def objects(self) -> list[Node]:
        """This element and those below it that make objects, in the order of the file."""
        found, todo = [], [self]
        while todo:
            node = todo.pop()
            found.append(node)
            todo.extend(child for child in reversed(node.children) if child.is_object)
        return found

    def __str__(self) -> str:
        kind = f' type="{shown(self.type)}"' if self.type else ""
        place = f"line {self.line} of '{shown(self.file)}'" if self.file else f"line {self.line}"
        return f"<{shown(self.tag)}{kind}> ({place})"


def check(root: Node) -> None:
    """Hold every element below the root against the lists of elements and attributes, and against its place.

    Raises:
        SceneRejected: an element or attribute that is unknown, or stands where it cannot.
    """
    todo = [root]
    while todo:
        parent = todo.pop()
        allowed = plugins.ATTRIBUTES.get(parent.tag)
        if allowed is None:
            raise SceneRejected(f"{parent} is not an element of Mitsuba's scene format")
        for name in parent.attributes:
            if name not in allowed:
                raise SceneRejected(f"{parent} has an unknown attribute '{shown(name)}'")
        for node in parent.children:
            in_transform = node.tag in plugins.TRANSFORMS
            known = node.tag in plugins.ATTRIBUTES
            wrong = (parent.tag != "transform") if in_transform else (node.tag == "scene" or not parent.is_object)
            if known and wrong:
                raise SceneRejected(f"{node} cannot stand inside {parent}")
        todo.extend(reversed(parent.children))


def write(root: Node, replace: dict[int, str]) -> tuple[str, list[Node]]:
    """The tree as XML, one element a line, attributes sorted; and the element of each line.

    Args:
        root: the tree.
        replace: ``id(node)`` -> what to write in place of the node's file name.
    """
    lines: list[str] = []
    nodes: list[Node] = []
    todo: list[Node | str] = [root]
    while todo:
        item = todo.pop()
        if isinstance(item, str):
            lines.append(item)
            nodes.append(nodes[-1])
            continue
        attributes = dict(item.attributes)
        if id(item) in replace:
            attributes["filename" if item.tag == "spectrum" else "value"] = replace[id(item)]
        text = "".join(f" {name}={quoteattr(value)}" for name, value in sorted(attributes.items()))
        nodes.append(item)
        if item.children:
            lines.append(f"<{item.tag}{text}>")
            todo.append(f"</{item.tag}>")
            todo.extend(reversed(item.children))
        else:
            lines.append(f"<{item.tag}{text}/>")
    return "\n".join(lines), nodes
