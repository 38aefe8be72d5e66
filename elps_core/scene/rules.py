"""Check a scene file's tree against the lists and limits: plugins, values, references. Imports no Mitsuba."""

from __future__ import annotations

import re
from collections.abc import Iterator

from elps_core.errors import SceneRejected
from elps_core.scene import plugins
from elps_core.scene.markup import Node
from elps_core.scene.text import is_plain, shown
from elps_core.settings import MAX_PIXELS_SIDE

MAX_OBJECTS = 200_000
"""Plugins in one scene; Mitsuba makes about 20,000 a second."""
MAX_EMITTERS = 10_000
"""The adjoint image has at least one column for each."""
MAX_SENSORS = 256
MAX_FILM_PIXELS = 2**26
"""8192 x 8192: an accumulated image with its error takes about 40 bytes a pixel, 2.7 GB."""
MAX_FILM_PARTS = 64
"""Objects inside one film: each response function of a spectral film is one more channel of every pixel."""
MAX_SAMPLE_COUNT = 2**20
"""Of a scene's sampler; settings of the render say how many are drawn."""
MAX_PATHS = 2_000_000
"""Mitsuba walks every way through the references from every object: a few dozen lines make 2^30 of them."""
MAX_REFERENCE_DEPTH = 64
MAX_FLOAT = 3.4028234e38
"""Largest number in single precision; beyond it a finite text becomes an infinite value."""
MAX_LABEL_CHARACTERS = 200
"""Of an object's id or name."""

DEFAULT_FILM_SIZE = (768, 576)
"""Mitsuba's own, where a film does not say."""

_PART = "shape_index"
"""Parameter of a shape whose file holds several."""
_NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_SEPARATORS = re.compile(r"[,\s]+")
_SPECTRUM_SEPARATORS = re.compile(r"[,:\s]+")
_NOT_FINITE = re.compile(r"[+-]?(?:nan|inf|infinity)", re.IGNORECASE)
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_.\-]{0,99}")
_TAKEN = re.compile(r"filename|_arg_[0-9]+")
"""Names of files, and those that Mitsuba gives to objects without a name: a parameter that is called so takes an
object's place, without a word."""
_STRING = re.compile(r"[A-Za-z0-9_ .,:;+\-*()=\t\r\n]*")
"""Text parameters: names of materials and distributions, lists of numbers. Without a slash none is a path."""


def check(root: Node) -> None:
    """Check every element below ``root``.

    Raises:
        SceneRejected: a plugin that is not allowed; a value that is no finite number, or out of range; a
            text that could be a path; a reference to nothing, in a circle, or of explosive length.
    """
    objects = root.objects()
    if len(objects) > MAX_OBJECTS:
        raise SceneRejected(f"the scene has {len(objects)} objects: at most {MAX_OBJECTS} are allowed")
    if sum(node.tag == "emitter" for node in objects) > MAX_EMITTERS:
        raise SceneRejected(f"the scene has more than {MAX_EMITTERS} emitters: merge them or use a textured one")
    if sum(node.tag == "sensor" for node in objects) > MAX_SENSORS:
        raise SceneRejected(f"the scene has more than {MAX_SENSORS} sensors: leave some out")
    for node in objects:
        _check_object(node)
        names: set[str] = set()
        for child in node.children:
            _check_name(child, names)
            if not child.is_object:
                for part in (child, *child.children):
                    _check_property(part, node)
    _check_references(objects)


def film_of(sensor: Node, objects: list[Node]) -> Node | None:
    """The film of a sensor, inside it or referred to; None where Mitsuba makes its default one."""
    by_id = {node.attributes["id"]: node for node in objects if "id" in node.attributes}
    for child in sensor.children:
        target = by_id.get(child.attributes.get("id", "")) if child.tag == "ref" else child
        if target is not None and target.tag == "film":
            return target
    return None


def film_size(film: Node | None) -> tuple[int, int]:
    """Width and height of the whole film in pixels, without its crop window.

    Raises:
        SceneRejected: no pixel, or too many.
    """
    sizes = []
    for name, default in zip(("width", "height"), DEFAULT_FILM_SIZE, strict=True):
        given = film.property("integer", name) if film else None
        sizes.append(int(given.attributes["value"]) if given else default)
    width, height = sizes
    check_film_size(width, height)
    return width, height


def part_of(owner: Node) -> int:
    """Which mesh of its file a shape asks for, counted from 0.

    Raises:
        SceneRejected: it does not say so by an integer.
    """
    given = next((child for child in owner.children if child.attributes.get("name") == _PART), None)
    if given is None:
        return 0
    if given.tag != "integer":
        raise SceneRejected(f"{owner}: its parameter '{_PART}' must be of the type integer, not {given.tag}")
    return int(given.attributes["value"])


def check_film_size(width: int, height: int) -> None:
    """Refuse an image without pixels or with too many.

    Raises:
        SceneRejected: so it is.
    """
    if width < 1 or height < 1:
        raise SceneRejected(f"the film has {width}x{height} pixels: give it at least one each way")
    if max(width, height) > MAX_PIXELS_SIDE or width * height > MAX_FILM_PIXELS:
        raise SceneRejected(f"the film has {width}x{height} pixels: at most {MAX_FILM_PIXELS} are allowed")


