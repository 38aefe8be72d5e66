"""Algorithms at equal time, everything counted, against a converged reference."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from elps_core.estimate.stats import rel_mse, relative_squares
from elps_core.io.exr import read_exr
from elps_core.io.preview import to_png
from tests.benchmarks.common import TRIM, render

PLAIN: dict[str, list[str]] = {
    "mi_path": ["--integrator", "mi_path"],
    "mi_path, no roulette": ["--integrator", "mi_path", "--roulette", "none"],
}
"""The peers that all ratios are to."""
REFERENCE_SEED = 999


@dataclass(frozen=True)
class Duel:
    """One scene and the ways to render it."""

    title: str
    scene: Path
    ways: Mapping[str, Sequence[str]]
    """Name -> options of ``elps render``; those of :data:`PLAIN` among them."""
    reference: Sequence[str]
    """Options of the reference."""
    size: str
    pictures: Mapping[str, Path]
    """Where the first picture of a way goes."""


def equal_time(duel: Duel, seconds: float, reference_seconds: float, runs: int) -> list[str]:
    """A table as lines of Markdown; each way renders ``runs`` times, in turns."""
    results: dict[str, list[tuple[float, ...]]] = {name: [] for name in duel.ways}
    with tempfile.TemporaryDirectory(prefix="elps-bench-") as name:
        image, converged = Path(name) / "image.exr", Path(name) / "reference.exr"
        made = render(duel.scene, converged, duel.size, reference_seconds, REFERENCE_SEED, *duel.reference)
        parts, _ = read_exr(converged)
        reference = parts["image"]
        # A reference has noise of its own, which every difference from it holds too.
        squares = np.sort(relative_squares(parts["standard error"], reference).mean(axis=-1).ravel())
        own, own_trimmed = float(squares.mean()), float(squares[: len(squares) - int(TRIM * len(squares))].mean())
        for turn in range(runs):
            for way, options in duel.ways.items():
                figures = render(duel.scene, image, duel.size, seconds, turn, *options)
                picture = read_exr(image)[0]["image"]
                taken = float(figures["seconds_total"])
                error, trimmed = rel_mse(picture, reference) - own, rel_mse(picture, reference, trim=TRIM) - own_trimmed
                before = figures["seconds_context"], figures["seconds_compile"]
                results[way].append(
                    (1 / (error * taken), 1 / (trimmed * taken), error, trimmed, figures["spp"], *before)
                )
                chosen = (figures.get("choice") or {}).get("name", "")
                print(duel.title, way, turn, f"{error:.5f} {trimmed:.5f}", figures["spp"], *before, chosen, flush=True)
                if turn == 0 and way in duel.pictures:
                    duel.pictures[way].write_bytes(to_png(picture))
    lines = [
        f"## Equal time: {duel.title}",
        "",
        f"{duel.size}, depth 16, {seconds:.0f} s a render with loading, compilation and the context counted;",
        f"{runs} run{'s' * (runs > 1)} each, in turns. relMSE against {made['spp']} samples per pixel of another seed",
        f"(`{' '.join(duel.reference)}`), whose own relative variance, {own:.5f}, is taken off; *trimmed*",
        f"leaves out {TRIM:.0%} of the pixels, the worst.",
        "Efficiency is 1 / (relMSE seconds), as a ratio to `mi_path`, and to `mi_path` without roulette"
        + (": mean and range of the runs." if runs > 1 else "."),
        "",
        "| | context, compilation (s) | samples per pixel | relMSE | trimmed | to `mi_path` | trimmed "
        "| to it without roulette | trimmed |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    to, plain = (np.array(results[way]).mean(axis=0) for way in PLAIN)
    for way, rows in results.items():
        table = np.array(rows)
        mean = table.mean(axis=0)
        ratios = [_range(table[:, kind] / peer[kind]) for peer in (to, plain) for kind in (0, 1)]
        first = f"{way} | {mean[5]:.1f}, {mean[6]:.1f} | {mean[4]:.0f}"
        lines.append(f"| {first} | {mean[2]:.5f} | {mean[3]:.5f} | {' | '.join(ratios)} |")
    return [*lines, ""]


def _range(ratios: NDArray[np.float64]) -> str:
    """Mean, and where there are several the least and the greatest."""
    spread = f" ({ratios.min():.2f} to {ratios.max():.2f})" if len(ratios) > 1 else ""
    return f"{ratios.mean():.2f}{spread}"
