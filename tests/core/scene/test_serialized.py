"""Serialized meshes: the one that a shape asks for is checked, wherever a file says that it lies."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import pytest

from elps_core.scene import meshes
from elps_core.scene.meshes import BadFileError

from .conftest import Reject, load, mesh, scene_xml

NORMALS, COORDINATES, COLOURS, DOUBLE = 0x1, 0x2, 0x8, 0x2000


def part(
    faces: int,
    version: int = 4,
    flags: int = 0x1000,
    *,
    counts: tuple[int, int] | None = None,
    first: float = 0.0,
    indices: tuple[int, ...] | None = None,
) -> bytes:
    """One mesh of that many triangles apart from one another; ``counts`` is what it says of itself."""
    letter = "d" if flags & DOUBLE else "f"
    extra = 3 * bool(flags & NORMALS) + 2 * bool(flags & COORDINATES) + 3 * bool(flags & COLOURS)
    places = [float(x) for face in range(faces) for x in (0, 0, face, 1, 0, face, 0, 1, face)]
    places[0] = first
    values = struct.pack(f"<{9 * faces}{letter}", *places)
    values += struct.pack(f"<{3 * faces * extra}{letter}", *[1.0] * (3 * faces * extra))
    values += struct.pack(f"<{3 * faces}I", *(indices or range(3 * faces)))
    head = struct.pack("<I", flags) + (b"name\0" if version == 4 else b"")
    head += struct.pack("<QQ", *(counts or (3 * faces, faces)))
    return struct.pack("<HH", 0x041C, version) + zlib.compress(head + values)


def joined(parts: list[bytes], version: int = 4, offsets: list[int] | None = None, count: int | None = None) -> bytes:
    """A file of these meshes, with a directory that may lie."""
    places = [sum(map(len, parts[:number])) for number in range(len(parts))] if offsets is None else offsets
    directory = struct.pack(f"<{len(places)}{'Q' if version == 4 else 'I'}", *places)
    return b"".join(parts) + directory + struct.pack("<I", len(parts) if count is None else count)


def asking(index: int | str | None, tag: str = "integer") -> bytes:
    given = "" if index is None else f'<{tag} name="shape_index" value="{index}"/>'
    return scene_xml(mesh("serialized", "a.serialized").replace("</shape>", f"{given}</shape>"))


THREE = [part(1), part(2), part(3)]


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("flags", [0x1000, DOUBLE, NORMALS | COORDINATES, DOUBLE | NORMALS | COORDINATES | COLOURS])
def test_the_mesh_that_is_asked_for_is_loaded(version: int, flags: int, tmp_path: Path) -> None:
    content = joined([part(faces, version, flags) for faces in (1, 2, 3)], version)
    for index, faces in ((None, 1), (0, 1), (1, 2), (2, 3)):
        assert load(tmp_path, asking(index), {"a.serialized": content}).summary.triangles == faces


def test_the_first_mesh_needs_no_directory(tmp_path: Path) -> None:
    for content in (part(1), joined(THREE, offsets=[7, 7, 7]), joined(THREE, count=2**32 - 1)):
        assert load(tmp_path, asking(None), {"a.serialized": content}).summary.triangles == 1


@pytest.mark.parametrize(
    ("index", "content", "words"),
    [
        (3, joined(THREE), ["3 meshes", "'shape_index' 3"]),
        (2**31 - 1, joined(THREE), ["'shape_index'"]),
        (-1, joined(THREE), ["'shape_index' -1"]),
        (1, part(1), ["directory"]),
        (1, joined(THREE, count=0), ["directory"]),
        (1, joined(THREE, count=2**32 - 1), ["directory"]),
        (1, joined(THREE, offsets=[0, 2**40, 0]), ["mesh 1", "beyond its end"]),
        (1, joined(THREE, offsets=[0, 2**64 - 1, 0]), ["mesh 1", "beyond its end"]),
        (1, joined(THREE, offsets=[0, 3, 0]), ["damaged compression"]),
        (2, joined(THREE)[:-30], ["directory"]),
        (0, joined([part(1, 5)]), ["version 5"]),
        (0, joined([part(1)]).replace(b"\x1c\x04", b"PK"), ["not a serialized mesh"]),
        (0, b"\x1c\x04\x04", ["not a serialized mesh"]),
        (0, b"\x1c\x04\x04\0", ["beyond its end"]),
        (0, part(30)[:-20], ["cut off"]),
        (0, joined([part(1)], version=3).replace(b"\x1c\x04\x04", b"\x1c\x04\x03"), ["vertices or faces"]),
        (0, part(1, counts=(2**60, 2**60)), ["than are allowed"]),
        (0, part(1, counts=(2**28, 2**28)), ["than it holds"]),
        (0, part(1, counts=(3, 2)), ["than it holds"]),
        (0, part(1, indices=(0, 1, 3)), ["name vertices"]),
        (0, part(1, first=float("nan")), ["not finite"]),
        (0, part(1, flags=DOUBLE, first=1e300), ["not finite"]),
        (1, joined([part(1), part(1, indices=(0, 1, 3))]), ["name vertices"]),
    ],
)
def test_files_that_lie_are_refused(index: int, content: bytes, words: list[str], tmp_path: Path) -> None:
    (tmp_path / "a.serialized").write_bytes(content)
    with (tmp_path / "a.serialized").open("rb") as file, pytest.raises(BadFileError) as caught:
        meshes.serialized(file, part=index)
    assert all(word in str(caught.value) for word in words), caught.value


def test_an_error_names_shape_file_and_parameter(tmp_path: Path, reject: Reject) -> None:
    message = reject(load, tmp_path, asking(3), {"a.serialized": joined(THREE)})
    assert all(word in message for word in ('<shape type="serialized"> (line 7)', "'a.serialized'", "'shape_index' 3"))
    assert "integer, not float" in reject(load, tmp_path, asking("1.0", "float"), {"a.serialized": joined(THREE)})


def test_of_a_file_only_the_meshes_that_are_used_count(tmp_path: Path) -> None:
    (tmp_path / "a.serialized").write_bytes(joined([part(1), part(1000)]))
    memory = []
    for index in (0, 1):
        with (tmp_path / "a.serialized").open("rb") as file:
            memory.append(meshes.serialized(file, part=index))
    assert 100 * memory[0] < memory[1]


def test_what_a_mesh_unpacks_to_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(meshes, "MAX_MESH_BYTES", 2**19)
    (tmp_path / "a.serialized").write_bytes(part(20_000))
    assert (tmp_path / "a.serialized").stat().st_size < 2**19
    with (tmp_path / "a.serialized").open("rb") as file, pytest.raises(BadFileError, match="make it smaller"):
        meshes.serialized(file)
