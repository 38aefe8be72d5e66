"""Write an OBJ file anew where Mitsuba would misread it. Imports no Mitsuba.

Mitsuba's reader takes positive indices, faces of three or four corners, and one line for each: it loses what is
continued on the next line, and all corners after the fourth.
"""

from __future__ import annotations

import mmap
import re
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from elps_core.scene.meshes import BadFileError, file_size
from elps_core.scene.polygons import triangles

_ODD = re.compile(
    rb"\\[ \t]*\r?\n"  # continued lines
    rb"|^[ \t]*f[ \t][^\n#]*-"  # indices from the end
    rb"|^[ \t]*f(?:[ \t]+[^\s#]+){5}"  # more than four corners
    rb"|^[ \t]*vn(?:[ \t]+[-+]?0*\.?0*(?:[eE][-+]?[0-9]+)?){3}[ \t]*\r?$"  # normals of no length
    rb"|^[ \t]*vn[ \t][^\n]*(?:[nN][aA][nN]|[iI][nN][fF])"
    rb"|^[ \t]*(?:v|vn|vt|f)[ \t][^\n#]*#",  # comments behind numbers
    re.MULTILINE,
)
"""Lines that Mitsuba misreads."""
_CONTINUED = re.compile(rb"\\[ \t]*\r?\n")
_BLANK, _COMMENT, _MINUS, _DIGIT, _LETTER = 1, 2, 4, 8, 16
"""Kinds of characters; the letters are of numbers that are none."""
_KINDS = np.zeros(256, np.uint8)
"""Of each character."""
for _characters, _kind in (
    (b" \t", _BLANK),
    (b"#", _COMMENT),
    (b"-", _MINUS),
    (b"123456789", _DIGIT),
    (b"aAiI", _LETTER),
):
    _KINDS[list(_characters)] = _kind
_MOST_CORNERS = 4
"""Of a face that Mitsuba reads whole; each has a blank before it."""
_TINY = 1e-30
"""Length below which a normal has no direction."""


def mended(file: BinaryIO) -> tuple[bytes, list[str]] | None:
    """The file as Mitsuba reads it right, and what was done to it; None where it does so as it stands.

    Raises:
        BadFileError: a line that cannot be read; it is named.
    """
    if file_size(file) == 0:
        return None
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        odd = b"\\" in data or (_may_be_odd(data) and _ODD.search(data) is not None)
        return _Rewriting().run(data[:]) if odd else None


def _may_be_odd(data: mmap.mmap) -> bool:
    """Whether some line may be one of :data:`_ODD`, by the characters in each: those that are odd are all among them.

    Looking for the expression itself takes two seconds for 24 MB, this a tenth of that.
    """
    text = np.frombuffer(data, np.uint8)
    begins = np.concatenate([[0], np.flatnonzero(text[:-1] == ord("\n")) + 1])
    first, second = text[begins], text[np.minimum(begins + 1, len(text) - 1)]
    kinds = _KINDS[text]
    there = np.bitwise_or.reduceat(kinds, begins)
    blanks = np.add.reduceat(kinds & _BLANK, begins, dtype=np.int32)
    face, normal = first == ord("f"), (first == ord("v")) & (second == ord("n"))
    moved_in = (_KINDS[first] & _BLANK) != 0
    comments = ((there & _COMMENT) != 0) & (first != ord("#"))
    faces = face & (((there & _MINUS) != 0) | (blanks > _MOST_CORNERS))
    normals = normal & (((there & _DIGIT) == 0) | ((there & _LETTER) != 0))
    return bool((moved_in | comments | faces | normals).any())


