"""The scenes of the first job, and how each is brought before ELPS and before Mitsuba.

They are in two halves. Constants that decide a choice are chosen on :data:`TUNED_ON` and checked on :data:`JUDGED_ON`.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from elps_core.scene import generate
from elps_core.scene.bundle import is_archive, root_xml
from tests.benchmarks.enlightened import CASES

Size = tuple[int, int]
"""Width and height in pixels."""
FILM = {"width": 768, "height": 576}
"""Mitsuba's own film size, pixels, where a scene names none."""
LAMPS = 2000
"""Lamps of the room: so many that to draw one of them by its power alone finds a near one seldom."""


class LeftOut(Exception):
    """A scene that is not here; the message says why."""


@dataclass(frozen=True)
class Scene:
    """One scene of the comparison."""

    title: str
    find: Callable[[Path, Path], Path]
    """(empty folder, folder of shared scenes) -> scene file or bundle; raises :class:`LeftOut`."""
    reference: str
    """The way among ``tests.benchmarks.enlightened.WAYS`` that renders the reference."""
    keeps_aspect: bool = False
    """Whether the image has the proportions of the scene's own film, in place of those of ``--size``."""


@dataclass(frozen=True)
class Staged:
    """A scene ready to be rendered by both."""

    source: Path
    """What ``elps render`` is given."""
    xml: Path
    """Its scene file as it was found, with the files that it names beside it."""
    peer: Path
    """What Mitsuba is given: the same scene file with the size of the film changed."""
    size: Size

    @property
    def size_text(self) -> str:
        """The size as ``--size`` takes it."""
        return "{}x{}".format(*self.size)


def _case(title: str) -> Scene:
    """A scene of the comparison of enlightened ways."""

    def find(folder: Path, _: Path) -> Path:
        path = folder / "scene.zip"
        CASES[title].make(path)
        return path

    return Scene(title, find, CASES[title].reference)


def _generated(title: str, reference: str, **parameters: int) -> Scene:
    """A scene of the generator of the same name."""

    def find(folder: Path, _: Path) -> Path:
        make = generate.GENERATORS.get(title)
        if make is None:
            raise LeftOut(f"this version has no generator '{title}'")
        path = folder / "scene.zip"
        generate.write(make(**parameters), path)
        return path

    return Scene(title, find, reference)


def _shared(title: str, reference: str) -> Scene:
    """A scene that the project does not hold."""

    def find(_: Path, shared: Path) -> Path:
        path = shared / title / "scene.xml"
        if not path.exists():
            raise LeftOut("the folder of shared scenes does not hold it: name another with --shared")
        return path

    return Scene(title, find, reference, keeps_aspect=True)


TUNED_ON = (
    _case("door 9"),
    _case("cornell"),
    _shared("veach-bidir", "bdpt"),
    _shared("classroom", "enlightened path"),
    _generated("lamps", "path, lit by context", lamps=LAMPS),
)
JUDGED_ON = (
    _case("door 3"),
    _case("maze"),
    _case("bulb in glass"),
    _shared("staircase2", "enlightened path"),
    _shared("dining-room", "enlightened path"),
    _generated("office", "enlightened path"),
)
SCENES = {scene.title: scene for scene in (*TUNED_ON, *JUDGED_ON)}


def stage(scene: Scene, folder: Path, shared: Path, box: Size) -> Staged:
    """Find or make ``scene``, and copy it for Mitsuba.

    Args:
        scene: the scene.
        folder: an empty folder that outlives the result.
        shared: folder of scenes that the project does not hold.
        box: size of the image, or what an image of the scene's own proportions is fitted into.

    Raises:
        LeftOut: the scene is not here.
    """
    source = scene.find(folder, shared)
    xml = source
    if is_archive(source):
        with zipfile.ZipFile(source) as archive:
            archive.extractall(folder / "unpacked")
        xml = root_xml(folder / "unpacked")
    size = fitted(film_size(xml), box) if scene.keeps_aspect else box
    return Staged(source, xml, resized(xml, folder / "peer", size), size)


def fitted(film: Size, box: Size) -> Size:
    """The largest size with the proportions of ``film`` that fits into ``box``."""
    scale = min(box[0] / film[0], box[1] / film[1])
    return max(1, round(film[0] * scale)), max(1, round(film[1] * scale))


def film_size(xml: Path) -> Size:
    """The size of the first film in a scene file, its ``<default>`` parameters put in."""
    root = ET.parse(xml).getroot()
    parameters = {f"${node.attrib['name']}": node.attrib["value"] for node in root.iter("default")}
    found = dict(FILM)
    for node in _film(root).iter("integer"):
        if node.attrib["name"] in found:
            value = node.attrib["value"].strip()
            found[node.attrib["name"]] = int(parameters.get(value, value))
    return found["width"], found["height"]


def resized(xml: Path, folder: Path, size: Size) -> Path:
    """A copy of a scene file in the new ``folder``, with films of ``size`` and links to the files beside it.

    The original may be read-only. A crop window is dropped, as ``elps render --size`` does.
    """
    folder.mkdir()
    for beside in xml.resolve().parent.iterdir():
        if beside.name != xml.name:
            (folder / beside.name).symlink_to(beside, target_is_directory=beside.is_dir())
    tree = ET.parse(xml)
    _film(tree.getroot())
    for film in tree.getroot().iter("film"):
        for node in list(film):
            name = node.attrib.get("name", "")
            if name in FILM or name.startswith("crop_"):
                film.remove(node)
        for name, pixels in zip(FILM, size, strict=True):
            ET.SubElement(film, "integer", name=name, value=str(pixels))
    copy = folder / xml.name
    tree.write(copy, encoding="utf-8", xml_declaration=True)
    return copy


def _film(root: ET.Element) -> ET.Element:
    film = next(root.iter("film"), None)
    if film is None:
        raise LeftOut("its scene file has no film whose size could be set")
    return film
