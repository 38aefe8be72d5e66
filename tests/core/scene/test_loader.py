"""Loading scenes: what is loaded is what the file says, and nothing of it chooses what runs or is opened."""

from __future__ import annotations

import os
import re
import shutil
import struct
import subprocess
import sys
import textwrap
import zlib
from pathlib import Path

import numpy as np
import OpenImageIO
import pytest

from elps_core import device
from elps_core.scene import markup, plugins
from elps_core.scene.bundle import BundleLimits
from elps_core.scene.loader import LoadedScene, canonicalize, load_scene

from .conftest import LIGHT, OBJ, SENSOR, SQUARE, Reject, folder_of, mesh, ply, png, scene_xml, texture, zip_of

VARIANT = "scalar_rgb"


def load(tmp_path: Path, xml: bytes, files: dict[str, bytes] | None = None) -> LoadedScene:
    return load_scene(zip_of(tmp_path / "upload.zip", {"scene.xml": xml, **(files or {})}), VARIANT)


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
        <shape type="rectangle"><transform name="to_world"><rotate y="1" angle="80"/></transform><ref id="grey"/></shape>
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
    assert "no sensor 5" in reject(lambda: load_scene(upload, VARIANT, sensor=5))
    assert "no sensor -1" in reject(lambda: load_scene(upload, VARIANT, sensor=-1))


@pytest.mark.parametrize("name", ["path", "elps_bdpt", "volpathmis", "prb"])
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