def _check_object(node: Node) -> None:
    if reason := plugins.REFUSED.get((node.tag, node.type)):
        raise SceneRejected(f"{node} is not one that a scene may use: {reason}")
    if node.tag != "scene" and node.type not in plugins.PLUGINS[node.tag]:
        raise SceneRejected(f"{node}: the plugin is not one that a scene may use as <{node.tag}>")
    identifier = node.attributes.get("id")
    if identifier is not None and not _is_label(identifier):
        raise SceneRejected(f"{node} has an id that is empty, too long or not printable")
    if node.tag == "film" and sum(child.is_object for child in node.children) > MAX_FILM_PARTS:
        raise SceneRejected(f"{node} has more than {MAX_FILM_PARTS} parts")


def _is_label(text: str) -> bool:
    """Whether an object may be called so."""
    return 0 < len(text) <= MAX_LABEL_CHARACTERS and is_plain(text)


def _check_name(node: Node, taken: set[str]) -> None:
    name = node.attributes.get("name")
    if name is None and not (node.is_object or node.tag == "ref"):
        raise SceneRejected(f"{node} needs a name")
    # Exporters give objects the names that users gave them, in any language; those of parameters are Mitsuba's.
    named = node.is_object or node.tag == "ref"
    if name is not None and not (_is_label(name) if named else _NAME.fullmatch(name)):
        raise SceneRejected(f"{node} has a name that no parameter has: '{shown(name)}'")
    if name is not None and _TAKEN.fullmatch(name) and (name, node.tag) != ("filename", "string"):
        raise SceneRejected(f"{node} has the name '{name}', which Mitsuba gives to others: rename it")
    if name in taken:
        raise SceneRejected(f"{node} gives the parameter '{shown(name)}' a second time")
    if name is not None:
        taken.add(name)


def _check_property(node: Node, owner: Node) -> None:
    for attribute, counts in plugins.NUMBER_COUNTS.get(node.tag, {}).items():
        text = node.attributes.get(attribute)
        if text is not None:
            _check_numbers(text, _SEPARATORS, counts, node, owner)
    value = node.attributes.get("value")
    if node.tag in ("float", "integer", "rgb", "boolean", "string", "matrix") and value is None:
        raise SceneRejected(f"{node} in {owner} needs a value")
    if node.tag == "integer" and value is not None:
        _check_integer(value, node, owner)
    if node.tag == "spectrum" and value is not None:
        _check_numbers(value, _SPECTRUM_SEPARATORS, None, node, owner)
    is_file = node.attributes.get("name") == "filename"
    if node.tag == "string" and value is not None and not is_file and not _STRING.fullmatch(value):
        name = shown(node.attributes.get("name", ""))
        raise SceneRejected(f"{node} in {owner}: the text of '{name}' has characters that no such parameter has")
    if node.tag == "ref" and "id" not in node.attributes:
        raise SceneRejected(f"{node} in {owner} needs an id")


def _check_numbers(
    text: str, separators: re.Pattern[str], counts: tuple[int, ...] | None, node: Node, owner: Node
) -> None:
    numbers = [word for word in separators.split(text) if word]
    for word in numbers:
        if _NOT_FINITE.fullmatch(word) or (_NUMBER.fullmatch(word) and not abs(float(word)) <= MAX_FLOAT):
            raise SceneRejected(f"{node} in {owner} has a number that is not finite")
        if not _NUMBER.fullmatch(word):
            raise SceneRejected(f"{node} in {owner} has a value that is not a number")
    if counts is not None and len(numbers) not in counts:
        wanted = " or ".join(str(count) for count in counts)
        raise SceneRejected(f"{node} in {owner} has {len(numbers)} numbers in place of {wanted}")


def _check_integer(text: str, node: Node, owner: Node) -> None:
    word = text.strip()
    if not re.fullmatch(r"[+-]?[0-9]{1,10}", word) or not -(2**31) <= int(word) < 2**31:
        raise SceneRejected(f"{node} in {owner} has a value that is not an integer of 32 bits")
    if node.attributes.get("name") == "sample_count" and not 1 <= int(word) <= MAX_SAMPLE_COUNT:
        raise SceneRejected(f"{node} in {owner} asks for {int(word)} samples: choose 1 to {MAX_SAMPLE_COUNT}")


def _check_references(objects: list[Node]) -> None:
    by_id: dict[str, Node] = {}
    for node in objects:
        identifier = node.attributes.get("id")
        if identifier is not None and by_id.setdefault(identifier, node) is not node:
            raise SceneRejected(f"{node} has the id '{shown(identifier)}', which another element has: rename one")

    def targets(node: Node) -> Iterator[Node]:
        for child in node.children:
            if child.is_object:
                yield child
            elif child.tag == "ref":
                target = by_id.get(child.attributes["id"])
                if target is None:
                    raise SceneRejected(f"{child} refers to '{shown(child.attributes['id'])}', which does not exist")
                yield target

    # Depth first without recursion: a chain of references may be as long as the file.
    paths: dict[int, int] = {}
    depths: dict[int, int] = {}
    total = 0
    for start in objects:
        stack = [(start, targets(start))] if id(start) not in paths else []
        entered = {id(start)}
        while stack:
            node, rest = stack[-1]
            target = next(rest, None)
            if target is None:
                below = list(targets(node))
                paths[id(node)] = 1 + sum(paths[id(t)] for t in below)
                depths[id(node)] = 1 + max((depths[id(t)] for t in below), default=0)
                total += paths[id(node)]
                if total > MAX_PATHS or depths[id(node)] > MAX_REFERENCE_DEPTH:
                    raise SceneRejected(f"{node} refers to objects that refer to others, too often to follow")
                entered.discard(id(node))
                stack.pop()
            elif id(target) in entered:
                raise SceneRejected(f"{target} refers to itself in a circle")
            elif id(target) not in paths:
                entered.add(id(target))
                stack.append((target, targets(target)))
