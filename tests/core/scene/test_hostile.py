"""Hostile scenes: code that wants to run, files that lie or lead outside, text that explodes."""

from __future__ import annotations

import os
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

from elps_core.scene import reading
from elps_core.scene.bundle import BundleLimits
from elps_core.scene.files import Files
from elps_core.scene.loader import load_scene

from .conftest import OBJ, SENSOR, SQUARE, VARIANT, Reject, folder_of, load, mesh, ply, png, scene_xml, texture, zip_of

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
        '<bsdf type="measured" id="x"><string name="filename" value="a.txt"/></bsdf>',
        '<sensor type="perspective"><film type="evil"/></sensor>',
        '<spectrum type="evil" name="x"/>',
        '<default name="p" value="../evil"/><bsdf type="$p" id="x"/>',
        '<default name="a" value="../"/><default name="b" value="${a}"/><bsdf type="$b" id="x"/>',
        '<default name="a" value="ev"/><default name="b" value="$ail"/><bsdf type="$b" id="x"/>',
    ],
)
def test_plugins_that_are_not_listed_are_refused(element: str, tmp_path: Path, reject: Reject) -> None:
    reject(load, tmp_path, scene_xml(element + SQUARE), {"a.txt": b""})


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
    message = reject(load_scene, folder, VARIANT)
    assert "SECRET" not in message
    assert "root:" not in message


