"""What the context is worth: plain and enlightened algorithms at equal time, and what pilots make of both.

``python -m tests.benchmarks.enlightened`` writes docs/enlightened.md and its pictures, in about an hour on two cores
that do nothing else; ``--scene`` takes some of the scenes, and keeps what the page says of the others. ``--way`` takes
some of the ways beside the peers, and writes a section of its own.
"""

from __future__ import annotations

import re
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from elps_core.scene.generate import cornell, door, maze, write
from tests.benchmarks.common import render
from tests.benchmarks.equal_time import PLAIN, Duel, equal_time

REPORT = Path("docs/enlightened.md")
FORCED = ["--direction-sampling", "context", "--roulette", "context", "--set", "context.adaptive=false"]
LIT = ["--light-sampling", "context", "--set", "context.adaptive=false"]
WAYS: dict[str, list[str]] = {
    **PLAIN,
    "path": ["--integrator", "path"],
    "bdpt": ["--integrator", "bdpt"],
    "bdpt, exitance": ["--integrator", "bdpt", "--light-sampling", "power"],
    "pssmlt": ["--integrator", "pssmlt"],
    "pssmlt, exitance": ["--integrator", "pssmlt", "--light-sampling", "power"],
    "enlightened path": ["--integrator", "path", *FORCED],
    "enlightened bdpt": ["--integrator", "bdpt", *FORCED, "--set", "bdpt.guided_light=true"],
    "enlightened bdpt, unjoined": [
        *("--integrator", "bdpt", *FORCED, "--set", "bdpt.eye_paths=4"),
        *("--set", "bdpt.joins=false"),
    ],
    "enlightened pssmlt": ["--integrator", "pssmlt", *FORCED],
    "enlightened pssmlt over path": ["--integrator", "pssmlt", *FORCED, "--set", "pssmlt.over=path"],
    "enlightened pssmlt, unjoined": ["--integrator", "pssmlt", *FORCED, "--set", "pssmlt.over=unjoined"],
    "path, lit by context": ["--integrator", "path", *LIT],
    "bdpt, lit by context, unjoined": [
        *("--integrator", "bdpt", *LIT, "--set", "bdpt.eye_paths=4"),
        *("--set", "bdpt.joins=false"),
    ],
    "thesis bdpt": ["--integrator", "bdpt", "--preset", "thesis"],
    "auto": ["--integrator", "auto"],
}
CACHED = "auto, second job"
"""Finds the context that another job has left."""
PICTURES = {
    "mi_path": "mi-path",
    "enlightened path": "path",
    "auto": "auto",
    "bdpt, exitance": "bdpt-exitance",
    "bdpt": "bdpt-adjoint",
    "pssmlt, exitance": "pssmlt-exitance",
    "pssmlt": "pssmlt-adjoint",
}
SIZE = "192x144"


def bulb(path: Path) -> None:
    """The door room with a bulb in a ball of glass in place of its lamp: no light point is seen from anywhere."""
    write(door(angle=20.0), path)
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    lamp = re.compile(r'<shape type="rectangle" id="light">.*?</shape>', re.DOTALL)
    center = '<point name="center" x="1.3" y="6.7" z="1.8" />'
    inside = (
        f'<shape type="sphere" id="light">{center}<float name="radius" value="0.12" />'
        '<emitter type="area"><rgb name="radiance" value="9000 8500 7700" /></emitter></shape>'
        f'<shape type="sphere" id="bulb">{center}<float name="radius" value="0.2" />'
        '<bsdf type="dielectric" /></shape>'
    )
    text, count = lamp.subn(inside, files["scene.xml"].decode())
    assert count == 1, "the door scene has another lamp"
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, text if name == "scene.xml" else data)


@dataclass(frozen=True)
class Case:
    """A scene, and what renders it for how long."""

    make: Callable[[Path], None]
    ways: tuple[str, ...]
    reference: str = "enlightened bdpt, unjoined"
    factor: float = 1.0
    """Of the seconds of a render."""
    pictures: tuple[str, ...] = ()
    """Ways whose pictures the report shows."""


