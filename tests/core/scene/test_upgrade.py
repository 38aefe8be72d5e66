"""Scene files of older Mitsubas: what each of their words becomes, and that the image is the one they meant."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any
from xml.parsers import expat

import mitsuba as mi
import numpy as np
import pytest

from elps_core import device
from elps_core.errors import SceneRejected
from elps_core.scene import known, plugins, rewriting, rules
from elps_core.scene.loader import load_scene
from elps_core.scene.markup import Node, write
from elps_core.scene.upgrade import upgrade
from elps_core.scene.upgrade_bsdfs import internal_reflectance

from .conftest import LIGHT, SENSOR, folder_of

OLD = (0, 6, 0)
TODAY = (3, 0, 0)
VARIANT = "scalar_rgb"


@pytest.fixture(autouse=True, scope="module")
def _variant() -> None:
    device.use(VARIANT)


def tree(text: str) -> Node:
    """A file's elements, unchecked."""
    opened: list[Node] = []
    roots: list[Node] = []
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        node = Node(tag, attributes, parser.CurrentLineNumber)
        (opened[-1].children if opened else roots).append(node)
        opened.append(node)

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: opened.pop()
    parser.Parse(text, True)
    return roots[0]


def upgraded(text: str, version: tuple[int, int, int] = OLD) -> tuple[Node, list[str]]:
    root = tree(text)
    return root, upgrade(root, {"": version})


def one(text: str, version: tuple[int, int, int] = OLD) -> Node:
    """The only element inside a scene, upgraded."""
    (node,) = upgraded(f'<scene version="0.6.0">{text}</scene>', version)[0].children
    return node


def told(text: str, version: tuple[int, int, int] = OLD) -> list[str]:
    return upgraded(f'<scene version="0.6.0">{text}</scene>', version)[1]


def shape_of(node: Node) -> Any:
    """Element, attributes and children, without lines and in an order that does not matter to Mitsuba."""
    parts = [shape_of(child) for child in node.children]
    properties = sorted((part for part in parts if "type" not in part[1] and part[0] != "ref"), key=repr)
    objects = [part for part in parts if "type" in part[1] or part[0] == "ref"]
    return node.tag, dict(node.attributes), properties if node.tag != "transform" else parts, objects


def same(old: str, new: str, version: tuple[int, int, int] = OLD) -> None:
    """``old`` becomes the element ``new``."""
    assert shape_of(one(old, version)) == shape_of(tree(new))


def made(node: Node) -> Any:
    """What Mitsuba makes of an upgraded object, with unknown parameters refused."""
    node.attributes["version"] = "3.0.0"
    return mi.load_string(write(node, {})[0])


def reflected(bsdf: Any, wi: tuple[float, float, float], wo: tuple[float, float, float]) -> float:
    """BSDF times cosine, green, for directions that are given without their length."""
    directions = [np.array(d, float) / np.linalg.norm(d) for d in (wi, wo)]
    si = mi.SurfaceInteraction3f()
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.wi = mi.Vector3f(*directions[0])
    return float(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(*directions[1]))[1])


SLANTED = ((0.6, 0.0, 0.8), (-0.3, 0.4, 0.7))

# Names


@pytest.mark.parametrize(
    "name",
    ["toWorld", "intIOR", "sigmaA", "B", "to_world", "uvScaleXYZ", "maxDepth", "ABc", "x2Y", "_aB", "aBCdE"],
)
def test_names_change_as_mitsuba_changes_them(name: str) -> None:
    text = f'<scene version="0.6.0"><bsdf type="diffuse"><float name="{name}" value="1"/></bsdf></scene>'
    config = mi.parser.ParserConfig(VARIANT)
    state = mi.parser.parse_string(config, text)
    mi.parser.transform_upgrade(config, state)
    ours = upgraded(text)[0].children[0].children[0].attributes["name"]
    assert ours in state.nodes[1].props


def test_a_file_of_today_stays_as_it_is() -> None:
    text = """<scene version="3.0.0"><bsdf type="phong"><float name="maxDepth" value="1"/><rgb name="a" value="#fff"/>
        <spectrum name="radiance" value="1, 2, 3"/></bsdf><emitter type="point"><float name="nonsense" value="1"/>
        </emitter><bsdf type="roughconductor"><string name="distribution" value="as"/></bsdf></scene>"""
    root, warnings = upgraded(text, TODAY)
    assert shape_of(root) == shape_of(tree(text))
    assert warnings == []


def test_an_upgraded_scene_is_not_upgraded_again() -> None:
    assert upgraded('<scene version="0.5.0"/>')[0].attributes == {"version": "3.0.0"}


def test_an_included_object_is_upgraded_as_a_scene_is() -> None:
    root, _ = upgraded('<bsdf type="Diffuse" version="0.6.0"><rgb name="diffuseReflectance" value="1 0 0"/></bsdf>')
    assert shape_of(root) == shape_of(
        tree('<bsdf type="diffuse" version="3.0.0"><rgb name="reflectance" value="1 0 0"/></bsdf>')
    )


# Values


