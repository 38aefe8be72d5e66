"""Read PLY files of any layout, and write them as Mitsuba reads them right. Imports no Mitsuba.

Mitsuba takes triangles and numbers that are what they say: it refuses faces of four corners and texture coordinates by
face, and takes a colour of 255 for an albedo of 255.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any, BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from elps_core.scene.meshes import (
    BYTES_PER_VERTEX,
    MAX_COUNT,
    MAX_HEADER_BYTES,
    MAX_TEXT_BYTES,
    PLY_TYPES,
    BadFileError,
    file_size,
)
from elps_core.scene.polygons import triangles

_ORDER = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_COLOURS = {"red": "r", "green": "g", "blue": "b", "diffuse_red": "r", "diffuse_green": "g", "diffuse_blue": "b"}
_TEXTURES = {"s": "u", "t": "v", "texture_u": "u", "texture_v": "v", "texture_s": "u", "texture_t": "v"}
RENAMED = _COLOURS | _TEXTURES
"""Names that exporters use -> Mitsuba's."""
_DROPPED = frozenset({"alpha", "diffuse_alpha", "a"})
"""Opacity: no attribute of a shape has it."""
_INDICES = ("vertex_indices", "vertex_index")
_CORNERS = ("texcoord", "texcoords", "texture_coordinates")
"""Lists of faces with two numbers for each corner."""
_DIGITS = 18
"""Longest count that is converted; Python refuses to convert thousands of digits."""
BYTES_PER_FIELD = 8
"""Of memory for each value of a vertex or face, above what every vertex takes."""


@dataclass
class Element:
    """One kind of thing in a PLY file."""

    name: str
    count: int
    fields: list[tuple[str, str, str]] = field(default_factory=list)
    """(name, numpy type, numpy type of a list's length or nothing)."""
    values: dict[str, NDArray[Any]] = field(default_factory=dict)
    """[count] of scalar fields."""
    lists: dict[str, tuple[NDArray[np.int64], NDArray[Any]]] = field(default_factory=dict)
    """Lengths [count] and all items in a row."""


@dataclass(frozen=True)
class Header:
    """What a PLY file declares."""

    elements: list[Element]
    order: str
    """Byte order; empty where the rest is text."""
    begin: int
    """First byte after the header."""
    plain: bool
    """Whether Mitsuba reads such a file right as far as the header tells."""


def header(file: BinaryIO) -> Header:
    """The header of an open file.

    Raises:
        BadFileError: it is none, or not supported.
    """
    file.seek(0)
    head = file.read(MAX_HEADER_BYTES)
    blank = len(head) - len(head.lstrip())
    end = re.search(rb"\nend_header[ \t]*\r?\n", head)
    if not head.lstrip().startswith(b"ply") or end is None:
        raise BadFileError("is not a PLY file, or its header does not end")
    elements: list[Element] = []
    order: str | None = None
    noted = False  # Mitsuba takes comments and no notes.
    for line in head[: end.start()].decode("latin-1").splitlines():
        match line.split():
            case ["format", name, "1.0"] if name in _ORDER and order is None:
                order = _ORDER[name]
            case ["element", name, count] if count.isascii() and count.isdigit():
                if any(element.name == name for element in elements):
                    raise BadFileError("has a PLY header that declares an element twice")
                elements.append(Element(name, int(count[:_DIGITS])))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= PLY_TYPES.keys():
                elements[-1].fields.append((name, PLY_TYPES[kind], PLY_TYPES[length]))
            case ["property", kind, name] if elements and kind in PLY_TYPES:
                elements[-1].fields.append((name, PLY_TYPES[kind], ""))
            case ["obj_info", *_]:
                noted = True
            case ["ply"] | ["comment", *_] | []:
                pass
            case _:
                raise BadFileError("has a PLY header with a line that is not supported")
    if order is None or not any(element.name == "vertex" for element in elements):
        raise BadFileError("has a PLY header without format or vertices")
    for element in elements:
        names = [name for name, _, _ in element.fields]
        if element.count > MAX_COUNT:
            raise BadFileError("declares more vertices or faces than are allowed")
        if len(set(names)) < len(names):
            raise BadFileError("has a PLY header that declares a property twice")
        if element.count and not names:
            raise BadFileError("has a PLY header with an element without properties")
    plain = blank == 0 and not noted and b"\r\n" not in head[: end.end()] and all(map(_plain, elements))
    return Header(elements, order, end.end(), plain)


def _plain(element: Element) -> bool:
    lists = [name for name, _, length in element.fields if length]
    scalars = [(name, kind) for name, kind, length in element.fields if not length]
    if element.name not in ("vertex", "face"):
        return not element.count
    if lists != ([_INDICES[0]] if element.name == "face" and _INDICES[0] in lists else lists[:1] and [_INDICES[1]]):
        return False
    odd = RENAMED.keys() - {"s", "t"} | _DROPPED
    return not any(name in odd or (name in "rgb" and kind[0] in "ui") for name, kind in scalars)