@pytest.mark.parametrize(
    "body",
    [
        '<path value="/etc"/>',
        '<include filename="/etc/passwd"/>',
        '<include filename="scene.xml"/>',
        '<include filename="a.txt"/>',
        '<include filename="../other.xml"/>',
        "<include/>",
        "<path/>",
        '<path value=".."/>',
        '<path value="~"/>',
        '<alias id="a"/>',
        '<alias id="a" as="b"/><ref id="b"/>',
        '<resource value="x"/>',
        '<bsdf type="conductor" id="x"><string name="material" value="../../../../tmp/Au"/></bsdf>',
        '<bsdf type="conductor" id="x"><string name="material" value="/tmp/Au"/></bsdf>',
        '<bsdf type="dielectric" id="x"><string name="int_ior" value="/etc/passwd"/></bsdf>',
        '<shape type="sphere"><string name="filename" value="a.txt"/></shape>',
        '<string name="filename" value="a.txt"/>',
        '<shape type="obj"><string name="filename" value="a.obj"/><string name="filename" value="/etc/group"/></shape>',
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
    assert "root:" not in reject(load, tmp_path, scene_xml(body), files)


def test_a_refusal_does_not_tell_which_files_the_host_has(tmp_path: Path, reject: Reject) -> None:
    (tmp_path / "there.obj").write_bytes(OBJ)
    folder = tmp_path / "folder"
    messages = set()
    for name in ("there", "gone!"):
        folder_of(folder, {"scene.xml": scene_xml(mesh("obj", f"../{name}.obj"))})
        messages.add(reject(load_scene, folder, VARIANT).replace(name, ""))
    assert len(messages) == 1


def test_a_missing_mesh_is_named(tmp_path: Path, reject: Reject) -> None:
    message = reject(load, tmp_path, scene_xml("\n\n" + mesh("obj", "models/lamp.obj")))
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
    message = reject(load, tmp_path, scene_xml(element), {name: content})
    assert name in message
    assert "root:" not in message


def test_damaged_exr_images_do_not_end_the_process(tmp_path: Path, reject: Reject) -> None:
    """Mitsuba decodes them in threads of their own, where an error is fatal: several, so that one of them is."""
    output = OpenImageIO.ImageOutput.create(str(tmp_path / "a.exr"))
    assert output is not None
    assert output.open(str(tmp_path / "a.exr"), OpenImageIO.ImageSpec(64, 64, 3, "float"))
    output.write_image(np.random.default_rng(1).random((64, 64, 3), dtype=np.float32))
    output.close()
    data = (tmp_path / "a.exr").read_bytes()
    names = [f"{i}.exr" for i in range(8)]
    xml = scene_xml("".join(texture(name) for name in names))
    load(tmp_path, xml, dict.fromkeys(names, data))
    assert "damaged" in reject(load, tmp_path, xml, dict.fromkeys(names, data[: len(data) * 2 // 3]))


def test_a_mesh_inside_a_group_is_checked_as_well(tmp_path: Path, reject: Reject) -> None:
    group = (
        f'<shape type="shapegroup" id="g">{mesh("ply", "a.ply")}</shape><shape type="instance"><ref id="g"/></shape>'
    )
    load(tmp_path, scene_xml(group), {"a.ply": ply()})
    assert "a.ply" in reject(load, tmp_path, scene_xml(group), {"a.ply": ply(indices=(0, 1, 1000))})


# Text


def _laughs(levels: int) -> str:
    steps = "".join(f'<default name="d{i + 1}" value="{"$d" + str(i)}{"$d" + str(i)}"/>' for i in range(levels))
    return f'<default name="d0" value="0123456789"/>{steps}<string name="x" value="$d{levels}"/>'


def _chain(levels: int) -> str:
    """Each BSDF refers twice to the one before: 2^levels ways through a short file."""
    blends = "".join(
        f'<bsdf type="blendbsdf" id="b{i + 1}"><float name="weight" value="1"/><ref id="b{i}"/><ref id="b{i}"/></bsdf>'
        for i in range(levels)
    )
    return f'<bsdf type="diffuse" id="b0"/>{blends}'


PLAIN = scene_xml()
BLENDS_IN_A_ROW = '<bsdf type="diffuse" id="b0"/>' + "".join(
    f'<bsdf type="twosided" id="b{i + 1}"><ref id="b{i}"/></bsdf>' for i in range(3000)
)
ENTITIES = (
    b"<!DOCTYPE s [<!ENTITY a 'aaaaaaaaaa'><!ENTITY b '&a;&a;&a;&a;&a;&a;&a;&a;'><!ENTITY c '&b;&b;&b;&b;&b;&b;'>]>"
)


@pytest.mark.parametrize(
    ("word", "xml"),
    [
        ("well-formed", b""),
        ("well-formed", b"\0\0\0"),
        ("well-formed", b"<scene"),
        ("well-formed", b"<scene version='3.0.0'>"),
        ("well-formed", PLAIN + PLAIN),
        ("root element", PLAIN.replace(b'version="3.0.0"', b"")),
        ("root element", PLAIN.replace(b"3.0.0", b"1.0.0")),
        ("root element", PLAIN.replace(b"3.0.0", b"three")),
        ("root element", b"<bsdf type='diffuse'/>"),
        ("well-formed", PLAIN.decode().encode("utf-32")),
        ("DOCTYPE", b"<!DOCTYPE scene>" + PLAIN),
        ("DOCTYPE", b"<!DOCTYPE scene SYSTEM 'file:///etc/passwd'>" + PLAIN),
        ("DOCTYPE", b"<!DOCTYPE s [<!ENTITY a SYSTEM 'file:///etc/passwd'>]>" + PLAIN.replace(b"45", b"&a;")),
        ("DOCTYPE", ENTITIES + PLAIN.replace(b"45", b"&c;")),
        ("deep", scene_xml("<bsdf type='twosided'>" * 100_000)),
        ("deep", scene_xml("<bsdf type='twosided'>" * 40 + "</bsdf>" * 40)),
        ("too long", scene_xml(_laughs(30))),
        (
            "too long",
            scene_xml(f'<default name="a" value="{"x" * 100_000}"/><string name="x" value="{"$a" * 100_000}"/>'),
        ),
        ("parameters", scene_xml("".join(f'<default name="d{i}" value="1"/>' for i in range(1000)))),
        ("'$undefined'", scene_xml('<float name="$undefined" value="1"/>')),
        ("needs a value", scene_xml('<default name="" value="1"/>')),
        ("needs a value", scene_xml("<default/>")),
        ("too often", scene_xml(_chain(40))),
        ("too often", scene_xml(BLENDS_IN_A_ROW)),
        (
            "circle",
            scene_xml('<bsdf type="mask" id="a"><ref id="b"/></bsdf><bsdf type="mask" id="b"><ref id="a"/></bsdf>'),
        ),
        ("circle", scene_xml('<bsdf type="twosided" id="a"><ref id="a"/></bsdf>')),
        ("does not exist", scene_xml('<ref id="nothing"/>')),
        ("needs an id", scene_xml("<ref/>")),
        ("has the id", scene_xml('<bsdf type="diffuse" id="a"/><bsdf type="diffuse" id="a"/>')),
        ("an id that", scene_xml('<bsdf type="diffuse" id="&#x202e;"/>')),
        ("an id that", scene_xml(f'<bsdf type="diffuse" id="{"x" * 1000}"/>')),
        ("cannot stand", scene_xml('<scene version="3.0.0"/>')),
        ("not an element", scene_xml("<script>import os</script>")),
        ("not an element", scene_xml('<python value="1"/>')),
        ("unknown attribute", scene_xml('<shape type="sphere" onload="1"/>')),
        ("cannot stand", scene_xml('<matrix value="1 0 0 0 1 0 0 0 1"/>')),
        ("cannot stand", scene_xml('<transform name="to_world"><float name="x" value="1"/></transform>')),
        ("needs a value", scene_xml('<float name="a"/>')),
        ("needs a name", scene_xml('<float value="1"/>')),
        ("second time", scene_xml('<shape type="sphere">' + '<float name="radius" value="1"/>' * 2 + "</shape>")),
        ("'nonsense'", scene_xml('<shape type="sphere"><float name="nonsense" value="1"/></shape>')),
        ("'radius'", scene_xml('<shape type="sphere"><string name="radius" value="wide"/></shape>')),
        ("conductor", scene_xml('<bsdf type="conductor" id="x"><string name="material" value="Unobtainium"/></bsdf>')),
        ("emitters", scene_xml('<emitter type="point"/>' * 10_001)),
        ("objects", scene_xml('<shape type="sphere"/>' * 200_001)),
        ("sensors", scene_xml(sensor=SENSOR * 300)),
    ],
)
def test_hostile_text_is_refused(word: str, xml: bytes, tmp_path: Path, reject: Reject) -> None:
    message = reject(load, tmp_path, xml)
    assert word in message
    assert "root:" not in message


def test_the_text_limit_holds_before_it_is_parsed(tmp_path: Path, reject: Reject) -> None:
    (tmp_path / "scene.xml").write_bytes(scene_xml())
    reading.read(tmp_path / "scene.xml", Files(tmp_path))
    small = BundleLimits(xml_bytes=100)
    assert "larger" in reject(reading.read, tmp_path / "scene.xml", Files(tmp_path), None, small)
