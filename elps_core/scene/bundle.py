"""Unpack an upload into an empty folder and refuse what a scene has no need of.

An upload is a zip archive, a single XML file, or a folder. Nothing that a header declares is
trusted: bytes, entries and the compression ratio are counted while reading. Imports no Mitsuba.
"""

from __future__ import annotations

import mmap
import os
import re
import shutil
import stat
import struct
import unicodedata
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path, PurePosixPath
from typing import IO, BinaryIO, NamedTuple

from elps_core.errors import SceneRejected
from elps_core.scene import packing
from elps_core.scene.text import is_plain, shown

MIB = 2**20

READ_BY_MITSUBA = frozenset(
    {"xml", "obj", "ply", "serialized", "png", "jpg", "jpeg", "exr", "hdr", "rgbe", "pfm", "ppm", "bmp", "tga"}
    | {"bsdf", "spd", "vol"}
)
TEXT = frozenset({"txt"})
"""Extension of curves' control points, and of many notes: unpacked, read where a scene names it."""
CODE = frozenset({"so", "dll", "dylib", "py", "pyc", "pyd", "exe", "com", "bat", "cmd", "ps1", "sh"})
"""Refused with their own message: a scene that brings code is hostile or misunderstood."""
ARCHIVES = frozenset({"zip", "tar", "tgz", "gz", "bz2", "xz", "7z", "rar"})
"""Refused: what is in them would be missing."""
JUNK_FOLDER = "__MACOSX"
JUNK_FILES = frozenset({".DS_Store", "Thumbs.db"})
"""Left by file managers in nearly every hand-made archive; skipped without a word."""
MOST_IGNORED = 20
"""Files that are named to the user as left out; more of them say nothing new."""

ROOT_XML = "scene.xml"
COPY_BYTES = MIB
RATIO_FLOOR = 8 * MIB
"""Below this size any compression ratio is allowed: a small picture of one colour packs a thousand times."""
_LOCAL_HEADER = struct.Struct("<4s22xHH")
"""Signature, then the lengths of name and extra field of a zip entry's local header (APPNOTE 4.3.7)."""
_CENTRAL_SIGNATURE = b"PK\x01\x02"
_INCLUDED = re.compile(rb"<include\s[^>]*?filename\s*=\s*[\"']([^\"'<>]{1,240})[\"']")
_CAMERA = re.compile(rb"<(?:sensor|camera)\s")


@dataclass(frozen=True)
class BundleLimits:
    """What an upload may hold; sizes in bytes."""

    upload_bytes: int = 512 * MIB
    total_bytes: int = 1024 * MIB
    file_bytes: int = 512 * MIB
    xml_bytes: int = 32 * MIB
    entries: int = 4096
    ratio: int = 200
    """Unpacked to packed size, over the whole archive."""
    name_bytes: int = 240
    """Longest path inside the bundle; with the temporary folder it stays below common file system limits."""
    folders: int = 16
    """Deepest nesting of folders."""


DEFAULT_LIMITS = BundleLimits()


class Unpacked(NamedTuple):
    """An upload in a folder."""

    xml: Path
    """Its scene file."""
    ignored: tuple[str, ...]
    """Names of files that no scene has a use for: they were left out."""


def unpack(upload: Path, into: Path, limits: BundleLimits = DEFAULT_LIMITS) -> Unpacked:
    """Check an upload, and copy what a scene may use of it into the folder ``into``.

    ``into`` is created where it is missing and must be empty. On rejection nothing is left in it.

    Raises:
        SceneRejected: not a zip archive, XML file or folder; too large; or it holds something that
            a scene may not bring: code, links, nested archives, paths that lead outside.
    """
    upload = upload.resolve()  # the upload itself may be a link; nothing in it may
    into.mkdir(parents=True, exist_ok=True)
    names = _Names(limits)
    try:
        if upload.is_dir():
            _copy_folder(upload, into, names)
        elif is_archive(upload):
            with _archive_errors():
                _unpack_archive(upload, into, names)
        else:
            _copy_xml(upload, into, limits)
        return Unpacked(root_xml(into), tuple(names.ignored[:MOST_IGNORED]))
    except BaseException:
        for left in into.iterdir():
            if left.is_dir() and not left.is_symlink():
                shutil.rmtree(left)
            else:
                left.unlink()
        raise


