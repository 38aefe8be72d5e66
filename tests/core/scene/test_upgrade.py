"""Scene files of older Mitsubas: what each of their words becomes, and that the image is the one they meant."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from elps_core import device
from elps_core.errors import SceneRejected
from elps_core.scene import known, plugins, rewriting, rules
from elps_core.scene.loader import load_scene
from elps_core.scene.markup import write
from elps_core.scene.text import MAX_WARNINGS

from .conftest import LIGHT, SENSOR, folder_of
from .upgrading import OLD, TODAY, VARIANT, one, same, shape_of, told, tree, upgraded


@pytest.fixture(autouse=True, scope="module")
def _variant() -> None:
    device.use(VARIANT)


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
    assert len(lines) == MAX_WARNINGS
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


@pytest.mark.parametrize(
    ("kind", "smooth"), [("roughdielectric", "dielectric"), ("roughplastic", "plastic"), ("pplastic", "plastic")]
)
@pytest.mark.parametrize(("inside", "outside"), [("1.30", "1.3"), ("Water", "1.333"), ("air", None)])
def test_rough_surfaces_between_equal_indices_are_smooth_ones(
    kind: str, smooth: str, inside: str, outside: str | None, tmp_path: Path
) -> None:
    """Mitsuba refuses them. Where nothing is reflected or bent, roughness changes nothing."""

    def written_index(name: str, value: str | None) -> str:
        tag = "string" if value and value[0].isalpha() else "float"
        return f'<{tag} name="{name}" value="{value}"/>' if value else ""

    indices = written_index("int_ior", inside) + written_index("ext_ior", outside)
    rough = '<float name="alpha" value="0.2"/><string name="distribution" value="ggx"/>'
    scene = '<scene version="3.0.0"><shape type="sphere"><bsdf type="{}">{}</bsdf></shape>{}</scene>'
    root, warnings = upgraded(scene.format(kind, rough + indices, SENSOR), TODAY)
    assert shape_of(root) == shape_of(tree(scene.format(smooth, indices, SENSOR)))
    assert warnings == []
    (tmp_path / "a.xml").write_text(scene.format(kind, rough + indices, SENSOR + LIGHT).replace("Water", "water"))
    (shape,) = load_scene(tmp_path / "a.xml", VARIANT).scene.shapes()
    assert shape.bsdf().class_name() == f"Smooth{smooth.capitalize()}"


@pytest.mark.parametrize("index", ["", '<float name="int_ior" value="1.31"/><float name="ext_ior" value="1.3"/>'])
def test_rough_surfaces_between_others_stay_rough(index: str) -> None:
    scene = f'<scene version="3.0.0"><bsdf type="roughplastic">{index}<float name="alpha" value="0.2"/></bsdf></scene>'
    root, _ = upgraded(scene, TODAY)
    assert shape_of(root) == shape_of(tree(scene))
