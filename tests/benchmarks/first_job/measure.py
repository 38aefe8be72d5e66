"""One image by ELPS or by Mitsuba in a fresh process, timed from outside, and its error."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elps_core import device
from elps_core.errors import DeviceUnavailable
from elps_core.estimate.stats import rel_mse, relative_squares
from elps_core.io.exr import read_exr
from elps_core.scene.canonical import canonicalize
from tests.benchmarks.common import TRIM, render
from tests.benchmarks.equal_time import REFERENCE_SEED
from tests.benchmarks.first_job.ratios import block_sums
from tests.benchmarks.first_job.results import Record, rounded
from tests.benchmarks.first_job.scenes import LeftOut, Scene, Staged

CACHE_VARIABLE = "DRJIT_CACHE_DIR"
"""Environment variable by which Dr.Jit is told where it keeps compiled kernels."""
SCRIPT = Path(__file__).with_name("peer.py")
KEY_DIGITS = 16
"""Of the name of a reference, hexadecimal: a few dozen of them do not collide."""
CLOCK_DIGITS = 3
"""Decimals of a time in seconds: processes do not start more evenly than that."""

Image = NDArray[np.float32]


@dataclass(frozen=True)
class Timed:
    """One image and what it took."""

    image: Image
    """[height, width, 3], linear RGB."""
    figures: Record
    """Samples, times of the process by its own clock and, for ``auto``, what it chose."""


@dataclass(frozen=True)
class Reference:
    """A converged image and the noise that it has left."""

    image: Image
    """[height, width, 3], linear RGB."""
    own: NDArray[np.float64]
    """Its own relative variance, [height, width]: every difference from it holds that, too."""
    key: str
    """Names the image: errors are compared with those against the same one."""

    def errors(self, image: Image) -> Record:
        """relMSE, trimmed relMSE and the sums of relMSE's summands by block, each without the reference's noise."""
        squares = relative_squares(image - self.image, self.image).mean(axis=-1) - self.own
        own = np.sort(self.own.ravel())
        own_trimmed = float(own[: own.size - int(TRIM * own.size)].mean())
        return {
            "relmse": rounded(rel_mse(image, self.image) - float(own.mean())),
            "trimmed": rounded(rel_mse(image, self.image, trim=TRIM) - own_trimmed),
            "blocks": [rounded(value) for value in block_sums(squares / squares.size)],
            "against": self.key,
        }


def environment(cache: Path) -> dict[str, str]:
    """What a process is given: kernels are kept in ``cache``, and LLVM is the library that ELPS chooses.

    Raises:
        DeviceUnavailable: there is none that Dr.Jit works with.
    """
    missing = device.missing_packages()  # where it finds an LLVM, it names that in this process's own environment
    if missing:
        raise DeviceUnavailable(f"Mitsuba does not run here: type '{device.install_command(missing)}'")
    return {**os.environ, CACHE_VARIABLE: str(cache)}


def by_elps(staged: Staged, folder: Path, seconds: float, seed: int, options: Sequence[str], cache: Path) -> Timed:
    """One image by ``elps render``."""
    output, begin = folder / "image.exr", time.monotonic()
    told = render(
        staged.source, output, staged.size_text, seconds, seed, *options, environment=environment(cache)
    )  # fmt: skip
    choice = (told.get("choice") or {}).get("name")
    return Timed(read_exr(output)[0]["image"], {**_figures(told, seconds, begin), "choice": choice})


def by_mitsuba(staged: Staged, folder: Path, seconds: float, seed: int, cache: Path) -> Timed:
    """One image by Mitsuba's path tracer; its clock begins before Python does."""
    output, begin = folder / "image.npy", time.monotonic()
    done = subprocess.run(
        [
            *(sys.executable, str(SCRIPT), str(staged.peer), str(output)),
            *("--seconds", str(seconds), "--began", str(begin), "--seed", str(seed)),
        ],
        check=True,
        capture_output=True,
        text=True,
        env=environment(cache),
    )
    told = json.loads(done.stdout.strip().splitlines()[-1])
    return Timed(np.load(output), {**_figures(told, seconds, begin), "choice": None})


def _figures(told: Mapping[str, Any], seconds: float, begin: float) -> Record:
    """Samples, every part of the time that the process told, its time from outside, and what is over ``seconds``."""
    whole = time.monotonic() - begin
    parts = {name: value for name, value in told.items() if name.startswith("seconds_")}
    times = {**parts, "seconds_process": whole, "overshoot": parts["seconds_total"] - seconds}
    times["overshoot_process"] = whole - seconds
    return {"spp": told["spp"], **{name: round(value, CLOCK_DIGITS) for name, value in times.items()}}


def reference(
    scene: Scene, staged: Staged, options: Sequence[str], seconds: float, kept: Path
) -> tuple[Reference, Record]:
    """The converged image of a scene, rendered once and then taken from the folder ``kept``; and what the report says.

    Its name in the folder holds scene, size, options and seconds, but not the version of ELPS: empty the folder to
    have it rendered anew.

    Raises:
        LeftOut: it failed, or is too short to know its noise.
    """
    digest = canonicalize(staged.xml).digest
    made_by = json.dumps([digest, staged.size, list(options), seconds, REFERENCE_SEED])
    key = hashlib.sha256(made_by.encode()).hexdigest()[:KEY_DIGITS]
    path = kept / f"{key}.exr"
    if not path.exists():
        try:
            render(staged.source, path, staged.size_text, seconds, REFERENCE_SEED, *options)
        except subprocess.CalledProcessError as failed:
            print(failed.stderr, file=sys.stderr, flush=True)
            raise LeftOut("its reference failed") from None
    parts, attributes = read_exr(path)
    own = relative_squares(parts["standard error"], parts["image"]).mean(axis=-1)
    found = Reference(parts["image"], own, key)
    if not found.own.any():
        raise LeftOut("its reference is one chunk and cannot tell its own noise: give more --reference-seconds")
    return found, {
        "scene": scene.title,
        "against": key,
        "rendered_by": scene.reference,
        "size": staged.size_text,
        "seconds_asked": seconds,
        "spp": attributes["samples"],
        "own": rounded(float(found.own.mean())),
    }