def may_be_used(name: str) -> bool:
    """Whether a scene has a use for a file of that name; others are left out of bundles."""
    return _extension(name) in READ_BY_MITSUBA | TEXT


def _extension(name: str) -> str:
    return PurePosixPath(name).suffix.removeprefix(".").casefold()


def is_archive(upload: Path) -> bool:
    """Whether the file begins as a zip archive does; names and extensions are not asked.

    Raises:
        SceneRejected: it is no ordinary file, or cannot be read.
    """
    with open_regular(upload) as file:
        return file.read(2) == b"PK"


def root_xml(folder: Path) -> Path:
    """The scene file of an unpacked bundle: at its top, else one folder down.

    It is the one called ``scene.xml``, else the only one that no other includes, else the only one of these with a
    camera.

    Raises:
        SceneRejected: none, or several and no way to tell.
    """
    for level in ("*", "*/*"):
        found = sorted(p for p in folder.glob(level) if p.suffix.lower() == ".xml" and _is_plain_file(p, folder))
        named = [p for p in found if p.name == ROOT_XML]
        if len(found) == 1 or len(named) == 1:
            return (named or found)[0]
        if found:
            return _scene_among(named or found)
    raise SceneRejected(f"the bundle has no XML file at its top, or one folder down: add the scene as '{ROOT_XML}'")


def _is_plain_file(path: Path, folder: Path) -> bool:
    """Whether it is an ordinary file below ordinary folders that are not hidden."""
    parents = [*path.relative_to(folder).parents][:-1]
    return path.is_file() and not any(
        (folder / parent).is_symlink() or parent.name.startswith(".") or parent.name == JUNK_FOLDER
        for parent in parents
    )


def _scene_among(found: list[Path]) -> Path:
    """The XML file that no other of them includes; the only one with a camera, where there are several."""
    texts = {}
    for path in found:
        with open_regular(path) as file:
            texts[path] = file.read(DEFAULT_LIMITS.xml_bytes)
    included = {
        PurePosixPath(name.decode("utf-8", "replace").replace("\\", "/")).name
        for text in texts.values()
        for name in _INCLUDED.findall(text)
    }
    alone = [path for path in found if path.name not in included]
    seen = [path for path in alone if _CAMERA.search(texts[path])]
    for fitting in (alone, seen):
        if len(fitting) == 1:
            return fitting[0]
    raise SceneRejected(f"the bundle has {len(found)} XML files: call the scene's own '{ROOT_XML}'")


@contextmanager
def _archive_errors() -> Iterator[None]:
    """Turn what the zip reader raises on damaged archives into one line."""
    damaged = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, struct.error)
    try:
        yield
    except (*damaged, ValueError, OverflowError):
        raise SceneRejected("the zip archive is damaged: pack it again") from None


