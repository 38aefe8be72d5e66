"""Look at a mesh, image, volume or material file before Mitsuba allocates what its header declares.

Imports no Mitsuba. Every check returns the bytes of memory that the file will take at most, so that
a scene's files can be summed up against one limit.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import BinaryIO

import OpenImageIO

from elps_core.scene import meshes, objfile, packing, plyfile, tensorfile
from elps_core.scene.meshes import BadFileError, file_size

MAX_IMAGE_SIDE = 16384
"""Pixels; the largest textures in use (16k)."""
MAX_CHANNELS = 64
"""Of one image; layers of a multi-channel EXR count."""
MAX_HEADER_BYTES = 64 * 1024
"""What is read of a text file to tell whether it is one."""
MAX_OBJ_LINE = 1024
"""Mitsuba's own limit on a line of an OBJ file."""
_OBJ_GROWTH = 12
"""Memory of Mitsuba's OBJ reader per byte of the file: the shortest face, ``f 1 1 1``, makes a triangle
of 12 bytes and, with its vertices' table entries, about 90."""

_IMAGE_MAGIC = (
    (b"\x89PNG\r\n\x1a\n", "png"),
    (b"\xff\xd8\xff", "jpeg"),
    (b"\x76\x2f\x31\x01", "openexr"),
    (b"#?", "hdr"),
    (b"PF", "pnm"),
    (b"Pf", "pnm"),
    (b"P6", "pnm"),
    (b"BM", "bmp"),
)
"""First bytes -> OpenImageIO's name of the format, for the formats that Mitsuba reads."""


def check(kind: str, file: BinaryIO, path: str, part: int = 0) -> int:
    """Check one file of a scene; return the bytes of memory that reading it takes at most.

    Args:
        kind: how the file is read, a value of :data:`elps_core.scene.plugins.FILE_READERS`.
        file: the open file, at its beginning.
        path: where it lies; images are opened by name.
        part: which of its meshes is asked for, where a file of that kind has several.

    Raises:
        BadFileError: the header is damaged, declares more than the file holds, or more than is allowed.
    """
    return _CHECKS[kind](file, path, part)


def mended(kind: str, file: BinaryIO) -> tuple[bytes, list[str]] | None:
    """A file that Mitsuba would refuse or misread, as it reads it right, and what was done; None for all others.

    Raises:
        BadFileError: it is damaged, or packed as a whole.
    """
    file.seek(0)
    packed = packing.advice(file.read(packing.MAGIC_BYTES))
    if packed:
        raise BadFileError(packed)
    file.seek(0)
    mend = _MENDS.get(kind)
    return mend(file) if mend else None


def _text(file: BinaryIO, *_: object) -> int:
    return _OBJ_GROWTH * file_size(file)


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


def _image(file: BinaryIO, path: str, *_: object) -> int:
    start = file.read(16)
    expected = next((name for magic, name in _IMAGE_MAGIC if start.startswith(magic)), None)
    if expected is None and path.lower().endswith(".tga"):
        expected = "targa"  # has no signature; Mitsuba goes by the name, too
    if expected is None:
        raise BadFileError("is not an image in PNG, JPEG, EXR, HDR, PFM, PPM, BMP or TGA format")
    image = OpenImageIO.ImageInput.open(path)
    if image is None:
        OpenImageIO.geterror()  # quotes the path; read it so that it does not pile up
        raise BadFileError("is an image with a damaged header")
    try:
        spec = image.spec()
        if image.format_name() != expected:
            raise BadFileError("is an image whose content does not match its extension: rename it")
        width, height = int(spec.width), int(spec.height)
        if not (1 <= width <= MAX_IMAGE_SIDE and 1 <= height <= MAX_IMAGE_SIDE):
            raise BadFileError(f"has {width}x{height} pixels: at most {MAX_IMAGE_SIDE} a side are allowed")
        if spec.nchannels > MAX_CHANNELS:
            raise BadFileError(f"has {spec.nchannels} channels: at most {MAX_CHANNELS} are allowed")
        # Mitsuba reads EXR data in a thread of its own, where an error ends the whole process.
        if expected == "openexr" and image.read_image("half") is None:
            image.geterror()
            raise BadFileError("is an EXR image that is cut off or damaged")
        # Mitsuba keeps images of 8 bits in half precision, others in single.
        return width * height * int(spec.nchannels) * (2 if spec.format.size() == 1 else 4)
    finally:
        image.close()


_CHECKS: dict[str, Callable[[BinaryIO, str, int], int]] = {
    "text": _text,
    "obj": _obj,
    "ply": plyfile.memory,
    "serialized": meshes.serialized,
    "volume": _volume,
    "image": _image,
    "measured": tensorfile.measured,
}
_MENDS: dict[str, Callable[[BinaryIO], tuple[bytes, list[str]] | None]] = {
    "obj": objfile.mended,
    "ply": plyfile.mended,
}
