"""``elps render``: the contract of the direct command, run as a user runs it."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elps_core.context.store import load, save
from elps_core.io.exr import read_exr
from elps_core.scene.inspect import inspect

SECONDS = {f"seconds_{part}" for part in ("total", "loading", "preparing", "rendering", "compiling", "tracing")}
CONTRACT = (
    SECONDS
    | {"spp", "spp_before_context", "context", "relative_error", "output"}
    | {
        "statistics",
        "choice",
        "warnings",
    }
)


@pytest.fixture(scope="module")
def maze(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "maze.zip"
    assert elps("scene", "maze", "-o", str(path), "--rooms", "2").returncode == 0
    return path


def elps(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "elps_core.cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def render(scene: Path, output: Path, *options: str) -> dict[str, Any]:
    done = elps("render", str(scene), "-o", str(output), "--size", "32x24", "--json", *options)
    assert done.returncode == 0, done.stderr
    figures: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    assert set(figures) == CONTRACT
    return figures


def test_samples_are_what_was_asked_for(maze: Path, tmp_path: Path) -> None:
    output = tmp_path / "image.exr"
    figures = render(
        maze, output, "--integrator", "bdpt", "--spp", "9", "--light-sampling", "power", "--max-depth", "4"
    )
    assert figures["spp"] == 9
    assert figures["context"] == {"digest": None, "hit": False}
    assert figures["relative_error"] > 0
    parts, attributes = read_exr(output)
    assert parts["image"].shape == (24, 32, 3)
    assert parts["image"].mean() > 0.05
    assert parts["standard error"].mean() > 0
    assert attributes["samples"] == 9
    assert attributes["integrator"] == "bdpt"


def test_a_context_file_is_made_once_and_used_again(maze: Path, tmp_path: Path) -> None:
    context = tmp_path / "maze.context"
    settings = ["--integrator", "bdpt", "--spp", "2", "--context", str(context), "--set", "context.resolution=16"]
    first = render(maze, tmp_path / "a.exr", *settings)
    second = render(maze, tmp_path / "b.exr", *settings)
    assert (first["context"]["hit"], second["context"]["hit"]) == (False, True)
    assert first["context"]["digest"] == second["context"]["digest"]
    assert second["seconds_preparing"] < first["seconds_preparing"]
    shown = elps("context", "show", str(context), "--json", "-o", str(tmp_path / "adjoint.png"))
    assert json.loads(shown.stdout)["digest"] == first["context"]["digest"]
    assert (tmp_path / "adjoint.png").stat().st_size > 0
    # The same samples with the same context: the same image.
    images = [read_exr(tmp_path / name)[0]["image"] for name in ("a.exr", "b.exr")]
    assert np.allclose(images[0], images[1], rtol=1e-3, atol=1e-4)


def test_tables_that_were_not_filled_to_the_end_are_told_of(maze: Path, tmp_path: Path) -> None:
    context, output = tmp_path / "maze.context", str(tmp_path / "a.exr")
    small = ["--spp", "1", "--context", str(context), "--max-depth", "3"]
    for setting in ("resolution=8", "samples_per_cell=4", "regions=16", "rows=4", "columns=8", "paths=4096"):
        small += ["--set", f"context.{setting}"]
    render(maze, tmp_path / "a.exr", *small, "--integrator", "bdpt", "--direction-sampling", "context")
    built = load(context)
    command = ["render", str(maze), "-o", output, "--size", "32x24", *small, "--direction-sampling", "context"]
    for thorough in (True, False):
        save(replace(built, statistics=built.statistics | {"thorough": thorough}), context)
        for integrator, keeps in (("path", True), ("bdpt", False)):
            done = elps(*command, "--integrator", integrator)
            assert done.returncode == 0, done.stderr
            assert ("not filled to the end" in done.stderr) is (keeps and not thorough)


def test_seconds_count_everything(maze: Path, tmp_path: Path) -> None:
    figures = render(maze, tmp_path / "image.exr", "--seconds", "6", "--set", "context.resolution=16")
    assert sum(figures[name] for name in ("seconds_loading", "seconds_preparing", "seconds_rendering")) > 4.0
    assert figures["spp"] >= 4


GLASS = """<scene version="3.0.0"><sensor type="perspective"/><emitter type="spot"/><shape type="rectangle"/>
<shape type="sphere"><bsdf type="dielectric"/></shape></scene>"""


def test_light_that_is_lost_is_told_everywhere(tmp_path: Path) -> None:
    scene, output = tmp_path / "glass.xml", tmp_path / "image.exr"
    scene.write_text(GLASS)
    options = ("--size", "8x6", "--spp", "2", "--light-sampling", "power", "--json")
    done = elps("render", str(scene), "-o", str(output), "--integrator", "path", *options)
    assert done.returncode == 0, done.stderr
    warning, dark = json.loads(done.stdout.strip().splitlines()[-1])["warnings"]
    assert "'spot' that comes by way of 'dielectric'" in warning
    assert dark.startswith("the image is black: no path was found")
    assert f"warning: {warning}" in done.stderr.splitlines()
    assert read_exr(output)[1]["unreachable"] == warning
    again = elps("render", str(scene), "-o", str(output), "--integrator", "path", "--max-depth", "2", *options)
    assert "by way of" not in again.stderr
    assert "unreachable" not in read_exr(output)[1]


def test_samples_that_are_not_finite_are_told_everywhere(tmp_path: Path) -> None:
    scene, output = tmp_path / "bright.xml", tmp_path / "image.exr"
    lamp = (
        '<boolean name="flip_normals" value="true"/><emitter type="area"><rgb name="radiance" value="3e38"/></emitter>'
    )
    scene.write_text(GLASS.replace('<shape type="sphere">', f'<shape type="sphere" id="lamp">{lamp}'))
    options = ("--integrator", "path", "--light-sampling", "power", "--size", "8x6", "--spp", "2", "--json")
    done = elps("render", str(scene), "-o", str(output), *options)
    assert done.returncode == 0, done.stderr
    (warning,) = (line for line in json.loads(done.stdout.strip().splitlines()[-1])["warnings"] if "finite" in line)
    assert "96 samples that are not finite are left out (the image has 96)" in warning
    assert "'lamp' of SmoothDielectric" in warning
    assert f"warning: {warning}" in done.stderr.splitlines()
    assert read_exr(output)[1]["warnings"] == warning


def test_a_black_image_is_an_image_and_says_why(tmp_path: Path) -> None:
    """It ends by an error that it does not have, and the reason is there before it has ended."""
    scene, output = tmp_path / "dark.xml", tmp_path / "image.exr"
    hidden = '<sensor type="perspective"><float name="near_clip" value="99"/></sensor>'
    scene.write_text(
        BALL.replace(BALL[BALL.index("<sensor") : BALL.index("<emitter")], hidden).replace("constant", "point")
    )
    done = elps("render", str(scene), "-o", str(output), "--size", "8x6", "--error", "0.05", "--json")
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout.strip().splitlines()[-1])
    (warning,) = figures["warnings"]
    assert "'near_clip'" in warning
    assert figures["relative_error"] is None
    lines = done.stderr.splitlines()
    assert lines.count(f"warning: {warning}") == 1
    assert lines.index(f"warning: {warning}") == 0
    parts, attributes = read_exr(output)
    assert not parts["image"].any()
    assert attributes["warnings"] == warning


def test_what_mitsuba_fails_at_is_one_line_and_status_2(tmp_path: Path) -> None:
    scene = tmp_path / "bumps.xml"
    bumps = '<bsdf type="bumpmap"><texture type="checkerboard"/><bsdf type="diffuse"/></bsdf>'
    scene.write_text(GLASS.replace('<bsdf type="dielectric"/>', bumps))
    done = elps("render", str(scene), "-o", str(tmp_path / "image.exr"), "--integrator", "mi_path", "--spp", "1")
    assert done.returncode == 2
    assert done.stderr.startswith("elps: mi_path cannot render this scene: a 'bumpmap'")
    assert len(done.stderr.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == [scene]


@pytest.mark.parametrize(
    "options",
    [
        ["--integrator", "path", "--set", "path.next_event=false"],
        ["--integrator", "light", "--light-sampling", "uniform", "--heuristic", "balance"],
        ["--integrator", "bdpt", "--light-sampling", "power", "--set", "bdpt.strategies=2,1 0,4"],
    ],
)
def test_every_algorithm_renders(maze: Path, tmp_path: Path, options: list[str]) -> None:
    figures = render(maze, tmp_path / "image.exr", *options, "--spp", "4", "--max-depth", "4")
    assert figures["context"]["digest"] is None
    assert read_exr(tmp_path / "image.exr")[0]["image"].any()


def test_pssmlt_says_how_it_fared(maze: Path, tmp_path: Path) -> None:
    options = ("--integrator", "pssmlt", "--light-sampling", "power", "--max-depth", "4", "--spp", "64")
    figures = render(maze, tmp_path / "image.exr", *options)
    attributes = read_exr(tmp_path / "image.exr")[1]
    for name in ("b", "accepted_large", "accepted_small"):
        found = figures["statistics"][name]
        assert 0.0 < found["standard_error"] < found["mean"]
        assert attributes[f"statistic:{name}"] == pytest.approx(found["mean"], rel=1e-5)
        assert attributes[f"statistic:{name}:standardError"] == pytest.approx(found["standard_error"], rel=1e-5)
    assert figures["statistics"]["accepted_small"]["mean"] > figures["statistics"]["accepted_large"]["mean"]


def test_baselines_of_mitsuba_can_be_named(maze: Path, tmp_path: Path) -> None:
    figures = render(maze, tmp_path / "image.exr", "--integrator", "mi_path", "--spp", "8")
    assert figures["spp"] == 8


def test_a_relative_error_ends_the_render(maze: Path, tmp_path: Path) -> None:
    figures = render(maze, tmp_path / "i.exr", "--integrator", "mi_path", "--error", "0.5", "--max-depth", "3")
    assert figures["relative_error"] <= 0.5


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--integrator", "nothing"], "unknown integrator"),
        (["--integrator", "auto", "--set", "context.adaptive=false"], "chooses by trials"),
        (["--integrator", "psmlt"], "did you mean 'pssmlt'"),
        (["--heuristic", "best"], "heuristic"),
        (["--integrator", "light", "--set", "light.connect=false"], "thinlens"),
        (["--integrator", "bdpt", "--direction-sampling", "context", "--set", "context.regions=0"], "context.regions"),
        (["--roulette", "context"], "name an integrator"),
        (["--integrator", "path", "--roulette", "context", "--set", "context.regions=0"], "context.regions"),
        (["--spp", "-3"], "samples"),
        (["--seconds", "nan"], "seconds"),
        (["--size", "0x5"], "WxH"),
        (["--size", "99999x5"], "width"),
        (["--max-depth", "0"], "max_depth"),
        (["--max-depth", "-2"], "max_depth"),
        (["--max-depth", "-1", "--integrator", "path", "--roulette", "none"], "roulette"),
        (["--sensor", "7"], "sensor"),
        (["--set", "context.nothing=1"], "unknown setting"),
        (["--set", "nonsense"], "NAME=VALUE"),
        (["--variant", "cuda_ad_rgb"], "CUDA"),
        (["--seed", "-1"], "seed"),
    ],
)
def test_refusals_are_one_line_and_status_2(maze: Path, tmp_path: Path, options: list[str], word: str) -> None:
    given = options if {"--spp", "--seconds"} & set(options) else [*options, "--spp", "1"]
    done = elps("render", str(maze), "-o", str(tmp_path / "image.exr"), *given)
    assert done.returncode == 2
    assert word in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert str(tmp_path) not in done.stderr
    assert not list(tmp_path.iterdir())


BALL = """<scene version="3.0.0"><default name="albedo" value="0.5"/>
<integrator type="path"><integer name="max_depth" value="3"/></integrator>
<sensor type="perspective"><film type="hdrfilm"><rfilter type="box"/></film>SAMPLER</sensor>
<emitter type="constant"/>
<shape type="sphere"><point name="center" x="0" y="0" z="5"/><bsdf type="diffuse">
<rgb name="reflectance" value="$albedo"/></bsdf></shape></scene>"""


def test_what_is_not_said_the_file_says(tmp_path: Path) -> None:
    """Depth and samples come from the file, the albedo from the command; a job that no one ends is refused."""
    scene, output = tmp_path / "ball.xml", tmp_path / "image.exr"
    sampler = '<sampler type="independent"><integer name="sample_count" value="4"/></sampler>'
    scene.write_text(BALL.replace("SAMPLER", sampler))
    plain = ("--integrator", "path", "--light-sampling", "uniform", "-D", "albedo=0")
    assert render(scene, output, *plain)["spp"] == 4
    parts, attributes = read_exr(output)
    assert attributes["maxDepth"] == 3
    assert parts["image"].min() == 0.0
    scene.write_text(BALL.replace("SAMPLER", ""))
    refused = elps("render", str(scene), "-o", str(output))
    assert refused.returncode == 2
    assert "say when to stop" in refused.stderr
    unknown = elps("render", str(scene), "-o", str(output), "--spp", "1", "-D", "albdo=0")
    assert unknown.returncode == 2
    assert "'albdo'" in unknown.stderr


@pytest.mark.parametrize(
    ("name", "word"), [("a.jpg", ".exr or .png"), ("f.exr", "folder"), ("x" * 300 + ".exr", "name")]
)
def test_outputs_are_tried_before_the_scene_is_read(tmp_path: Path, name: str, word: str) -> None:
    (tmp_path / "f.exr").mkdir()
    done = elps("render", str(tmp_path / "none.xml"), "-o", str(tmp_path / name), "--spp", "1")
    assert done.returncode == 2
    assert word in done.stderr
    assert "no scene" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


FILM = """<scene version="3.0.0"><sensor type="perspective"><transform name="to_world">
<lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform><film type="hdrfilm"><string name="pixel_format"
value="{pixels}"/><string name="component_format" value="float16"/><string name="file_format" value="pfm"/></film>
</sensor><shape type="sphere"><point name="center" x="-1" y="0" z="0"/></shape><emitter type="point">
<point name="position" x="0" y="2" z="3"/><rgb name="intensity" value="{light}"/></emitter></scene>"""


@pytest.mark.parametrize("integrator", ["path", "mi_path"])
def test_the_file_has_what_the_film_asks_for(tmp_path: Path, integrator: str) -> None:
    scene, images = tmp_path / "scene.xml", {}
    for pixels, names in (("rgba", "R,G,B,A"), ("xyza", "X,Y,Z,A"), ("luminance", "Y")):
        scene.write_text(FILM.format(pixels=pixels, light="20,10,5"))
        output = tmp_path / f"{pixels}.exr"
        figures = render(scene, output, "--integrator", integrator, "--spp", "64", "--light-sampling", "power")
        assert any("file_format" in line for line in figures["warnings"])
        parts, attributes = read_exr(output)
        assert attributes["channels"] == names
        images[pixels] = parts["image"]
        assert parts["standard error"].shape == parts["image"].shape == (24, 32, len(names.split(",")))
    alpha = images["rgba"][..., 3]
    assert (alpha.max(), alpha.min()) == (1.0, 0.0)
    assert 0.1 < alpha.mean() < 0.5
    assert images["xyza"][..., 3] == pytest.approx(alpha, abs=1e-3)
    assert not images["rgba"][alpha == 0.0].any()
    grey = images["rgba"][..., :3] @ np.array([0.212671, 0.715160, 0.072169], np.float32)
    assert images["xyza"][..., 1] == pytest.approx(grey, rel=5e-3, abs=1e-4)
    assert images["luminance"][..., 0] == pytest.approx(grey, rel=5e-3, abs=1e-4)


@pytest.mark.parametrize("integrator", ["bdpt", "light", "pssmlt", "mi_ptracer"])
def test_every_integrator_has_alpha(tmp_path: Path, integrator: str) -> None:
    scene = tmp_path / "scene.xml"
    scene.write_text(FILM.format(pixels="luminance_alpha", light="20,10,5"))
    options = ("--integrator", integrator, "--spp", "64", "--light-sampling", "power", "--max-depth", "2")
    render(scene, tmp_path / "a.exr", *options)
    parts, attributes = read_exr(tmp_path / "a.exr")
    assert attributes["channels"] == "Y,A"
    grey, alpha = np.moveaxis(parts["image"], -1, 0)
    assert (alpha.max(), alpha.min()) == (1.0, 0.0)
    assert 0.1 < alpha.mean() < 0.5
    assert grey[alpha > 0.9].mean() > 0.05
    assert not grey[alpha == 0.0].any()


@pytest.mark.parametrize("integrator", ["path", "mi_path"])
def test_a_black_image_has_no_error_and_comes_to_its_end(tmp_path: Path, integrator: str) -> None:
    scene = tmp_path / "scene.xml"
    scene.write_text(FILM.format(pixels="rgb", light="0,0,0"))
    figures = render(scene, tmp_path / "a.exr", "--integrator", integrator, "--error", "0.1")
    assert figures["relative_error"] is None
    assert not read_exr(tmp_path / "a.exr")[0]["image"].any()


def test_a_png_is_a_png(maze: Path, tmp_path: Path) -> None:
    output = tmp_path / "a.png"
    render(maze, output, "--integrator", "path", "--spp", "4", "--light-sampling", "power", "--max-depth", "3")
    assert output.read_bytes()[:8] == bytes([0x89]) + b"PNG\r\n" + bytes([0x1A]) + b"\n"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.png"]


SPECTRAL = """<scene version="3.0.0"><sensor type="perspective"><transform name="to_world">
<lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform><film type="specfilm"><rfilter type="box"/>
<spectrum name="far" value="700:1, 750:1, 800:1"/><spectrum name="blue" value="420:1, 450:1, 480:1"/></film></sensor>
<shape type="sphere"><bsdf type="diffuse"><spectrum name="reflectance" value="400:0.2, 500:0.2, 700:0.8, 900:0.8"/>
</bsdf></shape><emitter type="constant"><spectrum name="radiance" value="1.0"/></emitter></scene>"""


def test_bands_are_written_under_their_names(tmp_path: Path) -> None:
    scene, means = tmp_path / "scene.xml", {}
    scene.write_text(SPECTRAL)
    options = ("--variant", "llvm_ad_spectral", "--spp", "256", "--light-sampling", "power", "--max-depth", "3")
    for integrator in ("mi_path", "bdpt"):
        render(scene, tmp_path / "a.exr", "--integrator", integrator, *options)
        parts, attributes = read_exr(tmp_path / "a.exr")
        assert attributes["channels"] == "far,blue"
        means[integrator] = parts["image"][10:14, 14:18].mean(axis=(0, 1))
    blue, far = means["mi_path"]
    assert far / blue == pytest.approx(0.8 * 100 / (0.2 * 60), rel=0.05)
    assert means["bdpt"] == pytest.approx(means["mi_path"], rel=0.03)
    done = elps("render", str(scene), "-o", str(tmp_path / "b.exr"), "--integrator", "pssmlt", *options)
    assert done.returncode == 2
    assert "bands" in done.stderr
    assert inspect(scene).summary.sensors[0].film.pixels == "bands"


def test_a_missing_scene_is_refused(tmp_path: Path) -> None:
    done = elps("render", str(tmp_path / "none.zip"), "-o", str(tmp_path / "image.exr"), "--spp", "1")
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1


def test_a_context_of_another_scene_is_refused(maze: Path, tmp_path: Path) -> None:
    context, other = tmp_path / "context", tmp_path / "other.zip"
    adjoint = ("--integrator", "bdpt", "--spp", "1", "--context", str(context), "--set", "context.resolution=8")
    render(maze, tmp_path / "a.exr", *adjoint)
    assert elps("scene", "maze", "-o", str(other), "--rooms", "1").returncode == 0
    done = elps("render", str(other), "-o", str(tmp_path / "b.exr"), *adjoint)
    assert done.returncode == 2
    assert "another scene" in done.stderr