def memory(file: BinaryIO, *_: object) -> int:
    """Bytes that Mitsuba keeps of such a file at most; see :func:`elps_core.scene.headers.check`."""
    return sum(each.count * (BYTES_PER_VERTEX + BYTES_PER_FIELD * len(each.fields)) for each in header(file).elements)


def mended(file: BinaryIO) -> tuple[bytes, list[str]] | None:
    """The file as Mitsuba reads it right, and what was done to it; None where it does so as it stands.

    Raises:
        BadFileError: it holds less than it declares, or something else than numbers; faces name vertices that are not
            there.
    """
    declared = header(file)
    _read(file, declared)
    elements = {element.name: element for element in declared.elements}
    vertex, face = elements["vertex"], elements.get("face")
    if not {"x", "y", "z"} <= vertex.values.keys():
        raise BadFileError("has vertices without x, y and z")
    columns, warnings = _scalars(vertex)
    corners, owners, places = _triangulated(vertex, face, warnings)
    if declared.plain and not warnings:
        return None
    texture = _by_corner(face, places)
    if texture is not None:
        columns = {name: values[corners.ravel()] for name, values in columns.items() if name not in ("u", "v")}
        columns |= {"u": texture[:, 0], "v": texture[:, 1]}
        corners = np.arange(corners.size).reshape(-1, 3)
    of_face, more = _scalars(face) if face else ({}, [])
    return _written(columns, corners, {name: values[owners] for name, values in of_face.items()}), warnings + more


def _read(file: BinaryIO, declared: Header) -> None:
    """Fill the elements with what the file holds."""
    size = file_size(file)
    file.seek(declared.begin)
    if declared.order == "" and size > MAX_TEXT_BYTES:
        raise BadFileError("is a very large PLY file in text: save it as binary")
    body = file.read()
    if declared.order == "":
        try:
            numbers = np.array(body.split(), dtype=np.float64)
        except ValueError:
            raise BadFileError("has something that is not a number where numbers are due") from None
        source: _Source = _Text(numbers)
    else:
        source = _Binary(body, declared.order)
    for element in declared.elements:
        source.take(element)


class _Source(Protocol):
    """Where the values of elements come from, one after the other."""

    def take(self, element: Element) -> None:
        """Fill one element.

        Raises:
            BadFileError: there is not enough.
        """


def _enter(element: Element, rows: list[list[Any]], lengths: list[list[int]]) -> None:
    """Fill an element with the values of its fields and the lengths of those that are lists."""
    for (name, kind, length), values, counts in zip(element.fields, rows, lengths, strict=True):
        if length:
            element.lists[name] = np.array(counts, np.int64), np.array(values, kind)
        else:
            element.values[name] = np.array(values, kind)


def _short() -> BadFileError:
    return BadFileError("declares more vertices or faces than it holds: it is cut off or damaged")


class _Text:
    def __init__(self, numbers: NDArray[np.float64]) -> None:
        self.numbers, self.at = numbers, 0

    def take(self, element: Element) -> None:
        fields, numbers = element.fields, self.numbers
        if not any(length for _, _, length in fields):
            end = self.at + element.count * len(fields)
            if end > len(numbers):
                raise _short()
            block = numbers[self.at : end].reshape(element.count, len(fields))
            element.values = {name: block[:, k] for k, (name, _, _) in enumerate(fields)}
            self.at = end
            return
        rows: list[list[Any]] = [[] for _ in fields]
        lengths: list[list[int]] = [[] for _ in fields]
        for _ in range(element.count):
            for row, counts, (_, _, length) in zip(rows, lengths, fields, strict=True):
                if self.at >= len(numbers):
                    raise _short()
                many = 1
                if length:
                    many = int(numbers[self.at])
                    self.at += 1
                    if not 0 <= many <= len(numbers) - self.at:
                        raise _short()
                    counts.append(many)
                row.extend(numbers[self.at : self.at + many])
                self.at += many
        _enter(element, rows, lengths)


class _Binary:
    def __init__(self, body: bytes, order: str) -> None:
        self.body, self.order, self.at = body, order, 0

    def take(self, element: Element) -> None:
        if self._even(element):
            return
        rows: list[list[Any]] = [[] for _ in element.fields]
        lengths: list[list[int]] = [[] for _ in element.fields]
        for _ in range(element.count):
            for row, counts, (_, kind, length) in zip(rows, lengths, element.fields, strict=True):
                many = 1
                if length:
                    many = int(self._some(length, 1)[0])
                    if many < 0:
                        raise _short()
                    counts.append(many)
                row.extend(self._some(kind, many))
        _enter(element, rows, lengths)

    def _some(self, kind: str, many: int) -> NDArray[Any]:
        size = np.dtype(kind).itemsize * many
        if self.at + size > len(self.body):
            raise _short()
        found = np.frombuffer(self.body, self.order + kind, many, self.at)
        self.at += size
        return found

    def _even(self, element: Element) -> bool:
        """Read an element whose lists all have the lengths that those of its first row have; whether it is one."""
        begin, many = self.at, []
        parts: list[Any] = []
        for name, kind, length in element.fields if element.count else []:
            count = 1
            if length:
                count = int(self._some(length, 1)[0])
                parts.append((f"{name} length", self.order + length))
            if count < 0:
                raise _short()
            self._some(kind, count)
            parts.append((name, self.order + kind, (count,)) if length else (name, self.order + kind))
            many.append(count)
        self.at = begin
        layout = np.dtype(parts)
        if begin + layout.itemsize * element.count > len(self.body):
            if any(length for _, _, length in element.fields):
                return False
            raise _short()
        table = np.frombuffer(self.body, layout, element.count, begin)
        if not element.count:
            _enter(element, [[] for _ in element.fields], [[] for _ in element.fields])
            return True
        for (name, _, length), count in zip(element.fields, many, strict=True):
            if length and (table[f"{name} length"] != count).any():
                return False
        self.at = begin + layout.itemsize * element.count
        for (name, _, length), count in zip(element.fields, many, strict=True):
            if length:
                element.lists[name] = np.full(element.count, count, np.int64), table[name].ravel()
            else:
                element.values[name] = table[name]
        return True