class _Rewriting:
    def __init__(self) -> None:
        self.positions: list[tuple[float, ...]] = []
        self.normals: list[tuple[float, ...]] = []
        self.textures = 0
        self.faces: list[list[tuple[int, int, int]]] = []
        """Corners as (vertex, texture, normal), from 1; 0 where there is none."""
        self.vertex_lines: list[bytes] = []
        self.cut = False

    def run(self, data: bytes) -> tuple[bytes, list[str]]:
        number = 1
        # A continued line keeps its own end, so that lines are counted as an editor shows them.
        for line in _CONTINUED.sub(b"\\ ", data).split(b"\n"):
            continued = line.count(b"\\ ")
            self._line(line.replace(b"\\ ", b" ").partition(b"#")[0].split(), number)
            number += 1 + continued
        warnings = ["has faces of more than three corners: they are cut into triangles"] if self.cut else []
        if self._give_directions():
            warnings.append("has normals without a direction: those of its faces take their place")
        return self._text(), warnings

    def _line(self, words: list[bytes], number: int) -> None:
        if not words:
            return
        kind, values = words[0], words[1:]
        try:
            if kind == b"v":
                self.positions.append(tuple(map(float, values[:3])))
                self.vertex_lines.append(b"v " + b" ".join(values[:3]))
            elif kind == b"vn":
                self.normals.append(tuple(map(float, values[:3])))
            elif kind == b"vt":
                self.textures += 1
                self.vertex_lines.append(b"vt " + b" ".join(values[:2]))
            elif kind == b"f":
                self._face(values, number)
        except ValueError:
            raise BadFileError(f"has something that is not a number in line {number}") from None
        if kind in (b"v", b"vn") and len(values) < 3:
            raise BadFileError(f"has fewer than three numbers in line {number}")

    def _face(self, corners: list[bytes], number: int) -> None:
        if len(corners) < 3:
            return  # a point or a line has no surface
        counts = len(self.positions), self.textures, len(self.normals)
        face = []
        for corner in corners:
            parts = [int(part) if part else 0 for part in corner.split(b"/")]
            parts += [0] * (3 - len(parts))
            indices = [part + 1 + count if part < 0 else part for part, count in zip(parts, counts, strict=False)]
            if indices[0] == 0 or any(not 0 <= i <= count for i, count in zip(indices, counts, strict=True)):
                raise BadFileError(f"has a face that names vertices it does not have, in line {number}")
            face.append((indices[0], indices[1], indices[2]))
        if len(face) == 3:
            self.faces.append(face)
            return
        self.cut = True
        places = np.array([self.positions[vertex - 1] for vertex, _, _ in face])
        self.faces += [[face[k] for k in triangle] for triangle in triangles(places)]

    def _give_directions(self) -> bool:
        """Replace normals of no length by those of the faces that use them; whether there were any."""
        normals: NDArray[np.float64] = np.array(self.normals, np.float64).reshape(-1, 3)
        length = np.linalg.norm(normals, axis=-1)
        bad = ~(length > _TINY) | ~np.isfinite(length)
        if not bad.any():
            return False
        normals[bad] = 0.0
        for face in self.faces:
            a, b, c = (np.array(self.positions[vertex - 1]) for vertex, _, _ in face)
            for _, _, normal in face:
                if normal and bad[normal - 1]:
                    normals[normal - 1] += np.cross(b - a, c - a)
        length = np.linalg.norm(normals, axis=-1)
        normals[~(length > 0.0)] = (0.0, 0.0, 1.0)  # No face with a surface uses it.
        self.normals = [tuple(map(float, normal)) for normal in normals]
        return True

    def _text(self) -> bytes:
        normals = [b"vn " + b" ".join(repr(value).encode() for value in normal) for normal in self.normals]
        faces = [b"f " + b" ".join(map(_corner, face)) for face in self.faces]
        return b"\n".join([*self.vertex_lines, *normals, *faces, b""])


def _corner(corner: tuple[int, int, int]) -> bytes:
    vertex, texture, normal = corner
    parts = [str(vertex), str(texture) if texture else "", str(normal) if normal else ""]
    return "/".join(parts).rstrip("/").encode()
