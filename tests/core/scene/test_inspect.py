"""Checking an upload in a child process: its answer, its limits, and what it leaves."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from elps_core.scene import sandbox
from elps_core.scene.inspect import inspect, inspect_in_child
from elps_core.scene.loader import load_scene
from elps_core.scene.sandbox import ChildDiedError, ChildLimits

from .conftest import OBJ, Reject, folder_of, mesh, png, scene_xml, texture, zip_of

ROOT = Path(__file__).parents[3]
FILES = {"scene.xml": scene_xml(mesh("obj", "a.obj")), "a.obj": OBJ}
GIB = 2**30


@pytest.fixture(params=["isolated", "plain"])
def isolation(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Each test with bubblewrap, where it works here, and without."""
    if request.param == "plain":
        monkeypatch.setattr(sandbox, "_bubblewrap_works", lambda: False)
    elif not sandbox._bubblewrap_works():
        pytest.skip("bubblewrap does not work here")
    return str(request.param)


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


def test_the_child_reports_what_loading_here_finds(isolation: str, tmp_path: Path, scratch: Path) -> None:
    upload = zip_of(tmp_path / "a.zip", FILES)
    report = inspect_in_child(upload)
    assert report == inspect(upload)
    assert report.digest == load_scene(upload, "llvm_ad_rgb").digest
    assert report.summary.triangles == 1
    assert inspect_in_child(folder_of(tmp_path / "folder", FILES)) == report
    assert list(scratch.iterdir()) == []


def test_a_single_file_is_alone(tmp_path: Path, reject: Reject) -> None:
    """An uploaded XML file must not reach its neighbours in the upload folder."""
    folder_of(tmp_path, FILES)
    assert "a.obj" in reject(inspect_in_child, tmp_path / "scene.xml")
    (tmp_path / "scene.xml").write_bytes(scene_xml())
    assert inspect_in_child(tmp_path / "scene.xml").summary.shapes == 1


def test_refusals_come_back_as_they_are(isolation: str, tmp_path: Path, scratch: Path, reject: Reject) -> None:
    upload = zip_of(tmp_path / "a.zip", {"scene.xml": scene_xml(mesh("obj", "missing.obj"))})
    message = reject(inspect_in_child, upload)
    assert "missing.obj" in message
    (tmp_path / "b.zip").write_bytes(b"garbage")
    assert "neither" in reject(inspect_in_child, tmp_path / "b.zip")
    passwd = zip_of(tmp_path / "c.zip", {"scene.xml": scene_xml(mesh("obj", "/etc/passwd"))})
    assert "root:" not in reject(inspect_in_child, passwd)
    assert list(scratch.iterdir()) == []


def test_too_much_time_is_a_refusal(isolation: str, tmp_path: Path, scratch: Path, reject: Reject) -> None:
    upload = zip_of(tmp_path / "a.zip", FILES)
    started = time.monotonic()
    assert "too long" in reject(inspect_in_child, upload, ChildLimits(wall_seconds=0.2))
    assert time.monotonic() - started < 10
    slow = zip_of(tmp_path / "b.zip", {"scene.xml": scene_xml('<shape type="sphere"/>' * 190_000)})
    assert "too long" in reject(inspect_in_child, slow, ChildLimits(cpu_seconds=2))
    assert list(scratch.iterdir()) == []


def test_too_much_memory_is_a_refusal(isolation: str, tmp_path: Path, scratch: Path, reject: Reject) -> None:
    """A black picture: a megabyte that unpacks to 192, and to more while it is read."""
    big = png(8000, 8000, rows=8000)
    upload = zip_of(tmp_path / "a.zip", {"scene.xml": scene_xml(texture("big.png")), "big.png": big}, packed=False)
    inspect_in_child(upload)
    assert "memory" in reject(inspect_in_child, upload, ChildLimits(memory_bytes=GIB * 6 // 10))
    assert list(scratch.iterdir()) == []


def test_a_crash_is_a_refusal(isolation: str, tmp_path: Path) -> None:
    with pytest.raises(ChildDiedError, match="crash"):
        sandbox.run("elps_core.no_such_module", tmp_path, ChildLimits())


def test_the_child_sees_and_keeps_little(
    isolation: str, tmp_path: Path, scratch: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Run a module of our own in the sandbox and let it tell what it can do."""
    package = tmp_path / "package" / "elps_probe"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "look.py").write_text(
        "import json, os, socket, sys\n"
        "from elps_core.scene.sandbox import ChildLimits, restrict\n"
        "pairs = (text.partition('=') for text in sys.argv[2:])\n"
        "restrict(ChildLimits(**{name: int(float(value)) for name, _, value in pairs}))\n"
        "import resource\n"
        "def can(action):\n"
        "    try:\n"
        "        action()\n"
        "        return True\n"
        "    except OSError:\n"
        "        return False\n"
        "print(json.dumps({\n"
        "    'files': os.listdir('.'),\n"
        "    'variables': sorted(os.environ),\n"
        "    'limits': [resource.getrlimit(k)[1] for k in (resource.RLIMIT_AS, resource.RLIMIT_CORE)],\n"
        "    'interfaces': [name for _, name in socket.if_nameindex()],\n"
        "    'secret': can(lambda: open(sys.argv[1] + '/../secret.txt').read()),\n"
        "    'write': can(lambda: open(sys.argv[1] + '/new.txt', 'w')),\n"
        "    'passwd': can(lambda: open('/etc/passwd').read()),\n"
        "}))\n"
    )
    monkeypatch.setenv("ELPS_SECRET", "token")
    given = tmp_path / "given"
    given.mkdir()
    (tmp_path / "secret.txt").write_text("secret")
    monkeypatch.setattr(sandbox, "_environment", _with_path(sandbox._environment, package.parent))
    monkeypatch.setattr(sandbox, "SYSTEM_FOLDERS", (*sandbox.SYSTEM_FOLDERS, str(package.parent)))
    seen = json.loads(sandbox.run("elps_probe.look", given, ChildLimits(memory_bytes=GIB)))
    assert seen["files"] == []
    assert "ELPS_SECRET" not in seen["variables"]
    assert seen["limits"] == [GIB, 0]
    if isolation == "isolated":
        assert set(seen["interfaces"]) <= {"lo"}
        assert (seen["secret"], seen["write"], seen["passwd"]) == (False, False, False)
    assert list(scratch.iterdir()) == []


def _with_path(original, extra: Path):  # type: ignore[no-untyped-def]
    def environment(folder: str) -> dict[str, str]:
        made = original(folder)
        return {**made, "PYTHONPATH": f"{made['PYTHONPATH']}{os.pathsep}{extra}"}

    return environment


@pytest.mark.parametrize(("files", "key"), [(FILES, "digest"), ({"a.obj": OBJ}, "error")])
def test_the_command_prints_one_line_of_json(files: dict[str, bytes], key: str, tmp_path: Path) -> None:
    upload = zip_of(tmp_path / "a.zip", files)
    done = subprocess.run(
        [sys.executable, "-m", "elps_core.scene.inspect", str(upload)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.count("\n") == 1
    assert key in json.loads(done.stdout)


def test_asking_needs_no_mitsuba() -> None:
    code = "import sys, elps_core.scene.inspect; sys.exit('mitsuba' in sys.modules or 'drjit' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, cwd=ROOT).returncode == 0


def test_a_small_image_loads(tmp_path: Path) -> None:
    assert inspect_in_child(zip_of(tmp_path / "a.zip", {"scene.xml": scene_xml(texture("a.png")), "a.png": png()}))
