"""Hostile bundles: inclusion that leads out or never ends, names that become others, heaps of ignored files."""

from __future__ import annotations

import stat
import unicodedata
import zipfile
from pathlib import Path

import pytest

from elps_core.scene import reading, rules
from elps_core.scene.bundle import BundleLimits, unpack
from elps_core.scene.canonical import canonicalize
from elps_core.scene.files import Files
from elps_core.scene.loader import load_scene
from elps_core.scene.text import MAX_WARNINGS

from .conftest import OBJ, SQUARE, VARIANT, Reject, folder_of, listing, load, mesh, scene_xml, zip_of

SECRET = '<bsdf type="diffuse" id="TOP-SECRET"/>'
"""What lies outside each bundle, under several names: a scene that takes it in has got out."""


def read(folder: Path) -> reading.Document:
    return reading.read(folder / "scene.xml", Files(folder))


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    """An empty folder for a bundle, with files around it that it must not reach."""
    folder_of(tmp_path, {name: SECRET.encode() for name in ("secret.xml", "up/secret.xml", "caf\u00e9.xml")})
    return folder_of(tmp_path / "up" / "bundle", {"parts/here.xml": SECRET.encode()})


# Inclusion that leaves the bundle


@pytest.mark.parametrize(
    "name",
    [
        "../secret.xml",
        "../../secret.xml",
        "parts/../../secret.xml",
        "..\\secret.xml",
        "parts\\..\\..\\secret.xml",
        "..\\/secret.xml",
        "parts/..//..//secret.xml",
        "/etc/hostname",
        "\\etc\\hostname",
        "//localhost/etc/hostname",
        "\\\\localhost\\share\\secret.xml",
        "C:\\secret.xml",
        "c:secret.xml",
        "~/secret.xml",
        "~root/secret.xml",
        "file:///etc/hostname",
        "http://localhost/secret.xml",
        "\uff0e\uff0e/secret.xml",  # full-width full stops
        "\u2025/secret.xml",  # two dots as one character
        "..\u2215secret.xml",  # a slash that is none
        "%2e%2e/secret.xml",
        "..%2fsecret.xml",
        "../secret.xml\u0301",
        "parts/\u200b../../secret.xml",
        "parts/here.xml/../../../secret.xml",
        "../Bundle/../secret.xml",
        "../bundle/parts/here.xml",
        "$d/secret.xml",
        "secret.xml",
    ],
)
def test_inclusion_does_not_leave_the_bundle(name: str, outside: Path, reject: Reject) -> None:
    body = f'<default name="d" value=".."/><include filename="{name}"/>'
    folder_of(outside, {"scene.xml": scene_xml(body)})
    if name == "../bundle/parts/here.xml":  # leads out and in again
        assert read(outside).root.children[-1].attributes["id"] == "TOP-SECRET"
        return
    assert "SECRET" not in reject(read, outside)


@pytest.mark.parametrize("name", ["link.xml", "LINK.XML", "linked/secret.xml", "Linked\\Secret.xml", "cafe\u0301.xml"])
def test_inclusion_does_not_follow_links_out(name: str, outside: Path, reject: Reject) -> None:
    above = outside.parents[1]
    (outside / "link.xml").symlink_to(above / "secret.xml")
    (outside / "linked").symlink_to(above)
    (outside / "caf\u00e9.xml").symlink_to(above / "caf\u00e9.xml")
    folder_of(outside, {"scene.xml": scene_xml(f'<include filename="{name}"/>')})
    assert "SECRET" not in reject(read, outside)
    assert "symbolic link" in reject(unpack, outside, above / "into")


@pytest.mark.parametrize("folder", ["..", "parts/../..", "..\\", "/", "linked", "LINKED", "\\\\localhost", "~"])
def test_search_paths_do_not_leave_the_bundle(folder: str, outside: Path, reject: Reject) -> None:
    (outside / "linked").symlink_to(outside.parents[1])
    body = f'<path value="{folder}"/><include filename="secret.xml"/>'
    folder_of(outside, {"scene.xml": scene_xml(body)})
    assert "SECRET" not in reject(read, outside)