@pytest.mark.parametrize(
    ("old", "value"),
    [
        ('<rgb name="reflectance" value="#ff8000"/>', (1.0, 128 / 255, 0.0)),  # linear: only <srgb> is encoded
        ('<rgb name="reflectance" value="1, 0.5, 0" intent="illuminant"/>', (1.0, 0.5, 0.0)),
        ('<srgb name="reflectance" value="#ff8000"/>', (1.0, ((128 / 255 + 0.055) / 1.055) ** 2.4, 0.0)),
        ('<srgb name="reflectance" value="0.5 0.02 1"/>', (((0.5 + 0.055) / 1.055) ** 2.4, 0.02 / 12.92, 1.0)),
        ('<spectrum name="reflectance" value="1, 0.5, 0"/>', (1.0, 0.5, 0.0)),
        ('<xyz name="reflectance" value="0.475227964 .5 0.544528875"/>', (0.5, 0.5, 0.5)),
    ],
)
def test_colours_are_linear_numbers(old: str, value: tuple[float, ...]) -> None:
    (colour,) = one(f'<bsdf type="diffuse">{old}</bsdf>').children
    assert (colour.tag, set(colour.attributes)) == ("rgb", {"name", "value"})
    found = [float(v) for v in colour.attributes["value"].replace(",", " ").split()]
    assert found == pytest.approx(value, abs=2e-4)


def test_a_curve_and_a_grey_spectrum_stay() -> None:
    for value in ("400:.1, 700:.5", "0.5"):
        same(f'<bsdf type="diffuse"><spectrum name="reflectance" value="{value}"/></bsdf>',
             f'<bsdf type="diffuse"><spectrum name="reflectance" value="{value}"/></bsdf>')  # fmt: skip


def test_a_black_body_is_planck_s_curve() -> None:
    """Against Mitsuba's own plugin, which makes no colour of it."""
    text = '<emitter type="constant"><blackbody name="radiance" temperature="5000K" scale="0.1"/></emitter>'
    (curve,) = one(text).children
    mi.set_variant("scalar_spectral")
    try:
        plugin = mi.load_dict({"type": "blackbody", "temperature": 5000.0})
        si = mi.SurfaceInteraction3f()
        for part in curve.attributes["value"].split(", "):
            wavelength, value = (float(number) for number in part.split(":"))
            si.wavelengths = mi.Spectrum(wavelength)
            assert value == pytest.approx(0.1 * float(plugin.eval(si)[0]), rel=1e-4)
    finally:
        mi.set_variant(VARIANT)
    assert wavelength == 830


def test_a_lookat_of_before_0_3_looks_at_a_mirror_image() -> None:
    same(
        """<camera type="perspective"><transform name="toWorld">
            <lookAt ox="1" oy="2" oz="3" tx="0" ty="0" tz="0" uy="1"/></transform></camera>""",
        """<sensor type="perspective"><string name="fov_axis" value="smaller"/><transform name="to_world">
            <scale x="-1"/><scale x="-1"/><lookat origin="1, 2, 3" target="0, 0, 0" up="0, 1, 0"/>
            </transform></sensor>""",
        (0, 2, 0),
    )


def test_an_animation_stands_at_its_first_keyframe() -> None:
    text = """<shape type="sphere"><animation name="toWorld"><transform time="1"><translate x="9"/></transform>
        <transform time="0"><translate x="2"/></transform></animation></shape>"""
    same(text, '<shape type="sphere"><transform name="to_world"><translate x="2"/></transform></shape>')
    assert "first keyframe" in told(text)[0]


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


# Materials


def test_metals_are_copper_where_the_file_does_not_say() -> None:
    for kind in ("conductor", "roughconductor"):
        same(f'<bsdf type="{kind}"/>', f'<bsdf type="{kind}"><string name="material" value="Cu"/></bsdf>')
    given = '<bsdf type="conductor"><spectrum name="eta" value="400:1, 700:2"/><spectrum name="k" value="3"/>{}</bsdf>'
    same(given.format('<string name="material" value="Au"/><string name="extEta" value="air"/>'), given.format(""))
    same('<bsdf type="conductor"><float name="eta" value="3"/><float name="k" value="6"/>'
         '<float name="extEta" value="1.5"/></bsdf>',
         '<bsdf type="conductor"><float name="eta" value="2"/><float name="k" value="4"/></bsdf>')  # fmt: skip
    with pytest.raises(SceneRejected, match="give both"):
        one('<bsdf type="conductor"><float name="eta" value="3"/></bsdf>')
    with pytest.raises(SceneRejected, match="denser than air"):
        one('<bsdf type="conductor"><float name="extEta" value="1.33"/></bsdf>')


def test_a_rough_diffuse_material_is_diffuse() -> None:
    text = '<bsdf type="roughdiffuse"><rgb name="reflectance" value=".7 1 .7"/><float name="alpha" value=".4"/></bsdf>'
    same(text, '<bsdf type="diffuse"><rgb name="reflectance" value=".7 1 .7"/></bsdf>')
    (line,) = told(text)
    assert line.startswith("<bsdf type=\"diffuse\"> (line 1) stands for 'roughdiffuse'")


