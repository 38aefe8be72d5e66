"""Read a scene file, and the files that it includes, into one tree, under limits and without entities.

Everything that Mitsuba's own parser does to the text is done here before it (parameters, inclusion, search paths,
other names of objects, older versions), so that what is checked is what is instantiated. Imports no Mitsuba.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.parsers import expat

from elps_core.errors import SceneRejected
from elps_core.scene import lexical, markup, packing
from elps_core.scene.bundle import DEFAULT_LIMITS, BundleLimits, open_regular
from elps_core.scene.files import Files
from elps_core.scene.markup import Node
from elps_core.scene.text import shown
from elps_core.scene.upgrade import Version, upgrade

MAX_DEPTH = 32
"""Nesting of elements; BSDFs inside BSDFs inside shapes inside groups need about ten."""
MAX_ELEMENTS = 1_000_000
MAX_DEFAULTS = 256
"""Parameters of a scene; each is searched for in every value that has a dollar sign."""
MAX_VALUE_CHARACTERS = 2**20
"""One attribute value, after parameters are put in; tabulated spectra are the longest in use."""
MAX_INCLUDES = 1000
"""Files that are read for one scene, each counted as often as it is included: exporters write one for each kind of
thing, or one for each object of a set."""
MAX_NESTED = 15
"""Files that include one another in a row; Mitsuba's own limit."""

_VERSION = re.compile(r"([023])\.([0-9]{1,3})\.([0-9]{1,3})")
_PARAMETER = re.compile(r"[A-Za-z0-9_]{1,64}")
_USE = re.compile(r"\$([A-Za-z0-9_]*)")


@dataclass(frozen=True)
class Document:
    """What a scene file and all that it includes say."""

    root: Node
    """One tree: parameters put in, included elements in place, comments and text dropped."""
    parameters: Mapping[str, str]
    """Those that can be set, with the values that hold."""
    warnings: tuple[str, ...]


def read(
    xml: Path, files: Files, defines: Mapping[str, str] | None = None, limits: BundleLimits = DEFAULT_LIMITS
) -> Document:
    """Read a scene file.

    Args:
        xml: the scene file.
        files: where the files that it includes are looked for.
        defines: values of its parameters in place of those that it declares itself.
        limits: sizes in bytes.

    Raises:
        SceneRejected: not well-formed; too large or deep; a document type or entity; an element,
            attribute or parameter that is unknown or refused; a file that cannot be included.
    """
    reading = _Reading(files, dict(defines or {}), limits)
    root = reading.file(xml.resolve(), None)
    reading.put_in(root)
    unused = reading.defines.keys() - reading.declared
    if unused:
        raise SceneRejected(f"the scene has no parameter '{shown(min(unused))}'{_known(reading.declared)}")
    reading.rename(root)
    reading.warnings += upgrade(root, reading.versions)
    markup.check(root)
    return Document(root, dict(reading.values), tuple(reading.warnings))


def _known(names: set[str]) -> str:
    few = ", ".join(sorted(names)[:8])
    return f": it has {shown(few)}" if few else ": it declares none"


