"""Packed files: none is read, as Mitsuba reads none, and each is told what to do with."""

from __future__ import annotations

import bz2
import gzip
import lzma
from collections.abc import Callable
from pathlib import Path

import pytest

from elps_core.scene.bundle import unpack
from elps_core.scene.loader import load_scene

from .conftest import OBJ, VARIANT, Reject, folder_of, load, mesh, ply, png, scene_xml, texture, zip_of

CURVE = b"0 0 0 0.1\n1 0 0 0.1\n"


@pytest.mark.parametrize(
    ("element", "content"),
    [
        (mesh("obj", "{}"), OBJ),
        (mesh("ply", "{}"), ply()),
        (mesh("linearcurve", "{}"), CURVE),
        (texture("{}"), png()),
    ],
)
@pytest.mark.parametrize(("packer", "pack"), [("gzip", gzip.compress), ("bzip2", bz2.compress), ("xz", lzma.compress)])
def test_packed_files_are_refused_with_the_cure(
    element: str, content: bytes, packer: str, pack: Callable[[bytes], bytes], tmp_path: Path, reject: Reject
) -> None:
    name = "a.png" if content == png() else "a.ply"
    load(tmp_path, scene_xml(element.format(name)), {name: content})
    message = reject(load, tmp_path, scene_xml(element.format(name)), {name: pack(content)})
    assert f"'{name}' is packed by {packer}" in message
    assert "unpack it" in message


def test_a_packed_file_in_a_folder_is_named(tmp_path: Path, reject: Reject) -> None:
    files = {"scene.xml": scene_xml(mesh("ply", "a.ply.gz")), "a.ply.gz": gzip.compress(ply())}
    folder = folder_of(tmp_path / "folder", files)
    assert "'a.ply.gz' is packed by gzip" in reject(load_scene, folder / "scene.xml", VARIANT)
    assert "not unpacked" in reject(unpack, zip_of(tmp_path / "a.zip", files), tmp_path / "into")


def test_packed_scene_files_are_refused_with_the_cure(tmp_path: Path, reject: Reject) -> None:
    packed = gzip.compress(scene_xml())
    (tmp_path / "scene.xml.gz").write_bytes(packed)
    assert "packed by gzip" in reject(load_scene, tmp_path / "scene.xml.gz", VARIANT)
    assert "packed by gzip" in reject(unpack, tmp_path / "scene.xml.gz", tmp_path / "into")
    body = scene_xml('<include filename="part.xml"/>')
    assert "'part.xml' is packed by gzip" in reject(load, tmp_path, body, {"part.xml": packed})


def test_a_bomb_is_not_unpacked(tmp_path: Path, reject: Reject) -> None:
    bomb = gzip.compress(bytes(2**24))
    assert "packed by gzip" in reject(load, tmp_path, scene_xml(mesh("ply", "a.ply")), {"a.ply": bomb})