def test_a_name_that_differs_by_case_and_form_does_not_lead_out(outside: Path, reject: Reject) -> None:
    """The lookup of names that are written differently takes one part of a name after the other."""
    decomposed = unicodedata.normalize("NFD", "\u00dcp")
    folder_of(
        outside, {f"{decomposed}/a.xml": SECRET.encode(), "scene.xml": scene_xml('<include filename="ü\u0050/A.XML"/>')}
    )
    assert read(outside).root.children[-1].attributes["id"] == "TOP-SECRET"
    for name in ("\u00fcp/../../secret.xml", "\u00fcp/..\\..\\SECRET.xml", "UP/../../Secret.xml"):
        folder_of(outside, {"scene.xml": scene_xml(f'<include filename="{name}"/>')})
        assert "SECRET" not in reject(read, outside).replace("SECRET.xml", "")


# Inclusion and parameters without end


def included(*names: str) -> bytes:
    return f'<scene version="3.0.0">{"".join(f"<include filename={name!r}/>" for name in names)}</scene>'.encode()


@pytest.mark.parametrize(
    "files",
    [
        {"a.xml": included("A.XML")},
        {"a.xml": included("parts\\..\\a.xml")},
        {"a.xml": included("b.xml"), "b.xml": included("parts/c.xml"), "parts/c.xml": included("Scene.xml")},
        {"a.xml": included("caf\u00e9.xml"), "cafe\u0301.xml": included("a.xml")},
        {"a.xml": b'<scene version="3.0.0"><default name="n" value="a"/><include filename="$n.xml"/></scene>'},
    ],
)
def test_cycles_of_inclusion_are_found_whatever_they_are_called(
    files: dict[str, bytes], tmp_path: Path, reject: Reject
) -> None:
    folder_of(tmp_path, {"scene.xml": scene_xml('<include filename="a.xml"/>'), "parts/x.txt": b"", **files})
    assert "includes itself" in reject(read, tmp_path)


def test_inclusion_that_doubles_at_every_step_is_refused(tmp_path: Path, reject: Reject) -> None:
    """2^13 files of thirteen: the limit counts a file as often as it is read."""
    steps = {f"{n}.xml": included(f"{n + 1}.xml", f"{n + 1}.xml") for n in range(13)}
    folder_of(tmp_path, {"scene.xml": included("0.xml"), **steps, "13.xml": included()})
    assert "more than 1000 files" in reject(read, tmp_path)


def _doubling(levels: int, last: str) -> str:
    steps = "".join(f'<default name="d{i + 1}" value="$d{i}$d{i}"/>' for i in range(levels))
    return f'<default name="d0" value="{"x" * 64}"/>{steps}{last}'


@pytest.mark.parametrize(
    "body",
    [
        _doubling(40, ""),
        _doubling(13, '<string name="a" value="$d13"/>' * 100),
        _doubling(13, '<include filename="$d13"/>'),
        _doubling(13, '<bsdf type="$d13" id="$d13"/>' * 40),
        _doubling(13, '<path value="$d13/$d13/$d13"/>'),
        _doubling(13, '<alias id="$d13" as="$d12"/>' * 100),
        f'<default name="a" value="{"$aa" * 1000}"/><default name="aa" value="{"$a" * 1000}"/>'
        '<string name="x" value="$a$aa$a"/>',
    ],
)
def test_parameters_do_not_grow_without_bound(body: str, tmp_path: Path, reject: Reject) -> None:
    folder_of(tmp_path, {"scene.xml": scene_xml(body)})
    reject(read, tmp_path)


def test_growth_is_counted_over_all_files_and_from_outside(tmp_path: Path, reject: Reject) -> None:
    part = b'<scene version="3.0.0"><string name="a" value="$p$p$p$p"/></scene>'
    folder_of(tmp_path, {"scene.xml": included(*["a.xml"] * 900), "a.xml": part})
    message = reject(reading.read, tmp_path / "scene.xml", Files(tmp_path), {"p": "x" * 10_000})
    assert "grows too large" in message
    assert "too long" in reject(reading.read, tmp_path / "scene.xml", Files(tmp_path), {"p": "x" * 2**19})


def test_thousands_of_warnings_are_told_as_a_few(tmp_path: Path) -> None:
    body = SQUARE + '<path value="nowhere"/>' * 3000 + '<bsdf type="roughdiffuse"/>' * 3000
    loaded = load(tmp_path, scene_xml(body).replace(b"3.0.0", b"0.6.0"))
    assert len(loaded.summary.warnings) < 2 * MAX_WARNINGS
    assert any("2951 other warnings" in line for line in loaded.summary.warnings)


# Names that become something else


