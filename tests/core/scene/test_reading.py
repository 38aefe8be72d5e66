"""Reading a scene: what it includes stands in its place, parameters can be set, and neither grows without bound."""

from __future__ import annotations

from pathlib import Path

import pytest

from elps_core.scene import markup, reading
from elps_core.scene.files import Files
from elps_core.scene.loader import load_scene

from .conftest import LIGHT, OBJ, SENSOR, SQUARE, VARIANT, Reject, folder_of, load, mesh, scene_xml


def text(folder: Path, body: str, files: dict[str, str] | None = None, **defines: str) -> str:
    """The tree of a scene with that body, as it is written."""
    contents = {name: content.encode() for name, content in (files or {}).items()}
    folder_of(folder, {"scene.xml": scene(body).encode(), **contents})
    document = reading.read(folder / "scene.xml", Files(folder), defines)
    return markup.write(document.root, {})[0]


def scene(body: str) -> str:
    return f'<scene version="3.0.0">{body}</scene>'


GREY = '<bsdf type="diffuse" id="grey"/>'
BALL = '<shape type="sphere"><ref id="grey"/></shape>'


@pytest.mark.parametrize("included", [scene(GREY), GREY, f"<!-- alone -->{GREY}"])
def test_what_is_included_stands_in_its_place(included: str, tmp_path: Path) -> None:
    whole = text(tmp_path / "whole", GREY + BALL)
    parts = text(tmp_path / "parts", '<include filename="m/grey.xml"/>' + BALL, {"m/grey.xml": included})
    assert parts == whole


def test_inclusion_goes_on_and_shares_parameters_and_folders(tmp_path: Path) -> None:
    files = {
        "parts/a.xml": scene('<default name="r" value="2"/><include filename="b.xml"/>'),
        "parts/b.xml": scene('<shape type="sphere"><float name="radius" value="$r"/></shape>'),
    }
    found = text(tmp_path, '<path value="parts"/><include filename="a.xml"/>', files)
    assert '<float name="radius" value="2"/>' in found


def test_an_element_of_an_included_file_is_named_with_it(tmp_path: Path, reject: Reject) -> None:
    message = reject(text, tmp_path, '<include filename="m/a.xml"/>', {"m/a.xml": scene("\n<nonsense/>")})
    assert "line 2 of 'm/a.xml'" in message


def test_an_alias_is_another_name(tmp_path: Path, reject: Reject) -> None:
    whole = text(tmp_path / "whole", GREY + BALL)
    aliased = GREY + '<alias id="grey" as="g"/><alias id="g" as="h"/>' + BALL.replace("grey", "h")
    assert text(tmp_path / "alias", aliased) == whole
    assert "alias" in reject(text, tmp_path, GREY + '<alias id="x" as="grey"/>')


def test_parameters_are_set_and_unknown_ones_refused(tmp_path: Path, reject: Reject) -> None:
    body = '<default name="r" value="1"/><shape type="sphere"><float name="radius" value="$r"/></shape>'
    assert 'value="1"' in text(tmp_path, body)
    assert 'value="3"' in text(tmp_path, body, r="3")
    assert 'value="4"' in text(tmp_path, body.replace('<default name="r" value="1"/>', ""), r="4")
    assert "'radius'" in reject(text, tmp_path, body, radius="3")
    assert "'$r'" in reject(text, tmp_path, body.replace('<default name="r" value="1"/>', ""))


def test_parameters_enter_the_digest_where_they_matter(tmp_path: Path) -> None:
    body = '<default name="r" value="1"/><default name="spp" value="4"/>'
    body += '<integrator type="path"><integer name="max_depth" value="$spp"/></integrator>'
    body += '<shape type="sphere"><float name="radius" value="$r"/></shape>'
    folder_of(tmp_path, {"scene.xml": scene_xml(body)})
    loaded = [load_scene(tmp_path, VARIANT, defines=defines) for defines in ({}, {"spp": "9"}, {"r": "2"})]
    assert loaded[0].digest == loaded[1].digest != loaded[2].digest
    assert loaded[1].summary.defaults.max_depth == 9
    assert {each.name: each.value for each in loaded[2].summary.parameters} == {"r": "2", "spp": "4"}


def test_a_scene_in_parts_is_the_same_scene(tmp_path: Path) -> None:
    whole = load(tmp_path, scene_xml(GREY + BALL + mesh("obj", "m/a.obj")), {"m/a.obj": OBJ})
    body = f'<path value="m"/>{SENSOR}{LIGHT}<include filename="grey.xml"/>{BALL}{mesh("obj", "a.obj")}'
    parts = load(tmp_path, scene(body).encode(), {"m/a.obj": OBJ, "m/grey.xml": GREY.encode()})
    assert parts.digest == whole.digest


@pytest.mark.parametrize(
    ("word", "body", "files"),
    [
        ("itself", '<include filename="a.xml"/>', {"a.xml": scene('<include filename="scene.xml"/>')}),
        ("itself", '<include filename="a.xml"/>', {"a.xml": scene('<include filename="./a.xml"/>')}),
        (
            "too many others",
            '<include filename="0.xml"/>',
            {f"{n}.xml": scene(f'<include filename="{n + 1}.xml"/>') for n in range(30)},
        ),
        ("more than 1000 files", '<include filename="a.xml"/>' * 100_000, {"a.xml": scene("")}),
        (
            "more than 1000 files",
            '<include filename="a.xml"/>' * 100,
            {"a.xml": scene('<include filename="b.xml"/>' * 100), "b.xml": scene("")},
        ),
        ("larger than", '<include filename="a.xml"/>' * 100, {"a.xml": scene(f"<!--{'x' * 500_000}-->")}),
        ("outside", '<include filename="../a.xml"/>', {}),
        ("outside", '<include filename="/etc/hostname"/>', {}),
        ("not in the bundle", '<include filename="missing.xml"/>', {}),
        ("root element", '<include filename="a.xml"/>', {"a.xml": "<scene/>"}),
        ("well-formed", '<include filename="a.xml"/>', {"a.xml": "root:x:0:0"}),
        ("DOCTYPE", '<include filename="a.xml"/>', {"a.xml": "<!DOCTYPE scene>" + scene("")}),
        ("too long", '<include filename="a.xml"/>', {"a.xml": scene(f'<default name="p" value="{"$d" * 9**5}"/>')}),
        ("deep", '<include filename="a.xml"/>', {"a.xml": "<bsdf type='twosided'>" * 40 + "</bsdf>" * 40}),
    ],
)
def test_hostile_inclusion_is_refused(
    word: str, body: str, files: dict[str, str], tmp_path: Path, reject: Reject
) -> None:
    body = f'<default name="d" value="{"x" * 64}"/>{body}'
    message = reject(text, tmp_path, body, files)
    assert word in message
    assert "root:" not in message


def test_plugins_in_included_files_are_checked(tmp_path: Path, reject: Reject) -> None:
    evil = '<bsdf type="../evil" id="grey"/>'
    body = scene_xml('<include filename="a.xml"/>' + SQUARE)
    assert "not one that a scene may use" in reject(load, tmp_path, body, {"a.xml": evil.encode()})
