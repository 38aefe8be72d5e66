"""A texture that reads what its shape does not have is told of: nothing in the image says why it is black."""

from __future__ import annotations

from pathlib import Path

import pytest

from .conftest import OBJ, load, scene_xml

ATTRIBUTE = '<texture type="mesh_attribute" name="{}"><string name="name" value="vertex_color"/></texture>'
CHECKS = '<texture type="checkerboard" name="reflectance"/>'
DIFFUSE = '<bsdf type="{}"><bsdf type="diffuse">{}</bsdf></bsdf>'
UV = OBJ.replace(b"f 1 2 3", b"vt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3")
PLY = b"""ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property float r
property float g
property float b
element face 1
property list uchar int vertex_indices
end_header
0 0 0 1 0 0
1 0 0 0 1 0
0 1 0 0 0 1
3 0 1 2
"""
FILES = {"a.obj": OBJ, "b.obj": UV, "a.ply": PLY}
BLACK, ANEW = "has no attribute 'vertex_color'", "has no texture coordinates"


def shape(name: str, inside: str) -> str:
    return f'<shape type="{name[-3:]}" id="thing"><string name="filename" value="{name}"/>{inside}</shape>'


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (shape("a.obj", DIFFUSE.format("twosided", ATTRIBUTE.format("reflectance"))), ["'thing'", BLACK]),
        (shape("a.obj", f'<emitter type="area">{ATTRIBUTE.format("radiance")}</emitter>'), ["'thing'", BLACK]),
        (f'<shape type="sphere">{DIFFUSE.format("twosided", ATTRIBUTE.format("reflectance"))}</shape>', [BLACK]),
        (shape("a.ply", DIFFUSE.format("twosided", ATTRIBUTE.format("reflectance"))), []),
        (shape("a.obj", DIFFUSE.format("twosided", CHECKS)), ["'thing'", ANEW]),
        (shape("b.obj", DIFFUSE.format("twosided", CHECKS)), []),
        (shape("a.obj", ""), []),
        (f'<shape type="disk">{DIFFUSE.format("twosided", CHECKS)}</shape>', []),
    ],
)
def test_what_a_texture_reads_in_vain_is_told(tmp_path: Path, body: str, words: list[str]) -> None:
    warnings = load(tmp_path, scene_xml(body), FILES).summary.warnings
    assert len(warnings) == bool(words), warnings
    assert all(word in warnings[0] for word in words)