def test_reflectance_above_one_is_scaled_down_as_0_6_did() -> None:
    text = '<bsdf type="dielectric"><rgb name="specularReflectance" value="2 1 0"/></bsdf>'
    same(text, '<bsdf type="dielectric"><rgb name="specular_reflectance" value="1, 0.5, 0"/></bsdf>')
    assert "specular_reflectance is scaled down" in told(text)[0]


@pytest.mark.parametrize(
    ("text", "height"),
    [
        ('<bsdf type="phong"><float name="exponent" value="98"/>{}</bsdf>', 100 / (2 * math.pi)),
        ('<bsdf type="ward"><float name="alphaU" value="0.1"/><float name="alphaV" value="0.2"/>{}</bsdf>',
         1 / (4 * math.pi * 0.1 * 0.2)),
    ],
)  # fmt: skip
def test_two_lobes_have_their_height_and_their_energy(text: str, height: float) -> None:
    """At normal incidence: the formula of 0.6 at the peak, and what is reflected in all."""
    colours = '<rgb name="diffuseReflectance" value="0.4"/><rgb name="specularReflectance" value="0.3"/>'
    bsdf = made(one(text.format(colours)))
    up = (0.0, 0.0, 1.0)
    assert reflected(bsdf, up, up) == pytest.approx(0.4 / math.pi + 0.3 * height, rel=1e-3)
    theta, phi = np.meshgrid((np.arange(200) + 0.5) * math.pi / 400, (np.arange(24) + 0.5) * math.pi / 12)
    cosine = np.cos(theta).ravel()
    directions = zip((np.sin(theta) * np.cos(phi)).ravel(), (np.sin(theta) * np.sin(phi)).ravel(), cosine, strict=True)
    values = np.array([reflected(bsdf, up, d) for d in directions])
    total = (values * np.sin(theta).ravel()).sum() * (math.pi / 400) * (math.pi / 12)
    assert total == pytest.approx(0.7, rel=0.02)


def test_two_lobes_above_one_are_scaled_as_0_6_did() -> None:
    same(
        """<bsdf type="phong"><float name="exponent" value="48"/>
        <texture type="bitmap" name="diffuseReflectance"><string name="filename" value="a.png"/></texture>
        <rgb name="specularReflectance" value="0.25"/></bsdf>""",
        """<bsdf type="blendbsdf"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
        <string name="filename" value="a.png"/></texture></bsdf><bsdf type="roughconductor">
        <rgb name="specular_reflectance" value="1"/><string name="material" value="none"/>
        <string name="distribution" value="beckmann"/><float name="alpha" value="0.1"/></bsdf>
        <float name="weight" value="0.2"/></bsdf>""",
    )


@pytest.mark.parametrize("base", ['<bsdf type="diffuse"><rgb name="reflectance" value="0.6"/></bsdf>', '<ref id="b"/>'])
def test_a_coat_over_a_diffuse_base_loses_what_it_throws_back(base: str) -> None:
    """0.6: (1 - F(wi)) (1 - F(wo)) / eta^2 of the base, and nothing of what stays inside the coat."""
    root, warnings = upgraded(
        f"""<scene version="0.6.0"><bsdf type="diffuse" id="b"><rgb name="reflectance" value="0.6"/></bsdf>
        <bsdf type="coating"><float name="intIOR" value="1.5"/><float name="extIOR" value="1"/>{base}</bsdf></scene>"""
    )
    wi, wo = (np.array(d) / np.linalg.norm(d) for d in SLANTED)
    through = [1 - float(mi.fresnel(d[2], 1.5)[0]) for d in (wi, wo)]
    expected = 0.6 / math.pi * through[0] * through[1] / 1.5**2 * wo[2]
    assert reflected(made(root.children[1]), *SLANTED) == pytest.approx(expected, rel=1e-5)
    assert warnings == []


def test_internal_reflectance_is_the_one_that_plastic_divides_by() -> None:
    for index in (1.05, 1.33, 1.5, 2.4):
        assert internal_reflectance(index) == pytest.approx(float(mi.fresnel_diffuse_reflectance(1 / index)), rel=1e-6)


def test_a_coat_over_another_base_is_a_share_of_mirror() -> None:
    metal = '<bsdf type="roughconductor"><string name="material" value="Ag"/></bsdf>'
    text = f"""<bsdf type="roughcoating"><float name="intIOR" value="1.5"/><float name="extIOR" value="1"/>
        <float name="alpha" value="0.3"/>{metal}</bsdf>"""
    same(
        text,
        f"""<bsdf type="blendbsdf">{metal}<bsdf type="roughconductor"><float name="alpha" value="0.3"/>
        <string name="material" value="none"/></bsdf><float name="weight" value="0.04"/></bsdf>""",
    )
    assert "its coat reflects alike" in told(text)[0]
    with pytest.raises(SceneRejected, match="absorbs"):
        one('<bsdf type="coating"><rgb name="sigmaA" value="0 1 0"/><bsdf type="diffuse"/></bsdf>')
    with pytest.raises(SceneRejected, match="one material"):
        one('<bsdf type="coating"/>')