@pytest.mark.parametrize(
    "text",
    [
        '<bsdf type="MeasuredPolarized"><string name="filename" value="a.obj"/></bsdf>',
        '<bsdf type="measured_polarized"><string name="filename" value="a.obj"/></bsdf>',
        '<shape type="obj"><string name="fileName" value="a.obj"/></shape>',
        '<shape type="obj"><string name="Filename" value="/etc/passwd"/></shape>',
        '<shape type="obj"><string name="filename" value="a.obj"/><string name="filename" value="/etc/pw"/></shape>',
        '<shape type="sphere"><string name="filename" value="a.obj"/></shape>',
        '<shape type="ply"><string name="filename" value="a.obj"/><integer name="shapeIndex" value="-1"/></shape>',
        '<shape type="cube"><transform name="toWorld"/><transform name="to_world"/></shape>',
        '<shape type="cube"><float name="_arg_0" value="1"/></shape>',
        '<shape type="cube"><bsdf type="diffuse" name="filename"/></shape>',
        '<texture type="scale" name="filename"/>',
        '<shape type="Merge"><bsdf type="diffuse"/></shape>',
        '<emitter type="PLUGINS/evil"/>',
        '<luminaire type="../constant"/>',
        '<bsdf type="bump/../evil"/>',
        '<Shape type="cube"/>',
        '<INCLUDE filename="a.xml"/>',
        '<Default name="a" value="b"/>',
        '<integrator type="path"><string name="filename" value="/etc/passwd"/><bsdf type="evil"/></integrator>',
    ],
)  # fmt: skip
@pytest.mark.parametrize("version", ["0.6.0", "2.1.0", "3.0.0"])
def test_names_reach_nothing_forbidden_in_any_version(text: str, version: str, tmp_path: Path, reject: Reject) -> None:
    scene = scene_xml(SQUARE + text).replace(b"3.0.0", version.encode())
    folder_of(tmp_path, {"scene.xml": scene, "a.obj": OBJ, "a.xml": SECRET.encode()})
    if "<integrator" in text:  # left out with all that is in it
        assert "passwd" not in canonicalize(tmp_path / "scene.xml").text
        return
    assert "root:" not in reject(load_scene, tmp_path, VARIANT)


NAMES = [
    *("id", "type", "name", "props", "shape", "scene", "default", "interior", "nan", "-1", "0", "", ".", "..", "a.b"),
    *(
        "__class__",
        "__x",
        "_arg_",
        "_arg_x",
        "_arg_0",
        "_arg_1",
        "_arg_2",
        "_arg_99",
        "a/b",
        "../x",
        "/etc/passwd",
        "%s%n",
        "{0}",
        " a",
        "\u00e9",
        "\u0301",
    ),
    *("x" * 200, "'q'", "&lt;&amp;&gt;"),
]


@pytest.mark.parametrize("name", NAMES)
def test_objects_may_have_any_name_and_none_is_lost(name: str, tmp_path: Path, reject: Reject) -> None:
    """One mesh that is called so, by its name, its id and its material, among others without a name."""
    called = mesh("obj", "a.obj").replace("<shape", f'<shape name="{name}" id="{name}"')
    called = called.replace("</shape>", f'<bsdf type="twosided"><bsdf type="diffuse" name="{name}"/></bsdf></shape>')
    body = scene_xml(mesh("obj", "a.obj") + called + '<shape type="sphere"/>')
    if not name:
        reject(load, tmp_path, body, {"a.obj": OBJ})
        return
    loaded = load(tmp_path, body, {"a.obj": OBJ})
    assert (loaded.summary.shapes, loaded.summary.triangles) == (3, 2)
    assert (len(loaded.scene.emitters()), len(loaded.scene.sensors())) == (1, 1)


@pytest.mark.parametrize("name", ["filename", "x" * 201, "\u202eabc", "a\u200bb", "\u00a0"])
def test_names_that_would_take_another_s_place_or_cannot_be_shown_are_refused(
    name: str, tmp_path: Path, reject: Reject
) -> None:
    for body in (
        f'<shape type="sphere" name="{name}"/>',
        f'<shape type="sphere"><bsdf type="diffuse" name="{name}"/></shape>',
    ):
        assert "name" in reject(load, tmp_path, scene_xml(body))
    ref = f'<bsdf type="diffuse" id="m"/><shape type="sphere"><ref id="m" name="{name}"/></shape>'
    assert "name" in reject(load, tmp_path, scene_xml(ref))


