"""Loading scenes: what is loaded is what the file says, and nothing of it chooses what runs or is opened."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO
import pytest

from elps_core import device
from elps_core.scene import loader, plugins
from elps_core.scene.canonical import canonicalize
from elps_core.scene.loader import load_scene

from .conftest import (
    LIGHT,
    OBJ,
    SENSOR,
    SQUARE,
    VARIANT,
    Reject,
    folder_of,
    load,
    mesh,
    ply,
    scene_xml,
    texture,
    zip_of,
)

# What is taken


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral"])
def test_a_zip_a_folder_and_a_file_load_alike(variant: str, tmp_path: Path) -> None:
    files = {"scene.xml": scene_xml(mesh("obj", "models/a.obj")), "models/a.obj": OBJ}
    folder = folder_of(tmp_path / "folder", files)
    loaded = [load_scene(p, variant) for p in (zip_of(tmp_path / "a.zip", files), folder, folder / "scene.xml")]
    for one in loaded:
        assert one.size == (16, 12)
        assert one.variant == variant
        assert one.summary.triangles == 1
        assert one.digest == loaded[0].digest
        assert len(one.scene.shapes()) == 1


def test_renders_the_same_image_as_mitsuba_itself(tmp_path: Path) -> None:
    """Also with shared materials on rectangles, whose merged mesh Mitsuba leaves without bounds."""
    body = """
        <default name="albedo" value="0.7"/>
        <bsdf type="diffuse" id="grey"><rgb name="reflectance" value="$albedo"/></bsdf>
        <shape type="rectangle"><ref id="grey"/></shape>
        <shape type="rectangle"><ref id="grey"/><transform name="to_world"><rotate y="1" angle="80"/></transform>
        </shape>
        <shape type="obj"><string name="filename" value="a.obj"/></shape>
        <emitter type="constant"/>"""
    folder = folder_of(tmp_path / "folder", {"scene.xml": scene_xml(body), "a.obj": OBJ})
    ours = load_scene(folder, "llvm_ad_rgb")
    mi = device.use("llvm_ad_rgb")
    theirs = mi.load_file(str(folder / "scene.xml"), optimize=False)
    integrator = mi.load_dict({"type": "path", "max_depth": 4})
    images = [np.array(mi.render(scene, integrator=integrator, spp=8, seed=1)) for scene in (ours.scene, theirs)]
    assert images[0].max() > 0
    np.testing.assert_allclose(images[0], images[1], rtol=1e-4, atol=1e-5)


def test_the_summary_counts(tmp_path: Path) -> None:
    body = (
        '<shape type="cube"><emitter type="area"/><bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>'
        + mesh("ply", "a.ply")
        + SENSOR.replace('"16"', '"20"')
    )
    summary = load(tmp_path, scene_xml(body), {"a.ply": ply()}).summary
    assert [(s.type, s.width, s.height) for s in summary.sensors] == [("perspective", 16, 12), ("perspective", 20, 12)]
    assert [(e.type, e.count) for e in summary.emitters] == [("area", 1), ("point", 1)]
    assert summary.bsdfs == ("diffuse", "twosided")
    assert (summary.shapes, summary.triangles, summary.warnings) == (2, 13, ())


def test_media_are_warned_about(tmp_path: Path) -> None:
    medium = '<shape type="cube"><medium type="homogeneous" name="interior"/></shape>'
    warnings = load(tmp_path, scene_xml(medium)).summary.warnings
    assert len(warnings) == 1
    assert "mi_volpath" in warnings[0]


def test_a_scene_without_light_or_shapes_is_warned_about(tmp_path: Path) -> None:
    warnings = load(tmp_path, scene_xml("", light="")).summary.warnings
    assert len(warnings) == 2
    assert "emitters" in warnings[0]
    assert "shapes" in warnings[1]


@pytest.mark.parametrize(
    "sensor",
    [
        SENSOR,
        SENSOR.replace("<film", '<film id="f"'),
        re.sub(r"<film.*</film>", "", SENSOR),
        SENSOR.replace(
            "</film>",
            '<integer name="crop_width" value="4"/><integer name="crop_height" value="3"/>'
            '<integer name="crop_offset_x" value="2"/><integer name="crop_offset_y" value="2"/></film>',
        ),
        re.sub(r"(<film.*</film>)", r"", SENSOR).replace("</sensor>", '<ref id="f"/></sensor>')
        + '<film type="hdrfilm" id="f"><integer name="width" value="8"/><integer name="height" value="8"/></film>',
    ],
    ids=["own", "named", "default", "crop", "reference"],
)
def test_another_size_replaces_film_and_crop(sensor: str, tmp_path: Path) -> None:
    upload = zip_of(tmp_path / "a.zip", {"scene.xml": scene_xml(sensor=sensor + SENSOR)})
    plain = load_scene(upload, VARIANT)
    sized = load_scene(upload, VARIANT, size=(30, 20))
    assert sized.size == (30, 20)
    assert tuple(sized.sensor.film().crop_size()) == (30, 20)
    assert tuple(sized.sensor.film().size()) == (30, 20)
    assert (sized.summary.sensors[1].width, sized.summary.sensors[1].height) == (16, 12)
    assert sized.digest == plain.digest
    assert plain.size != (30, 20)


def test_the_sensor_is_counted_in_file_order(tmp_path: Path, reject: Reject) -> None:
    sensors = "".join(SENSOR.replace('value="16"', f'value="{10 + i}"') for i in range(5))
    upload = zip_of(tmp_path / "a.zip", {"scene.xml": scene_xml(sensor=sensors)})
    for index in range(5):
        loaded = load_scene(upload, VARIANT, sensor=index)
        assert loaded.size == (10 + index, 12)
        assert loaded.sensor.film().size()[0] == 10 + index
    assert "no sensor 5" in reject(load_scene, upload, VARIANT, sensor=5)
    assert "no sensor -1" in reject(load_scene, upload, VARIANT, sensor=-1)


@pytest.mark.parametrize("name", ["path", "elps_bdpt", "volpathmis", "prb", "pssmlt", "../evil", "aov"])
def test_an_integrator_may_be_named_and_does_not_enter(name: str, tmp_path: Path) -> None:
    with_one = load(
        tmp_path, scene_xml(f'<integrator type="{name}"><integer name="max_depth" value="3"/></integrator>' + SQUARE)
    )
    assert with_one.digest == load(tmp_path, scene_xml(SQUARE)).digest


def test_every_allowed_plugin_is_one_of_mitsubas_own() -> None:
    mi = device.use(VARIANT)
    folder = Path(str(mi.__file__)).parent / "plugins"
    built_in = {path.name.split(".")[0] for path in folder.iterdir()}
    named = {name for tag, names in plugins.PLUGINS.items() if tag != "integrator" for name in names}
    assert named <= built_in
    assert {
        name for name in plugins.INTEGRATORS if not name.startswith(("elps_", "prb", "direct_p", "volprim"))
    } <= built_in
    # No other is left without a word.
    refused = {name for _, name in plugins.REFUSED}
    assert not refused & named
    assert built_in == named | refused | (plugins.INTEGRATORS & built_in)


def test_names_of_mitsuba_s_exporter_lose_no_object(tmp_path: Path) -> None:
    """It writes those that objects without a name get: beside one of these, Mitsuba keeps the last alone."""
    lamp = '<bsdf type="diffuse" id="grey"/><shape type="sphere"><ref name="_arg_0" id="grey"/>{}</shape>'
    exported = load(tmp_path, scene_xml(lamp.format("")))
    plain = load(tmp_path, scene_xml(lamp.replace('name="_arg_0" ', "").format("")))
    assert exported.digest == plain.digest
    both = load(tmp_path, scene_xml(lamp.format('<emitter type="area"/>'), light=""))
    assert len(both.scene.emitters()) == 1
    assert both.scene.shapes()[0].bsdf().id() == "grey"
    blend = '<shape type="sphere"><bsdf type="blendbsdf"><float name="weight" value="0"/>{}</bsdf></shape>'
    parts = ['<bsdf type="diffuse" name="{}"><float name="reflectance" value="0.25"/></bsdf>', '<bsdf type="plastic"/>']
    for name in ("_arg_0", "_arg_1", "_arg_9"):
        loaded = load(tmp_path, scene_xml(blend.format("".join(parts).format(name))))
        assert "SmoothDiffuse" in str(loaded.scene.shapes()[0].bsdf()).split("nested_bsdf[1]")[0]


@pytest.mark.parametrize(("tag", "name"), sorted(plugins.REFUSED))
def test_a_plugin_that_is_left_out_is_refused_with_the_cure(
    tag: str, name: str, tmp_path: Path, reject: Reject
) -> None:
    message = reject(load, tmp_path, scene_xml(f'<{tag} type="{name}"><string name="x" value="y"/></{tag}>'))
    assert message.endswith(plugins.REFUSED[tag, name])


@pytest.mark.parametrize("extension", ["png", "jpg", "exr", "hdr", "pfm", "bmp", "tga"])
def test_every_image_format_loads_whole_and_is_refused_cut_off(extension: str, tmp_path: Path, reject: Reject) -> None:
    name = f"a.{extension}"
    output = OpenImageIO.ImageOutput.create(str(tmp_path / name))
    assert output is not None
    deep = extension in ("exr", "hdr", "pfm")
    assert output.open(str(tmp_path / name), OpenImageIO.ImageSpec(64, 64, 3, "float" if deep else "uint8"))
    output.write_image(np.random.default_rng(1).random((64, 64, 3), dtype=np.float32))
    output.close()
    data = (tmp_path / name).read_bytes()
    assert load(tmp_path, scene_xml(texture(name)), {name: data}).summary.shapes == 1
    if extension == "jpg":  # readers fill up what is missing in grey, as browsers do
        return
    assert name in reject(load, tmp_path, scene_xml(texture(name)), {name: data[: len(data) * 2 // 3]})


def test_a_scene_of_several_megabytes_loads_in_seconds(tmp_path: Path) -> None:
    shape = (
        '<shape type="rectangle"><transform name="to_world"><matrix value="1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/>'
        '</transform><ref id="grey"/></shape>'
    )
    xml = scene_xml('<bsdf type="diffuse" id="grey"/>' + shape * 20_000)
    assert len(xml) > 2 * 2**20
    assert load(tmp_path, xml).summary.shapes == 20_000


def test_parameters_are_put_in_as_mitsuba_does(tmp_path: Path) -> None:
    body = (
        '<default name="r" value="1"/><default name="radius" value="2"/><default name="r" value="9"/>'
        '<default name="both" value="$r.5"/>'
        '<shape type="sphere" id="a"><float name="radius" value="$radius"/></shape>'
        '<shape type="sphere" id="b"><float name="radius" value="$both"/></shape>'
        '<shape type="sphere" id="c"><float name="radius" value="$radiusx"/></shape>'.replace("$radiusx", "$r")
    )
    boxes = {s.id(): float(s.bbox().max[0]) for s in load(tmp_path, scene_xml(body)).scene.shapes()}
    assert boxes == {"a": 2.0, "b": 1.5, "c": 1.0}


# Numbers


@pytest.mark.parametrize("bad", ["nan", "NaN", "-inf", "Infinity", "1e39", "-1e400"])
@pytest.mark.parametrize("original", ["0, 0, 4", "45", "0, 1, 0"])
def test_a_camera_that_is_not_finite_is_refused_by_name(
    bad: str, original: str, tmp_path: Path, reject: Reject
) -> None:
    sensor = SENSOR.replace(f'"{original}"', '"' + original.replace(original[0:2].strip(","), bad, 1) + '"')
    assert bad in sensor
    message = reject(load, tmp_path, scene_xml(sensor=sensor))
    assert 'in <sensor type="perspective">' in message
    assert "not finite" in message


@pytest.mark.parametrize(
    "element",
    [
        '<float name="radius" value="{}"/>',
        '<point name="center" x="{}" y="0" z="0"/>',
        '<point name="center" value="{} 0 0"/>',
        '<transform name="to_world"><translate x="{}"/></transform>',
        '<transform name="to_world"><rotate y="1" angle="{}"/></transform>',
        '<transform name="to_world"><scale value="{}"/></transform>',
        '<transform name="to_world"><matrix value="{} 0 0 0 1 0 0 0 1"/></transform>',
        '<bsdf type="diffuse"><rgb name="reflectance" value="{}"/></bsdf>',
        '<bsdf type="diffuse"><spectrum name="reflectance" value="400:{}, 700:1"/></bsdf>',
    ],
)
def test_numbers_that_are_not_finite_are_refused_everywhere(element: str, tmp_path: Path, reject: Reject) -> None:
    def sphere(value: str) -> bytes:
        return scene_xml(f'<shape type="sphere">{element.format(value)}</shape>')

    load(tmp_path, sphere("0.5"))
    for bad in ("nan", "inf", "1e60"):
        assert "not finite" in reject(load, tmp_path, sphere(bad))
    for bad in ("", "1_0", "0x10", "1" * 100_000 + "x", "\u0661", "1;2"):
        reject(load, tmp_path, sphere(bad))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('value="16"', 'value="0"'),
        ('value="16"', 'value="-5"'),
        ('value="16"', 'value="16385"'),
        ('value="16"', 'value="99999999999999999999"'),
        ('value="16"', 'value="1.5"'),
        ('value="16"', 'value="2147483647"'),
        ("<lookat", '<scale x="1" y="1" z="0"/><lookat'),
        ("<lookat", '<scale value="1e30"/><scale value="1e30"/><lookat'),
        ('target="0, 0, 0"', 'target="0, 0, 4"'),
        ('up="0, 1, 0"', 'up="0, 0, 1"'),
        ('"45"', '"0"'),
        ("</film>", '<rfilter type="gaussian"><float name="stddev" value="1e6"/></rfilter></film>'),
        ("</film>", '<rfilter type="lanczos"><integer name="lobes" value="100000"/></rfilter></film>'),
        ("</film>", '<integer name="crop_width" value="0"/><integer name="crop_height" value="0"/></film>'),
        ("<film", '<sampler type="multijitter"><integer name="sample_count" value="2000000000"/></sampler><film'),
        ("<film", '<sampler type="multijitter"><integer name="sample_count" value="0"/></sampler><film'),
    ],
)
def test_cameras_that_cannot_render_are_refused(old: str, new: str, tmp_path: Path, reject: Reject) -> None:
    assert old in SENSOR
    reject(load, tmp_path, scene_xml(sensor=SENSOR.replace(old, new)))


def test_a_size_beyond_the_limit_is_refused(tmp_path: Path, reject: Reject) -> None:
    upload = zip_of(tmp_path / "a.zip", {"scene.xml": scene_xml()})
    for size in [(0, 10), (10, -1), (16384, 16384), (10**9, 1)]:
        reject(load_scene, upload, VARIANT, size=size)


def test_a_scene_without_camera_gets_one_that_sees_all_of_it(mi: Any, tmp_path: Path) -> None:
    shapes = '<shape type="sphere"/><shape type="sphere"><point name="center" x="9" y="0" z="0"/></shape>'
    loaded = load(tmp_path, scene_xml(shapes + LIGHT, sensor=""))
    assert [warning for warning in loaded.summary.warnings if "no <sensor>" in warning]
    image = np.array(mi.render(loaded.scene, integrator=mi.load_dict({"type": "depth"}), spp=1))[..., 0]
    seen = image > 0.0
    assert 0.01 < seen.mean() < 0.5
    assert not seen[[0, -1]].any()
    assert not seen[:, [0, -1]].any()


def test_shapes_that_overflow_are_refused(tmp_path: Path, reject: Reject) -> None:
    body = (
        '<shape type="cube"><transform name="to_world"><scale value="1e30"/><scale value="1e30"/></transform></shape>'
    )
    reject(load, tmp_path, scene_xml(body))


# What stays


def test_nothing_stays_on_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reject: Reject) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    load(tmp_path, scene_xml(mesh("obj", "a.obj")), {"a.obj": OBJ})
    reject(load, tmp_path, scene_xml(mesh("obj", "a.obj")), {"a.obj": b""})
    reject(load, tmp_path, b"<scene")
    assert list(scratch.iterdir()) == []


def test_only_mitsubas_own_folder_is_searched(tmp_path: Path) -> None:
    load(tmp_path, scene_xml())
    mi = device.use(VARIANT)
    resolver = mi.file_resolver()
    assert [str(resolver[i]) for i in range(len(resolver))] == [str(Path(str(mi.__file__)).parent)]


def test_mitsubas_own_reading_of_the_text_is_checked_again(tmp_path: Path, reject: Reject) -> None:
    """Should the two readers ever disagree about a text, no plugin and no file gets past the second look."""
    folder = folder_of(tmp_path / "folder", {"scene.xml": scene_xml(mesh("obj", "a.obj")), "a.obj": OBJ})
    canonical = canonicalize(folder / "scene.xml")
    mi = device.use(VARIANT)
    for old, new in (('type="obj"', 'type="../evil"'), ("a.obj", "b.obj")):
        changed = dataclasses.replace(canonical, text=canonical.text.replace(old, new))
        assert "the scene names a" in reject(loader._instantiate, mi, changed, VARIANT)


def test_the_canonical_text_holds_nothing_unchecked(tmp_path: Path) -> None:
    body = '<!-- note --> <default name="f" value="a"/> text' + mesh("obj", "$f.obj") + LIGHT
    folder = folder_of(tmp_path / "fold$er", {"scene.xml": scene_xml(body), "a.obj": OBJ})
    canonical = canonicalize(folder / "scene.xml")
    assert canonical.files == {str(folder / "a.obj")}
    assert "default" not in canonical.text
    assert "note" not in canonical.text
    assert load_scene(folder, VARIANT).summary.triangles == 1
