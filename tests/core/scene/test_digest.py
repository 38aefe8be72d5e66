"""Digests: equal where the image is the same, different where it may not be."""

from __future__ import annotations

import re
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest

from elps_core.scene.canonical import canonicalize
from elps_core.scene.digest import context_digest, render_digest
from elps_core.settings import ContextSettings, RenderSettings

from .conftest import OBJ, SENSOR, folder_of, mesh, scene_xml, zip_of

XML = scene_xml(mesh("obj", "models/a.obj"))
FILES = {"scene.xml": XML, "models/a.obj": OBJ}
SCENE = "sha256:" + "0" * 64


def digest_of(folder: Path, files: dict[str, bytes]) -> str:
    return canonicalize(folder_of(folder, files) / "scene.xml").digest


def test_form() -> None:
    form = re.compile(r"sha256:[0-9a-f]{64}")
    assert form.fullmatch(context_digest(SCENE, 0, (4, 3), ContextSettings(), "llvm_ad_rgb"))
    assert form.fullmatch(render_digest(SCENE, RenderSettings(), (4, 3)))


def test_a_scene_is_the_same_wherever_it_lies_and_however_it_is_packed(tmp_path: Path) -> None:
    from elps_core.scene.bundle import unpack

    digests = {digest_of(tmp_path / "a", FILES), digest_of(tmp_path / "b" / "deep", FILES)}
    for index, files in enumerate([FILES, {f"top/{name}": data for name, data in FILES.items()}]):
        for packed in (True, False):
            upload = zip_of(tmp_path / f"{index}{packed}.zip", files, packed=packed)
            digests.add(canonicalize(unpack(upload, tmp_path / f"into{index}{packed}").xml).digest)
    reverse = tmp_path / "reverse.zip"
    with zipfile.ZipFile(reverse, "w") as archive:
        for name in reversed(FILES):
            archive.writestr(zipfile.ZipInfo(name, (1999, 1, 1, 0, 0, 0)), FILES[name])
    digests.add(canonicalize(unpack(reverse, tmp_path / "into-reverse").xml).digest)
    assert len(digests) == 1


def test_what_the_image_does_not_depend_on_does_not_enter(tmp_path: Path) -> None:
    plain = digest_of(tmp_path / "plain", FILES)
    same = {
        "comment": {**FILES, "scene.xml": XML.replace(b"<emitter", b"<!-- x -->\n  <emitter")},
        "unused": {**FILES, "notes.txt": b"x", "models/b.obj": OBJ},
        "renamed": {"scene.xml": XML.replace(b"models/a", b"m/b"), "m/b.obj": OBJ},
        "parameter": {**FILES, "scene.xml": scene_xml('<default name="n" value="a"/>' + mesh("obj", "models/$n.obj"))},
        "attributes": {**FILES, "scene.xml": XML.replace(b'name="fov" value="45"', b'value="45" name="fov"')},
    }
    for name, files in same.items():
        assert digest_of(tmp_path / name, files) == plain, name


def test_what_the_image_depends_on_enters(tmp_path: Path) -> None:
    changed = {
        "plain": FILES,
        "mesh": {**FILES, "models/a.obj": OBJ.replace(b"1 0 0", b"2 0 0")},
        "camera": {**FILES, "scene.xml": XML.replace(b'"45"', b'"46"')},
        "film": {**FILES, "scene.xml": XML.replace(b'"16"', b'"17"')},
        "shape": {**FILES, "scene.xml": scene_xml(mesh("obj", "models/a.obj") * 2)},
        "sensor": {**FILES, "scene.xml": scene_xml(mesh("obj", "models/a.obj"), sensor=SENSOR * 2)},
    }
    assert len({digest_of(tmp_path / name, files) for name, files in changed.items()}) == len(changed)


@pytest.mark.parametrize(
    "change",
    [
        {"integrator": "mi_path"},
        {"light_sampling": "power"},
        {"roulette": "none"},
        {"rr_depth": 6},
        {"heuristic": "balance"},
        {"bdpt": {"strategies": "1,3"}},
        {"integrator": "path"},
        {"integrator": "light"},
        {"integrator": "pssmlt"},
        {"max_depth": 7},
        {"sensor": 1},
        {"seed": 1},
        {"variant": "llvm_ad_mono"},
        {"context": {"seed": 1}},
        {"context": {"resolution": 32}},
    ],
)
def test_settings_that_change_a_render_enter(change: dict[str, Any]) -> None:
    bdpt = {"integrator": "bdpt"}
    changed = RenderSettings(**(bdpt | change))
    assert render_digest(SCENE, changed, (4, 3)) != render_digest(SCENE, RenderSettings(**bdpt), (4, 3))


def test_size_and_scene_enter_a_render() -> None:
    digests = {
        render_digest(scene, RenderSettings(), size) for scene in (SCENE, SCENE[:-1] + "1") for size in ((4, 3), (8, 6))
    }
    assert len(digests) == 4


def test_a_size_counts_the_same_from_film_or_settings() -> None:
    assert render_digest(SCENE, RenderSettings(), (4, 3)) == render_digest(
        SCENE, RenderSettings(width=4, height=3), (4, 3)
    )


