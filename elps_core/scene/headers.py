"""Look at a mesh, image, volume or material file before Mitsuba allocates what its header declares.

Imports no Mitsuba. Every check returns the bytes of memory that the file will take at most, so that
a scene's files can be summed up against one limit.
"""

from __future__ import annotations

import mmap
import re
import struct
from collections.abc import Callable
from typing import BinaryIO

from elps_core.scene import images, meshes, objfile, packing, plyfile, tensorfile
from elps_core.scene.meshes import BadFileError, file_size

MAX_HEADER_BYTES = 64 * 1024
"""What is read of a text file to tell whether it is one."""
MAX_OBJ_LINE = 1024
"""Mitsuba's own limit on a line of an OBJ file."""
_OBJ_GROWTH = 12
"""Memory of Mitsuba's OBJ reader per byte of the file: the shortest face, ``f 1 1 1``, makes a triangle
of 12 bytes and, with its vertices' table entries, about 90."""


def check(kind: str, file: BinaryIO, path: str, part: int = 0) -> int:
    """Check one file of a scene; return the bytes of memory that reading it takes at most.

    What is in an image behind its header :func:`mended` has looked at.

    Args:
        kind: how the file is read, a value of :data:`elps_core.scene.plugins.FILE_READERS`.
        file: the open file, at its beginning.
        path: where it lies; images are opened by name.
        part: which of its meshes is asked for, where a file of that kind has several.

    Raises:
        BadFileError: the header is damaged, declares more than the file holds, or more than is allowed.
    """
    return _CHECKS[kind](file, path, part)


def mended(kind: str, file: BinaryIO, path: str) -> tuple[bytes, list[str]] | None:
    """A file that Mitsuba would refuse or misread, as it reads it right, and what was done; None for all others.

    Arguments are those of :func:`check`.

    Raises:
        BadFileError: it is damaged, or packed as a whole.
    """
    file.seek(0)
    packed = packing.advice(file.read(packing.MAGIC_BYTES))
    if packed:
        raise BadFileError(packed)
    file.seek(0)
    mend = _MENDS.get(kind)
    return mend(file, path) if mend else None


_NOT_FINITE = re.compile(rb"^[^#\n]*?(?<![\w.])(?:nan|inf(?:inity)?)(?!\w)", re.MULTILINE | re.IGNORECASE)
"""A number in a line that is no comment."""


def _text(file: BinaryIO, *_: object) -> int:
    """Numbers of a spectrum or of a curve, which Mitsuba takes whatever they are."""
    size = file_size(file)
    if size:
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            if _NOT_FINITE.search(data):
                raise BadFileError("has numbers that are not finite")
    return _OBJ_GROWTH * size


def _obj(file: BinaryIO, *_: object) -> int:
    """Mitsuba's reader takes decimal numbers and positive indices; anything else it may misread."""
    start = file.read(MAX_HEADER_BYTES)
    if b"\0" in start:
        raise BadFileError("is not an OBJ file: it is not text")
    if max(len(line) for line in start.split(b"\n")) > MAX_OBJ_LINE:
        raise BadFileError("has lines that are too long for an OBJ file")
    return _OBJ_GROWTH * file_size(file)


_VOLUME_HEADER = struct.Struct("<3sB5i6f")
"""Signature, version, value type, size in x, y, z, channels, bounding box."""


def _volume(file: BinaryIO, *_: object) -> int:
    head = file.read(_VOLUME_HEADER.size)
    if len(head) < _VOLUME_HEADER.size:
        raise BadFileError("is not a volume file")
    signature, version, kind, x, y, z, channels, *_box = _VOLUME_HEADER.unpack(head)
    if signature != b"VOL" or version != 3 or kind != 1:
        raise BadFileError("is not a volume file of version 3 with single precision")
    if min(x, y, z, channels) < 1 or x * y * z * channels * 4 > file_size(file) - _VOLUME_HEADER.size:
        raise BadFileError("declares more voxels than it holds: it is cut off or damaged")
    return 3 * file_size(file)


_CHECKS: dict[str, Callable[[BinaryIO, str, int], int]] = {
    "text": _text,
    "obj": _obj,
    "ply": plyfile.memory,
    "serialized": meshes.serialized,
    "volume": _volume,
    "image": images.memory,
    "measured": tensorfile.measured,
}
_MENDS: dict[str, Callable[[BinaryIO, str], tuple[bytes, list[str]] | None]] = {
    "obj": lambda file, _: objfile.mended(file),
    "ply": lambda file, _: plyfile.mended(file),
    "image": images.mended,
}
