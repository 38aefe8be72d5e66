"""The files that scenes of the corpus name, made in code: a few triangles, a few pixels."""

from __future__ import annotations

import io
import struct
import tempfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path, PurePosixPath

import numpy as np
import OpenImageIO
from PIL import Image

from tests.tensors import material, written

SQUARE = ((-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0))
CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))
"""Texture coordinates of the square."""
TRIANGLES = ((0, 1, 2), (0, 2, 3))
OBJ_FACES = "f 1/1/1 2/2/1 3/3/1\nf 1/1/1 3/3/1 4/4/1\n"
PIXELS = (4, 2)


def obj(faces: str = OBJ_FACES) -> bytes:
    """The square as OBJ, as modelling programs write it."""
    lines = ["# a square", "mtllib square.mtl", "o Square"]
    lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in SQUARE]
    lines += [f"vt {u} {v}" for u, v in CORNERS]
    return ("\n".join([*lines, "vn 0 0 1", "usemtl None", "s off"]) + "\n" + faces).encode()


def ply(order: str = "<", faces: tuple[tuple[int, ...], ...] = TRIANGLES, extra: str = "") -> bytes:
    """The square as binary PLY, with normals and texture coordinates."""
    fields = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz", "u", "v"))
    kind = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = (
        f"ply\nformat {kind} 1.0\ncomment made in code\n{extra}element vertex {len(SQUARE)}\n{fields}"
        f"element face {len(faces)}\nproperty list uchar int vertex_index\nend_header\n"
    )
    vertices = [struct.pack(order + "8f", *p, 0, 0, 1, *uv) for p, uv in zip(SQUARE, CORNERS, strict=True)]
    return head.encode() + b"".join(vertices) + b"".join(struct.pack(f"{order}B{len(f)}i", len(f), *f) for f in faces)


def serialized() -> bytes:
    """Two meshes in one file of Mitsuba 0.x: one triangle, and the square."""
    data, offsets = b"", []
    for name, faces in ((b"first", TRIANGLES[:1]), (b"second", TRIANGLES)):
        offsets.append(len(data))
        head = struct.pack("<I", 0x1000) + name + b"\0" + struct.pack("<QQ", len(SQUARE), len(faces))
        body = np.array(SQUARE, "<f4").tobytes() + np.array(faces, "<u4").tobytes()
        data += b"\x1c\x04\x04\x00" + zlib.compress(head + body)
    return data + struct.pack("<2QI", *offsets, 2)


def volume() -> bytes:
    """A grid of two densities a side."""
    return struct.pack("<3sB5i6f", b"VOL", 3, 1, 2, 2, 2, 1, 0, 0, 0, 1, 1, 1) + np.full(8, 0.5, "<f4").tobytes()


def picture(kind: str) -> bytes:
    """A small image of one colour; ``kind`` as Pillow calls formats."""
    out = io.BytesIO()
    Image.new("RGB", PIXELS, (200, 120, 40)).save(out, kind)
    return out.getvalue()


def radiance(ending: str) -> bytes:
    """A small image of floating point numbers."""
    pixels = np.full((PIXELS[1], PIXELS[0], 3), 0.5, np.float32)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"image{ending}"
        image = OpenImageIO.ImageOutput.create(str(path))
        image.open(str(path), OpenImageIO.ImageSpec(*PIXELS, 3, "float"))
        image.write_image(pixels)
        image.close()
        return path.read_bytes()


_KINDS: dict[str, Callable[[], bytes]] = {
    ".obj": obj,
    ".ply": ply,
    ".serialized": serialized,
    ".vol": volume,
    ".bsdf": lambda: written(material()),
    ".png": lambda: picture("PNG"),
    ".jpg": lambda: picture("JPEG"),
    ".tga": lambda: picture("TGA"),
    ".bmp": lambda: picture("BMP"),
    ".exr": lambda: radiance(".exr"),
    ".hdr": lambda: radiance(".hdr"),
    ".pfm": lambda: radiance(".pfm"),
    ".spd": lambda: b"400 0.5\n500 0.6\n600 0.7\n700 0.8\n",
    ".txt": lambda: b"".join(b"%d 0 0 0.1\n" % i for i in range(5)),
    ".blend": lambda: b"BLENDER-v306",
    ".mtl": lambda: b"newmtl None\nKd 0.8 0.8 0.8\n",
}
"""Ending of a name -> what makes such a file."""


@cache
def _made(ending: str) -> bytes:
    return _KINDS[ending]()


def made(*names: str) -> dict[str, bytes]:
    """Files of these names, their content by the ending."""
    return {name: _made(PurePosixPath(name).suffix.lower()) for name in names}