ASKED = {
    "heuristic": "balance",
    "light_sampling": "power",
    "direction_sampling": "context",
    "table_share": 0.5,
    "roulette": "throughput",
    "rr_depth": 9,
    "max_depth": 9,
    "path": {"next_event": False},
    "light": {"connect": False},
    "bdpt": {"strategies": "1,3"},
    "pssmlt": {"chains": 1024},
    "context": {"resolution": 32},
    "seed": 1,
    "variant": "llvm_ad_spectral",
    "sensor": 1,
}
"""Another value for every setting that could enter a render."""
ALWAYS = {"seed", "variant", "sensor"}
OURS = {*ALWAYS, "direction_sampling", "roulette", "rr_depth", "max_depth", "light_sampling", "heuristic", "context"}


@pytest.mark.parametrize(
    ("base", "entering"),
    [
        ({"integrator": "path"}, {*OURS, "path"}),
        (
            {"integrator": "path", "path": {"next_event": False}},
            {*OURS, "path"} - {"light_sampling", "heuristic", "context"},
        ),
        ({"integrator": "path", "direction_sampling": "context"}, {*OURS, "path", "table_share"}),
        ({"integrator": "auto"}, {*OURS, "table_share"} - {"direction_sampling", "roulette"}),
        ({"integrator": "light"}, {*OURS, "light"}),
        ({"integrator": "bdpt"}, {*OURS, "bdpt"}),
        ({"integrator": "bdpt", "light_sampling": "uniform"}, {*OURS, "bdpt"} - {"context"}),
        ({"integrator": "bdpt", "roulette": "none"}, {*OURS, "bdpt"} - {"rr_depth"}),
        ({"integrator": "pssmlt"}, {*OURS, "pssmlt"}),
        ({"integrator": "pssmlt", "direction_sampling": "context"}, {*OURS, "pssmlt", "table_share"}),
        # Mitsuba knows one roulette, which the default asks for as well.
        ({"integrator": "mi_path"}, {*ALWAYS, "rr_depth", "max_depth"}),
        ({"integrator": "mi_path", "roulette": "none"}, {*ALWAYS, "roulette", "max_depth"}),
        ({"integrator": "mi_direct"}, ALWAYS),
    ],
)
def test_what_an_integrator_does_not_read_does_not_enter(base: dict[str, Any], entering: set[str]) -> None:
    assert set(ASKED) | {"integrator", "width", "height", "preset", "hide_emitters"} == set(RenderSettings.model_fields)
    digests = {}
    for name, other in ASKED.items():
        if base["integrator"] == "auto" and name in (
            "direction_sampling",
            "roulette",
            "path",
            "light",
            "bdpt",
            "pssmlt",
        ):
            continue  # Refused
        same = {"path": {"next_event": True}, "direction_sampling": "scattering"}
        value = same[name] if base.get(name) == other else other
        digests[name] = render_digest(SCENE, RenderSettings(**{**base, name: value}), (4, 3))
    plain = render_digest(SCENE, RenderSettings(**base), (4, 3))
    assert {name for name, digest in digests.items() if digest != plain} == entering


def test_chains_over_guided_light_paths_are_other_chains() -> None:
    guided = {"bdpt": {"guided_light": True}}
    for base, enters in (({"direction_sampling": "context"}, True), ({}, False)):
        both = [RenderSettings(**{"integrator": "pssmlt", **base, **more}) for more in ({}, guided)]
        assert (len({render_digest(SCENE, settings, (4, 3)) for settings in both}) == 2) is enters


def test_context_settings_enter_only_where_a_context_is_used() -> None:
    contexts = [ContextSettings(), ContextSettings(resolution=32)]
    plain, adjoint = (
        {
            render_digest(SCENE, RenderSettings(integrator="bdpt", light_sampling=sampling, context=c), (4, 3))
            for c in contexts
        }
        for sampling in ("power", "adjoint")
    )
    assert (len(plain), len(adjoint)) == (1, 2)


def test_a_context_depends_on_aspect_but_not_on_resolution() -> None:
    def of(size: tuple[int, int], **change: Any) -> str:
        sensor, variant = change.pop("sensor", 0), change.pop("variant", "llvm_ad_rgb")
        return context_digest(SCENE, sensor, size, ContextSettings(**change), variant)

    assert of((640, 480)) == of((1600, 1200)) == of((4, 3))
    others = {of((640, 481)), of((480, 640)), of((4, 3), sensor=1), of((4, 3), seed=1), of((4, 3), resolution=32)}
    assert len(others) == 5
    assert of((4, 3)) not in others
    assert of((4, 3), variant="llvm_ad_spectral") == of((4, 3)) != of((4, 3), variant="cuda_ad_rgb")


def test_a_scene_digest_does_not_change_by_accident(tmp_path: Path) -> None:
    """Stored scenes are found by it: whoever changes the canonical text raises ``SCENE_FORMAT``."""
    assert digest_of(tmp_path, FILES) == "sha256:0bcb248656949a72d74af50c3c2efa974ccf4dc2cee2a178a9bde348c0061937"


def test_digests_need_no_mitsuba() -> None:
    code = "import sys, elps_core.scene.digest; sys.exit('mitsuba' in sys.modules or 'drjit' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, cwd=Path(__file__).parents[3]).returncode == 0


@pytest.mark.parametrize("integrator", ["auto", "path", "mi_path"])
def test_hidden_emitters_enter_and_shown_ones_do_not(integrator: str) -> None:
    shown, hidden = (RenderSettings(integrator=integrator, hide_emitters=hides) for hides in (False, True))
    assert render_digest(SCENE, shown, (4, 3)) == render_digest(SCENE, RenderSettings(integrator=integrator), (4, 3))
    assert render_digest(SCENE, hidden, (4, 3)) != render_digest(SCENE, shown, (4, 3))
