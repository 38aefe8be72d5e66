"""Which file a scene means by a name: one below the folder that it may use, and no other. Imports no Mitsuba."""

from __future__ import annotations

import os
import re
import unicodedata
from pathlib import Path

from elps_core.errors import SceneRejected
from elps_core.scene.bundle import may_be_used
from elps_core.scene.text import is_plain, shown

MAX_FOLDERS = 64
"""Folders in which one scene's files are looked for: each name is tried in all of them."""
_DRIVE = re.compile(r"[A-Za-z]:")
"""How an absolute name begins on Windows."""


class Files:
    """The files that a scene may name, looked for in the folders in which Mitsuba looks for them.

    A name that fits exactly wins; else the only one that differs by case or by its Unicode form alone, with a warning.

    Args:
        home: the folder of the scene file, to which names are relative.
        root: the folder that nothing may lead out of: ``home`` itself or one above it. Absent: ``home``.
        local: whether the folder is the user's own, who can name another one, and not a bundle.
    """

    def __init__(self, home: Path, root: Path | None = None, *, local: bool = False) -> None:
        self.home = home.resolve()
        self.root = (root or home).resolve()
        self.warnings: list[str] = []
        self._folders = [self.home]
        self._listed: dict[Path, dict[str, list[Path]]] = {}
        """Folder -> its entries by what their names have in common with those that are written differently."""
        self._local = local
        if not self.home.is_relative_to(self.root):
            raise SceneRejected("the scene file lies outside the folder that --root names: name one that holds it")

    def search(self, name: str, label: str) -> None:
        """Look for files in another folder first, as ``<path>`` asks; a folder that is not there is warned about.

        Raises:
            SceneRejected: the folder lies outside, or there are too many.
        """
        folder = self._found(name, f"{label}: the folder '{shown(name)}'", [self.home])
        if folder is None or not folder.is_dir():
            self.warnings.append(f"{label}: there is no folder '{shown(name)}': it is not searched")
            return
        self._folders = [folder, *(other for other in self._folders if other != folder)]
        if len(self._folders) > MAX_FOLDERS:
            raise SceneRejected(f"{label}: more than {MAX_FOLDERS} folders are searched: name fewer")

    def find(self, name: str, label: str) -> Path:
        """The absolute path of a file.

        Args:
            name: as the scene file has it; backslashes separate folders, too.
            label: the element that names the file, for messages.

        Raises:
            SceneRejected: it is not there, or lies outside.
        """
        label = f"{label}: the file '{shown(name)}'"
        found = self._found(name, label, self._folders)
        if found is None:
            if self._local:
                raise SceneRejected(f"{label} is not there")
            if not may_be_used(name):
                raise SceneRejected(f"{label} is of a kind that is left out of bundles: convert it, to PNG, EXR or PLY")
            raise SceneRejected(f"{label} is not in the bundle")
        return found

    def name_of(self, path: Path) -> str:
        """A file's name relative to the scene file, for messages."""
        return shown(Path(os.path.relpath(path, self.home)).as_posix())

    def _found(self, name: str, label: str, folders: list[Path]) -> Path | None:
        plain = name.replace("\\", "/")
        if not name or not is_plain(name) or "$" in name:
            raise SceneRejected(f"{label} has a name that is not allowed: use plain relative names")
        if plain.startswith(("/", "~")) or _DRIVE.match(plain):
            raise self._outside(label)
        places = [place for folder in folders if (place := self._inside(folder / plain)) is not None]
        # Said before anything is looked up: an answer must not tell which files the host has.
        if not places:
            raise self._outside(label)
        for place in places:
            try:
                path = place.resolve(strict=True)
            except (OSError, RuntimeError, ValueError):  # missing, a name too long, links in a circle
                continue
            if not path.is_relative_to(self.root):  # through a link
                raise self._outside(label)
            return path
        for path in filter(None, map(self._alike, places)):
            self.warnings.append(f"{label} is taken to be '{self.name_of(path)}', which is written differently")
            return path
        return None

    def _inside(self, path: Path) -> Path | None:
        """The path without ``..``, where it stays below the root."""
        plain = Path(os.path.normpath(path))
        return plain if plain.is_relative_to(self.root) else None

    def _alike(self, place: Path) -> Path | None:
        """The only file below the root whose name is the same but for case and Unicode form."""
        here = self.root
        for part in place.relative_to(self.root).parts:
            fitting = self._fitting(here, part)
            if len(fitting) != 1:
                return None
            here = fitting[0]
        path = here.resolve()
        return path if path.is_relative_to(self.root) else None

    def _fitting(self, folder: Path, name: str) -> list[Path]:
        """The entry of that name, or those whose names differ from it by case or Unicode form."""
        try:
            if (folder / name).exists():
                return [folder / name]
            # A scene may look for thousands of files: the folder is gone through once.
            if folder not in self._listed:
                listed = self._listed[folder] = {}
                for path in sorted(folder.iterdir()):
                    listed.setdefault(_key(path.name), []).append(path)
            return self._listed[folder].get(_key(name), [])
        except (OSError, ValueError):  # no folder, or a name too long
            return []

    def _outside(self, label: str) -> SceneRejected:
        if self._local:
            return SceneRejected(f"{label} lies outside the scene's folder: name a folder that holds both with --root")
        return SceneRejected(f"{label} lies outside the bundle: put it in and name it relative to the scene file")


def _key(name: str) -> str:
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())
