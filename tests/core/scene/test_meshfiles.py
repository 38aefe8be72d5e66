"""Meshes as exporters write them: what Mitsuba would refuse or misread comes out as the plain file does."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from elps_core.scene.polygons import triangles

from .conftest import Reject, load, mesh, scene_xml

CORNERS = "v -1 0 0\nv 1 0 0\nv 1 1 0\nv -1 1 0\nv 0 2 0\n"
HOUSE = CORNERS + "f 1 2 3\nf 1 3 4\nf 4 3 5\n"


def made(tmp_path: Path, name: str, content: bytes | str) -> tuple[Any, tuple[str, ...]]:
    """The mesh of a file, and the warnings of its scene."""
    data = content.encode() if isinstance(content, str) else content
    loaded = load(tmp_path, scene_xml(mesh(name.split(".")[1], name)), {name: data})
    shape = next(shape for shape in loaded.scene.shapes() if shape.is_mesh())
    return mi.traverse(shape), loaded.summary.warnings


def area(params: Any) -> float:
    place = np.array(params["vertex_positions"]).reshape(-1, 3)[np.array(params["faces"]).reshape(-1, 3)]
    return float(np.linalg.norm(np.cross(place[:, 1] - place[:, 0], place[:, 2] - place[:, 0]), axis=-1).sum() / 2)


@pytest.mark.parametrize(
    "faces",
    [
        "f 1 2 3 4\nf 4 3 5\n",
        "f 1 2 3 5 4\n",
        "f -5 -4 -3\nf -5 -3 -2\nf -2 -3 -1\n",
        "f 1 2 \\\n3 4\nf 4 3 5\n",
        "f 1 2 \\\r\n3 4\r\nf 4 \\\r\n 3 5\r\n",
        "f 1 2 3 # a comment\nf 1 3 4\nf 4 3 5",
        "f 1 2 3 4\nf 1 2\nl 1 2 3\np 1\nf 4 3 5 # end\n",
    ],
)
def test_faces_of_obj_files_are_all_there(faces: str, tmp_path: Path) -> None:
    expected, _ = made(tmp_path, "a.obj", HOUSE)
    found, _ = made(tmp_path, "a.obj", CORNERS + faces)
    assert len(np.array(found["faces"])) == len(np.array(expected["faces"])) == 9
    assert area(found) == pytest.approx(area(expected)) == pytest.approx(3.0)


def test_indices_from_the_end_count_texture_coordinates_and_normals_too(tmp_path: Path) -> None:
    data = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nvn 0 0 1\n"
    plain, _ = made(tmp_path, "a.obj", data + "f 1/1/1 2/2/1 3/3/1\n")
    other, _ = made(tmp_path, "a.obj", data + "f -3/-3/-1 -2/-2/-1 -1/-1/-1\n")
    for name in ("vertex_positions", "vertex_texcoords", "vertex_normals", "faces"):
        assert np.array_equal(np.array(plain[name]), np.array(other[name])), name


def test_normals_without_a_direction_are_those_of_the_faces(tmp_path: Path) -> None:
    data = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 0\nvn 0.0 -0 0e3\nvn nan 0 1\nf 1//1 2//2 3//3\n"
    found, warnings = made(tmp_path, "a.obj", data)
    assert np.array(found["vertex_normals"]).reshape(-1, 3) == pytest.approx(np.tile([0.0, 0.0, 1.0], (3, 1)))
    assert [warning for warning in warnings if "normals" in warning]


@pytest.mark.parametrize(
    ("line", "word"),
    [("f 1 2 -9", "line 6"), ("f 1 2 3 4 9", "line 6"), ("f 0 -1 2", "line 6"), ("f -1 x 2", "line 6"), ("v -1#", "6")],
)
def test_a_line_of_an_obj_file_that_cannot_be_is_named(line: str, word: str, tmp_path: Path, reject: Reject) -> None:
    message = reject(load, tmp_path, scene_xml(mesh("obj", "a.obj")), {"a.obj": (CORNERS + line + "\n").encode()})
    assert word in message
    assert "a.obj" in message


def header(form: str, vertex: str, face: str, *more: str, vertices: int = 5, faces: int = 2) -> str:
    lines = ["ply", f"format {form} 1.0", *more, f"element vertex {vertices}", *vertex.split(";")]
    return "\n".join([*lines, f"element face {faces}", *face.split(";"), "end_header\n"])


FLOATS = "property float x;property float y;property float z"
INDICES = "property list uchar int vertex_indices"
PLACES = [(-1, 0, 0), (1, 0, 0), (1, 1, 0), (-1, 1, 0), (0, 2, 0)]
ROWS = "".join(f"{x} {y} {z}\n" for x, y, z in PLACES)


def binary(order: str, faces: list[tuple[int, ...]]) -> bytes:
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    body = b"".join(struct.pack(f"{order}3f", *place) for place in PLACES)
    body += b"".join(struct.pack(f"{order}B{len(face)}i", len(face), *face) for face in faces)
    return header(form, FLOATS, INDICES, faces=len(faces)).encode() + body


@pytest.mark.parametrize(
    "content",
    [
        header("ascii", FLOATS, INDICES) + ROWS + "4 0 1 2 3\n3 3 2 4\n",
        header("ascii", FLOATS, INDICES, faces=1) + ROWS + "5 0 1 2 4 3\n",
        "\n" + header("ascii", FLOATS, INDICES, faces=3) + ROWS + "3 0 1 2\n3 0 2 3\n3 3 2 4\n",
        (header("ascii", FLOATS, INDICES) + ROWS + "4 0 1 2 3\n3 3 2 4\n").replace("\n", "\r\n"),
        header("ascii", FLOATS, INDICES, "comment by hand").replace("end_header", "element edge 1\nproperty int a\n"
               "property int b\nend_header") + ROWS + "4 0 1 2 3\n3 3 2 4\n0 1\n",
        header("ascii", FLOATS, "property list uint ushort vertex_index;property int group") + ROWS
        + "4 0 1 2 3 7\n3 3 2 4 8\n",
        binary("<", [(0, 1, 2, 3), (3, 2, 4)]),
        binary(">", [(0, 1, 2, 3), (3, 2, 4)]),
        binary(">", [(0, 1, 2), (0, 2, 3), (3, 2, 4)]),
        binary("<", [(0, 1, 2), (0, 2, 3), (1, 0), (3, 2, 4)]),
    ],
    ids=range(10),
)  # fmt: skip
def test_faces_of_ply_files_are_all_there(content: str | bytes, tmp_path: Path) -> None:
    found, _ = made(tmp_path, "a.ply", content)
    assert len(np.array(found["faces"])) == 9
    assert area(found) == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("fields", "row"),
    [
        ("property uchar red;property uchar green;property uchar blue", "255 51 0"),
        ("property uchar red;property uchar green;property uchar blue;property uchar alpha", "255 51 0 255"),
        ("property float r;property float g;property float b", "1 0.2 0"),
        ("property float red;property float green;property float blue", "1 0.2 0"),
        ("property ushort diffuse_red;property ushort diffuse_green;property ushort diffuse_blue", "65535 13107 0"),
    ],
)
def test_colours_are_between_0_and_1(fields: str, row: str, tmp_path: Path) -> None:
    places = "".join(f"{x} {y} {z} {row}\n" for x, y, z in PLACES)
    content = header("ascii", f"{FLOATS};{fields}", INDICES, faces=1) + places + "3 0 1 2\n"
    found, _ = made(tmp_path, "a.ply", content)
    assert np.array(found["vertex_color"]).reshape(-1, 3) == pytest.approx(np.tile([1.0, 0.2, 0.0], (5, 1)))


def test_texture_coordinates_of_corners_part_their_vertices(tmp_path: Path) -> None:
    face = f"{INDICES};property list uchar float texcoord"
    content = header("ascii", FLOATS, face) + ROWS + "4 0 1 2 3 8 0 0 1 0 1 1 0 1\n3 3 2 4 6 9 9 8 8 7 7\n"
    found, _ = made(tmp_path, "a.ply", content)
    place = np.array(found["vertex_positions"]).reshape(-1, 3)
    texture = np.array(found["vertex_texcoords"]).reshape(-1, 2)
    at_top = texture[np.all(place == (0, 2, 0), axis=-1)]
    assert at_top == pytest.approx(np.array([[7.0, 7.0]]))
    assert {tuple(each) for each in texture[np.all(place == (1, 1, 0), axis=-1)].tolist()} == {(1.0, 1.0), (8.0, 8.0)}


@pytest.mark.parametrize(
    "content",
    [
        header("ascii", FLOATS, INDICES) + ROWS + "4 0 1 2 3\n3 3 2\n",
        header("ascii", FLOATS, INDICES) + ROWS + "4 0 1 2 9\n3 3 2 4\n",
        header("ascii", FLOATS, INDICES) + ROWS + "-4 0 1 2 3\n3 3 2 4\n",
        header("ascii", FLOATS, INDICES) + ROWS + "4e9 0 1 2 3\n3 3 2 4\n",
        header("ascii", FLOATS, INDICES, faces=10**9) + ROWS + "4 0 1 2 3\n",
        header("ascii", FLOATS, f"{INDICES};{INDICES}") + ROWS + "3 0 1 2 3 0 1 2\n3 3 2 4 3 3 2 4\n",
        header("ascii", FLOATS.replace("z", "w"), INDICES) + ROWS + "4 0 1 2 3\n3 3 2 4\n",
        binary("<", [(0, 1, 2, 3), (3, 2, 4)])[:-1],
        binary("<", [(0, 1, 2, 3), (3, 2, 4)]).replace(b"uchar int", b"uint int"),
    ],
)
def test_damaged_files_with_polygons_are_refused(content: str | bytes, tmp_path: Path, reject: Reject) -> None:
    data = content.encode() if isinstance(content, str) else content
    assert "a.ply" in reject(load, tmp_path, scene_xml(mesh("ply", "a.ply")), {"a.ply": data})


def test_polygons_that_are_not_convex_keep_their_area() -> None:
    arrow = np.array([[0, 0, 0], [2, 1, 0], [0, 2, 0], [0.5, 1, 0]], np.float64)
    angles, radii = np.arange(10) * 0.2 * np.pi, np.array([2.0, 1.0] * 5)
    star = np.stack([np.cos(angles) * radii, np.zeros(10), np.sin(angles) * radii], axis=-1)
    for polygon in (arrow, arrow[::-1], np.roll(arrow, 1, axis=0), star):
        whole = np.cross(polygon, np.roll(polygon, -1, axis=0)).sum(axis=0) / 2
        cut = [polygon[list(each)] for each in triangles(polygon)]
        parts = [np.cross(b - a, c - a) / 2 for a, b, c in cut]
        assert np.sum(parts, axis=0) == pytest.approx(whole)
        assert np.linalg.norm(parts, axis=-1).sum() == pytest.approx(np.linalg.norm(whole))
