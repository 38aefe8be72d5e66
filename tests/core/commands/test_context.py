"""``elps context``: what is asked for is measured, and what a file holds is told and drawn."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from elps_core.context.encoding import DirectionalTables
from elps_core.context.regions import Regions, Table
from elps_core.context.store import DirectionalParts, GlobalContext, load, save
from elps_core.settings import ContextSettings

SMALL = ("--resolution", "16", "--size", "16x12", "--set", "context.samples_per_cell=4")


def elps(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "elps_core.cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "box.zip"
    assert elps("scene", "cornell", "-o", str(path)).returncode == 0
    return path


def directions(count: int = 5) -> DirectionalParts:
    rng = np.random.default_rng(0)
    normals = np.tile(np.array([[0, 0, 1]], np.float32), (count, 1))
    table = Table((0.0, 0.0, 0.0), 1.0, np.array([[[1]]], np.uint32), np.zeros((6, 1), np.uint16))
    regions = Regions(rng.random((count, 3)).astype(np.float32), normals, 1.0, table)
    radiance, importance = (
        DirectionalTables.of(rng.random((count, 4, 8)), rng.random(count), rng.integers(0, 9, count)).encoded("log8")
        for _ in range(2)
    )
    view = rng.integers(0, count, (12, 16)).astype(np.uint16)
    pilot, density = (rng.random(shape).astype(np.float32) for shape in ((12, 16), (2, 8, 8)))
    return DirectionalParts(
        regions, radiance, importance, pilot, 1.0, np.ones((regions.count, 2), np.float32), view, density
    )


def file_with(parts: DirectionalParts | None, path: Path) -> Path:
    context = GlobalContext(
        digest="sha256:" + "a" * 64,
        scene="sha256:" + "b" * 64,
        sensor=1,
        settings=ContextSettings(resolution=8),
        adjoint=np.ones((8, 9), np.float32),
        emitters=np.ones((3, 7), np.float32),
        statistics={"seconds": 1.25, "rows": 8, "columns": 9, "note": "[/odd]"},
        directions=parts,
    )
    save(context, path)
    return path


def test_no_regions_is_what_renders_without_tables_want(box: Path, tmp_path: Path) -> None:
    file = tmp_path / "box.elps"
    done = elps("context", "build", str(box), "-o", str(file), "--regions", "0", "--paths", "2048", *SMALL)
    assert done.returncode == 0, done.stderr
    found = load(file)
    assert found.directions is None
    assert found.settings == ContextSettings(resolution=16, samples_per_cell=4).without_tables()
    assert found.digest in done.stderr.replace("\n", "").replace(" ", "")


def test_the_tables_are_measured_as_asked(box: Path, tmp_path: Path) -> None:
    file = tmp_path / "box.elps"
    options = ("--particles", "classical", "--regions", "32", "--paths", "4096")
    done = elps("context", "build", str(box), "-o", str(file), *options, *SMALL)
    assert done.returncode == 0, done.stderr
    wanted = ContextSettings(resolution=16, samples_per_cell=4, particles="classical", regions=32, paths=4096)
    assert load(file).settings == wanted


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--particles", "waves"], "particles"),
        (["--regions", "-1"], "regions"),
        (["--paths", "1"], "paths"),
        (["-o", "nowhere/box.elps"], "folder"),
        (["-o", "."], "folder"),
    ],
)
def test_refusals_of_build_are_one_line(box: Path, tmp_path: Path, options: list[str], word: str) -> None:
    done = elps("context", "build", str(box), "-o", str(tmp_path / "box.elps"), *options)
    assert done.returncode == 2
    assert word in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_the_facts_are_told(tmp_path: Path) -> None:
    file = file_with(directions(), tmp_path / "a.elps")
    done = elps("context", "show", str(file))
    assert done.returncode == 0, done.stderr
    lines = {line.split("  ")[0].strip(): line for line in done.stdout.splitlines()}
    assert lines["regions"].split() == ["regions", "5"]
    assert "4 x 8 directions, log8" in lines["tables"]
    assert "8 x 9 cells" in lines["adjoint image"]
    assert lines["file"].strip().endswith("MiB")
    assert "1.25" in lines["seconds"]
    assert "[/odd]" in lines["note"]
    assert "a" * 64 in done.stdout.replace("\n", "").replace(" ", "")


@pytest.mark.parametrize("with_tables", [True, False])
def test_the_facts_as_json(tmp_path: Path, with_tables: bool) -> None:
    file = file_with(directions() if with_tables else None, tmp_path / "a.elps")
    done = elps("context", "show", str(file), "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    tables = {"regions": 5, "rows": 4, "columns": 8, "encoding": "log8"}
    assert facts["tables"] == (tables if with_tables else None)
    assert facts["bytes"] == file.stat().st_size
    assert facts["adjoint"] == [8, 9]
    assert facts["settings"]["resolution"] == 8
    assert facts["statistics"]["seconds"] == 1.25


def test_a_folder_gets_all_pictures_and_a_file_the_adjoint_image(tmp_path: Path) -> None:
    file = file_with(directions(), tmp_path / "a.elps")
    folder, picture = tmp_path / "pictures", tmp_path / "alone.png"
    for output in (folder, folder, picture):  # A folder that is there is filled again
        done = elps("context", "show", str(file), "-o", str(output))
        assert done.returncode == 0, done.stderr
    names = {"adjoint.png", "particles.png", "regions.png", "tables.png"}
    assert {path.name for path in folder.iterdir()} == names
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in folder.iterdir())
    assert picture.read_bytes() == (folder / "adjoint.png").read_bytes()


@pytest.mark.parametrize(
    ("output", "word"), [("nowhere/pictures", "folder"), ("a.elps", "another kind"), ("folder.png", "another kind")]
)
def test_refusals_of_show_are_one_line(tmp_path: Path, output: str, word: str) -> None:
    file = file_with(None, tmp_path / "a.elps")
    before = file.read_bytes()
    (tmp_path / "folder.png").mkdir()
    done = elps("context", "show", str(file), "-o", str(tmp_path / output))
    assert done.returncode == 2
    assert word in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert file.read_bytes() == before


def test_another_file_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    (tmp_path / "a.elps").write_bytes(b"no context")
    done = elps("context", "show", str(tmp_path / "a.elps"), "-o", str(tmp_path / "pictures"))
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "pictures").exists()