def test_a_mixture_is_a_weighted_sum() -> None:
    greys = "".join(f'<bsdf type="diffuse"><float name="reflectance" value="{g}"/></bsdf>' for g in (0.9, 0.3, 0.6))
    for weights, expected in (("0.5, 0.2, 0.1", 0.57), ("0.2 0.2 0.6", 0.6), ("2; 1; 1", 0.675), ("1, 0, 0", 0.9)):
        bsdf = made(one(f'<bsdf type="mixturebsdf"><string name="weights" value="{weights}"/>{greys}</bsdf>'))
        assert reflected(bsdf, (0, 0, 1), (0, 0, 1)) * math.pi == pytest.approx(expected, rel=1e-5)
    for weights in ("0.5, 0.5", "-1, 1, 1", "a, b, c", "0, 0, 0", ""):
        with pytest.raises(SceneRejected, match=r"mixturebsdf.* needs"):
            one(f'<bsdf type="mixturebsdf"><string name="weights" value="{weights}"/>{greys}</bsdf>')


def test_a_mixture_of_very_many_is_refused_before_it_nests() -> None:
    body = '<bsdf type="diffuse"/>' * 5000
    with pytest.raises(SceneRejected, match="at most 32"):
        one(f'<bsdf type="mixturebsdf"><string name="weights" value="{"1 " * 5000}"/>{body}</bsdf>')


def test_a_diffuse_transmitter_transmits_diffusely() -> None:
    bsdf = made(one('<bsdf type="difftrans"><rgb name="transmittance" value="0.4"/></bsdf>'))
    (x, y, z), wo = SLANTED
    assert reflected(bsdf, (x, y, z), (wo[0], wo[1], -wo[2])) == pytest.approx(
        0.4 / math.pi * wo[2] / math.hypot(*wo), rel=1e-5
    )
    for direction in ((-x, -y, z), wo):
        assert reflected(bsdf, (x, y, z), direction) == 0.0


DOCUMENTED = [
    '<bsdf type="plastic"><boolean name="preserveColors" value="true"/><spectrum name="specularReflectance" value="1"/>'
    '<srgb name="diffuseReflectance" value="#18455c"/><float name="intIOR" value="1.9"/></bsdf>',
    '<bsdf type="roughplastic"><string name="distribution" value="GGX"/><boolean name="nonlinear" value="true"/>'
    '<rgb name="diffuseReflectance" value="0"/><float name="alpha" value="0.15"/></bsdf>',
    '<bsdf type="thindielectric"><string name="intIOR" value="Acrylic Glass"/></bsdf>',
    '<bsdf type="roughdielectric"><string name="distribution" value="as"/><float name="alphaU" value=".1"/>'
    '<float name="alphaV" value=".3"/><string name="extIOR" value="air"/></bsdf>',
    '<bsdf type="roughconductor"><float name="extEta" value="1.0"/><srgb name="specularReflectance" value="1 1 1"/>'
    '<boolean name="sampleVisible" value="false"/></bsdf>',
    '<bsdf type="conductor"><rgb name="eta" value="1.65 0.88 0.52"/><rgb name="k" value="9.2 6.2 4.8"/></bsdf>',
    '<bsdf type="mask"><spectrum name="opacity" value="0.5"/><bsdf type="diffuse"/></bsdf>',
    '<bsdf type="blendbsdf"><texture name="weight" type="checkerboard"/><bsdf type="conductor"/>'
    '<bsdf type="phong"/></bsdf>',
    '<bsdf type="coating"><bsdf type="mixturebsdf"><string name="weights" value=".5 .3"/><bsdf type="diffuse"/>'
    '<bsdf type="difftrans"/></bsdf></bsdf>',
    '<bsdf type="coating"><float name="thickness" value="2"/><bsdf type="roughdiffuse"/></bsdf>',
    '<bsdf type="bumpmap"><texture type="checkerboard"/><bsdf type="ward"><string name="variant" value="ward"/>'
    "</bsdf></bsdf>",
    '<bsdf type="twosided"><bsdf type="ward"/><bsdf type="lambertian"/></bsdf>',
    '<bsdf type="dielectric"><rgb name="specularTransmittance" value="255 102 102"/></bsdf>',
    '<medium type="heterogeneous"><string name="method" value="woodcock"/><volume name="density" type="constvolume">'
    '<float name="value" value="1"/></volume><volume name="albedo" type="constvolume"><rgb name="value" value=".5"/>'
    '</volume><float name="scale" value="100"/><phase type="mixturephase"><string name="weights" value="1 3"/>'
    '<phase type="isotropic"/><phase type="hg"/></phase></medium>',
    '<sensor type="perspective"><float name="focusDistance" value="3"/><string name="focalLength" value="50mm"/>'
    "</sensor>",
    '<sensor type="orthographic"><transform name="toWorld"><scale x="10" y="10"/></transform></sensor>',
    '<emitter type="directional"><vector name="direction" x="1" y="0" z="0"/><float name="samplingWeight" value="3"/>'
    '<spectrum name="irradiance" value="400:3, 700:4"/></emitter>',
    '<shape type="cylinder"><point name="p0" x="0" y="0" z="0"/><boolean name="flipNormals" value="true"/></shape>',
]  # fmt: skip
"""Objects in the style of the manual of Mitsuba 0.6."""


