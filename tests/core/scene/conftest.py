"""Helpers that build small scenes and bundles, and say what a rejection must look like."""

from __future__ import annotations

import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from elps_core.errors import SceneRejected
from elps_core.scene.loader import LoadedScene, load_scene

VARIANT = "scalar_rgb"

SENSOR = """
<sensor type="perspective">
    <float name="fov" value="45"/>
    <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="12"/></film>
</sensor>
"""
LIGHT = '<emitter type="point"><point name="position" value="1, 2, 3"/></emitter>'
SQUARE = '<shape type="rectangle"/>'

OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def scene_xml(body: str = SQUARE, *, sensor: str = SENSOR, light: str = LIGHT) -> bytes:
    return f'<scene version="3.0.0">{sensor}{light}{body}</scene>'.encode()


def mesh(kind: str, name: str) -> str:
    return f'<shape type="{kind}"><string name="filename" value="{name}"/></shape>'


def texture(name: str) -> str:
    bitmap = f'<texture type="bitmap" name="reflectance"><string name="filename" value="{name}"/></texture>'
    return f'<shape type="rectangle"><bsdf type="diffuse">{bitmap}</bsdf></shape>'


def ply(vertices: int = 3, faces: int = 1, indices: tuple[int, ...] = (0, 1, 2), body: bytes | None = None) -> bytes:
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    if body is None:
        body = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0) + struct.pack("<B3i", 3, *indices)
    return head + body


def png(width: int = 1, height: int = 1, rows: int = 1) -> bytes:
    """A black RGB image whose header may declare more rows than the data holds."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj(1)
    data = b"".join([*(packer.compress(bytes(1 + 3 * width)) for _ in range(rows)), packer.flush()])
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def zip_of(path: Path, files: dict[str, bytes], *, packed: bool = True) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def folder_of(path: Path, files: dict[str, bytes]) -> Path:
    for name, content in files.items():
        target = path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content)
    return path


def load(tmp_path: Path, xml: bytes, files: dict[str, bytes] | None = None) -> LoadedScene:
    """Load a bundle of a scene and other files, in the variant that starts fastest."""
    return load_scene(zip_of(tmp_path / "upload.zip", {"scene.xml": xml, **(files or {})}), VARIANT)


def listing(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


Reject = Callable[..., str]
"""(function, arguments ...) -> the message of the SceneRejected that it must raise."""


@pytest.fixture
def reject(tmp_path: Path) -> Reject:
    """Call something that must raise SceneRejected; return the message once its form is checked."""

    def call(action: Callable[..., object], *arguments: Any, **named: Any) -> str:
        with pytest.raises(SceneRejected) as caught:
            action(*arguments, **named)
        message = str(caught.value)
        assert message
        assert message.isprintable()
        assert len(message) < 300
        assert str(tmp_path) not in message
        assert not re.search(r"/(tmp|home|work|usr|root|var)\b", message)
        assert "site-packages" not in message
        return message

    return call
