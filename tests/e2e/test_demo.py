"""The demo, in short."""

from __future__ import annotations

import signal
import subprocess
import time
from pathlib import Path

from PIL import Image

from tests.e2e.processes import ELPS, assert_gone, descendants, elps

SECONDS = "10"
"""Two chunks, which an error estimate needs, take 4 s on two idle cores."""


def test_demo(tmp_path: Path) -> None:
    done = elps("demo", "--out", tmp_path / "out", "--seconds", SECONDS)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "times as efficient as by" in done.stdout
    partials = {path.name for path in (tmp_path / "out" / "partials").iterdir()}
    assert {"power_0001.exr", "adjoint_0001.exr"} <= partials
    with Image.open(tmp_path / "out" / "comparison.png") as figure:
        assert figure.width > figure.height > 800


def test_interrupted_demo_leaves_nothing(tmp_path: Path) -> None:
    command = [*ELPS, "demo", "--out", str(tmp_path / "out")]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    while len(family := descendants(process.pid)) < 4:
        assert process.poll() is None
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    assert process.wait(40.0) == 130
    assert_gone(family, 1.0)