@pytest.mark.parametrize("text", DOCUMENTED)
def test_what_the_manual_of_0_6_shows_can_be_made(text: str) -> None:
    assert made(one(text)) is not None


@pytest.mark.parametrize("given", ["as", "phong", "Beckmann", "GGX"])
def test_distributions_that_have_gone_are_beckmann(given: str) -> None:
    text = f'<bsdf type="roughplastic"><string name="distribution" value="{given}"/></bsdf>'
    known_name = given.lower() in ("beckmann", "ggx")
    new = given.lower() if known_name else "beckmann"
    same(text, f'<bsdf type="roughplastic"><string name="distribution" value="{new}"/></bsdf>')
    assert bool(told(text)) is not known_name


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('<bsdf type="hk"/>', "'?hk.*has gone from Mitsuba: replace"),
        ('<bsdf type="twosided"><bsdf type="irawan"/></bsdf>', "irawan.*has gone"),
        ('<shape type="sphere"><subsurface type="dipole"/></shape>', "dipole.*has gone.*medium"),
        ('<sensor type="spherical"/>', "spherical.*has gone.*perspective"),
        ('<shape type="hair"/>', "hair.*bsplinecurve"),
        ('<texture type="wireframe"/>', "wireframe.*bitmap"),
        ('<emitter type="collimated"/>', "collimated.*directionalarea"),
    ],
)
def test_what_has_gone_is_refused_by_name_line_and_cure(text: str, words: str) -> None:
    with pytest.raises(SceneRejected, match=words) as caught:
        one("\n" + text)
    assert "(line 2)" in str(caught.value)
    assert "\n" not in str(caught.value)


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


# What no image depends on

FILM = """<film type="hdrfilm"><integer name="width" value="8"/><boolean name="banner" value="false"/>
    <float name="gamma" value="2.2"/><string name="pixel_format" value="luminanceAlpha"/>
    <string name="component_format" value="half"/>{}</film>"""


@pytest.mark.parametrize("version", [OLD, (2, 1, 0), TODAY])
def test_what_a_film_does_not_know_is_left_out_with_one_warning(version: tuple[int, int, int]) -> None:
    text = (
        FILM.format('<rfilter type="wsinc"/>') + '<shape type="obj"><float name="max_smooth_angle" value="3"/></shape>'
    )
    root, warnings = upgraded(f'<scene version="3.0.0">{text}</scene>', version)
    assert shape_of(root.children[0]) == shape_of(
        tree(
            """<film type="hdrfilm"><integer name="width" value="8"/>
            <string name="pixel_format" value="luminance_alpha"/><rfilter type="gaussian"/></film>"""
        )
    )
    assert warnings == [
        "<rfilter type=\"gaussian\"> (line 3) stands for 'wsinc', which today's Mitsuba does not have",
        'left out, as today\'s Mitsuba does not know it: banner of <film type="hdrfilm"> (line 1), '
        'gamma of <film type="hdrfilm"> (line 1), component_format of <film type="hdrfilm"> (line 1), '
        'max_smooth_angle of <shape type="obj"> (line 3)',
    ]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('<film type="ldrfilm"><string name="tonemapMethod" value="reinhard"/></film>', '<film type="hdrfilm"/>'),
        ('<film type="mfilm"/>', '<film type="hdrfilm"><string name="pixel_format" value="luminance"/></film>'),
        ('<sampler type="sobol"><integer name="sampleCount" value="4"/><integer name="scramble" value="1"/></sampler>',
         '<sampler type="independent"><integer name="sample_count" value="4"/></sampler>'),
        ('<integrator type="adaptive"><float name="maxError" value="1"/><integrator type="path">'
         '<integer name="maxDepth" value="4"/></integrator></integrator>',
         '<integrator type="adaptive"><integrator type="path"><integer name="max_depth" value="4"/></integrator>'
         "</integrator>"),
        ('<integrator type="my own"><sampler type="x"/></integrator>', '<integrator type="my own"/>'),
    ],
)  # fmt: skip
def test_films_samplers_and_integrators_are_advice(old: str, new: str) -> None:
    same(old, new)


