"""Look at the header of a mesh, image or volume file before Mitsuba allocates what it declares.

Imports no Mitsuba. Every check returns the bytes of memory that the file will take at most, so that
a scene's files can be summed up against one limit.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Callable
from typing import BinaryIO

import OpenImageIO

MAX_IMAGE_SIDE = 16384
"""Pixels; the largest textures in use (16k)."""
MAX_HEADER_BYTES = 64 * 1024
"""PLY headers with dozens of attributes stay below 4 KiB."""
MAX_COUNT = 2**28
"""Vertices or faces of one mesh: beyond it Mitsuba's 32-bit index arithmetic gets close to its end."""
MAX_OBJ_LINE = 1024
"""Mitsuba's own limit on a line of an OBJ file."""
DEFLATE_BEST_RATIO = 1032
"""A deflate stream grows at most this much (zlib's technical notes)."""

_BYTES_PER_VERTEX = 32
"""Position, normal, texture coordinates in single precision."""
_BYTES_PER_FACE = 12
_OBJ_GROWTH = 12
"""Memory of Mitsuba's OBJ reader per byte of the file: the shortest face, ``f 1 1 1``, makes a triangle
of 12 bytes and, with its vertices' table entries, about 90."""

_PLY_TYPE_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16", "half", "float16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64", "long", "ulong", "int64", "uint64"), 8),
}
_PLY_INDEX_TYPES = ("int", "uint", "int32", "uint32", "short", "ushort", "int16", "uint16", "uchar", "uint8")
_PLY_FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")

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


class BadFileError(Exception):
    """What is wrong with a file, without its name: ``is not a PLY file``."""


def check(kind: str, file: BinaryIO, path: str) -> int:
    """Check one file of a scene; return the bytes of memory that reading it takes at most.

    Args:
        kind: how the file is read, a value of :data:`elps_core.scene.plugins.FILE_READERS`.
        file: the open file, at its beginning.
        path: where it lies; images are opened by name.

    Raises:
        BadFileError: the header is damaged, declares more than the file holds, or more than is allowed.
    """
    return _CHECKS[kind](file, path)


def _size(file: BinaryIO) -> int:
    return os.fstat(file.fileno()).st_size


def _text(file: BinaryIO, _: str) -> int:
    return _OBJ_GROWTH * _size(file)


def _obj(file: BinaryIO, _: str) -> int:
    """Mitsuba's reader takes decimal numbers and positive indices; anything else it may misread."""
    start = file.read(MAX_HEADER_BYTES)
    if b"\0" in start:
        raise BadFileError("is not an OBJ file: it is not text")
    if max(len(line) for line in start.split(b"\n")) > MAX_OBJ_LINE:
        raise BadFileError("has lines that are too long for an OBJ file")
    return _OBJ_GROWTH * _size(file)


def _ply(file: BinaryIO, _: str) -> int:
    size = _size(file)
    elements, header_bytes, is_text = _ply_header(file)
    least = memory = 0
    for name, count, item_bytes, item_values in elements:
        if count > MAX_COUNT:
            raise BadFileError(f"declares {min(count, 10**18)} of '{name}', more than is allowed")
        # A number in text takes a digit and a separator.
        least += count * (2 * item_values if is_text else item_bytes)
        memory += count * (_BYTES_PER_VERTEX + item_bytes + 8 * item_values)
    if least > size - header_bytes + 1:
        raise BadFileError("declares more vertices or faces than it holds: it is cut off or damaged")
    return memory


def _ply_header(file: BinaryIO) -> tuple[list[tuple[str, int, int, int]], int, bool]:
    """(name, count, bytes, values) of each element, the header's length, and whether the rest is text.

    A list counts as three indices, the only kind of face that Mitsuba reads.
    """
    head = file.read(MAX_HEADER_BYTES)
    end = re.search(rb"(?:^|\n)end_header[ \t]*\r?\n", head)
    if not head.startswith(b"ply") or end is None:
        raise BadFileError("is not a PLY file, or its header does not end")
    elements: list[tuple[str, int, int, int]] = []
    file_format = ""
    for line in head[: end.start()].decode("latin-1").splitlines():
        match line.split():
            case ["format", file_format, "1.0"] if file_format in _PLY_FORMATS:
                pass
            case ["element", ("vertex" | "face") as name, count] if count.isascii() and count.isdigit():
                # Checked as text first: Python refuses to convert thousands of digits.
                elements.append((name, int(count[:19]) if len(count) < 20 else 2**63, 0, 0))
            case ["element", _, "0"]:
                elements.append(("other", 0, 0, 0))
            case ["property", "list", counter, index, _] if (
                elements and _PLY_TYPE_BYTES.get(counter) and (index in _PLY_INDEX_TYPES)
            ):
                width = _PLY_TYPE_BYTES[counter] + 3 * _PLY_TYPE_BYTES[index]
                elements[-1] = _wider(elements[-1], width, 4)
            case ["property", kind, _] if elements and kind in _PLY_TYPE_BYTES:
                elements[-1] = _wider(elements[-1], _PLY_TYPE_BYTES[kind], 1)
            case ["ply"] | ["comment", *_] | ["obj_info", *_] | []:
                pass
            case _:
                raise BadFileError("has a PLY header with a line that Mitsuba does not read")
    if not file_format or not any(name == "vertex" for name, *_ in elements):
        raise BadFileError("has a PLY header without format or vertices")
    return elements, end.end(), file_format == "ascii"


