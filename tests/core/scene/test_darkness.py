"""Black images say why, and others do not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from elps_core.estimate.film import Accumulation
from elps_core.scene.loader import load_scene
from elps_core.settings import RenderSettings, with_file_defaults

BALL = '<shape type="sphere"/>'
GLASS = '<shape type="sphere"><bsdf type="dielectric"/></shape>'
CRATE = '<shape type="cube" id="crate"/>'
ROOM = '<shape type="cube" id="room"><bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>'
AGAIN = f'<shape type="shapegroup" id="g">{CRATE}</shape><shape type="instance"><ref id="g"/></shape>'
ASIDE = '<shape type="sphere"><point name="center" value="50, 0, 0"/></shape>'
WALL = '<shape type="rectangle"><transform name="to_world">{turn}<scale value="9"/></transform>{inside}</shape>'
BLACK = '<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>'
SKY = '<emitter type="constant"/>'
SUN = '<emitter type="{kind}">{when}</emitter>'
DOWN = '<vector name="sun_direction" value="1, 0, -1"/>'
NIGHT = '<float name="start_time" value="0"/><float name="end_time" value="1"/>'
LAMP = '<emitter type="point"><point name="position" value="3, 3, 5"/>{}</emitter>'
DIM = '<rgb name="intensity" value="0"/>'
SPOT = '<emitter type="spot"><transform name="to_world"><lookat origin="0,3,0" target="0,9,0" up="1,0,0"/></transform>'
BOARD = (
    '<shape type="rectangle" id="board"><transform name="to_world"><scale value="0.2"/>{turn}<translate value="{at}"/>'
    '</transform><emitter type="area"/></shape>'
)
INTO = '<rotate x="1" angle="90"/>'
"""Turns what faces along z downwards."""
OUT = '<rotate x="1" angle="-90"/>'
HIDES = '<integrator type="path"><boolean name="hide_emitters" value="true"/></integrator>'
SHALLOW = '<integrator type="path"><integer name="max_depth" value="1"/></integrator>'
FIXTURE = BOARD.format(turn=INTO, at="0, 4, 0") + (
    '<shape type="cube" id="hood"><transform name="to_world"><scale value="0.5"/><translate y="4"/></transform></shape>'
)
IN = "0.2, 0.1, 0.3"
"""Inside of what stands at the origin."""


def drawn(
    folder: Path, body: str, algorithm: str = "path", eye: str = "0, 0, 6", clips: str = "", kind: str = "perspective"
) -> Accumulation:
    """A small image of a scene that looks at the origin."""
    from elps_core.renderer import Renderer

    (folder / "scene.xml").write_text(
        f'<scene version="3.0.0"><sensor type="{kind}">{clips}<transform name="to_world">'
        f'<lookat origin="{eye}" target="0, 0, 0" up="0, 1, 0"/></transform><film type="hdrfilm">'
        '<integer name="width" value="8"/><integer name="height" value="8"/><string name="pixel_format" value="rgba"/>'
        f"</film></sensor>{body}</scene>"
    )
    settings = RenderSettings(
        integrator=algorithm, light_sampling="power", direction_sampling="scattering", roulette="albedo"
    )
    loaded = load_scene(folder / "scene.xml", "llvm_ad_rgb")
    renderer = Renderer(loaded, with_file_defaults(settings, loaded.summary.defaults.settings()))
    merged = Accumulation(8, 8)
    merged.add(renderer.render_chunk(0, 4))
    return Accumulation.from_bytes(merged.to_bytes())


def clip(plane: str, value: float) -> str:
    return f'<float name="{plane}" value="{value}"/>'


@pytest.mark.parametrize(
    ("body", "options", "words"),
    [
        (BALL, {"algorithm": "mi_path"}, ["no emitter"]),
        (BALL, {}, ["no emitter"]),
        (BALL + SUN.format(kind="sunsky", when=DOWN), {}, ["horizon"]),
        (BALL + LAMP.format(DIM), {}, ["no lamp gives light", "are 0"]),
        (BALL + SPOT + "</emitter>", {}, ["turn them round"]),
        (BALL + BOARD.format(turn=OUT, at="0, 3, 0"), {"eye": "0, 2, 6"}, ["turn them round", "flip_normals"]),
        (BALL + LAMP.format(""), {"eye": IN}, ["inside a closed surface", "a sphere"]),
        (CRATE + SKY, {"eye": IN}, ["inside a closed surface", "'crate'"]),
        (ROOM + LAMP.format(""), {"eye": IN}, ["inside a closed surface", "'room'"]),
        (AGAIN + LAMP.format(""), {"eye": IN}, ["inside a closed surface", "'crate'"]),
        ('<shape type="sphere" id="sun"><emitter type="area"/></shape>', {"eye": IN}, ["inside a closed", "'sun'"]),
        (BALL + FIXTURE, {}, ["all lamps are inside", "'hood'"]),
        (BALL + LAMP.format(""), {"clips": clip("near_clip", 20)}, ["'near_clip'", "smaller"]),
        (BALL + LAMP.format(""), {"clips": clip("far_clip", 2)}, ["'far_clip'", "larger"]),
        (BALL + LAMP.format(""), {"clips": clip("near_clip", 20), "kind": "orthographic"}, ["'near_clip'", "smaller"]),
        (BALL + LAMP.format(""), {"clips": clip("far_clip", 2), "kind": "thinlens"}, ["'far_clip'", "larger"]),
        (ASIDE + LAMP.format(""), {}, ["looks past"]),
        (ASIDE + SKY + HIDES, {}, ["'hide_emitters'"]),
        (BALL + LAMP.format("") + SHALLOW, {}, ["max_depth is 1"]),
        (WALL.format(turn='<rotate y="1" angle="180"/>', inside="") + LAMP.format(""), {}, ["backs", "'twosided'"]),
        (WALL.format(turn="", inside=BLACK) + LAMP.format(""), {}, ["black materials"]),
        (GLASS + LAMP.format(""), {"eye": IN}, ["no path was found"]),
    ],
)
def test_a_black_image_says_why(body: str, options: dict[str, Any], words: list[str], tmp_path: Path, mi: Any) -> None:
    del mi
    if "thinlens" in options.values():
        options = options | {"clips": options["clips"] + clip("aperture_radius", 0.1)}
    merged = drawn(tmp_path, body, **options)
    assert not merged.mean()[..., :3].any()
    (warning,) = merged.warnings()
    assert all(word in warning for word in ["the image is black: ", *words]), warning


@pytest.mark.parametrize(
    ("body", "eye"),
    [
        (ROOM + BOARD.format(turn=INTO, at="0, 0.9, 0"), "0.2, 0.1, 0.8"),  # The camera is inside, and so is the lamp
        (BALL + LAMP.format(""), "0, 0, 6"),
    ],
)
def test_an_image_that_is_not_black_says_nothing(body: str, eye: str, tmp_path: Path, mi: Any) -> None:
    del mi
    assert drawn(tmp_path, body, eye=eye).warnings() == ()


def test_what_a_room_holds_is_seen_as_inside_with_its_lamp(tmp_path: Path, mi: Any) -> None:
    """A lamp beside the camera takes the room off the list of reasons, though the image is black."""
    del mi
    dark = ROOM.replace('<bsdf type="diffuse"/>', BLACK)
    (warning,) = drawn(tmp_path, dark + BOARD.format(turn=INTO, at="0, 0.9, 0"), eye="0.2, 0.1, 0.8").warnings()
    assert "black materials" in warning


@pytest.mark.parametrize("algorithm", ["light", "bdpt", "pssmlt", "mi_ptracer", "mi_volpath"])
def test_a_scene_without_emitters_is_rendered_by_every_algorithm(algorithm: str, tmp_path: Path, mi: Any) -> None:
    del mi
    merged = drawn(tmp_path, BALL, algorithm)
    assert not merged.mean()[..., :3].any()
    alpha = merged.mean()[..., 3]
    assert 0.0 < alpha.mean() < 0.5, "what is not there covers nothing"
    assert merged.warnings() == ("the image is black: the scene has no emitter: add one",)


def test_an_image_of_distances_is_not_dark(tmp_path: Path, mi: Any) -> None:
    del mi
    merged = drawn(tmp_path, BALL, "mi_depth")
    assert merged.mean()[..., :3].any()
    assert merged.warnings() == ()


@pytest.mark.parametrize("variant", ["llvm_ad_spectral", "llvm_ad_mono"])
@pytest.mark.parametrize(
    "light",
    [
        "",
        LAMP.format(DIM),
        LAMP.format(DIM.replace('"0"', '"0.0, 0, .0"')),
        LAMP.format(DIM.replace("rgb", "float")),
        LAMP.format('<spectrum name="intensity" value="400:0, 700:0e3"/>'),
    ],
)
def test_no_light_is_no_light_in_every_variant(tmp_path: Path, mi: Any, light: str, variant: str) -> None:
    """Mitsuba makes no lamp of a black colour where there are spectra."""
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0"><sensor type="perspective"/>{BALL}{light}</scene>')
    try:
        loaded = load_scene(tmp_path / "scene.xml", variant)
        assert loaded.emission.count == 1
        assert not loaded.emission.power.any()
    finally:
        mi.set_variant("llvm_ad_rgb")


def test_what_is_nearly_black_is_left_as_it_is(tmp_path: Path, mi: Any) -> None:
    del mi
    for value in ("0, 0, 1e-3", "1e-3", "0.5"):
        lamp = LAMP.format(DIM.replace('"0"', f'"{value}"'))
        (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0"><sensor type="perspective"/>{BALL}{lamp}</scene>')
        assert load_scene(tmp_path / "scene.xml", "llvm_ad_rgb").emission.power.all()
