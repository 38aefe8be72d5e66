"""Read a scene file into a small tree, under limits, without entities and without opening files.

Everything that Mitsuba's own parser does to the text is done here before it (parameters) or refused
(inclusion, search paths), so that what is checked is what is instantiated. Imports no Mitsuba.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from elps_core.errors import SceneRejected
from elps_core.scene import plugins
from elps_core.scene.bundle import DEFAULT_LIMITS, BundleLimits, open_regular
from elps_core.scene.text import shown

MAX_DEPTH = 32
"""Nesting of elements; BSDFs inside BSDFs inside shapes inside groups need about ten."""
MAX_ELEMENTS = 1_000_000
MAX_DEFAULTS = 256
"""Parameters declared by <default>; each is searched for in every value that has a dollar sign."""
MAX_VALUE_CHARACTERS = 2**20
"""One attribute value, after parameters are put in; tabulated spectra are the longest in use."""

_VERSION = re.compile(r"[23]\.[0-9]{1,3}\.[0-9]{1,3}")
_PARAMETER = re.compile(r"[A-Za-z0-9_]{1,64}")


@dataclass
class Node:
    """One element of a scene file."""

    tag: str
    attributes: dict[str, str]
    line: int
    """Line of the scene file, from 1."""
    children: list[Node] = field(default_factory=list)

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
        return f"<{shown(self.tag)}{kind}> (line {self.line})"


def read(xml: Path, limits: BundleLimits = DEFAULT_LIMITS) -> Node:
    """The root element of a scene file, parameters put in, comments and text dropped.

    Raises:
        SceneRejected: not well-formed; too large or deep; a document type or entity; an element,
            attribute or parameter that is unknown or refused.
    """
    with open_regular(xml) as file:
        content = file.read(limits.xml_bytes + 1)
    if len(content) > limits.xml_bytes:
        raise SceneRejected(f"the scene file is larger than {limits.xml_bytes} bytes: move its data into mesh files")
    reader = _Reader(limits)
    try:
        reader.parser.Parse(content, True)
    except expat.ExpatError as error:
        reason = expat.errors.messages.get(error.code, "syntax error")
        raise SceneRejected(f"the scene file is not well-formed XML: {reason} (line {error.lineno})") from None
    except (ValueError, LookupError):  # an encoding that Python does not know
        raise SceneRejected("the scene file names an unknown text encoding: save it as UTF-8") from None
    if reader.root is None:
        raise SceneRejected("the scene file is empty")
    return reader.root


class _Reader:
    """Handlers of one parse."""

    def __init__(self, limits: BundleLimits) -> None:
        self.root: Node | None = None
        self.open: list[Node] = []
        self.elements = 0
        self.expanded = 0
        self.most_expanded = limits.xml_bytes
        self.defaults: dict[str, str] = {}
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.StartDoctypeDeclHandler = self._refuse_doctype
        self.parser.EntityDeclHandler = self._refuse_doctype

    def _refuse_doctype(self, *_: object) -> None:
        raise SceneRejected("the scene file has a DOCTYPE or entities: remove them")

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self.elements += 1
        if self.elements > MAX_ELEMENTS:
            raise SceneRejected(f"the scene file has more than {MAX_ELEMENTS} elements")
        if len(self.open) >= MAX_DEPTH:
            raise SceneRejected(f"the scene file nests elements more than {MAX_DEPTH} deep")
        node = Node(tag, attributes, self.parser.CurrentLineNumber)
        self._check_element(node)
        for name, value in attributes.items():
            if "$" in value:
                attributes[name] = self._expand(value, node)
            elif len(value) > MAX_VALUE_CHARACTERS:
                raise SceneRejected(f"{node}: the value of '{shown(name)}' is too long: move the data into a file")
        if tag == "default":
            self._declare(node)
        elif self.open:
            self.open[-1].children.append(node)
        else:
            self.root = node
        self.open.append(node)

    def _end(self, _: str) -> None:
        self.open.pop()

    def _check_element(self, node: Node) -> None:
        if node.tag in plugins.REFUSED:
            raise SceneRejected(f"{node} is not supported: {plugins.REFUSED[node.tag]}")
        allowed = plugins.ATTRIBUTES.get(node.tag)
        if allowed is None:
            raise SceneRejected(f"{node} is not an element of Mitsuba's scene format")
        for name in node.attributes:
            if name not in allowed:
                raise SceneRejected(f"{node} has an unknown attribute '{shown(name)}'")
        if not self.open:
            # Older versions rename parameters while they are read, past every check.
            if node.tag != "scene" or not _VERSION.fullmatch(node.attributes.get("version", "")):
                raise SceneRejected('the root element must be <scene version="3.0.0">, or another version from 2 on')
            return
        parent = self.open[-1]
        in_transform = node.tag in plugins.TRANSFORMS
        if (parent.tag != "transform") if in_transform else (node.tag == "scene" or not parent.is_object):
            raise SceneRejected(f"{node} cannot stand inside {parent}")

    def _declare(self, node: Node) -> None:
        name, value = node.attributes.get("name", ""), node.attributes.get("value")
        if not _PARAMETER.fullmatch(name) or value is None:
            raise SceneRejected(f"{node} needs a value, and a name of letters, digits and underscores")
        # As in Mitsuba, the first declaration of a name holds.
        self.defaults.setdefault(name, value)
        if len(self.defaults) > MAX_DEFAULTS:
            raise SceneRejected(f"the scene file declares more than {MAX_DEFAULTS} parameters")

    def _expand(self, value: str, node: Node) -> str:
        """``value`` with parameters put in, as Mitsuba does: longest name first, no second pass."""
        if "\\$" in value:
            raise SceneRejected(f"{node}: an escaped dollar sign is not supported")
        for name in sorted(self.defaults, key=len, reverse=True):
            key, put_in = f"${name}", self.defaults[name]
            # Parameters may hold parameters: without this bound a few lines grow to gigabytes.
            if len(value) + value.count(key) * (len(put_in) - len(key)) > MAX_VALUE_CHARACTERS:
                raise SceneRejected(f"{node}: a value grows too long when its parameters are put in")
            value = value.replace(key, put_in)
        if "$" in value:
            raise SceneRejected(f"{node} uses a parameter that no <default> declares")
        self.expanded += len(value)
        if self.expanded > self.most_expanded:
            raise SceneRejected("the scene file grows too large when its parameters are put in")
        return value


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