class _Names:
    """The paths seen so far in one bundle, to refuse what would collide on some file system."""

    def __init__(self, limits: BundleLimits) -> None:
        self.limits = limits
        self.files: set[str] = set()
        self.folders: set[str] = set()
        self.ignored: list[str] = []
        """Names of files that no scene has a use for."""

    def check(self, name: str) -> PurePosixPath | None:
        """The checked relative path of a file, or None where it is to be skipped."""
        label = f"'{shown(name)}'"
        name = name.replace("\\", "/")  # as some programs pack folders
        if len(name.encode("utf-8", "replace")) > self.limits.name_bytes:
            raise SceneRejected(f"the name {label} is too long: shorten it")
        if not is_plain(name):
            raise SceneRejected(f"the name {label} has control or invisible characters: rename it")
        if "$" in name or ":" in name:
            raise SceneRejected(f"the name {label} has a '$' or ':': rename it")
        parts = name.split("/")
        if name.startswith(("/", "~")) or any(part in ("", ".", "..") for part in parts):
            raise SceneRejected(f"the name {label} leads out of the bundle: use plain relative names")
        if any(part != part.strip(" ") or part.endswith(".") for part in parts):
            raise SceneRejected(f"the name {label} has a part that begins or ends with a space or dot: rename it")
        if len(parts) > self.limits.folders:
            raise SceneRejected(f"the name {label} is nested too deeply")
        keys = [unicodedata.normalize("NFKC", part).casefold() for part in parts]
        if "plugins" in keys:
            raise SceneRejected(f"{label}: folders called 'plugins' are not allowed in a bundle")
        # Every dot counts: "evil.so.1" and "evil.py.txt" are refused as well.
        if CODE.intersection(keys[-1].split(".")[1:]):
            raise SceneRejected(f"{label}: a scene may not bring program code")
        if _extension(keys[-1]) in ARCHIVES:
            raise SceneRejected(f"{label}: an archive in a bundle is not unpacked: put its files into the bundle")
        if parts[0] == JUNK_FOLDER or parts[-1] in JUNK_FILES:
            return None
        self._check_collisions(keys, label)
        if not may_be_used(keys[-1]):
            self.ignored.append(shown(name))
            return None
        return PurePosixPath(*parts)

    def _check_collisions(self, keys: list[str], label: str) -> None:
        path = "/".join(keys)
        parents = {"/".join(keys[:i]) for i in range(1, len(keys))}
        if path in self.files or path in self.folders or parents & self.files:
            raise SceneRejected(f"the name {label} is there twice, or differs only by case: rename one")
        self.files.add(path)
        self.folders |= parents


class _Counter:
    """Bytes that really arrive, against the limits."""

    def __init__(self, limits: BundleLimits, packed_bytes: int | None) -> None:
        self.limits = limits
        self.total = 0
        by_ratio = limits.total_bytes if packed_bytes is None else max(RATIO_FLOOR, limits.ratio * packed_bytes)
        self.most = min(limits.total_bytes, by_ratio)

    def copy(self, source: IO[bytes], target: Path) -> None:
        """Copy to a new file, private to this user; refuse the bundle as soon as a limit is passed."""
        is_xml = target.suffix.lower() == ".xml"
        most_here = self.limits.xml_bytes if is_xml else self.limits.file_bytes
        count = 0
        target.parent.mkdir(parents=True, exist_ok=True)
        with os.fdopen(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as out:
            while block := source.read(COPY_BYTES):
                count += len(block)
                self.total += len(block)
                if count > most_here:
                    raise SceneRejected(
                        f"'{shown(target.name)}' is larger than {most_here // MIB} MiB: make it smaller"
                    )
                if self.total > self.most:
                    raise SceneRejected("the bundle unpacks to far more than it may: make its files smaller")
                out.write(block)


def _unpack_archive(upload: Path, into: Path, names: _Names) -> None:
    with open_regular(upload) as file:
        _unpack_open_archive(file, into, names)


def _unpack_open_archive(file: BinaryIO, into: Path, names: _Names) -> None:
    limits = names.limits
    size = os.fstat(file.fileno()).st_size
    if size > limits.upload_bytes:
        raise SceneRejected(f"the archive is larger than {limits.upload_bytes // MIB} MiB: make its files smaller")
    _check_central_records(file, limits)
    with zipfile.ZipFile(file) as archive:
        infos = archive.infolist()
        if len(infos) > limits.entries:
            raise SceneRejected(f"the archive has more than {limits.entries} entries: merge or leave out files")
        _check_overlap(file, infos, archive.start_dir)
        counter = _Counter(limits, size)
        for info in infos:
            _check_entry(info)
            if _is_folder(info):
                _check_folder_name(info.orig_filename, names)
                continue
            path = names.check(info.orig_filename)
            if path is not None:
                with archive.open(info) as source:
                    counter.copy(source, into / path)


def _check_central_records(file: BinaryIO, limits: BundleLimits) -> None:
    """Count entries before the zip reader makes an object of each (a million fit into 46 MB)."""
    try:
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            found, at = 0, data.find(_CENTRAL_SIGNATURE)
            while at >= 0:
                found += 1
                # By chance, packed data holds the signature once in 4 GiB: twice the limit is never chance.
                if found > 2 * limits.entries:
                    raise SceneRejected(f"the archive has more than {limits.entries} entries: merge or leave out files")
                at = data.find(_CENTRAL_SIGNATURE, at + 1)
    finally:
        file.seek(0)


def _check_overlap(file: BinaryIO, infos: list[zipfile.ZipInfo], directory_at: int) -> None:
    """Refuse entries that share bytes: one packed block unpacked a thousand times (bpo, CVE-2024-0450)."""
    spans = sorted((info.header_offset, info.compress_size) for info in infos)
    ends = [start for start, _ in spans[1:]] + [directory_at]
    if spans and spans[0][0] < 0:
        raise zipfile.BadZipFile
    for (start, packed), end in zip(spans, ends, strict=True):
        file.seek(start)
        signature, name_bytes, extra_bytes = _LOCAL_HEADER.unpack(file.read(_LOCAL_HEADER.size))
        if signature != b"PK\x03\x04":
            raise zipfile.BadZipFile
        if start + _LOCAL_HEADER.size + name_bytes + extra_bytes + packed > end:
            raise SceneRejected("the archive has overlapping entries: pack it again with an ordinary zip program")


def _is_folder(info: zipfile.ZipInfo) -> bool:
    return info.orig_filename.endswith(("/", "\\"))


def _check_entry(info: zipfile.ZipInfo) -> None:
    label = f"'{shown(info.orig_filename)}'"
    kind = stat.S_IFMT(info.external_attr >> 16)
    if kind == stat.S_IFLNK:
        raise SceneRejected(f"{label} is a symbolic link: put the file itself into the archive")
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR) or (kind == stat.S_IFDIR) > _is_folder(info):
        raise SceneRejected(f"{label} is not an ordinary file: leave it out")
    if info.flag_bits & (0x1 | 0x40):  # encrypted, strongly encrypted (APPNOTE 4.4.4)
        raise SceneRejected(f"{label} is encrypted: pack it without a password")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise SceneRejected(f"{label} is packed by an unusual method: use deflate")
    if _is_folder(info) and info.compress_size:
        raise SceneRejected(f"{label} is a folder with content: pack it again with an ordinary zip program")


