"""From a scene file and the files that it names to a checked tree and the canonical text that Mitsuba is given.

What is checked is what is written; nothing of it comes from anywhere else. Imports no Mitsuba.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping
from contextlib import ExitStack
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from elps_core.errors import SceneRejected
from elps_core.scene import advice, headers, markup, meshes, plugins, reading, rules
from elps_core.scene.bundle import open_regular
from elps_core.scene.digest import file_hash, scene_digest, surroundings_digest
from elps_core.scene.files import Files
from elps_core.scene.markup import Node
from elps_core.scene.summary import FileDefaults
from elps_core.scene.text import few

MAX_SCENE_BYTES = 4 * 2**30
"""Memory that all files of a scene may take together, each counted as often as it is used."""
_NO_NAME = re.compile(r"_arg_[0-9]+")
_LIGHT = frozenset({"radiance", "irradiance", "intensity"})
"""Parameters of emitters that say how much light they give."""
_NOTHING = r"[+-]?(?:0+(?:\.0*)?|\.0+)(?:[eE][+-]?[0-9]{1,4})?"
_BLACK = re.compile(rf"(?:[0-9.]{{1,20}}:)?{_NOTHING}(?:[\s,]+(?:[0-9.]{{1,20}}:)?{_NOTHING})*")
"""Values that are 0 throughout: a number, a colour, or a curve of wavelengths and values."""
_NO_CAMERA = "the scene has no <sensor>: a camera stands in front of it, looks along z and sees all of it"


@dataclass(frozen=True)
class CanonicalScene:
    """A scene file that passed every check that needs no Mitsuba."""

    text: str
    """What Mitsuba is given: allowed plugins only, parameters put in, absolute file names."""
    nodes: tuple[Node, ...]
    """The element of the scene file behind each line of ``text``."""
    digest: str
    surroundings: str
    """Digest without the cameras."""
    root: Node
    """The tree of ``text``. The scene's integrator is left out: settings decide."""
    sensors: tuple[Node, ...]
    """Cameras in the order of the scene file."""
    files: frozenset[str]
    """The absolute file names in ``text``."""
    parameters: Mapping[str, str]
    """The parameters that can be set, with their values."""
    defaults: FileDefaults
    """What the file says of its render."""
    integrators: tuple[Node, ...]
    """Those of the scene file, which say it."""
    framed: bool
    """Whether the file has no camera, and one is to be put where it sees all shapes."""
    warnings: tuple[str, ...]


def canonicalize(
    xml: Path,
    files: Files | None = None,
    scratch: Path | None = None,
    *,
    sensor: int = 0,
    size: tuple[int, int] | None = None,
    defines: Mapping[str, str] | None = None,
) -> CanonicalScene:
    """Read and check a scene file and the files that it names. Runs no Mitsuba.

    Args:
        xml: the scene file.
        files: the files that it may name; absent: those of its folder.
        scratch: a folder for files that have to be written anew; absent: they are gone at once.
        sensor: the camera whose film ``size`` applies to.
        size: (width, height) in pixels.
        defines: as in :func:`elps_core.scene.loader.load_scene`.

    Raises:
        SceneRejected: as :func:`elps_core.scene.loader.load_scene`.
    """
    files = files or Files(xml.parent)
    document = reading.read(xml, files, defines)
    scene = document.root
    integrators = [child for child in scene.children if child.tag == "integrator"]
    scene.children = [child for child in scene.children if child.tag != "integrator"]
    _plain(scene)
    rules.check(scene)
    objects = scene.objects()
    defaults, warnings = advice.take(integrators, [node for node in objects if node.tag == "sampler"])
    sensors = _sensors(objects)
    framed = not sensors
    if framed:
        sensors = [Node("sensor", {"type": "perspective"}, scene.line)]
        scene.children += sensors
        warnings.append(_NO_CAMERA)
    absolute: dict[int, str] = {}
    hashed: dict[int, str] = {}
    checked: dict[tuple[str, str, int], _File] = {}
    contents: dict[Path, str] = {}
    memory = 0
    for owner in objects:
        for node, kind in file_names(owner):
            path = files.find(node.attributes.get("filename") or node.attributes.get("value", ""), str(owner))
            key = kind, str(path), rules.part_of(owner)
            if key not in checked:
                checked[key] = _check_file(key, owner, files, scratch, contents)
            file = checked[key]
            memory += file.memory
            if memory > MAX_SCENE_BYTES:
                raise SceneRejected(f"{owner}: with this file the scene needs more than {MAX_SCENE_BYTES >> 30} GiB")
            # A dollar sign in the path of the bundle is no parameter.
            absolute[id(node)] = str(file.path).replace("$", "\\$")
            hashed[id(node)] = f"sha256:{file.content}{path.suffix.lower()}"
    digest = scene_digest(markup.write(scene, hashed)[0])
    surroundings = surroundings_digest(markup.write(_without_sensors(scene), hashed)[0])
    if sensor not in range(len(sensors)):
        raise SceneRejected(f"the scene has {len(sensors)} sensors, counted from 0: there is no sensor {sensor}")
    if size is not None:
        rules.check_film_size(*size)
        _resize(sensors[sensor], objects, size)
    _say_black(objects)
    text, nodes = markup.write(_with_emitter(scene, objects), absolute)
    return CanonicalScene(
        text,
        tuple(nodes),
        digest,
        surroundings,
        scene,
        tuple(sensors),
        frozenset(str(file.path) for file in checked.values()),
        document.parameters,
        defaults,
        tuple(integrators),
        framed,
        (*document.warnings, *few(files.warnings), *few(warnings)),
    )