def _scalars(element: Element) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """The columns of an element under Mitsuba's names, and warnings."""
    columns: dict[str, NDArray[Any]] = {}
    warnings = []
    coloured = {RENAMED.get(name, name) for name in element.values} >= {"r", "g", "b"}
    for name, kind, length in element.fields:
        if length or (name in _DROPPED and coloured):
            continue
        values = np.asarray(element.values[name], np.float64)
        own = RENAMED.get(name, name)
        if own in "rgb" and coloured and kind[0] in "ui":
            values = values / float(np.iinfo(kind).max)
            if own == "r":
                warnings.append("has colours in whole numbers: the greatest of their type is taken as 1, linearly")
        if own in columns:
            continue
        columns[own] = values
    for axis in ("x", "y", "z"):
        if element.name == "vertex" and not np.isfinite(columns.get(axis, np.zeros(0))).all():
            raise BadFileError("has vertices that are not finite numbers")
    return columns, warnings


def _triangulated(
    vertex: Element, face: Element | None, warnings: list[str]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Vertices of each triangle [n, 3], the face that it belongs to [n], and where its corners stand in the list."""
    nothing = np.zeros((0, 3), np.int64)
    name = next((name for name in _INDICES if face and name in face.lists), None)
    if face is None or name is None:
        return nothing, np.zeros(0, np.int64), nothing
    lengths, items = face.lists[name]
    wide = np.asarray(items, np.float64)
    if not ((wide >= 0) & (wide < vertex.count)).all():
        raise BadFileError("has faces that name vertices it does not have")
    indices = wide.astype(np.int64)
    begins = np.concatenate([[0], np.cumsum(lengths)[:-1]]) if len(lengths) else np.zeros(0, np.int64)
    if (lengths == 3).all():
        places = begins[:, None] + np.arange(3)
        return indices[places], np.arange(len(lengths)), places
    warnings.append("has faces of more than three corners: they are cut into triangles")
    position = np.stack([np.asarray(vertex.values[axis], np.float64) for axis in ("x", "y", "z")], axis=-1)
    found, owners = [], []
    for number, (begin, count) in enumerate(zip(begins.tolist(), lengths.tolist(), strict=True)):
        if count < 3:
            continue  # a point or a line has no surface
        for triangle in triangles(position[indices[begin : begin + count]]):
            found.append([begin + k for k in triangle])
            owners.append(number)
    places = np.array(found, np.int64).reshape(-1, 3)
    return indices[places], np.array(owners, np.int64), places


def _by_corner(face: Element | None, places: NDArray[np.int64]) -> NDArray[np.float64] | None:
    """Texture coordinates of each corner of each triangle [3 n, 2], where faces have them."""
    name = next((name for name in _CORNERS if face and name in face.lists), None)
    if face is None or name is None:
        return None
    lengths, items = face.lists[name]
    corners = face.lists[next(each for each in _INDICES if each in face.lists)][0]
    if not (lengths == 2 * corners).all():
        raise BadFileError("has faces with texture coordinates for some of their corners only")
    return np.asarray(items, np.float64).reshape(-1, 2)[places.ravel()]


def _written(vertices: dict[str, NDArray[Any]], corners: NDArray[np.int64], faces: dict[str, NDArray[Any]]) -> bytes:
    """A PLY file in little-endian single precision."""
    count = len(vertices["x"])
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property float {name}" for name in vertices]
    lines += [f"element face {len(corners)}", "property list uchar int vertex_indices"]
    lines += [f"property float {name}" for name in faces]
    table = np.stack([np.asarray(values, "<f4") for values in vertices.values()], axis=-1)
    layout = [("length", "u1"), ("index", "<i4", (3,)), *((name, "<f4") for name in faces)]
    rows = np.zeros(len(corners), layout)
    rows["length"], rows["index"] = 3, corners
    for name, values in faces.items():
        rows[name] = values
    return "\n".join([*lines, "end_header\n"]).encode() + table.tobytes() + rows.tobytes()
