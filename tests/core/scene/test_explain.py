"""An error blames what is at fault: the parameter, the file or what is missing, and quotes nothing of the host."""

from __future__ import annotations

from pathlib import Path

import pytest

from .conftest import OBJ, Reject, load, mesh, png, scene_xml

BITMAP = '<texture type="bitmap" name="reflectance"><string name="filename" value="a.png"/>{}</texture>'


def material(content: str, kind: str = "diffuse") -> str:
    return f'<shape type="rectangle"><bsdf type="{kind}">{content}</bsdf></shape>'


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (material(BITMAP.format('<string name="wrap_mode" value="odd"/>')), ["bitmap", "'odd'", "'wrap_mode'"]),
        (material(BITMAP.format('<float name="speed" value="1"/>')), ["bitmap", "'speed'"]),
        (material(BITMAP.replace("a.png", "b.png").format("")), ["bitmap", "'b.png'"]),
        (material('<string name="reflectance" value="red"/>'), ["diffuse", "'reflectance'", "texture or float"]),
        (material('<string name="distribution" value="phong"/>', "roughconductor"), ["'phong'", "'distribution'"]),
        (material('<string name="material" value="Unobtainium"/>', "conductor"), ["'Unobtainium'", "'material'"]),
        (material('<float name="weight" value="1"/>', "blendbsdf"), ["blendbsdf", "two materials"]),
        (material('<bsdf type="dielectric"/>', "twosided"), ["twosided", "light passes"]),
        ('<emitter type="envmap"/>', ["envmap", "needs the parameter 'filename'"]),
        (mesh("obj", "bad.obj"), ["obj", "names a vertex"]),
        (mesh("obj", "a.obj").replace("</shape>", '<float name="x" value="1"/></shape>'), ["'x'"]),
    ],
)  # fmt: skip
def test_what_is_at_fault_is_named(body: str, words: list[str], tmp_path: Path, reject: Reject) -> None:
    files = {"a.png": png(), "b.png": png()[:40], "a.obj": OBJ, "bad.obj": OBJ.replace(b"1 2 3", b"1 2 300")}
    message = reject(load, tmp_path, scene_xml(body), files)
    assert all(word in message for word in words), message