def _plain(node: Node) -> None:
    """Put the shapes of each ``merge`` in its place, and take names away that only say that there is none.

    Meshes of one material become one in any case. Mitsuba calls objects without a name ``_arg_0`` and writes that
    into files; as a name of another object it would take that one's place.
    """
    whole: list[Node] = []
    for child in node.children:
        if (child.is_object or child.tag == "ref") and _NO_NAME.fullmatch(child.attributes.get("name", "")):
            del child.attributes["name"]
        _plain(child)
        merges = child.tag == "shape" and child.type == "merge"
        if merges and all(part.tag == "shape" and "name" not in part.attributes for part in child.children):
            whole += child.children
        else:
            whole.append(child)
    node.children = whole


def _say_black(objects: list[Node]) -> None:
    """Write light that is 0 as a constant spectrum: variants with spectra make none of a black colour or curve."""
    for node in objects:
        for child in node.children if node.tag == "emitter" else ():
            light = child.tag in ("rgb", "float", "spectrum") and child.attributes.get("name") in _LIGHT
            if light and _BLACK.fullmatch(child.attributes.get("value", "").strip()):
                child.tag, child.attributes = "spectrum", {**child.attributes, "value": "0"}


def _with_emitter(root: Node, objects: list[Node]) -> Node:
    """The scene, with an emitter that gives no light where it has none: every algorithm begins or ends at one."""
    if any(node.tag == "emitter" for node in objects):
        return root
    dark = Node("emitter", {"type": "directional"}, root.line)
    dark.children = [Node("spectrum", {"name": "irradiance", "value": "0"}, root.line)]
    whole = copy(root)
    whole.children = [*root.children, dark]
    return whole


def _without_sensors(root: Node) -> Node:
    bare = copy(root)
    bare.children = [child for child in root.children if child.tag not in ("sensor", "film")]
    return bare


def file_names(owner: Node) -> list[tuple[Node, str]]:
    """The elements below an object that name a file, and how each file is checked."""
    found = []
    for child in owner.children:
        if child.tag == "spectrum" and "filename" in child.attributes:
            if child.is_object:
                raise SceneRejected(f"{child} has both a type and a filename")
            found.append((child, "text"))
        elif child.tag == "string" and child.attributes.get("name") == "filename":
            kind = plugins.FILE_READERS.get((owner.tag, owner.type))
            if kind is None:
                raise SceneRejected(f"{owner} takes no filename")
            found.append((child, kind))
    return found


class _File(NamedTuple):
    """A file that passed its check."""

    memory: int
    """Bytes that it takes at most."""
    content: str
    """Hash of the user's file."""
    path: Path
    """What Mitsuba is given: the file itself, or one that it reads right."""


def _check_file(
    key: tuple[str, str, int], owner: Node, files: Files, scratch: Path | None, contents: dict[Path, str]
) -> _File:
    """Check a file; where Mitsuba would refuse or misread it, write it anew into ``scratch``.

    Args:
        key: how it is read, where it lies, which of its parts is asked for.
        owner: the element that names it.
        files: where it was found.
        scratch: as in :func:`canonicalize`.
        contents: hashes of the files of this scene, taken once each.
    """
    kind, path, part = key[0], Path(key[1]), key[2]
    with open_regular(path) as file, ExitStack() as until_checked:
        content = contents[path] = contents.get(path) or file_hash(file)
        given, opened = path, file
        try:
            mended = headers.mended(kind, file, str(path))
            if mended is not None:
                data, told = mended
                folder = scratch or Path(until_checked.enter_context(tempfile.TemporaryDirectory()))
                given = folder / f"{content}{path.suffix.lower()}"
                given.write_bytes(data)
                opened = until_checked.enter_context(given.open("rb"))
                files.warnings += [f"{owner}: '{files.name_of(path)}' {what}" for what in told]
            opened.seek(0)
            return _File(headers.check(kind, opened, str(given), part), content, given)
        except meshes.BadFileError as error:
            raise SceneRejected(f"{owner}: '{files.name_of(path)}' {error}") from None


def _sensors(objects: list[Node]) -> list[Node]:
    """Cameras that can render, in order; those inside a batch belong to it.

    Raises:
        SceneRejected: a film is too large.
    """
    inside = {id(part) for node in objects if node.tag == "sensor" for part in node.objects()[1:]}
    sensors = [node for node in objects if node.tag == "sensor" and id(node) not in inside]
    for film in objects:
        if film.tag == "film":
            rules.film_size(film)
    return sensors


def _resize(sensor: Node, objects: list[Node], size: tuple[int, int]) -> None:
    """Give a camera a film of its own with another size."""
    original = rules.film_of(sensor, objects)
    sized = {"width": size[0], "height": size[1]}
    dropped = {"crop_width", "crop_height", "crop_offset_x", "crop_offset_y", *sized}
    film = Node("film", {"type": original.type if original else "hdrfilm"}, sensor.line)
    film.children = [
        *(c for c in (original.children if original else ()) if c.attributes.get("name") not in dropped),
        *(Node("integer", {"name": name, "value": str(value)}, film.line) for name, value in sized.items()),
    ]
    replaced = {id(original)}
    if original is not None and all(child is not original for child in sensor.children):
        name = original.attributes["id"]
        replaced = {id(child) for child in sensor.children if child.tag == "ref" and child.attributes["id"] == name}
    sensor.children = [child for child in sensor.children if id(child) not in replaced] + [film]
