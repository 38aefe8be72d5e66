"""Check serialized meshes before Mitsuba reads them: sizes, indices, finite vertices.

Mitsuba does not compare the indices of a face with the number of vertices, and reads whatever lies
in memory there. Imports no Mitsuba.
"""

from __future__ import annotations

import os
import struct
import zlib
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

MAX_HEADER_BYTES = 64 * 1024
"""PLY headers with dozens of attributes stay below 4 KiB."""
MAX_COUNT = 2**28
"""Vertices or faces of one mesh: beyond it Mitsuba's 32-bit index arithmetic gets close to its end."""
MAX_TEXT_BYTES = 2**26
"""Of a PLY file in text, which takes 20 times its size while it is checked; larger ones should be binary."""
DEFLATE_BEST_RATIO = 1032
"""A deflate stream grows at most this much (zlib's technical notes)."""
MAX_PARTS = 4096
"""Meshes in one serialized file."""

BYTES_PER_VERTEX = 32
"""Position, normal, texture coordinates in single precision."""
_COUNT_DIGITS = 18
"""Longest count that is converted; Python refuses to convert thousands of digits."""

PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("half", "float16"), "f2"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}


class BadFileError(Exception):
    """What is wrong with a file, without its name: ``is not a PLY file``."""


def file_size(file: BinaryIO) -> int:
    """Bytes in an open file."""
    return os.fstat(file.fileno()).st_size


def check_columns(names: list[str], columns: list[NDArray[Any]], vertices: int) -> None:
    """Refuse indices that name no vertex, and positions that are not finite.

    Raises:
        BadFileError: so it is.
    """
    for name, column in zip(names, columns, strict=False):
        if name == "index" and not ((column >= 0) & (column < vertices)).all():
            raise BadFileError("has faces that name vertices it does not have")
        if name in ("x", "y", "z") and not np.isfinite(column).all():
            raise BadFileError("has vertices that are not finite numbers")


def serialized(file: BinaryIO, _: str = "") -> int:
    """Check every mesh of a serialized file; see :func:`elps_core.scene.headers.check`."""
    size = file_size(file)
    start = file.read(4)
    if len(start) < 4 or start[:2] != b"\x1c\x04":
        raise BadFileError("is not a serialized mesh file")
    version = struct.unpack("<H", start[2:])[0]
    if version not in (3, 4):
        raise BadFileError("is a serialized mesh file of an unknown version")
    width, code = (8, "Q") if version == 4 else (4, "I")
    file.seek(size - 4)
    count = struct.unpack("<I", file.read(4))[0]
    if count == 0 or count > MAX_PARTS or 4 + count * width > size:
        raise BadFileError("is a serialized mesh file with a damaged directory")
    file.seek(size - 4 - count * width)
    offsets = struct.unpack(f"<{count}{code}", file.read(count * width))
    # Parts may not share bytes: a small file would else be unpacked thousands of times.
    ends = [*offsets[1:], size]
    if offsets[0] != 0 or any(begin + 4 >= end for begin, end in zip(offsets, ends, strict=True)):
        raise BadFileError("is a serialized mesh file with a damaged directory")
    return sum(_serialized_mesh(file, begin, end, version == 4) for begin, end in zip(offsets, ends, strict=True))


def _serialized_mesh(file: BinaryIO, begin: int, end: int, has_name: bool) -> int:
    """One mesh: flags, name, counts, then positions, normals, texture coordinates, colours, faces."""
    file.seek(begin + 4)
    packed = file.read(end - begin - 4)
    stream = zlib.decompressobj()
    try:
        head = stream.decompress(packed, MAX_HEADER_BYTES)
        at = head.find(b"\0", 4) + 1 if has_name else 4
        if at == 0 or len(head) < at + 16:
            raise BadFileError("is a serialized mesh file that is cut off")
        flags = struct.unpack_from("<I", head)[0]
        vertices, faces = struct.unpack_from("<QQ", head, at)
        if max(vertices, faces) > MAX_COUNT:
            raise BadFileError("declares more vertices or faces than are allowed")
        # The bits of the file format: normals, texture coordinates, colours; double precision.
        values = 3 + 3 * bool(flags & 0x1) + 2 * bool(flags & 0x2) + 3 * bool(flags & 0x8)
        kind = "<f8" if flags & 0x2000 else "<f4"
        vertex_bytes = int(vertices) * values * np.dtype(kind).itemsize
        needed = at + 16 + vertex_bytes + int(faces) * 12
        if needed > DEFLATE_BEST_RATIO * len(packed):
            raise BadFileError("declares more vertices or faces than it holds: it is cut off or damaged")
        if len(head) < needed:
            head += stream.decompress(stream.unconsumed_tail, needed - len(head))
    except zlib.error:
        raise BadFileError("is a serialized mesh file with damaged compression") from None
    if len(head) < needed:
        raise BadFileError("declares more vertices or faces than it holds: it is cut off or damaged")
    positions = np.frombuffer(head, kind, int(vertices) * 3, at + 16)
    indices = np.frombuffer(head, "<u4", int(faces) * 3, at + 16 + vertex_bytes)
    names = ["x", "index"]
    check_columns(names, [positions, indices], int(vertices))
    return needed + int(vertices) * BYTES_PER_VERTEX