def _check_folder_name(name: str, names: _Names) -> None:
    """A folder obeys the rules of the files in it; it is made when a file needs it."""
    _Names(names.limits).check(name.rstrip("/\\") + "/folder.txt")


def _copy_folder(upload: Path, into: Path, names: _Names) -> None:
    limits = names.limits
    counter, entries = _Counter(limits, None), 0
    for folder, subfolders, files in os.walk(upload, followlinks=False):
        for name in [*subfolders, *files]:
            path = Path(folder, name)
            relative = path.relative_to(upload).as_posix()
            entries += 1
            if entries > limits.entries:
                raise SceneRejected(f"the folder has more than {limits.entries} entries: leave out files")
            if path.is_symlink():
                raise SceneRejected(f"'{shown(relative)}' is a symbolic link: put the file itself into the folder")
            if name in subfolders:
                _check_folder_name(relative, names)
                continue
            checked = names.check(relative)
            if checked is not None:
                with open_regular(path) as source:
                    if os.fstat(source.fileno()).st_nlink > 1:
                        raise SceneRejected(f"'{shown(relative)}' is a hard link: copy the file")
                    counter.copy(source, into / checked)


def _copy_xml(upload: Path, into: Path, limits: BundleLimits) -> None:
    with open_regular(upload) as source:
        start = source.read(256)
        if not start.lstrip(b"\xef\xbb\xbf\xff\xfe\x00 \t\r\n").startswith(b"<"):
            reason = packing.advice(start) or "is neither a zip archive nor a Mitsuba scene in XML"
            raise SceneRejected(f"the upload {reason}")
        source.seek(0)
        _Counter(limits, None).copy(source, into / ROOT_XML)


def open_regular(path: Path) -> BufferedReader:
    """Open an ordinary file for reading; a link, pipe or device is refused without being read or waited for.

    Raises:
        SceneRejected: it is no ordinary file, or cannot be read.
    """
    try:
        file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb")
    except OSError:
        raise SceneRejected(f"'{shown(path.name)}' cannot be read as an ordinary file") from None
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise SceneRejected(f"'{shown(path.name)}' is not an ordinary file")
    return file
