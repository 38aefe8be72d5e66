"""Every scene of the zoo by every algorithm that can render it, at a power that the test suite has no time for.

``python -m tests.benchmarks.validation`` prints a line for each comparison and writes docs/validation.md. It
takes half an hour on two cores that do nothing else; ``--seconds`` sets the time of a comparison, and with it
the smallest bias that it would have found, which stands beside each verdict.
"""

from __future__ import annotations

import gc
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from tests.agreement import POWER, Agreement, compare
from tests.rendering import Sampler, sampler
from tests.zoo import ALGORITHMS, ZOO, Entry

Array = np.ndarray[Any, Any]

REPORT = Path("docs/validation.md")
IMAGES = 24
"""Independent images of each estimator."""
BLOCK = 8
LEVEL = 0.01
"""Chance of a false alarm in the whole run."""
GOAL = 0.002
"""Relative bias of the mean that a comparison should find; what finds it takes no more time."""
REFERENCE_SHARE = 0.3
"""Part of the variance that is left to the reference, whose samples serve all algorithms and are cheaper."""
PILOT_SPP, PILOT_IMAGES = 64, 8
"""Images from which the noise is known before the samples are chosen."""
NOISE_MARGIN = 1.3
"""On the variance, which few images tell to within a third."""
STEEPNESS = 7.4
"""Standard errors of the difference that make a detectable bias: quantiles of Student's t at the run's level."""


@dataclass(frozen=True)
class Cell:
    """One comparison."""

    entry: Entry
    algorithm: str
    agreement: Agreement
    spp: int
    seconds: float

    def verdict(self) -> str:
        """A line for the terminal, and for the report where it disagrees."""
        found = self.agreement
        verdict = "agrees" if found.agrees else "DISAGREES"
        return (
            f"{self.entry.name} by {self.algorithm}: {verdict}, mean {found.mean_ratio - 1.0:+.3%}, "
            f"detectable {found.detectable:.2%}, smallest p {found.worst_p:.1e} (limit {found.level:.1e}) "
            f"at {found.where} ({found.ratio - 1.0:+.2%}), {IMAGES} images of {self.spp} spp, {self.seconds:.0f} s"
        )


def estimate(draw: Sampler, seconds: float, share: float) -> tuple[Array, int]:
    """Independent images of an estimator, and their samples per pixel.

    As many as reach the goal with ``share`` of the variance, and no more than fit in ``seconds``.
    """
    # The numbers of these images chose the samples, so that they are not among those that count.
    pilot = np.stack([draw(index, PILOT_SPP) for index in range(PILOT_IMAGES)])
    means = pilot.mean(axis=(1, 2, 3))
    variance = float(means.var(ddof=1)) * PILOT_SPP / max(float(means.mean()) ** 2, 1e-12)
    wanted = NOISE_MARGIN * variance / (share * (GOAL / STEEPNESS) ** 2) / IMAGES
    spp = round(affordable(draw, seconds / IMAGES, wanted))
    return np.stack([draw(PILOT_IMAGES + index, spp) for index in range(IMAGES)]), spp


def affordable(draw: Sampler, seconds: float, wanted: float) -> float:
    """Samples per pixel of one image: ``wanted``, or fewer where they take longer than ``seconds``."""
    spp = PILOT_SPP
    while True:
        begin = time.perf_counter()
        draw(0, spp)
        took = time.perf_counter() - begin
        if spp >= wanted or 2.0 * took > seconds:
            return max(PILOT_SPP, min(wanted, spp * seconds / took))
        spp *= 2


def validate(entry: Entry, algorithms: list[str], seconds: float, level: float) -> Iterator[Cell]:
    """Compare the algorithms' images of one scene with one reference."""
    with tempfile.TemporaryDirectory(prefix="elps-zoo-") as folder:
        scene = entry.load(Path(folder))
    reference = None
    for algorithm in algorithms:
        begin = time.perf_counter()
        common = {"max_depth": entry.max_depth, "seed": entry.seed}
        if reference is None:
            reference, _ = estimate(sampler(scene, entry.reference, **common), seconds, REFERENCE_SHARE)
        images, spp = estimate(sampler(scene, algorithm, **common), seconds, 1.0 - REFERENCE_SHARE)
        agreement = compare(images, reference, block=BLOCK, level=level)
        yield Cell(entry, algorithm, agreement, spp, time.perf_counter() - begin)


