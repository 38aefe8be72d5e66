"""What the benchmarks share: the command, the machine, and fair turns."""

from __future__ import annotations

import json
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

ELPS = Path(sys.executable).with_name("elps")
TRIM = 0.01
"""Share of the worst pixels that trimmed figures leave out."""


def run(*arguments: str, environment: Mapping[str, str] | None = None) -> str:
    """Run ``elps``, in this process's environment if none is given; returns the last line of its output."""
    done = subprocess.run([str(ELPS), *arguments], check=True, capture_output=True, text=True, env=environment)
    return (done.stdout.strip().splitlines() or [""])[-1]


def render(
    scene: Path,
    output: Path,
    size: str,
    seconds: float,
    seed: int,
    *options: str,
    environment: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """One image by ``elps render``, everything counted; returns its figures."""
    line = run(
        "render", str(scene), "-o", str(output), "--size", size, "--seconds", str(seconds), "--seed", str(seed),
        "--json", *options, environment=environment,
    )  # fmt: skip
    figures: dict[str, Any] = json.loads(line)
    return figures


def in_turns(ways: Mapping[str, Callable[[int], object]], turns: int) -> dict[str, np.ndarray[Any, Any]]:
    """Seconds of each way in each turn; a turn before the first is thrown away, for it may compile."""
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for turn in range(turns + 1):
        for name, way in ways.items():
            begin = time.perf_counter()
            way(turn)
            if turn:
                seconds[name].append(time.perf_counter() - begin)
    return {name: np.array(values) for name, values in seconds.items()}


def processor() -> str:
    """The processor's name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or "an unknown processor"
