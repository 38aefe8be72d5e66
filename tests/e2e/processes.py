"""The command ``elps`` as a user runs it, and what is left of it afterwards."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ELPS = [sys.executable, "-m", "elps_core.cli"]
START_SECONDS, STOP_SECONDS = 60.0, 40.0


def elps(*arguments: str | Path, timeout: float = 120.0) -> subprocess.CompletedProcess[str]:
    """Runs a command to its end."""
    command = [*ELPS, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)


@contextmanager
def served(data: Path, *options: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A running ``elps serve`` and its URL; ended as Ctrl-C in a terminal does, and held to leaving nothing."""
    command = [*ELPS, "serve", "--port", "0", "--data", str(data), *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("listening on http://127.0.0.1:"), line
        yield process, line.split()[-1]
    finally:
        family = descendants(process.pid)
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGINT)
            assert process.wait(STOP_SECONDS) == 0
        if process.stdout is not None:
            process.stdout.close()
        assert_gone(family, 1.0)


def descendants(pid: int) -> set[int]:
    """Processes that ``pid`` started, and those that they started."""
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            # The command's name stands in brackets and may hold anything, blanks included.
            parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    found = {pid}
    while more := {child for child, parent in parents.items() if parent in found} - found:
        found |= more
    return found - {pid}


def assert_gone(pids: set[int], seconds: float) -> None:
    """Waits for processes to end."""
    end = time.monotonic() + seconds
    while left := {pid for pid in pids if alive(pid)}:
        assert time.monotonic() < end, [Path(f"/proc/{pid}/cmdline").read_text() for pid in left]
        time.sleep(0.05)


def alive(pid: int) -> bool:
    """Whether a process exists and is no zombie."""
    try:
        os.kill(pid, 0)
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
