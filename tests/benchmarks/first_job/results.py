"""The measurements in a JSON file: no images, one line each, so that changes are easy to read and tables to remake."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tests.benchmarks.common import processor

Record = dict[str, Any]
"""One measurement: what was measured (:data:`WHAT`), and its figures."""
PEER = "mitsuba"
"""The way that all ratios are to: :mod:`tests.benchmarks.first_job.peer`."""
AUTO = "auto"
KINDS = ("references", "runs", "clock", "first_image", "left_out")
"""Lists of the file. ``runs`` are for equal time, ``clock`` asks only whether ``auto`` keeps its time."""
WHAT = ("scene", "way", "temperature", "asked")
"""What names a series of measurements: a new series takes the place of the old one."""
DIGITS = 4
"""Significant digits of an error in the file: noise leaves fewer."""


def load(path: Path) -> dict[str, list[Record]]:
    """The lists of a file, empty where there is none."""
    held = json.loads(path.read_text()) if path.exists() else {}
    return {kind: held.get(kind, []) for kind in KINDS}


def enter(path: Path, kind: str, records: Iterable[Record]) -> None:
    """Put a series into a file in place of the one that measured the same things, stamped with what it was made on."""
    new = [{**record, **stamp()} for record in records]
    fresh = {_what(record) for record in new}
    held = load(path)
    held[kind] = [record for record in held[kind] if _what(record) not in fresh] + new
    save(path, held)


def forget(path: Path, kind: str, scene: str) -> None:
    """Leave out of a list what it says of a scene."""
    held = load(path)
    held[kind] = [record for record in held[kind] if record["scene"] != scene]
    save(path, held)


def save(path: Path, held: dict[str, list[Record]]) -> None:
    """Write the lists, a record a line."""
    parts = []
    for kind, records in held.items():
        lines = ",\n".join(json.dumps(record) for record in records)
        parts.append(f'"{kind}": [\n{lines}\n]' if records else f'"{kind}": []')
    path.write_text("{\n" + ",\n".join(parts) + "\n}\n")


def stamp() -> dict[str, str]:
    """Commit (with a plus where files differ from it), date and processor."""
    return {"commit": _commit(), "date": time.strftime("%Y-%m-%d"), "processor": processor()}


def rounded(value: float) -> float:
    """A figure with :data:`DIGITS` significant digits."""
    return float(f"{value:.{DIGITS}g}")


def _what(record: Record) -> tuple[Any, ...]:
    return tuple(record.get(name) for name in WHAT)


def _commit() -> str:
    try:
        commit = _git("rev-parse", "--short", "HEAD")
        return commit + "+" * bool(_git("status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], check=True, capture_output=True, text=True).stdout.strip()
