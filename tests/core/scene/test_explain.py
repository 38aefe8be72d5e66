"""An error blames what is at fault: the parameter, the file or what is missing, and quotes nothing of the host."""

from __future__ import annotations

from pathlib import Path

import pytest

from .conftest import OBJ, Reject, load, mesh, png, scene_xml

BITMAP = '<texture type="bitmap" name="reflectance"><string name="filename" value="a.png"/>{}</texture>'

INDEX = '<float name="int_ior" value="{}"/><float name="ext_ior" value="{}"/>'
TWO_INDICES = '<float name="eta" value="1.3"/><float name="specular" value="1"/>'


def material(content: str, kind: str = "diffuse") -> str:
    return f'<shape type="rectangle"><bsdf type="{kind}">{content}</bsdf></shape>'


def placed(name: str, place: str) -> str:
    return mesh("obj", name).replace("</shape>", f"{place}</shape>")


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
        (material(INDEX.format(1.3, 1.3), "hair"), ["hair", "must be positive and differ"]),
        (material(INDEX.format(-1.0, 1.3), "dielectric"), ["dielectric", "'int_ior' and 'ext_ior' must be positive"]),
        (material('<float name="alpha_u" value="1"/>', "roughconductor"), ["roughconductor", "give both"]),
        (material(TWO_INDICES, "principled"), ["principled", "'eta'"]),
        (material('<rgb name="reflectance" value="1.5"/>'), ["colour", "from 0 to 1"]),
        ('<emitter type="envmap"/>', ["envmap", "needs the parameter 'filename'"]),
        (mesh("obj", "bad.obj"), ["obj", "names a vertex"]),
        (placed("flat.obj", '<transform name="to_world"><scale x="1" y="1" z="0"/></transform>'), ["'to_world'"]),
        (placed("a.obj", '<string name="to_world" value="up"/>'), ["'to_world'", "transform, not string"]),
        (placed("a.obj", '<vector name="to_world" value="99999"/>'), ["'to_world'", "transform, not vector"]),
        (mesh("obj", "a.obj").replace("</shape>", '<float name="x" value="1"/></shape>'), ["'x'"]),
    ],
)  # fmt: skip
def test_what_is_at_fault_is_named(body: str, words: list[str], tmp_path: Path, reject: Reject) -> None:
    files = {"a.png": png(), "b.png": png()[:40], "a.obj": OBJ, "bad.obj": OBJ.replace(b"1 2 3", b"1 2 300")}
    files["flat.obj"] = OBJ.replace(b"f 1 2 3", b"vn 0 0 1\nf 1//1 2//1 3//1")
    message = reject(load, tmp_path, scene_xml(body), files)
    assert all(word in message for word in words), message