@pytest.mark.parametrize("extension", ["png", "jpg", "exr", "hdr", "pfm", "bmp", "tga"])
def test_every_image_format_loads_whole_and_is_refused_cut_off(extension: str, tmp_path: Path, reject: Reject) -> None:
    name = f"a.{extension}"
    output = OpenImageIO.ImageOutput.create(str(tmp_path / name))
    assert output is not None
    deep = extension in ("exr", "hdr", "pfm")
    assert output.open(str(tmp_path / name), OpenImageIO.ImageSpec(32, 32, 3, "float" if deep else "uint8"))
    output.write_image(np.random.default_rng(1).random((32, 32, 3), dtype=np.float32))
    output.close()
    data = (tmp_path / name).read_bytes()
    assert load(tmp_path, scene_xml(texture(name)), {name: data}).summary.shapes == 1
    if extension == "jpg":  # readers fill up what is missing in grey, as browsers do
        return
    assert name in reject(lambda: load(tmp_path, scene_xml(texture(name)), {name: data[: len(data) // 2]}))


def test_a_scene_of_several_megabytes_loads_in_seconds(tmp_path: Path) -> None:
    shape = (
        '<shape type="rectangle"><transform name="to_world"><matrix value="1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/>'
        '</transform><ref id="grey"/></shape>'
    )
    xml = scene_xml('<bsdf type="diffuse" id="grey"/>' + shape * 20_000)
    assert len(xml) > 2 * 2**20
    assert load(tmp_path, xml).summary.shapes == 20_000


# Code


PLUGIN_SOURCE = """
#include <stdio.h>
__attribute__((constructor)) static void run(void) {{
    FILE *marker = fopen("{marker}", "w");
    if (marker) fclose(marker);
}}
"""


@pytest.fixture
def evil_plugin(tmp_path: Path) -> tuple[Path, Path]:
    """A library that writes a file as soon as anything loads it, and that file's path."""
    marker = tmp_path / "the-plugin-ran"
    source = tmp_path / "evil.c"
    source.write_text(PLUGIN_SOURCE.format(marker=marker))
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("no C compiler")
    library = tmp_path / "evil.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", str(library), str(source)], check=True)
    return library, marker


def run_python(code: str, *arguments: str, cwd: Path) -> None:
    """In a child process: a library that is loaded once stays loaded."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    subprocess.run(
        [sys.executable, "-P", "-c", textwrap.dedent(code), *arguments],
        cwd=cwd,
        env=environment,
        check=False,
        capture_output=True,
        timeout=120,
    )


WITH_MITSUBA = """
    import sys
    from elps_core import device
    mi = device.use("scalar_rgb")
    mi.load_file(sys.argv[1])
"""
WITH_US = """
    import sys
    from pathlib import Path
    from elps_core.errors import SceneRejected
    from elps_core.scene.loader import load_scene
    try:
        loaded = load_scene(Path(sys.argv[1]), "scalar_rgb")
        import mitsuba as mi
        mi.render(loaded.scene, integrator=mi.load_dict({"type": "path"}), spp=1)
        Path(sys.argv[2]).write_text("loaded")
    except SceneRejected as error:
        Path(sys.argv[2]).write_text(f"refused: {error}")
"""


def test_a_plugin_beside_the_scene_or_in_the_working_directory_never_runs(
    tmp_path: Path, evil_plugin: tuple[Path, Path]
) -> None:
    library, marker = evil_plugin
    answer = tmp_path / "answer"
    scene = scene_xml('<shape type="rectangle"><bsdf type="diffuse"/></shape>')
    hostile = folder_of(tmp_path / "hostile", {"scene.xml": scene, "plugins/x.txt": b""})
    for name in ("diffuse", "rectangle", "path", "perspective"):
        shutil.copy(library, hostile / f"plugins/{name}.so")
    empty = folder_of(tmp_path / "empty", {"scene.xml": scene})

    run_python(WITH_MITSUBA, str(hostile / "scene.xml"), cwd=empty)
    assert marker.exists(), "the attack itself does not work: this test shows nothing"
    marker.unlink()
    run_python(WITH_MITSUBA, str(empty / "scene.xml"), cwd=hostile)
    assert marker.exists(), "the attack through the working directory does not work: this test shows nothing"
    marker.unlink()

    for source, working in [(hostile, empty), (hostile / "scene.xml", empty), (hostile, hostile), (empty, hostile)]:
        run_python(WITH_US, str(source), str(answer), cwd=working)
        assert answer.read_text() == "loaded"
        assert not marker.exists()
        answer.unlink()
    with_plugin = zip_of(tmp_path / "a.zip", {"scene.xml": scene, "plugins/diffuse.so": library.read_bytes()})
    run_python(WITH_US, str(with_plugin), str(answer), cwd=empty)
    assert answer.read_text().startswith("refused: 'plugins/diffuse.so'")
    assert not marker.exists()


@pytest.mark.parametrize("name", ["../evil", "../hostile/evil", "evil", "./diffuse", "plugins/evil"])
def test_a_plugin_named_by_its_path_never_runs(name: str, tmp_path: Path, evil_plugin: tuple[Path, Path]) -> None:
    library, marker = evil_plugin
    hostile = folder_of(tmp_path / "hostile", {"scene.xml": scene_xml(f'<bsdf type="{name}" id="x"/>')})
    for place in ("evil.so", "plugins/evil.so", "plugins/diffuse.so", "plugins/plugins/evil.so"):
        (hostile / place).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(library, hostile / place)
    if name in ("../evil", "evil"):
        run_python(WITH_MITSUBA, str(hostile / "scene.xml"), cwd=hostile)
        assert marker.exists(), "the attack itself does not work: this test shows nothing"
        marker.unlink()
    run_python(WITH_US, str(hostile), str(tmp_path / "answer"), cwd=hostile)
    assert (tmp_path / "answer").read_text().startswith("refused")
    assert not marker.exists()


@pytest.mark.parametrize(
    "element",
    [
        '<bsdf type="evil" id="x"/>',
        '<bsdf type="Diffuse" id="x"/>',
        '<bsdf type=" diffuse" id="x"/>',
        '<bsdf type="diffuse&#10;" id="x"/>',
        '<bsdf type="" id="x"/>',
        '<bsdf type="sphere" id="x"/>',
        '<bsdf type="diffuse.so" id="x"/>',
        '<shape type="blender"/>',
        '<shape type="merge"/>',
        '<bsdf type="measured" id="x"><string name="filename" value="a.txt"/></bsdf>',
        '<integrator type="../evil"/>',
        '<integrator type="elps_evil"/>',
        '<integrator type="aov"><integrator type="evil"/></integrator>',
        '<sensor type="perspective"><film type="evil"/></sensor>',
        '<spectrum type="evil" name="x"/>',
        '<default name="p" value="../evil"/><bsdf type="$p" id="x"/>',
        '<default name="a" value="../"/><default name="b" value="${a}"/><bsdf type="$b" id="x"/>',
        '<default name="a" value="ev"/><default name="b" value="$ail"/><bsdf type="$b" id="x"/>',
    ],
)
def test_plugins_that_are_not_listed_are_refused(element: str, tmp_path: Path, reject: Reject) -> None:
    reject(lambda: load(tmp_path, scene_xml(element + SQUARE), {"a.txt": b""}))


# Files


FILE_ELEMENTS = [
    mesh("obj", "{}"),
    mesh("ply", "{}"),
    mesh("serialized", "{}"),
    mesh("linearcurve", "{}"),
    texture("{}"),
    '<emitter type="envmap"><string name="filename" value="{}"/></emitter>',
    '<medium type="heterogeneous" id="m"><volume type="gridvolume" name="albedo"><string name="filename" value="{}"/>'
    "</volume></medium>",
    '<shape type="sphere"><bsdf type="diffuse"><spectrum name="reflectance" filename="{}"/></bsdf></shape>',
]


@pytest.mark.parametrize("element", FILE_ELEMENTS)
@pytest.mark.parametrize(
    "name",
    [
        "/etc/passwd",
        "../secret.txt",
        "models/../../secret.txt",
        "models/../a.txt",
        "~/secret.txt",
        "missing.txt",
        "models",
        ".",
        "",
        "a.txt\\..\\b",
        "link.txt",
        "linked/secret.txt",
        "pipe.txt",
        "x" * 5000,
        "new&#10;line",
        "/dev/zero",
        "/proc/self/environ",
    ],
)
def test_files_outside_the_bundle_are_not_opened(element: str, name: str, tmp_path: Path, reject: Reject) -> None:
    secret = tmp_path / "secret.txt"
    secret.write_text("TOP-SECRET 1 2 3\n")
    folder = folder_of(tmp_path / "folder", {"scene.xml": scene_xml(element.format(name)), "models/a.txt": b"x"})
    (folder / "link.txt").symlink_to(secret)
    (folder / "linked").symlink_to(tmp_path)
    os.mkfifo(folder / "pipe.txt")
    message = reject(lambda: load_scene(folder, VARIANT))
    assert "SECRET" not in message
    assert "root:" not in message


@pytest.mark.parametrize(
    "body",
    [
        '<path value="/etc"/>',
        '<include filename="/etc/passwd"/>',
        '<include filename="scene.xml"/>',
        '<include filename="other.xml"/>',
        '<resource value="x"/>',
        '<alias id="a" as="b"/>',
        '<bsdf type="conductor" id="x"><string name="material" value="../../../../tmp/Au"/></bsdf>',
        '<bsdf type="conductor" id="x"><string name="material" value="/tmp/Au"/></bsdf>',
        '<bsdf type="dielectric" id="x"><string name="int_ior" value="/etc/passwd"/></bsdf>',
        '<shape type="sphere"><string name="filename" value="a.txt"/></shape>',
        '<string name="filename" value="a.txt"/>',
        '<shape type="obj"><string name="filename" value="a.obj"/><string name="filename" value="/etc/passwd"/></shape>',
        '<shape type="obj"><string name="file" value="/etc/passwd"/></shape>',
        '<shape type="obj"><string name="fileName" value="/etc/passwd"/></shape>',
        '<default name="d" value="/etc"/><shape type="obj"><string name="filename" value="$d/passwd"/></shape>',
        '<default name="d" value="."/><shape type="obj"><string name="filename" value="$d$d/a.obj"/></shape>',
        '<shape type="obj"><string name="filename" value="\\$d/a.obj"/></shape>',
        '<shape type="obj"><ref name="filename" id="a"/></shape>',
    ],
)
def test_other_ways_to_name_a_file_are_refused(body: str, tmp_path: Path, reject: Reject) -> None:
    files = {"other.xml": scene_xml(), "a.txt": b"x", "a.obj": OBJ}
    assert "root:" not in reject(lambda: load(tmp_path, scene_xml(body), files))


def test_a_missing_mesh_is_named(tmp_path: Path, reject: Reject) -> None:
    message = reject(lambda: load(tmp_path, scene_xml("\n\n" + mesh("obj", "models/lamp.obj"))))
    assert "models/lamp.obj" in message
    assert '<shape type="obj"> (line 9)' in message


def _serialized(vertices: int, faces: int, indices: tuple[int, ...] = (0, 1, 2)) -> bytes:
    data = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0) + struct.pack("<3I", *indices)
    head = struct.pack("<I", 0x1000) + b"name\0" + struct.pack("<QQ", vertices, faces)
    return struct.pack("<HH", 0x041C, 4) + zlib.compress(head + data) + struct.pack("<QI", 0, 1)


def _volume(side: int) -> bytes:
    return struct.pack("<3sB5i6f", b"VOL", 3, 1, side, side, side, 1, 0, 0, 0, 1, 1, 1) + bytes(32)


ASCII_PLY = (
    b"ply\nformat ascii 1.0\ncomment by hand\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)
VOLUME = FILE_ELEMENTS[6]


def test_whole_files_of_every_kind_load(tmp_path: Path) -> None:
    spectrum = FILE_ELEMENTS[7].format("s.spd")
    body = mesh("obj", "a.obj") + mesh("ply", "a.ply") + mesh("ply", "b.ply") + mesh("serialized", "a.serialized")
    body += VOLUME.format("a.vol") + spectrum + mesh("linearcurve", "curve.txt") + texture("a.png")
    files = {
        "a.obj": OBJ,
        "a.ply": ply(),
        "b.ply": ASCII_PLY,
        "a.serialized": _serialized(3, 1),
        "a.vol": _volume(2),
        "s.spd": b"400 0.5\n700 0.5\n",
        "curve.txt": b"0 0 0 0.1\n1 0 0 0.1\n",
        "a.png": png(),
    }
    assert load(tmp_path, scene_xml(body), files).summary.triangles == 4 + 2


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.ply", ply()[:-4]),
        ("a.ply", ply(vertices=2**31)),
        ("a.ply", ply(vertices=2**63, faces=2**63)),
        ("a.ply", ply().replace(b"vertex 3", b"vertex " + b"9" * 5000)),
        ("a.ply", ply(faces=10**9)),
        ("a.ply", ply(indices=(0, 1, 3))),
        ("a.ply", ply(indices=(0, 1, -1))),
        ("a.ply", ply().replace(b"uchar int", b"uint int")),
        ("a.ply", ply()[:-13] + struct.pack("<B3i", 200, 0, 1, 2)),
        ("a.ply", ply(body=struct.pack("<9f", 0, 0, 0, float("nan"), 0, 0, 0, 1, 0) + struct.pack("<B3i", 3, 0, 1, 2))),
        ("a.ply", ply(body=struct.pack("<9f", 0, 0, 0, float("inf"), 0, 0, 0, 1, 0) + struct.pack("<B3i", 3, 0, 1, 2))),
        ("a.ply", ASCII_PLY.replace(b"0 1 2", b"0 1 7")),
        ("a.ply", ASCII_PLY.replace(b"1 0 0\n", b"1 0 nan\n")),
        ("a.ply", ASCII_PLY.replace(b"1 0 0\n", b"root:x:0\n")),
        ("a.ply", b"ply\n" + b"comment x\n" * 100_000),
        ("a.ply", b"root:x:0:0:root:/root:/bin/bash\n"),
        ("a.obj", OBJ.replace(b"1 2 3", b"1 2 300")),
        ("a.obj", OBJ.replace(b"1 2 3", b"1/1/1 2/9/9 3/9/9")),
        ("a.obj", OBJ.replace(b"v 1 0 0", b"v nan 0 0")),
        ("a.obj", b"v " + b"1" * 100_000),
        ("a.obj", b""),
        ("a.serialized", _serialized(3, 1)[:-20]),
        ("a.serialized", _serialized(2**60, 2**60)),
        ("a.serialized", _serialized(2**28, 2**28)),
        ("a.serialized", _serialized(3, 1, (0, 1, 3))),
        ("a.serialized", _serialized(3, 1)[:-12] + struct.pack("<QI", 0, 2**32 - 1)),
        ("a.serialized", _serialized(3, 1)[:-12] + struct.pack("<3QI", 0, 0, 0, 3)),
        ("a.vol", _volume(2000)),
        ("a.vol", _volume(-2)),
        ("a.png", png(2**31 - 1, 2**31 - 1, rows=0)),
        ("a.png", png(60_000, 2, rows=2)),
        ("a.png", png(4000, 4000)),
        ("a.png", b"root:x:0:0:root:/root:/bin/bash\n"),
        ("a.png", b""),
    ],
)
def test_damaged_and_lying_files_are_refused(name: str, content: bytes, tmp_path: Path, reject: Reject) -> None:
    kind = name.split(".")[1]
    element = {"vol": VOLUME.format(name), "png": texture(name)}.get(kind, mesh(kind, name))
    message = reject(lambda: load(tmp_path, scene_xml(element), {name: content}))
    assert name in message
    assert "root:" not in message


def test_a_mesh_inside_a_group_is_checked_as_well(tmp_path: Path, reject: Reject) -> None:
    group = (
        f'<shape type="shapegroup" id="g">{mesh("ply", "a.ply")}</shape><shape type="instance"><ref id="g"/></shape>'
    )
    load(tmp_path, scene_xml(group), {"a.ply": ply()})
    assert "a.ply" in reject(lambda: load(tmp_path, scene_xml(group), {"a.ply": ply(indices=(0, 1, 1000))}))


# Text


def _laughs(levels: int) -> str:
    steps = "".join(f'<default name="d{i + 1}" value="{"$d" + str(i)}{"$d" + str(i)}"/>' for i in range(levels))
    return f'<default name="d0" value="0123456789"/>{steps}<string name="x" value="$d{levels}"/>'


def _chain(levels: int) -> str:
    """Each BSDF refers twice to the one before: 2^levels ways through a short file."""
    blends = "".join(
        f'<bsdf type="blendbsdf" id="b{i + 1}"><float name="weight" value="0.5"/><ref id="b{i}"/><ref id="b{i}"/></bsdf>'
        for i in range(levels)
    )
    return f'<bsdf type="diffuse" id="b0"/>{blends}'


@pytest.mark.parametrize(
    "xml",
    [
        b"",
        b"\0\0\0",
        b"<scene",
        b"<scene version='3.0.0'>",
        b"<scene/>",
        b"<scene version='1.0.0'/>",
        b"<scene version='0.6.0'/>",
        b"<bsdf version='3.0.0' type='diffuse'/>",
        b"<scene version='3.0.0'/><scene version='3.0.0'/>",
        b"<?xml version='1.0' encoding='nonsense'?><scene version='3.0.0'/>",
        b"<?xml version='1.0' encoding='UTF-16'?><scene version='3.0.0'/>",
        b"<!DOCTYPE scene><scene version='3.0.0'/>",
        b"<!DOCTYPE scene SYSTEM 'file:///etc/passwd'><scene version='3.0.0'/>",
        b"<!DOCTYPE s [<!ENTITY a SYSTEM 'file:///etc/passwd'>]><scene version='3.0.0'><string name='x' value='&a;'/></scene>",
        b"<!DOCTYPE s [<!ENTITY a 'aaaaaaaaaa'><!ENTITY b '&a;&a;&a;&a;&a;&a;&a;&a;'><!ENTITY c '&b;&b;&b;&b;&b;&b;'>]>"
        b"<scene version='3.0.0'><string name='x' value='&c;'/></scene>",
        scene_xml("<bsdf type='twosided'>" * 100_000),
        scene_xml("<bsdf type='twosided'>" * 40 + "</bsdf>" * 40),
        scene_xml(_laughs(30)),
        scene_xml('<default name="a" value="' + "x" * 100_000 + '"/><string name="x" value="' + "$a" * 100_000 + '"/>'),
        scene_xml("".join(f'<default name="d{i}" value="1"/>' for i in range(1000))),
        scene_xml('<float name="$undefined" value="1"/>'),
        scene_xml('<default name="" value="1"/>'),
        scene_xml("<default/>"),
        scene_xml(_chain(40)),
        scene_xml('<bsdf type="twosided" id="a"><ref id="b"/></bsdf><bsdf type="twosided" id="b"><ref id="a"/></bsdf>'),
        scene_xml('<bsdf type="twosided" id="a"><ref id="a"/></bsdf>'),
        scene_xml('<bsdf type="diffuse" id="b0"/>' + "".join(
            f'<bsdf type="twosided" id="b{i + 1}"><ref id="b{i}"/></bsdf>' for i in range(3000)
        )),
        scene_xml('<ref id="nothing"/>'),
        scene_xml("<ref/>"),
        scene_xml('<bsdf type="diffuse" id="a"/><bsdf type="diffuse" id="a"/>'),
        scene_xml('<bsdf type="diffuse" id="&#7;"/>'.replace("&#7;", "&#x202e;")),
        scene_xml('<bsdf type="diffuse" id="' + "x" * 1000 + '"/>'),
        scene_xml('<scene version="3.0.0"/>'),
        scene_xml("<script>import os</script>"),
        scene_xml('<python value="1"/>'),
        scene_xml('<shape type="sphere" onload="1"/>'),
        scene_xml('<matrix value="1 0 0 0 1 0 0 0 1"/>'),
        scene_xml('<transform name="to_world"><float name="x" value="1"/></transform>'),
        scene_xml('<float name="a"/>'),
        scene_xml('<float value="1"/>'),
        scene_xml('<shape type="sphere"><float name="radius" value="1"/><float name="radius" value="2"/></shape>'),
        scene_xml('<shape type="sphere"><float name="nonsense" value="1"/></shape>'),
        scene_xml('<shape type="sphere"><string name="radius" value="wide"/></shape>'),
        scene_xml('<bsdf type="conductor" id="x"><string name="material" value="Unobtainium"/></bsdf>'),
        scene_xml('<emitter type="point"/>' * 10_001),
        scene_xml('<shape type="sphere"/>' * 200_001),
        scene_xml(sensor=SENSOR * 300),
    ],
)  # fmt: skip
def test_hostile_text_is_refused(xml: bytes, tmp_path: Path, reject: Reject) -> None:
    assert "root:" not in reject(lambda: load(tmp_path, xml))


def test_the_text_limit_holds_before_it_is_parsed(tmp_path: Path, reject: Reject) -> None:
    (tmp_path / "scene.xml").write_bytes(scene_xml())
    markup.read(tmp_path / "scene.xml")
    assert "larger" in reject(lambda: markup.read(tmp_path / "scene.xml", BundleLimits(xml_bytes=100)))


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
    message = reject(lambda: load(tmp_path, scene_xml(sensor=sensor)))
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
        assert "not finite" in reject(lambda bad=bad: load(tmp_path, sphere(bad)))
    for bad in ("", "1_0", "0x10", "1" * 100_000 + "x", "\u0661", "1;2"):
        reject(lambda bad=bad: load(tmp_path, sphere(bad)))


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
    reject(lambda: load(tmp_path, scene_xml(sensor=SENSOR.replace(old, new))))


def test_a_size_beyond_the_limit_is_refused(tmp_path: Path, reject: Reject) -> None:
    upload = zip_of(tmp_path / "a.zip", {"scene.xml": scene_xml()})
    for size in [(0, 10), (10, -1), (16384, 16384), (10**9, 1)]:
        reject(lambda size=size: load_scene(upload, VARIANT, size=size))


def test_a_scene_without_camera_is_refused(tmp_path: Path, reject: Reject) -> None:
    assert "sensor" in reject(lambda: load(tmp_path, scene_xml(sensor="")))


def test_shapes_that_overflow_are_refused(tmp_path: Path, reject: Reject) -> None:
    body = (
        '<shape type="cube"><transform name="to_world"><scale value="1e30"/><scale value="1e30"/></transform></shape>'
    )
    reject(lambda: load(tmp_path, scene_xml(body)))


# What stays


def test_nothing_stays_on_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reject: Reject) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    load(tmp_path, scene_xml(mesh("obj", "a.obj")), {"a.obj": OBJ})
    reject(lambda: load(tmp_path, scene_xml(mesh("obj", "a.obj")), {"a.obj": b""}))
    reject(lambda: load(tmp_path, b"<scene"))
    assert list(scratch.iterdir()) == []


def test_only_mitsubas_own_folder_is_searched(tmp_path: Path) -> None:
    load(tmp_path, scene_xml())
    mi = device.use(VARIANT)
    resolver = mi.file_resolver()
    assert [str(resolver[i]) for i in range(len(resolver))] == [str(Path(str(mi.__file__)).parent)]


def test_the_canonical_text_holds_nothing_unchecked(tmp_path: Path) -> None:
    body = '<!-- note --> <default name="f" value="a"/> text' + mesh("obj", "$f.obj") + LIGHT
    folder = folder_of(tmp_path / "fold$er", {"scene.xml": scene_xml(body), "a.obj": OBJ})
    canonical = canonicalize(folder / "scene.xml")
    assert canonical.files == {str(folder / "a.obj")}
    assert "default" not in canonical.text
    assert "note" not in canonical.text
    assert load_scene(folder, VARIANT).summary.triangles == 1