@pytest.mark.parametrize(("tag", "plugin"), [(tag, p) for tag, group in known.PARAMETERS.items() for p in group])
def test_the_lists_of_parameters_are_mitsuba_s(tag: str, plugin: str) -> None:
    """Every listed parameter is taken; others, of 0.6 or of other plugins, are not."""
    values = {"pixel_format": "rgb", "component_format": "float32", "file_format": "openexr"}
    every = frozenset().union(*known.PARAMETERS[tag].values()) | {
        "gamma",
        "high_quality_edges",
        "attach_log",
        "scramble",
    }
    # One film takes a spectrum's response, in a spectral variant only.
    mi.set_variant("scalar_spectral" if plugin == "specfilm" else VARIANT)
    try:
        for name in sorted(every):
            band = '<spectrum name="band" value="400:1, 700:1"/>' if plugin == "specfilm" else ""
            text = f'<{tag} version="3.0.0" type="{plugin}">{band}'
            number = 0 if "offset" in name else 4  # The crop must stay inside, and no sample is no sampler
            options = [f'<string name="{name}" value="{values.get(name, "")}"/>']
            options += [f'<integer name="{name}" value="{number}"/>', f'<boolean name="{name}" value="true"/>']
            taken = False
            for option in options:
                try:
                    mi.load_string(f"{text}{option}</{tag}>")
                    taken = True
                except RuntimeError:
                    continue
            assert taken is (name in known.PARAMETERS[tag][plugin]), name
    finally:
        mi.set_variant(VARIANT)


# Through the loader

MATERIALS_0_6 = b"""<scene version="0.6.0">
    <bsdf type="diffuse" id="base"><srgb name="diffuseReflectance" value="#bcbcbc"/></bsdf>
    <bsdf type="roughdiffuse" id="wall"/></scene>"""
PARTS = """<scene version="{}">{}<include filename="materials.xml"/>
    <bsdf type="twosided" id="coated"><bsdf type="{}"/></bsdf>
    <shape type="rectangle"><ref id="base"/></shape><shape type="sphere"><ref id="wall"/></shape>{}</scene>"""


def test_each_file_is_of_its_own_version(tmp_path: Path) -> None:
    """Names of 0.6 are taken in the included file, and not in that of today, which is held to today's."""
    files = {"materials.xml": MATERIALS_0_6, "scene.xml": PARTS.format("3.0.0", SENSOR, "diffuse", LIGHT).encode()}
    scene = load_scene(folder_of(tmp_path / "a", files), VARIANT)
    assert scene.summary.bsdfs == ("diffuse",)
    (warning,) = scene.summary.warnings
    assert warning.startswith("<bsdf type=\"diffuse\"> (line 3 of 'materials.xml') stands for 'roughdiffuse'")
    files["scene.xml"] = PARTS.format("3.0.0", SENSOR, "roughdiffuse", LIGHT).encode()
    with pytest.raises(SceneRejected, match=r"roughdiffuse.*not one that a scene may use"):
        load_scene(folder_of(tmp_path / "b", files), VARIANT)


def test_a_material_may_be_in_another_file_than_its_coat(tmp_path: Path) -> None:
    coat = '<bsdf type="coating"><ref id="base"/></bsdf>'
    shape = f'<include filename="materials.xml"/><shape type="cube">{coat}</shape>'
    text = f'<scene version="0.6.0">{SENSOR}{LIGHT}{shape}</scene>'
    scene = load_scene(folder_of(tmp_path / "a", {"materials.xml": MATERIALS_0_6, "scene.xml": text.encode()}), VARIANT)
    assert scene.summary.bsdfs == ("blendbsdf", "plastic")


@pytest.mark.parametrize("version", ["", ' version="0.6.0"', ' version="2.1.0"'])
def test_a_single_included_element_has_a_version_or_that_of_its_place(version: str, tmp_path: Path) -> None:
    part = f'<bsdf type="diffuse" id="x"{version}><rgb name="reflectance" value="0 0 1"/></bsdf>'.encode()
    shape = '<include filename="part.xml"/><shape type="cube"><ref id="x"/></shape>'
    text = f'<scene version="0.6.0">{SENSOR}{LIGHT}{shape}</scene>'
    files = {"part.xml": part, "scene.xml": text.encode()}
    assert load_scene(folder_of(tmp_path / "a", files), VARIANT).summary.shapes == 1


@pytest.mark.parametrize(
    "text",
    [
        '<shape type="BLENDER"/>',
        '<bsdf type="Measured"><string name="fileName" value="a.bsdf"/></bsdf>',
        '<shape type="../Evil"/>',
        '<luminaire type="EllipsoidsMesh"/>',
        '<bsdf type="conductor"><string name="material" value="../../etc"/></bsdf>',
        '<shape type="ply"><string name="fileName" value="/etc/passwd"/></shape>',
        '<camera type="perspective" version="3.0.0"/>',
        '<bsdf type="scale"/>',
        '<film type="evil"/>',
        '<spectrum type="bitmap" fileName="x"/>',
    ],
)
def test_old_spellings_reach_nothing_that_today_s_do_not(text: str, tmp_path: Path) -> None:
    scene = f'<scene version="0.6.0">{SENSOR}{LIGHT}<shape type="cube"/>{text}</scene>'
    with pytest.raises(SceneRejected):
        load_scene(folder_of(tmp_path / "a", {"scene.xml": scene.encode()}), VARIANT)


def test_alike_warnings_are_one_line() -> None:
    assert told('<bsdf type="roughdiffuse"/>\n<bsdf type="roughdiffuse"/>') == [
        "<bsdf type=\"diffuse\"> (line 1) and 1 more stands for 'roughdiffuse' of Mitsuba 0.x: darker at grazing angles"
    ]


