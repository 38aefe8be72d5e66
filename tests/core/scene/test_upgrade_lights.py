"""Emitters, sensors, media and textures of Mitsuba 0.x: what becomes of each, and that its image is the old one."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from elps_core import device
from elps_core.errors import SceneRejected
from elps_core.scene.markup import write

from .upgrading import OLD, TODAY, VARIANT, made, one, same, told, upgraded


@pytest.fixture(autouse=True, scope="module")
def _variant() -> None:
    device.use(VARIANT)


# Textures


def test_offset_and_scale_of_a_texture_move_it_as_0_6_did() -> None:
    """0.6 scales first: u' = u * scale + offset. Mitsuba's own step agrees where only one of the two is given."""
    texture = one(
        """<texture type="checkerboard"><float name="uoffset" value=".25"/><float name="uscale" value="4"/>
        <rgb name="color0" value="1"/><rgb name="color1" value="0"/></texture>"""
    )
    si = mi.SurfaceInteraction3f()
    plain = mi.load_dict({"type": "checkerboard", "color0": {"type": "rgb", "value": 1.0},
                          "color1": {"type": "rgb", "value": 0.0}})  # fmt: skip
    for u in np.linspace(0.01, 0.99, 23):
        si.uv = mi.Point2f(u, 0.1)
        found = float(made(texture).eval(si)[0])
        si.uv = mi.Point2f(4 * u + 0.25, 0.1)
        assert found == float(plain.eval(si)[0])


def test_a_scale_of_both_directions_gives_way_to_that_of_one() -> None:
    same('<texture type="checkerboard"><float name="uvscale" value="4"/><float name="vscale" value="2"/></texture>',
         '<texture type="checkerboard"><transform name="to_uv"><scale x="4" y="2"/></transform></texture>')  # fmt: skip


@pytest.mark.parametrize("name", ["uoffset", "voffset", "uscale", "vscale"])
def test_a_single_offset_or_scale_is_mitsuba_s_own(name: str) -> None:
    text = f'<scene version="0.6.0"><texture type="checkerboard"><float name="{name}" value="3"/></texture></scene>'
    config = mi.parser.ParserConfig(VARIANT)
    state = mi.parser.parse_string(config, text)
    mi.parser.transform_upgrade(config, state)
    ours = mi.parser.parse_string(config, write(upgraded(text)[0], {})[0])
    assert np.allclose(ours.nodes[1].props["to_uv"].matrix, state.nodes[1].props["to_uv"].matrix)


BITMAP = '<texture type="bitmap"><string name="filename" value="{}"/>{}</texture>'


@pytest.mark.parametrize("version", [OLD, (2, 2, 1), TODAY])
@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('<float name="gamma" value="1.0"/>', '<boolean name="raw" value="true"/>'),
        ('<float name="gamma" value="2.2"/>', ""),
        ('<string name="filter_type" value="ewa"/><float name="max_anisotropy" value="20"/>', ""),
        ('<string name="filter_type" value="nearest"/>', '<string name="filter_type" value="nearest"/>'),
        ('<boolean name="cache" value="false"/>', ""),
        ('<string name="wrap_mode" value="mirror"/>', '<string name="wrap_mode" value="mirror"/>'),
        ('<string name="wrap_mode" value="zero"/>', '<string name="wrap_mode" value="clamp"/>'),
        ('<string name="wrap_mode_u" value="clamp"/><string name="wrap_mode_v" value="clamp"/>',
         '<string name="wrap_mode" value="clamp"/>'),
        ('<string name="wrap_mode_u" value="mirror"/>', '<string name="wrap_mode" value="mirror"/>'),
    ],
)  # fmt: skip
def test_an_image_keeps_what_changes_it(old: str, new: str, version: tuple[int, int, int]) -> None:
    same(BITMAP.format("a.png", old), BITMAP.format("a.png", new), version)


def test_an_exr_is_linear_without_being_told() -> None:
    same(BITMAP.format("a.EXR", '<float name="gamma" value="1"/>'), BITMAP.format("a.EXR", ""))


def test_scales_go_into_what_they_scale() -> None:
    scale = '<texture type="scale" name="{}"><float name="scale" value="0.5"/>{}</texture>'
    image = '<texture type="bitmap" name="{}"><string name="filename" value="a.png"/></texture>'
    same('<bsdf type="roughplastic">' + scale.format("diffuseReflectance", '<rgb name="value" value="1 .5 0"/>')
         + "</bsdf>",
         '<bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="0.5, 0.25, 0"/></bsdf>')  # fmt: skip
    same('<bsdf type="bumpmap">' + scale.format("", image.format("")) + '<bsdf type="diffuse"/></bsdf>',
         '<bsdf type="bumpmap"><texture type="bitmap"><string name="filename" value="a.png"/></texture>'
         '<bsdf type="diffuse"/><float name="scale" value="0.5"/></bsdf>')  # fmt: skip
    black = '<bsdf type="diffuse"><float name="reflectance" value="0"/></bsdf>'
    same('<bsdf type="diffuse">' + scale.format("reflectance", image.format("")) + "</bsdf>",
         f'<bsdf type="blendbsdf">{black}<bsdf type="diffuse">{image.format("reflectance")}</bsdf>'
         '<float name="weight" value="0.5"/></bsdf>')  # fmt: skip
    with pytest.raises(SceneRejected, match="scales a texture"):
        one('<bsdf type="plastic">' + scale.format("diffuseReflectance", image.format("")) + "</bsdf>")


def test_a_scaled_texture_may_be_referred_to() -> None:
    root, _ = upgraded(
        """<scene version="0.6.0"><texture type="scale" id="t"><float name="scale" value="2"/>
        <texture type="bitmap"><string name="filename" value="a.png"/></texture></texture>
        <bsdf type="bumpmap"><ref id="t"/><bsdf type="diffuse"/></bsdf></scene>"""
    )
    (bump,) = root.children
    assert [child.type for child in bump.children] == ["bitmap", "diffuse", ""]
    assert bump.children[2].attributes == {"name": "scale", "value": "2"}


# Light


def sun_of(text: str) -> np.ndarray:
    """Where an upgraded sky has its sun, in the world."""
    scene = mi.load_string(write(upgraded(f'<scene version="0.6.0">{text}<shape type="sphere"/></scene>')[0], {})[0])
    direction, _ = scene.emitters()[0].sample_direction(mi.Interaction3f(), mi.Point2f(0.9999999, 0.5))
    return np.array(direction.d).ravel()


def test_a_sky_of_0_6_has_y_up_and_its_sun_where_it_was() -> None:
    """At 3 pm the sun of Tokyo is in the west, which is -x in 0.6, a little south, which is +z."""
    west = sun_of('<emitter type="sunsky"/>')
    assert west == pytest.approx([-0.6916, 0.7201, 0.0560], abs=2e-3)
    morning = sun_of('<emitter type="sunsky"><float name="hour" value="9"/></emitter>')
    assert morning == pytest.approx([0.6146, 0.7824, 0.1003], abs=6e-3)


@pytest.mark.parametrize("turn", ["", '<transform name="toWorld"><rotate x="1" angle="90"/></transform>'])
def test_the_sun_s_direction_is_one_of_the_world(turn: str) -> None:
    wanted = np.array([0.3, 0.5, 0.6])
    sun = sun_of(f'<emitter type="sun"><vector name="sunDirection" x=".3" y=".5" z=".6"/>{turn}</emitter>')
    assert sun @ wanted / np.linalg.norm(wanted) > 0.9999


def test_parts_of_a_sky_have_their_scales() -> None:
    def scales(text: str) -> dict[str, str]:
        return {c.attributes["name"]: c.attributes.get("value", "") for c in one(text).children}

    sky = scales('<emitter type="sky"><float name="scale" value="3"/><float name="turbidity" value="4"/></emitter>')
    assert (sky["sky_scale"], sky["sun_scale"], sky["albedo"], sky["turbidity"]) == ("3", "0", "0.2", "4")
    sun = scales(
        '<emitter type="sun"><float name="scale" value="3"/><float name="sunRadiusScale" value="2"/></emitter>'
    )
    assert (sun["sun_scale"], sun["sky_scale"], float(sun["sun_aperture"])) == ("3", "0", pytest.approx(1.0716))
    both = scales('<emitter type="sunsky"><float name="scale" value="3"/><float name="skyScale" value="5"/></emitter>')
    assert (both["sun_scale"], both["sky_scale"]) == ("3", "5")
    assert "below the horizon" in told('<emitter type="sky"><float name="stretch" value="1.5"/></emitter>')[0]


def test_a_floor_under_a_sky_of_0_6_is_lit_from_above() -> None:
    scene = """<scene version="0.6.0"><integrator type="path"/><emitter type="sky"/>
        <shape type="rectangle"><transform name="toWorld"><rotate x="1" angle="{}"/></transform></shape>
        <sensor type="perspective"><transform name="toWorld"><lookAt origin="0, {}, 0" target="0, 0, 0" up="0, 0, 1"/>
        </transform><float name="fov" value="20"/><sampler type="independent"/>
        <film type="hdrfilm"><integer name="width" value="2"/><integer name="height" value="2"/></film></sensor>
        </scene>"""
    up, down = (
        np.array(mi.render(mi.load_string(write(upgraded(scene.format(angle, y))[0], {})[0]), spp=64)).mean()
        for angle, y in ((-90, 4), (90, -4))
    )
    assert up > 0.01
    assert down == 0.0


def test_lights_and_cameras_keep_their_meaning() -> None:
    same('<luminaire type="constant"><rgb name="intensity" value="1 2 3" intent="illuminant"/></luminaire>',
         '<emitter type="constant"><rgb name="radiance" value="1 2 3"/></emitter>', (0, 3, 0))  # fmt: skip
    same('<emitter type="spot"><float name="beamWidth" value="9"/><float name="samplingWeight" value="2"/></emitter>',
         '<emitter type="spot"><float name="beam_width" value="9"/><float name="sampling_weight" value="2"/>'
         "</emitter>")  # fmt: skip
    same('<sensor type="thinlens"><float name="apertureRadius" value="1"/><integer name="blades" value="6"/></sensor>',
         '<sensor type="thinlens"><float name="aperture_radius" value="1"/></sensor>')  # fmt: skip
    assert "equal energy" in told('<emitter type="area"><spectrum name="radiance" value="3"/></emitter>')[0]


# Media


def test_media_are_extinction_and_albedo() -> None:
    same(
        """<medium type="homogeneous"><rgb name="sigmaS" value="1 2 3"/><spectrum name="sigmaA" value="1"/>
        <float name="scale" value="2"/><phase type="hg"><float name="g" value=".5"/></phase></medium>""",
        """<medium type="homogeneous"><rgb name="sigma_t" value="0.5, 0.75, 1"/>
        <rgb name="albedo" value="0.5, 0.666666667, 0.75"/><float name="scale" value="8"/>
        <phase type="hg"><float name="g" value=".5"/></phase></medium>""",
    )
    with pytest.raises(SceneRejected, match="preset"):
        one('<medium type="homogeneous"><string name="material" value="ketchup"/></medium>')
    assert made(
        one('<medium type="homogeneous"><rgb name="sigmaT" value="1 2 3"/><rgb name="albedo" value="1"/></medium>')
    )


def test_a_shape_that_only_bounds_a_medium_lets_light_pass() -> None:
    same('<shape type="sphere"><ref name="interior" id="m"/></shape>',
         '<shape type="sphere"><ref name="interior" id="m"/><bsdf type="null"/></shape>')  # fmt: skip
    same('<shape type="sphere"><ref name="interior" id="m"/><ref id="b"/></shape>',
         '<shape type="sphere"><ref name="interior" id="m"/><ref id="b"/></shape>')  # fmt: skip