class _Reading:
    """What all files of a scene share while they are read."""

    def __init__(self, files: Files, defines: dict[str, str], limits: BundleLimits) -> None:
        self.files = files
        self.limits = limits
        self.defines = defines
        self.declared: set[str] = set()
        """Parameters that the files declare or use."""
        self.values = dict(defines)
        self._by_length: list[tuple[str, str]] = []
        """What stands for each of them, and its name, the longest first; kept, as every value is looked at."""
        self.aliases: dict[str, str] = {}
        self.open: list[Path] = []
        """Files that are being read, each included by the one before."""
        self.names: list[str] = []
        """Their names, as elements have them."""
        self.versions: dict[str, Version] = {}
        """Name of a file -> the Mitsuba that it is written for."""
        self.warnings: list[str] = []
        self.included: dict[int, tuple[Node, list[Node]]] = {}
        """``id`` of an ``<include>`` -> itself, and the elements that take its place."""
        self.elements = self.expanded = self.bytes = self.count = 0
        for name, value in defines.items():
            if not _PARAMETER.fullmatch(name) or len(value) > MAX_VALUE_CHARACTERS:
                raise SceneRejected(f"'{shown(name)}' cannot be the name of a parameter: use letters, digits, '_'")

    def file(self, path: Path, including: Node | None) -> Node:
        """The tree of one file, with the contents of those that it includes."""
        name = "" if including is None else self.files.name_of(path)
        label = "the scene file" if including is None else f"{including}: the file '{name}'"
        if path in self.open:
            raise SceneRejected(f"{label} includes itself, at once or through others")
        if len(self.open) > MAX_NESTED:
            raise SceneRejected(f"{label} is included by too many others in a row: at most {MAX_NESTED} are followed")
        self.count += 1
        if self.count > MAX_INCLUDES:
            raise SceneRejected(f"the scene includes more than {MAX_INCLUDES} files: merge some")
        with open_regular(path) as file:
            content = file.read(self.limits.xml_bytes + 1)
        self.bytes += len(content)
        if self.bytes > self.limits.xml_bytes:
            raise SceneRejected(f"{label} is larger than {self.limits.xml_bytes} bytes: move its data into mesh files")
        if packed := packing.advice(content):
            raise SceneRejected(f"{label} {packed}")
        self.open.append(path)
        self.names.append(name)
        root = _Reader(self, name).read(content, label)
        self.open.pop()
        self.names.pop()
        return root

    def include(self, node: Node) -> None:
        """Read the file that an ``<include>`` names: its scene's elements, or the one element that it is."""
        path = self.files.find(node.attributes.get("filename", ""), str(node))
        root = self.file(path, node)
        self.included[id(node)] = node, (root.children if root.tag == "scene" else [root])

    def put_in(self, root: Node) -> None:
        """Let the elements of included files stand where they are included."""
        todo = [root] if self.included else []
        while todo:
            node = todo.pop()
            while any(id(child) in self.included for child in node.children):
                node.children = [
                    each for child in node.children for each in self.included.get(id(child), (child, [child]))[1]
                ]
            todo.extend(node.children)

    def check_version(self, root: Node) -> None:
        """Refuse a file whose format nobody knows; a single included element may have the including file's."""
        given = root.attributes.get("version")
        found = _VERSION.fullmatch(given or "")
        alone = len(self.open) > 1 and root.tag != "scene"
        if alone and given is None:
            self.versions[root.file] = self.versions[self.names[-2]]
        elif found and (alone or root.tag == "scene"):
            major, minor, patch = map(int, found.groups())
            self.versions[root.file] = major, minor, patch
        else:
            raise SceneRejected(f'{root}: the root element must be <scene version="3.0.0">, or of another version')
        if alone:
            root.attributes.pop("version", None)

    def declare(self, node: Node) -> None:
        """Take up the parameter of a ``<default>``."""
        name, value = node.attributes.get("name", ""), node.attributes.get("value")
        if not _PARAMETER.fullmatch(name) or value is None:
            raise SceneRejected(f"{node} needs a value, and a name of letters, digits and underscores")
        # As in Mitsuba, the first declaration of a name holds.
        self.values.setdefault(name, value)
        self.declared.add(name)
        if len(self.values) > MAX_DEFAULTS:
            raise SceneRejected(f"the scene file declares more than {MAX_DEFAULTS} parameters")

    def expand(self, value: str, node: Node) -> str:
        """``value`` with parameters put in, as Mitsuba does: longest name first, no second pass."""
        if "\\$" in value:
            raise SceneRejected(f"{node}: an escaped dollar sign is not supported")
        if len(self._by_length) < len(self.values):
            self._by_length = [(f"${name}", name) for name in sorted(self.values, key=len, reverse=True)]
        for key, name in self._by_length:
            if key not in value:
                continue
            put_in = self.values[name]
            count = value.count(key)
            # Parameters may hold parameters: without this bound a few lines grow to gigabytes.
            if len(value) + count * (len(put_in) - len(key)) > MAX_VALUE_CHARACTERS:
                raise SceneRejected(f"{node}: a value grows too long when its parameters are put in")
            self.declared.add(name)
            value = value.replace(key, put_in)
        left = _USE.search(value)
        if left:
            name = shown(left[0])
            raise SceneRejected(f"{node} uses the parameter '{name}', which has no value: no <default> declares it")
        self.expanded += len(value)
        if self.expanded > self.limits.xml_bytes:
            raise SceneRejected("the scene file grows too large when its parameters are put in")
        return value

    def alias(self, node: Node) -> None:
        """Take up another name of an object."""
        source, name = node.attributes.get("id", ""), node.attributes.get("as", "")
        if not source or not name or name in self.aliases:
            raise SceneRejected(f"{node} needs the 'id' of an object and a new name for it in 'as'")
        # An alias of an alias is one of the object itself. Only names that were given before count: none is circular.
        self.aliases[name] = self.aliases.get(source, source)

    def rename(self, root: Node) -> None:
        """Let references name objects by their own ids."""
        todo = [root] if self.aliases else []
        while todo:
            node = todo.pop()
            name = node.attributes.get("id", "")
            if node.tag == "ref" and name in self.aliases:
                node.attributes["id"] = self.aliases[name]
            elif name in self.aliases:
                raise SceneRejected(f"{node} has the id '{shown(name)}', which is an alias of another object")
            todo.extend(node.children)


class _Reader:
    """Handlers of the parse of one file."""

    def __init__(self, reading: _Reading, name: str) -> None:
        self.reading = reading
        self.name = name
        self.root: Node | None = None
        self.open: list[Node] = []
        self.parser = expat.ParserCreate("utf-8")
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.StartDoctypeDeclHandler = self._refuse_doctype
        self.parser.EntityDeclHandler = self._refuse_doctype

    def read(self, content: bytes, label: str) -> Node:
        try:
            self.parser.Parse(lexical.plain(content), True)
        except expat.ExpatError as error:
            reason = expat.errors.messages.get(error.code, "syntax error")
            raise SceneRejected(f"{label} is not well-formed XML: {reason} (line {error.lineno})") from None
        if self.root is None:
            raise SceneRejected(f"{label} is empty")
        return self.root

    def _refuse_doctype(self, *_: object) -> None:
        raise SceneRejected("the scene file has a DOCTYPE or entities: remove them")

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        reading = self.reading
        reading.elements += 1
        if reading.elements > MAX_ELEMENTS:
            raise SceneRejected(f"the scene file has more than {MAX_ELEMENTS} elements")
        if len(self.open) >= MAX_DEPTH:
            raise SceneRejected(f"the scene file nests elements more than {MAX_DEPTH} deep")
        node = Node(tag, attributes, self.parser.CurrentLineNumber, file=self.name)
        if not self.open:
            reading.check_version(node)
        for name, value in attributes.items():
            if "$" in value:
                attributes[name] = reading.expand(value, node)
            elif len(value) > MAX_VALUE_CHARACTERS:
                raise SceneRejected(f"{node}: the value of '{shown(name)}' is too long: move the data into a file")
        if not self.open:
            self.root = node
        elif tag == "default":
            reading.declare(node)
        elif tag == "path":
            reading.files.search(attributes.get("value", ""), str(node))
        elif tag == "alias":
            reading.alias(node)
        else:
            self.open[-1].children.append(node)
            if tag == "include":
                reading.include(node)
        self.open.append(node)

    def _end(self, _: str) -> None:
        self.open.pop()