def _wider(element: tuple[str, int, int, int], more_bytes: int, more_values: int) -> tuple[str, int, int, int]:
    name, count, item_bytes, item_values = element
    return name, count, item_bytes + more_bytes, item_values + more_values


def _serialized(file: BinaryIO, _: str) -> int:
    """Every mesh that the directory at the end of the file points to."""
    size = _size(file)
    start = file.read(4)
    if len(start) < 4 or start[:2] != b"\x1c\x04":
        raise BadFileError("is not a serialized mesh file")
    version = struct.unpack("<H", start[2:])[0]
    if version not in (3, 4):
        raise BadFileError("is a serialized mesh file of an unknown version")
    width, code = (8, "Q") if version == 4 else (4, "I")
    file.seek(size - 4)
    count = struct.unpack("<I", file.read(4))[0]
    if count == 0 or count > MAX_HEADER_BYTES or 4 + count * width > size:
        raise BadFileError("is a serialized mesh file with a damaged directory")
    file.seek(size - 4 - count * width)
    offsets = struct.unpack(f"<{count}{code}", file.read(count * width))
    return sum(_serialized_mesh(file, offset, size, version) for offset in offsets)


def _serialized_mesh(file: BinaryIO, offset: int, size: int, version: int) -> int:
    if offset + 4 >= size:
        raise BadFileError("is a serialized mesh file with a damaged directory")
    file.seek(offset + 4)
    stream = zlib.decompressobj()
    try:
        head = stream.decompress(file.read(MAX_HEADER_BYTES), MAX_HEADER_BYTES)
    except zlib.error:
        raise BadFileError("is a serialized mesh file with damaged compression") from None
    at = 4
    if version == 4:
        at = head.find(b"\0", 4) + 1
        if at == 0:
            raise BadFileError("is a serialized mesh file with a damaged name")
    if len(head) < at + 16:
        raise BadFileError("is a serialized mesh file that is cut off")
    flags = struct.unpack_from("<I", head)[0]
    vertices, faces = struct.unpack_from("<QQ", head, at)
    if max(vertices, faces) > MAX_COUNT:
        raise BadFileError("declares more vertices or faces than are allowed")
    width = 8 if flags & 0x2000 else 4
    needed: int = vertices * 3 * width + faces * _BYTES_PER_FACE
    if needed > DEFLATE_BEST_RATIO * (size - offset):
        raise BadFileError("declares more vertices or faces than it holds: it is cut off or damaged")
    return needed + int(vertices) * _BYTES_PER_VERTEX


_VOLUME_HEADER = struct.Struct("<3sB5i6f")
"""Signature, version, value type, size in x, y, z, channels, bounding box."""


def _volume(file: BinaryIO, _: str) -> int:
    head = file.read(_VOLUME_HEADER.size)
    if len(head) < _VOLUME_HEADER.size:
        raise BadFileError("is not a volume file")
    signature, version, kind, x, y, z, channels, *_box = _VOLUME_HEADER.unpack(head)
    if signature != b"VOL" or version != 3 or kind != 1:
        raise BadFileError("is not a volume file of version 3 with single precision")
    if min(x, y, z, channels) < 1 or x * y * z * channels * 4 > _size(file) - _VOLUME_HEADER.size:
        raise BadFileError("declares more voxels than it holds: it is cut off or damaged")
    return 3 * _size(file)


def _image(file: BinaryIO, path: str) -> int:
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
        width, height, channels = int(spec.width), int(spec.height), int(spec.nchannels)
    finally:
        image.close()
    if not (1 <= width <= MAX_IMAGE_SIDE and 1 <= height <= MAX_IMAGE_SIDE):
        raise BadFileError(f"has {width}x{height} pixels: at most {MAX_IMAGE_SIDE} a side are allowed")
    return width * height * max(channels, 1) * 4


_CHECKS: dict[str, Callable[[BinaryIO, str], int]] = {
    "text": _text,
    "obj": _obj,
    "ply": _ply,
    "serialized": _serialized,
    "volume": _volume,
    "image": _image,
}