def test_copies_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rewriting, "MAX_COPIED", 1000)
    image = '<texture type="bitmap" name="reflectance">' + '<float name="a" value="1"/>' * 100 + "</texture>"
    coats = '<bsdf type="coating"><ref id="b"/></bsdf>' * 10
    with pytest.raises(SceneRejected, match="used too often"):
        upgraded(f'<scene version="0.6.0"><bsdf type="diffuse" id="b">{image}</bsdf>{coats}</scene>')


@pytest.mark.parametrize(
    "text",
    [
        '<bsdf type="coating"><float name="intIOR" value="1e308"/><bsdf type="diffuse"/></bsdf>',
        '<bsdf type="diffuse"><srgb name="reflectance" value="1e300"/></bsdf>',
        '<bsdf type="phong"><float name="exponent" value="1e999"/></bsdf>',
        '<bsdf type="mixturebsdf"><string name="weights" value="1e308 1e308"/><ref id="a"/><ref id="b"/></bsdf>',
        '<emitter type="area"><blackbody name="radiance" temperature="1e-300"/></emitter>',
        '<emitter type="area"><blackbody name="radiance" temperature="K"/></emitter>',
        '<medium type="homogeneous"><rgb name="sigmaT" value="9e37 1 1"/><float name="scale" value="9e37"/></medium>',
        '<texture type="bitmap"><string name="filename"/><float name="gamma"/></texture>',
        '<film/><sampler/><integrator/><rfilter/><rgb/><srgb/><spectrum/><blackbody/><lookAt ox=""/><animation/>',
    ],
)
def test_numbers_without_measure_end_in_a_refusal_at_the_latest_by_the_rules(text: str) -> None:
    try:
        root, _ = upgraded(f'<scene version="0.6.0">{text}</scene>')
    except SceneRejected:
        return
    assert not any(word in write(root, {})[0] for word in ('"nan', "1e+300"))
    try:
        rules.check(root)
    except SceneRejected:
        return
    assert "1e3" not in write(root, {})[0]


def test_warnings_are_few_and_show_no_odd_characters() -> None:
    lines = told("".join(f'<sampler type="a\u200b{i}"/>' for i in range(200)))
    assert len(lines) == rewriting.MAX_WARNINGS
    assert lines[-1] == "and 151 other warnings"
    assert "a?0" in lines[0]


# Whole scenes

CORNELL_0_6 = """<?xml version="1.0" encoding="utf-8"?>
<scene version="0.5.0">
    <integrator type="path"><integer name="maxDepth" value="4"/></integrator>
    <sensor type="perspective"><string name="fovAxis" value="smaller"/><float name="nearClip" value="1"/>
        <float name="farClip" value="2800"/><float name="fov" value="80"/>
        <transform name="toWorld"><lookAt origin="278, 273, 20" target="278, 250, 280" up="0, 1, 0"/></transform>
        <sampler type="ldsampler"><integer name="sampleCount" value="4"/></sampler>
        <film type="ldrfilm"><integer name="width" value="8"/><integer name="height" value="6"/>
            <rfilter type="box"/><float name="gamma" value="-1"/></film></sensor>
    <bsdf type="diffuse" id="red"><spectrum name="reflectance" value="400:0.04, 500:0.06, 600:0.5, 700:0.63"/></bsdf>
    <bsdf type="roughplastic" id="floor"><srgb name="diffuseReflectance" value="#808080"/>
        <float name="intIOR" value="1.4"/><float name="alpha" value="0.2"/></bsdf>
    <shape type="cube"><float name="maxSmoothAngle" value="3"/><transform name="toWorld">
        <scale x="278" y="273" z="280"/><translate x="278" y="273" z="279"/></transform>
        <boolean name="flipNormals" value="true"/><ref id="red"/></shape>
    <shape type="rectangle"><transform name="toWorld"><scale value="270"/><rotate x="1" angle="-90"/>
        <translate x="278" y="1" z="279"/></transform><ref id="floor"/></shape>
    <shape type="sphere"><point name="center" x="280" y="400" z="280"/><float name="radius" value="80"/>
        <emitter type="area"><rgb name="radiance" value="18.4, 15.6, 8.0"/></emitter></shape>
</scene>"""
CORNELL_3 = """<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="4"/></integrator>
    <sensor type="perspective"><string name="fov_axis" value="smaller"/><float name="near_clip" value="1"/>
        <float name="far_clip" value="2800"/><float name="fov" value="80"/>
        <transform name="to_world"><lookat origin="278, 273, 20" target="278, 250, 280" up="0, 1, 0"/></transform>
        <sampler type="ldsampler"><integer name="sample_count" value="4"/></sampler>
        <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/>
            <rfilter type="box"/></film></sensor>
    <bsdf type="diffuse" id="red"><spectrum name="reflectance" value="400:0.04, 500:0.06, 600:0.5, 700:0.63"/></bsdf>
    <bsdf type="roughplastic" id="floor"><rgb name="diffuse_reflectance" value="0.215860501"/>
        <float name="int_ior" value="1.4"/><float name="alpha" value="0.2"/></bsdf>
    <shape type="cube"><transform name="to_world">
        <scale x="278" y="273" z="280"/><translate x="278" y="273" z="279"/></transform>
        <boolean name="flip_normals" value="true"/><ref id="red"/></shape>
    <shape type="rectangle"><transform name="to_world"><scale value="270"/><rotate x="1" angle="-90"/>
        <translate x="278" y="1" z="279"/></transform><ref id="floor"/></shape>
    <shape type="sphere"><point name="center" x="280" y="400" z="280"/><float name="radius" value="80"/>
        <emitter type="area"><rgb name="radiance" value="18.4, 15.6, 8.0"/></emitter></shape>
</scene>"""


