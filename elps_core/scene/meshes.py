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
MAX_MESH_BYTES = 2**31
"""Of one unpacked mesh of a serialized file, which is held in memory while it is checked: 50 million vertices."""
_PART_HEADER = 4
"""Bytes before the stream of each mesh of a serialized file: signature and version."""
_COUNT_BYTES = 4
"""Size of the number of meshes, which ends a serialized file."""
_BLOCK_BYTES = 2**20
"""What is read of a packed file at once."""

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


def serialized(file: BinaryIO, _: object = "", part: int = 0) -> int:
    """Check one mesh of a serialized file; see :func:`elps_core.scene.headers.check`."""
    size = file_size(file)
    start = file.read(_PART_HEADER)
    if len(start) < _PART_HEADER or start[:2] != b"\x1c\x04":
        raise BadFileError("is not a serialized mesh file")
    version = struct.unpack("<H", start[2:])[0]
    if version not in (3, 4):
        raise BadFileError(f"is a serialized mesh file of version {version}: only 3 and 4 can be read")
    begin = _offset(file, size, 8 if version == 4 else 4, part) if part else 0
    if begin + _PART_HEADER >= size:
        raise BadFileError(f"is cut off or damaged: its mesh {part} lies beyond its end")
    file.seek(begin + _PART_HEADER)
    return _serialized_mesh(_Stream(file), size - begin, version == 4)


def _offset(file: BinaryIO, size: int, width: int, part: int) -> int:
    """Where a mesh begins, by the directory at the end of the file: offsets of ``width`` bytes, and their count."""
    file.seek(size - _COUNT_BYTES)
    count = struct.unpack("<I", file.read(_COUNT_BYTES))[0]
    if count == 0 or _COUNT_BYTES + count * width > size:
        raise BadFileError("is a serialized mesh file with a damaged directory")
    # Mitsuba takes the number of meshes for one of them, and reads what stands there as an offset.
    if not 0 <= part < count:
        raise BadFileError(f"has {count} meshes, counted from 0: there is none of the 'shape_index' {part}")
    file.seek(size - _COUNT_BYTES - (count - part) * width)
    return int.from_bytes(file.read(width), "little")


class _Stream:
    """What a deflated stream holds, as far as it is asked for."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._stream = zlib.decompressobj()
        self._packed = b""

    def read(self, count: int) -> bytes:
        """The next bytes: fewer than ``count`` at the end of the stream only."""
        found = bytearray()
        while len(found) < count and not self._stream.eof:
            block = self._packed or self._file.read(_BLOCK_BYTES)
            piece = self._stream.decompress(block, count - len(found))
            self._packed = self._stream.unconsumed_tail
            if not block and not piece:
                break
            found += piece
        return bytes(found)


def _serialized_mesh(stream: _Stream, most_packed: int, has_name: bool) -> int:
    """One mesh: flags, name, counts, then positions, normals, texture coordinates, colours, faces."""
    try:
        head = stream.read(MAX_HEADER_BYTES)
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
        if needed > DEFLATE_BEST_RATIO * most_packed:
            raise BadFileError("declares more vertices or faces than it holds: it is cut off or damaged")
        if needed > MAX_MESH_BYTES:
            raise BadFileError(f"has a mesh of more than {MAX_MESH_BYTES >> 30} GiB: make it smaller")
        if len(head) < needed:
            head += stream.read(needed - len(head))
    except zlib.error:
        raise BadFileError("is a serialized mesh file with damaged compression") from None
    if len(head) < needed:
        raise BadFileError("declares more vertices or faces than it holds: it is cut off or damaged")
    with np.errstate(over="ignore"):  # what is too large for single precision becomes infinite, as in Mitsuba
        positions = np.frombuffer(head, kind, int(vertices) * 3, at + 16).astype(np.float32)
    indices = np.frombuffer(head, "<u4", int(faces) * 3, at + 16 + vertex_bytes)
    check_columns(["x", "index"], [positions, indices], int(vertices))
    return needed + int(vertices) * BYTES_PER_VERTEX