@pytest.mark.parametrize("name", ["to_world", "radius", "center", "flip_normals"])
def test_an_object_called_like_a_parameter_is_an_error_that_names_it(name: str, tmp_path: Path, reject: Reject) -> None:
    body = f'<shape type="sphere"><bsdf type="diffuse" name="{name}"/></shape>'
    assert f"'{name}'" in reject(load, tmp_path, scene_xml(body))


# Archives of ignored files


def test_ignored_files_count_as_entries(tmp_path: Path, reject: Reject) -> None:
    upload = tmp_path / "a.zip"
    with zipfile.ZipFile(upload, "w") as archive:
        archive.writestr("scene.xml", scene_xml())
        for number in range(20_000):
            archive.writestr(zipfile.ZipInfo(f"{number}/LICENSE"), b"")
    assert "entries" in reject(unpack, upload, tmp_path / "into")
    assert not listing(tmp_path / "into")


def test_a_folder_of_ignored_files_is_counted_as_well(tmp_path: Path, reject: Reject) -> None:
    folder = folder_of(tmp_path / "folder", {"scene.xml": scene_xml(), **{f"{n}/LICENSE": b"" for n in range(20)}})
    assert "entries" in reject(unpack, folder, tmp_path / "into", BundleLimits(entries=40))
    assert len(unpack(folder, tmp_path / "enough", BundleLimits(entries=41)).ignored) == 20


def test_of_many_ignored_files_a_few_are_named(tmp_path: Path) -> None:
    upload = zip_of(tmp_path / "a.zip", {"scene.xml": scene_xml(), **{f"{n}/LICENSE": b"" for n in range(3000)}})
    unpacked = unpack(upload, tmp_path / "into")
    assert len(unpacked.ignored) == 20
    assert listing(tmp_path / "into") == {"scene.xml"}


def test_ignored_bombs_are_not_unpacked(tmp_path: Path) -> None:
    """They would unpack to a thousand times what the bundle may."""
    names = ["room.blend", "LICENSE", ".git/objects/pack", "__MACOSX/._scene.xml", "models/.DS_Store"]
    upload = zip_of(tmp_path / "a.zip", {"scene.xml": scene_xml(), **dict.fromkeys(names, bytes(2**24))})
    unpacked = unpack(upload, tmp_path / "into", BundleLimits(total_bytes=2**16))
    assert set(unpacked.ignored) == set(names[:3])
    assert listing(tmp_path / "into") == {"scene.xml"}


@pytest.mark.parametrize("name", ["LICENSE", "room.blend", "__MACOSX/x", ".DS_Store", ".git/HEAD"])
def test_ignored_links_and_devices_are_refused_all_the_same(name: str, tmp_path: Path, reject: Reject) -> None:
    for kind in (stat.S_IFLNK, stat.S_IFIFO, stat.S_IFBLK):
        info = zipfile.ZipInfo(name)
        info.create_system, info.external_attr = 3, (kind | 0o777) << 16
        with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
            archive.writestr("scene.xml", scene_xml())
            archive.writestr(info, "/etc/passwd")
        assert name in reject(unpack, tmp_path / "a.zip", tmp_path / "into")


@pytest.mark.parametrize(
    "name", ["../LICENSE", "LICENSE.so", "__MACOSX/../../x", "plugins/LICENSE", ".git/../../HEAD", "a\\..\\..\\README"]
)
def test_ignored_files_obey_the_rules_of_names(name: str, tmp_path: Path, reject: Reject) -> None:
    reject(unpack, zip_of(tmp_path / "a.zip", {"scene.xml": scene_xml(), name: b"x"}), tmp_path / "into")
    assert not listing(tmp_path / "into")


def test_an_ignored_file_is_not_in_the_bundle(tmp_path: Path, reject: Reject) -> None:
    body = '<shape type="linearcurve"><string name="filename" value="LICENSE"/></shape>'
    assert "left out of bundles" in reject(load, tmp_path, scene_xml(body), {"LICENSE": b"0 0 0 0.1\n1 0 0 0.1\n"})


def test_one_line_is_said_of_every_name(tmp_path: Path, reject: Reject) -> None:
    assert rules.MAX_LABEL_CHARACTERS < 300
    folder = folder_of(tmp_path, {"scene.xml": scene_xml(f'<shape type="sphere"><ref id="{"y" * 5000}"/></shape>')})
    assert "does not exist" in reject(load_scene, folder, VARIANT)