def test_a_room_of_0_5_is_today_s_room_to_the_bit() -> None:
    old, new = (
        np.array(mi.render(mi.load_string(text), seed=3, spp=4))
        for text in (write(upgraded(CORNELL_0_6, (0, 5, 0))[0], {})[0], CORNELL_3)
    )
    assert old.mean() > 0.1
    assert np.array_equal(old, new)


BLENDER_0_6 = """<scene version="0.6.0">
    <integrator id="integrator" type="volpath"><integer name="maxDepth" value="-1"/>
        <boolean name="hideEmitters" value="true"/></integrator>
    <sensor id="Camera-camera" type="perspective"><transform name="toWorld"><scale x="-1.0"/>
        <matrix value="1 0 0 0 0 0.8 0.6 -6 0 -0.6 0.8 -6 0 0 0 1"/><scale x="1" y="1" z="1"/>
        </transform><string name="fovAxis" value="x"/><float name="fov" value="49.1"/>
        <float name="shutterOpen" value="0"/><float name="shutterClose" value="0"/>
        <sampler id="sampler" type="sobol"><integer name="sampleCount" value="16"/></sampler>
        <film id="film" type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="4"/>
            <string name="fileFormat" value="openexr"/><string name="pixelFormat" value="rgba"/>
            <string name="componentFormat" value="float16"/><boolean name="banner" value="false"/>
            <boolean name="attachLog" value="true"/><boolean name="highQualityEdges" value="true"/>
            <rfilter type="mitchell"><float name="B" value="0.3"/></rfilter></film></sensor>
    <bsdf type="twosided" id="Wood-material"><bsdf type="mixturebsdf"><string name="weights" value="0.7, 0.2"/>
        <bsdf type="roughdiffuse"><rgb name="reflectance" value=".7 .6 .5"/><float name="alpha" value=".2"/></bsdf>
        <bsdf type="roughconductor"><string name="distribution" value="phong"/><string name="material" value="Au"/>
        <float name="alphaU" value=".1"/><float name="alphaV" value=".2"/></bsdf></bsdf></bsdf>
    <bsdf type="bumpmap" id="Bumpy"><texture type="scale"><float name="scale" value="4"/>
        <texture type="checkerboard"><float name="uscale" value="8"/></texture></texture>
        <bsdf type="coating"><float name="intIOR" value="1.6"/><bsdf type="diffuse"/></bsdf></bsdf>
    <bsdf type="dielectric" id="Glass"><string name="intIOR" value="bk7"/><string name="extIOR" value="air"/>
        <spectrum name="specularTransmittance" value="0.9"/></bsdf>
    <shape id="Cube" type="cube"><ref name="bsdf" id="Wood-material"/></shape>
    <shape id="Ball" type="sphere"><ref id="Glass"/></shape>
    <shape id="Floor" type="rectangle"><ref id="Bumpy"/></shape>
    <emitter type="sunsky" id="Sun"><vector name="sunDirection" x="0.4" y="0.7" z="0.2"/>
        <float name="turbidity" value="3"/><integer name="resolution" value="512"/></emitter>
</scene>"""


@pytest.mark.parametrize("text", [BLENDER_0_6, CORNELL_0_6])
def test_what_comes_out_passes_the_checks(text: str) -> None:
    root, _ = upgraded(text)
    todo = [root]
    while todo:
        node = todo.pop()
        assert set(node.attributes) <= plugins.ATTRIBUTES[node.tag], node
        todo += node.children
    root.children = [child for child in root.children if child.tag != "integrator"]
    rules.check(root)


def test_a_scene_of_blender_s_exporter_loads_and_says_what_it_changed() -> None:
    root, warnings = upgraded(BLENDER_0_6)
    scene = mi.load_string(write(root, {})[0])
    assert (len(scene.shapes()), len(scene.emitters()), len(scene.sensors())) == (3, 1, 1)
    assert np.isfinite(np.array(mi.render(scene, spp=1))).all()
    text = "\n".join(warnings)
    for words in ("roughdiffuse", "'phong'", "'sunsky'", "'sobol'", "banner", "attach_log", "high_quality_edges"):
        assert words in text
    assert all("\n" not in line and "line" in line for line in warnings)
