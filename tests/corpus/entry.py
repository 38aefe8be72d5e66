"""What the corpus says of a scene file: its text, the files beside it, and what must come out."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from elps_core.scene.loader import LoadedScene

SIZE = (16, 12)
"""Width and height of nearly all images, in pixels."""
SCENE = "scene.xml"
BUNDLE = "bundle.zip"


@dataclass(frozen=True)
class Loads:
    """What comes out of a scene that loads; all of it is held."""

    shapes: int
    triangles: int
    emitters: str = ""
    """Their classes, sorted, each as often as it is there."""
    bsdfs: str = "diffuse"
    """Kinds of materials in use, sorted."""
    warnings: tuple[str, ...] = ()
    """Words, of which every warning has some and each is in one."""
    sizes: tuple[tuple[int, int], ...] = (SIZE,)
    """Width and height of the image of each camera."""
    defaults: Mapping[str, object] = field(default_factory=dict)
    """What the file says of its render, but for paths without limit, which a file means that does not limit them."""
    parameters: Mapping[str, str] = field(default_factory=dict)
    ignored: tuple[str, ...] = ()

    def differences(self, loaded: LoadedScene) -> list[str]:
        """What a loaded scene has in place of what it must have; one line each."""
        summary = loaded.summary
        found = {
            "shapes": (self.shapes, summary.shapes),
            "triangles": (self.triangles, summary.triangles),
            "emitters": (self.emitters, " ".join(" ".join([e.type] * e.count) for e in summary.emitters)),
            "bsdfs": (self.bsdfs, " ".join(summary.bsdfs)),
            "sizes": (self.sizes, tuple((sensor.width, sensor.height) for sensor in summary.sensors)),
            "defaults": ({"max_depth": -1, **self.defaults}, summary.defaults.model_dump(exclude_none=True)),
            "parameters": (dict(self.parameters), {p.name: p.value for p in summary.parameters}),
            "ignored": (self.ignored, summary.ignored),
        }
        lines = [f"{name}: {is_} in place of {must}" for name, (must, is_) in found.items() if must != is_]
        untold = [w for w in self.warnings if not any(w in warning for warning in summary.warnings)]
        unasked = [w for w in summary.warnings if not any(word in w for word in self.warnings)]
        return [*lines, *(f"no warning of '{w}'" for w in untold), *(f"warned: {w}" for w in unasked)]


@dataclass(frozen=True)
class Refused:
    """What a refusal must say: the element, its line, and the cure."""

    words: tuple[str, ...]
    on_purpose: bool = False
    """Whether Mitsuba loads the files: then we refuse what it takes, and know why."""


@dataclass(frozen=True)
class Entry:
    """A scene file as people have it."""

    name: str
    text: str | bytes
    out: Loads | Refused
    files: Mapping[str, bytes] = field(default_factory=dict)
    """The other files, by their names relative to the scene's folder."""
    defines: Mapping[str, str] = field(default_factory=dict)
    xml: str = SCENE
    """Name of the scene file."""
    bundle: bool = False
    """Whether it is uploaded as a zip archive; else it is a file with others beside it."""

    @property
    def content(self) -> bytes:
        """The scene file's bytes."""
        return self.text if isinstance(self.text, bytes) else self.text.encode()

    def write(self, folder: Path) -> Path:
        """Write all files, folders for backslashes, too; return the scene file."""
        for name, content in {**self.files, self.xml: self.content}.items():
            path = folder / name.replace("\\", "/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        return folder / self.xml.replace("\\", "/")

    def pack(self, folder: Path) -> Path:
        """Write what is uploaded: the archive, or the scene file with the others beside it."""
        if not self.bundle:
            return self.write(folder)
        folder.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(folder / BUNDLE, "w") as archive:
            for name, content in {**self.files, self.xml: self.content}.items():
                info = zipfile.ZipInfo("name")
                info.filename = name  # as it is: the constructor would make slashes of backslashes
                archive.writestr(info, content)
        return folder / BUNDLE
