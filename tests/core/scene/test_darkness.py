"""Black images say why, and what Mitsuba cannot render is said in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from elps_core.errors import RenderFailed
from elps_core.estimate.film import Accumulation
from elps_core.scene.loader import load_scene
from elps_core.settings import RenderSettings

BALL = '<shape type="sphere"/>'
SKY = '<emitter type="constant"/>'
LAMP = '<emitter type="point"><point name="position" value="3, 3, 5"/></emitter>'
BOARD = (
    '<shape type="rectangle"><transform name="to_world"><scale value="0.2"/>{turn}<translate value="{at}"/></transform>'
    '<emitter type="area"/></shape>'
)
TRIANGLE = "v -1 -1 0\nv 1 -1 0\nv 0 1 0\nf 1 2 3\n"
CHECKS = '<texture type="checkerboard" name="{}"/>'


def drawn(folder: Path, body: str, algorithm: str = "path", eye: str = "0, 0, 6", clips: str = "") -> Accumulation:
    """A small image of a scene that looks at the origin."""
    from elps_core.renderer import Renderer

    (folder / "triangle.obj").write_text(TRIANGLE)
    (folder / "scene.xml").write_text(
        f'<scene version="3.0.0"><sensor type="perspective">{clips}<transform name="to_world">'
        f'<lookat origin="{eye}" target="0, 0, 0" up="0, 1, 0"/></transform><film type="hdrfilm">'
        '<integer name="width" value="8"/><integer name="height" value="8"/><string name="pixel_format" value="rgba"/>'
        f"</film></sensor>{body}</scene>"
    )
    settings = RenderSettings(
        integrator=algorithm, light_sampling="power", direction_sampling="scattering", roulette="albedo"
    )
    renderer = Renderer(load_scene(folder / "scene.xml", "llvm_ad_rgb"), settings)
    merged = Accumulation(8, 8)
    merged.add(renderer.render_chunk(0, 4))
    return Accumulation.from_bytes(merged.to_bytes())


@pytest.mark.parametrize(
    ("body", "options", "words"),
    [
        (BALL, {"algorithm": "mi_path"}, ["no emitter"]),
        (BALL + '<emitter type="sunsky"><vector name="sun_direction" value="1, 0, -1"/></emitter>', {}, ["horizon"]),
        (BALL + LAMP.replace("/></em", '/><rgb name="intensity" value="0"/></em'), {}, ["radiance of every emitter"]),
        (BALL + LAMP, {"eye": "0.1, 0.1, 0.2"}, ["stands inside", "sphere"]),
        ('<shape type="cube" id="crate"/>' + SKY, {"eye": "0.2, 0.1, 0.3"}, ["stands inside", "'crate'"]),
        (BALL + LAMP, {"clips": '<float name="near_clip" value="20"/>'}, ["near or far clip"]),
        (BALL.replace("/>", '><point name="center" value="50, 0, 0"/></shape>') + LAMP, {}, ["looks past"]),
        (BALL + BOARD.format(turn="", at="0, 0, 3"), {"eye": "0, 3, 4"}, ["no light was found"]),
    ],
)
def test_a_black_image_says_why(body: str, options: dict[str, Any], words: list[str], tmp_path: Path, mi: Any) -> None:
    del mi
    merged = drawn(tmp_path, body, **options)
    assert not merged.mean()[..., :3].any()
    (warning,) = merged.warnings()
    assert all(word in warning for word in ["the image is black: ", *words]), warning


def test_an_image_that_is_not_black_says_nothing(tmp_path: Path, mi: Any) -> None:
    del mi
    room = '<shape type="cube"><bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>'
    lit = BOARD.format(turn='<rotate x="1" angle="90"/>', at="0, 0.9, 0")
    assert drawn(tmp_path, room + lit, eye="0.2, 0.1, 0.8").warnings() == ()


LAMP_OF_CHECKS = '<emitter type="area">' + CHECKS.format("radiance") + "</emitter>"
BUMPS_OF_CHECKS = '<bsdf type="bumpmap"><texture type="checkerboard"/><bsdf type="diffuse"/></bsdf>'


@pytest.mark.parametrize(
    ("algorithm", "inside", "words"),
    [
        ("mi_path", LAMP_OF_CHECKS, "texture coordinates"),
        ("mi_ptracer", LAMP_OF_CHECKS, "texture coordinates"),
        ("path", BUMPS_OF_CHECKS + SKY, "bump map"),
        ("mi_path", BUMPS_OF_CHECKS + SKY, "bump map"),
    ],
)
def test_what_mitsuba_cannot_render_is_said_in_one_line(
    algorithm: str, inside: str, words: str, tmp_path: Path, mi: Any
) -> None:
    del mi
    inside, sky = inside.removesuffix(SKY), SKY if inside.endswith(SKY) else ""
    shape = f'<shape type="obj"><string name="filename" value="triangle.obj"/>{inside}</shape>'
    with pytest.raises(RenderFailed, match=words) as caught:
        drawn(tmp_path, shape + sky, algorithm)
    assert "\n" not in str(caught.value)