def report(cells: list[Cell], command: str, minutes: float) -> str:
    """The text of docs/validation.md."""
    detectable = np.array([cell.agreement.detectable for cell in cells])
    failed = [cell for cell in cells if not cell.agreement.agrees]
    shares = ", ".join(f"{np.mean(detectable <= limit):.0%} at most {limit:.1%}" for limit in (0.002, 0.005, 0.01))
    names = list(dict.fromkeys(cell.entry.name for cell in cells))
    lines = [
        "# Validation",
        "",
        "Every scene of the zoo (`tests/zoo`) by every algorithm that can render it, against one reference: `mi_path`",
        "without roulette unless the table says otherwise, `mi_ptracer` where next event estimation does not find all",
        "light, and `naive` (walks that count what they meet, a dozen lines) where `mi_path` itself errs. Welch's",
        f"t-test on the overall mean, the mean of each channel and the means of {BLOCK}x{BLOCK}-pixel blocks of",
        f"{IMAGES} independent images each, with the algorithms' own variances, at a level of {LEVEL:.0%} for the",
        "whole table (Sidak).",
        "",
        "A cell holds the difference of the means and, in brackets, the relative bias of the mean that the comparison",
        f"would have found with a chance of {POWER:.0%}.",
        "",
        f"Made by `{command}` in {minutes:.0f} minutes: {len(cells)} comparisons over {len(names)} scenes,",
        f"{len(failed)} disagree. Detectable biases: median {np.median(detectable):.2%}; {shares}.",
        "",
        "| scene | reference | " + " | ".join(ALGORITHMS) + " |",
        "|---|---|" + "---|" * len(ALGORITHMS),
    ]
    by_place = {(cell.entry.name, cell.algorithm): cell for cell in cells}
    for name in names:
        row = [_shown(by_place.get((name, algorithm))) for algorithm in ALGORITHMS]
        lines.append(f"| {name} | `{ZOO[name].reference}` | " + " | ".join(row) + " |")
    lines += ["", "## Disagreements", ""]
    lines += [f"- {cell.verdict()}" for cell in failed] or ["None."]
    lines += ["", "## What the scenes cover, and who is left out", ""]
    for name in names:
        out = [f"{a}: {ZOO[name].left_out[a]}" for a in ALGORITHMS if a in ZOO[name].left_out]
        lines.append(f"- **{name}**: {ZOO[name].about}. {'; '.join(out).capitalize()}{'.' if out else ''}".rstrip())
    lines += ["", "`light pure` is left out but for a wide lens: no light path meets a pinhole by chance.", ""]
    return "\n".join(lines)


def _shown(cell: Cell | None) -> str:
    if cell is None:
        return ""
    text = f"{cell.agreement.mean_ratio - 1.0:+.2%} ({cell.agreement.detectable:.2%})"
    return text if cell.agreement.agrees else f"**{text}**"


def main(
    scene: Annotated[list[str] | None, typer.Option(help="A scene; again for more. All where absent.")] = None,
    algorithm: Annotated[list[str] | None, typer.Option(help="An algorithm; again for more.")] = None,
    seconds: Annotated[float, typer.Option(min=0.1, help="Longest time of one estimator in one scene.")] = 5.0,
    output: Annotated[Path, typer.Option(help="Where the report goes.")] = REPORT,
) -> None:
    """Run every comparison and write the report; the exit code is 1 where some images disagree."""
    unknown = [*(set(scene or ()) - set(ZOO)), *(set(algorithm or ()) - set(ALGORITHMS))]
    if unknown:
        raise typer.BadParameter(f"unknown: {', '.join(unknown)}")
    work = [(entry, [a for a in entry.algorithms() if not algorithm or a in algorithm]) for entry in ZOO.values()]
    work = [(entry, chosen) for entry, chosen in work if chosen and (not scene or entry.name in scene)]
    total = sum(len(chosen) for _, chosen in work)
    level = 1.0 - (1.0 - LEVEL) ** (1.0 / total)
    begin = time.perf_counter()
    cells: list[Cell] = []
    for entry, chosen in work:
        for cell in validate(entry, chosen, seconds, level):
            cells.append(cell)
            print(f"[{len(cells)}/{total}] {cell.verdict()}", flush=True)
        gc.collect()  # A kernel handles every object that is alive.
    command = " ".join(["python -m tests.benchmarks.validation", *sys.argv[1:]])
    output.write_text(report(cells, command, (time.perf_counter() - begin) / 60.0))
    sys.exit(0 if all(cell.agreement.agrees for cell in cells) else 1)


if __name__ == "__main__":
    typer.run(main)
