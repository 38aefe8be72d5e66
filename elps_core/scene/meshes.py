"""Check PLY and serialized meshes before Mitsuba reads them: sizes, indices, finite vertices.

Mitsuba does not compare the indices of a face with the number of vertices, and reads whatever lies
in memory there. Imports no Mitsuba.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from dataclasses import dataclass, field
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

_BYTES_PER_VERTEX = 32
"""Position, normal, texture coordinates in single precision."""
_COUNT_DIGITS = 18
"""Longest count that is converted; Python refuses to convert thousands of digits."""

_PLY_TYPES = {
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
_PLY_ORDER = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class BadFileError(Exception):
    """What is wrong with a file, without its name: ``is not a PLY file``."""


def file_size(file: BinaryIO) -> int:
    """Bytes in an open file."""
    return os.fstat(file.fileno()).st_size


@dataclass
class _Element:
    """One element of a PLY file; a list is three indices after their count, the only kind that Mitsuba reads."""

    name: str
    count: int
    fields: list[tuple[str, str]] = field(default_factory=list)
    """(name, numpy type); a list's fields are called ``count`` and ``index``."""


def ply(file: BinaryIO, _: str = "") -> int:
    """Check a PLY file; see :func:`elps_core.scene.headers.check`."""
    size = file_size(file)
    elements, header_bytes, order = _ply_header(file)
    file.seek(header_bytes)
    values = _ply_text(file, size) if order == "" else None
    vertices = next((element.count for element in elements if element.name == "vertex"), 0)
    memory = taken = 0
    for element in elements:
        if element.count > MAX_COUNT:
            raise BadFileError("declares more vertices or faces than are allowed")
        width = len(element.fields)
        if values is None:
            kind = np.dtype([(f"{name}{i}", order + code) for i, (name, code) in enumerate(element.fields)])
            taken += element.count * kind.itemsize
            enough = header_bytes + taken <= size
        else:
            taken += element.count * width
            enough = taken <= values.size
        if not enough:
            raise BadFileError("declares more vertices or faces than it holds: it is cut off or damaged")
        if values is None:
            rows: NDArray[Any] = np.fromfile(file, kind, element.count)
            columns = [rows[name] for name in kind.names or ()]
        else:
            columns = list(values[taken - element.count * width : taken].reshape(-1, max(width, 1)).T)
        _check_columns([name for name, _ in element.fields], columns, vertices)
        memory += element.count * (_BYTES_PER_VERTEX + 8 * width)
    return memory


def _check_columns(names: list[str], columns: list[NDArray[Any]], vertices: int) -> None:
    for name, column in zip(names, columns, strict=False):
        if name == "count" and (column != 3).any():
            raise BadFileError("has faces that are not triangles: triangulate it")
        if name == "index" and not ((column >= 0) & (column < vertices)).all():
            raise BadFileError("has faces that name vertices it does not have")
        if name in ("x", "y", "z") and not np.isfinite(column).all():
            raise BadFileError("has vertices that are not finite numbers")


def _ply_text(file: BinaryIO, size: int) -> NDArray[np.float64]:
    if size > MAX_TEXT_BYTES:
        raise BadFileError("is a very large PLY file in text: save it as binary")
    try:
        return np.array(file.read().split(), dtype=np.float64)
    except ValueError:
        raise BadFileError("has something that is not a number where numbers are due") from None


def _ply_header(file: BinaryIO) -> tuple[list[_Element], int, str]:
    """The elements, the header's length in bytes, and the byte order: empty where the rest is text."""
    head = file.read(MAX_HEADER_BYTES)
    end = re.search(rb"\nend_header[ \t]*\r?\n", head)
    if not head.startswith(b"ply") or end is None:
        raise BadFileError("is not a PLY file, or its header does not end")
    elements: list[_Element] = []
    order: str | None = None
    for line in head[: end.start()].decode("latin-1").splitlines():
        match line.split():
            case ["format", name, "1.0"] if name in _PLY_ORDER and order is None:
                order = _PLY_ORDER[name]
            case ["element", name, count] if count.isascii() and count.isdigit():
                if name not in ("vertex", "face") and count.strip("0"):
                    raise BadFileError("has PLY elements other than vertices and faces: export it without them")
                if any(element.name == name for element in elements):
                    raise BadFileError("has a PLY header that declares an element twice")
                elements.append(_Element(name, int(count[:_COUNT_DIGITS])))
            case ["property", "list", counter, index, _] if elements and {counter, index} <= _PLY_TYPES.keys():
                fields = [("count", _PLY_TYPES[counter]), *[("index", _PLY_TYPES[index])] * 3]
                elements[-1].fields += fields
            case ["property", kind, name] if elements and kind in _PLY_TYPES and name not in ("count", "index"):
                elements[-1].fields.append((name, _PLY_TYPES[kind]))
            case ["ply"] | ["comment", *_] | ["obj_info", *_] | []:
                pass
            case _:
                raise BadFileError("has a PLY header with a line that is not supported")
    if order is None or not any(element.name == "vertex" for element in elements):
        raise BadFileError("has a PLY header without format or vertices")
    return elements, end.end(), order


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
    _check_columns(names, [positions, indices], int(vertices))
    return needed + int(vertices) * _BYTES_PER_VERTEX
