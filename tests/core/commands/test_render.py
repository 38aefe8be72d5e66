"""``elps render``: the contract of the direct command, run as a user runs it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elps_core.io.exr import read_exr

CONTRACT = {"seconds_total", "seconds_context", "seconds_compile", "spp", "context", "relative_error", "output"}


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
    figures = render(maze, output, "--spp", "9", "--light-sampling", "power", "--max-depth", "4")
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
    settings = ["--spp", "2", "--context", str(context), "--set", "context.resolution=16"]
    first = render(maze, tmp_path / "a.exr", *settings)
    second = render(maze, tmp_path / "b.exr", *settings)
    assert (first["context"]["hit"], second["context"]["hit"]) == (False, True)
    assert first["context"]["digest"] == second["context"]["digest"]
    assert second["seconds_context"] < first["seconds_context"]
    shown = elps("context", "show", str(context), "--json", "-o", str(tmp_path / "adjoint.png"))
    assert json.loads(shown.stdout)["digest"] == first["context"]["digest"]
    assert (tmp_path / "adjoint.png").stat().st_size > 0
    # The same samples with the same context: the same image.
    images = [read_exr(tmp_path / name)[0]["image"] for name in ("a.exr", "b.exr")]
    assert np.allclose(images[0], images[1], rtol=1e-3, atol=1e-4)


def test_seconds_count_everything(maze: Path, tmp_path: Path) -> None:
    figures = render(maze, tmp_path / "image.exr", "--seconds", "6", "--set", "context.resolution=16")
    assert figures["seconds_context"] > 0
    assert figures["spp"] >= 4


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
        (["--integrator", "pssmlt"], "not built yet"),
        (["--direction-sampling", "context"], "not built yet"),
        (["--roulette", "context"], "not built yet"),
        (["--spp", "-3"], "samples"),
        (["--seconds", "nan"], "seconds"),
        (["--size", "0x5"], "WxH"),
        (["--size", "99999x5"], "width"),
        (["--max-depth", "0"], "max_depth"),
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


def test_no_limit_is_refused(maze: Path, tmp_path: Path) -> None:
    done = elps("render", str(maze), "-o", str(tmp_path / "image.exr"))
    assert done.returncode == 2
    assert "--spp" in done.stderr


def test_a_missing_scene_is_refused(tmp_path: Path) -> None:
    done = elps("render", str(tmp_path / "none.zip"), "-o", str(tmp_path / "image.exr"), "--spp", "1")
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1


def test_a_context_of_another_scene_is_refused(maze: Path, tmp_path: Path) -> None:
    context, other = tmp_path / "context", tmp_path / "other.zip"
    render(maze, tmp_path / "a.exr", "--spp", "1", "--context", str(context), "--set", "context.resolution=8")
    assert elps("scene", "maze", "-o", str(other), "--rooms", "1").returncode == 0
    done = elps("render", str(other), "-o", str(tmp_path / "b.exr"), "--spp", "1", "--context", str(context))
    assert done.returncode == 2
    assert "another scene" in done.stderr
