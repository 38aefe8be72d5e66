"""What the context is worth: plain and enlightened algorithms at equal time on scenes of our own.

``python -m tests.benchmarks.enlightened`` writes docs/enlightened.md and its pictures, in about 25 minutes on two cores
that do nothing else.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from elps_core.scene.generate import door, maze, write
from tests.benchmarks.common import processor
from tests.benchmarks.equal_time import PLAIN, Duel, equal_time

REPORT = Path("docs/enlightened.md")
GUIDED = ["--direction-sampling", "context", "--roulette", "context"]
WAYS: dict[str, list[str]] = {
    **PLAIN,
    "path": ["--integrator", "path"],
    "bdpt": ["--integrator", "bdpt"],
    "enlightened path": ["--integrator", "path", *GUIDED],
    "enlightened bdpt": ["--integrator", "bdpt", *GUIDED],
    "enlightened bdpt, 16 eye paths": ["--integrator", "bdpt", *GUIDED, "--set", "bdpt.eye_paths=16"],
}
PICTURES = {"mi_path": "mi-path", "enlightened path": "path", "enlightened bdpt, 16 eye paths": "bdpt"}
SIZE = "192x144"


def main(
    seconds: Annotated[float, typer.Option()] = 60.0,
    reference_seconds: Annotated[float, typer.Option()] = 240.0,
    runs: Annotated[int, typer.Option()] = 2,
    scene: Annotated[list[str] | None, typer.Option(help="door 9, door 3 or maze; again for more.")] = None,
) -> None:
    """Run the comparisons and write the report."""
    made = {"door 9": door(angle=9.0), "door 3": door(angle=3.0), "maze": maze()}
    text = [
        "# Enlightened sampling",
        "",
        f"Made by `python -m tests.benchmarks.enlightened` on {processor()}, two cores. *Enlightened* is",
        "`--direction-sampling context --roulette context`, its preprocessing counted as all the rest.",
        "",
    ]
    for title in scene or ("door 9", "maze"):
        with tempfile.TemporaryDirectory(prefix="elps-bench-") as name:
            path = Path(name) / "scene.zip"
            write(made[title], path)
            stem = title.replace(" ", "-")
            pictures = {way: REPORT.parent / f"{stem}-{file}.png" for way, file in PICTURES.items()}
            reference = WAYS["enlightened bdpt, 16 eye paths"]
            lines = equal_time(Duel(title, path, WAYS, reference, SIZE, pictures), seconds, reference_seconds, runs)
        print("\n".join(lines), flush=True)
        text += lines
    REPORT.write_text("\n".join(text) + "\n")


if __name__ == "__main__":
    typer.run(main)