PEERS = tuple(PLAIN)
EASY = (*PEERS, "path", "enlightened path", "bdpt", "auto")
FOUR = ("bdpt, exitance", "bdpt", "pssmlt, exitance", "pssmlt")
"""Of figure 5.11 of the thesis."""
CASES = {
    "door 9": Case(
        lambda path: write(door(angle=9.0), path),
        (
            *EASY,
            "enlightened bdpt, unjoined",
            "pssmlt",
            "enlightened pssmlt",
            "enlightened pssmlt over path",
            "enlightened pssmlt, unjoined",
            "thesis bdpt",
            CACHED,
        ),
        "enlightened path",
        pictures=("mi_path", "enlightened path", "auto"),
    ),
    "door 3": Case(
        lambda path: write(door(angle=3.0), path),
        (*PEERS, "enlightened path", "enlightened bdpt, unjoined", "auto"),
        "enlightened path",
        factor=2.0,
    ),
    "maze": Case(
        lambda path: write(maze(), path),
        tuple(
            dict.fromkeys(
                (
                    *EASY,
                    "enlightened bdpt, unjoined",
                    "path, lit by context",
                    "bdpt, lit by context, unjoined",
                    *FOUR,
                )
            )
        ),
        pictures=FOUR,
    ),
    "bulb in glass": Case(
        bulb,
        (*PEERS, "bdpt", "enlightened path", "enlightened bdpt", "enlightened bdpt, unjoined", "auto"),
        "bdpt",
        pictures=("mi_path", "auto"),
    ),
    "cornell": Case(lambda path: write(cornell(), path), EASY, "enlightened path"),
}


def _known(scenes: list[str]) -> list[str]:
    """Refuses a scene that is not one of :data:`CASES`, nor a file."""
    for name in scenes:
        if name not in CASES and not Path(name).exists():
            raise typer.BadParameter(f"there is no scene '{name}': choose among {', '.join(CASES)}, or name a file")
    return scenes


def _ways(names: list[str]) -> list[str]:
    """Refuses a way that is none of :data:`WAYS`, nor that of a second job."""
    for name in names:
        if name not in WAYS and name != CACHED:
            raise typer.BadParameter(f"there is no way '{name}': choose among {', '.join((*WAYS, CACHED))}")
    return names


def main(
    seconds: Annotated[float, typer.Option()] = 60.0,
    reference_seconds: Annotated[float, typer.Option()] = 240.0,
    runs: Annotated[int, typer.Option()] = 2,
    scene: Annotated[list[str], typer.Option(callback=_known, help="Again for more; files, too.")] = list(CASES),  # noqa: B006
    way: Annotated[list[str], typer.Option(callback=_ways, help="Again for more; all of the scene's if absent.")] = [],  # noqa: B006
) -> None:
    """Run the comparisons and write the report."""
    for title in scene:
        with tempfile.TemporaryDirectory(prefix="elps-bench-") as name:
            case, path = CASES.get(title), Path(name) / "scene.zip"
            if case:
                case.make(path)
            else:
                path, case = Path(title), Case(lambda _: None, EASY, "bdpt")
                title = path.parent.name if path.stem == "scene" else path.stem
            stem = title.replace(" ", "-")
            if way:
                ways = (*PEERS, *way)
                shown = tuple(name for name in case.pictures if name in ways)
                case, title = replace(case, ways=ways, pictures=shown), f"{title}, fewer ways"
            context = Path(name) / "context.elps"
            every = {**WAYS, CACHED: [*WAYS["auto"], "--context", str(context)]}
            if CACHED in case.ways:
                render(path, Path(name) / "first.exr", SIZE, case.factor * seconds, 0, *every[CACHED])
            pictures = {way: REPORT.parent / f"{stem}-{PICTURES[way]}.png" for way in case.pictures}
            duel = Duel(title, path, {way: every[way] for way in case.ways}, WAYS[case.reference], SIZE, pictures)
            lines = equal_time(duel, case.factor * seconds, case.factor * reference_seconds, runs)
        print("\n".join(lines), flush=True)
        _enter(lines)


def _enter(lines: list[str]) -> None:
    """Put a section in place of that of the same title, or at the end."""
    head, *sections = re.split(r"^(?=## )", REPORT.read_text(), flags=re.MULTILINE)
    new = "\n".join(lines) + "\n"
    kept = [new if section.splitlines()[0] == lines[0] else section for section in sections]
    if new not in kept:
        kept.append(new)
    REPORT.write_text(head + "\n\n".join(section.strip() for section in kept) + "\n")


if __name__ == "__main__":
    typer.run(main)
