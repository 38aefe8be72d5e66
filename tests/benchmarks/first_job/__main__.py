"""The benchmark that tells the truth: a user's first job by ``auto``, beside Mitsuba as its own users run it.

``python -m tests.benchmarks.first_job`` compares both at equal time, everything counted, with kernels compiled before
(warm) and not (cold), and writes docs/first-job.json and from it docs/first-job.md. It takes three hours on two cores
that do nothing else, 45 minutes of them for references, which are kept. ``--clock`` asks only whether ``auto``
keeps its time, ``--first-image`` how long a user of the service waits for a picture, ``--tables`` makes the page anew.
A series that is measured again takes the place of the old one; what the file says of all others stays.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import httpx
import typer

from elps_core.scene.bundle import is_archive
from tests.benchmarks.enlightened import WAYS
from tests.benchmarks.first_job import page, results
from tests.benchmarks.first_job.first_image import first_image
from tests.benchmarks.first_job.measure import Image, Timed, by_elps, by_mitsuba, reference
from tests.benchmarks.first_job.results import AUTO, PEER, Record
from tests.benchmarks.first_job.scenes import SCENES, LeftOut, Staged, stage

EQUAL_SECONDS = (15.0, 60.0)
"""A first look, and a picture: a job is not longer where somebody waits for it."""
CLOCK_SECONDS = (5.0, 10.0, 20.0, 60.0)
"""From less than compilation takes to as long as matters here."""
REFERENCES = Path(tempfile.gettempdir()) / "elps-references"
COLD, WARM = "cold", "warm"


def _scenes(names: list[str]) -> list[str]:
    """Refuses a scene that is not one of :data:`SCENES`."""
    for name in names:
        if name not in SCENES:
            raise typer.BadParameter(f"there is no scene '{name}': choose among {', '.join(SCENES)}")
    return names


def _ways(names: list[str]) -> list[str]:
    """Refuses a way that is none of :data:`WAYS`."""
    for name in names:
        if name not in WAYS:
            raise typer.BadParameter(f"there is no way '{name}': choose among {', '.join(WAYS)}")
    return names


def _size(text: str) -> str:
    """Refuses what is not WIDTHxHEIGHT."""
    if not all(part.isdecimal() and int(part) for part in text.split("x")) or text.count("x") != 1:
        raise typer.BadParameter("give the size as WIDTHxHEIGHT, for example 160x120")
    return text


def main(
    seconds: Annotated[list[float], typer.Option(help="Again for more; 15 and 60, by the clock 5 to 60.")] = [],  # noqa: B006
    runs: Annotated[int, typer.Option(min=1)] = 2,
    scene: Annotated[list[str], typer.Option(callback=_scenes, help="Again for more.")] = list(SCENES),  # noqa: B006
    way: Annotated[list[str], typer.Option(callback=_ways, help="Again for more; they stand beside auto.")] = [],  # noqa: B006
    size: Annotated[str, typer.Option(callback=_size, help="Shared scenes keep their proportions in it.")] = "160x120",
    reference_seconds: Annotated[float, typer.Option()] = 240.0,
    references: Annotated[Path, typer.Option(help="Where references are kept.")] = REFERENCES,
    shared: Annotated[Path, typer.Option(help="Scenes that the project does not hold.")] = Path("../shared/scenes"),
    cold: Annotated[bool, typer.Option("--cold", help="Only with no kernel compiled before.")] = False,
    warm: Annotated[bool, typer.Option("--warm", help="Only with all kernels compiled before.")] = False,
    clock: Annotated[bool, typer.Option("--clock", help="Only whether auto keeps its time, cold.")] = False,
    first: Annotated[bool, typer.Option("--first-image", help="Only the service's first partial image.")] = False,
    tables: Annotated[bool, typer.Option("--tables", help="Only make the page from the file.")] = False,
    out: Annotated[Path, typer.Option(help="The measurements; the page lies beside them.")] = Path(
        "docs/first-job.json"
    ),
) -> None:
    """Measure, and write the measurements and the page."""
    if not out.parent.is_dir():
        raise typer.BadParameter(f"the folder of {out} does not exist: create it first")
    temperatures = [name for name, only in ((COLD, cold), (WARM, warm)) if only or cold == warm]
    width, height = map(int, size.split("x"))
    for title in () if tables else scene:
        with tempfile.TemporaryDirectory(prefix="elps-bench-") as name:
            folder = Path(name)
            try:
                staged = stage(SCENES[title], _new(folder / "scene"), shared, (width, height))
                if first:
                    results.enter(out, "first_image", first_images(title, staged, folder, temperatures, runs))
                elif clock:
                    asked = seconds or list(CLOCK_SECONDS)
                    results.enter(out, "clock", equal_time(title, staged, folder, [AUTO], asked, [COLD], runs))
                else:
                    references.mkdir(parents=True, exist_ok=True)
                    options = WAYS[SCENES[title].reference]
                    converged, told = reference(SCENES[title], staged, options, reference_seconds, references)
                    results.enter(out, "references", [told])
                    ways = [PEER, AUTO, *(forced for forced in way if forced != AUTO)]
                    asked = seconds or list(EQUAL_SECONDS)
                    measured = equal_time(title, staged, folder, ways, asked, temperatures, runs, converged.errors)
                    results.enter(out, "runs", measured)
            except LeftOut as why:
                print(f"{title}: left out: {why}", flush=True)
                results.enter(out, "left_out", [{"scene": title, "why": str(why)}])
            else:
                results.forget(out, "left_out", title)
    page.write(out)


def equal_time(
    title: str,
    staged: Staged,
    folder: Path,
    ways: list[str],
    asked: list[float],
    temperatures: list[str],
    runs: int,
    errors: Callable[[Image], Record] = lambda _: {},
) -> list[Record]:
    """All ways for all times, in turns; every other turn begins with the last way.

    A turn of a way has an empty folder of kernels. Its cold run fills that, its warm one uses what the cold one left.
    """
    found: list[Record] = []
    for turn in range(runs):
        for limit in asked:
            for way in ways if turn % 2 == 0 else reversed(ways):
                cache = _new(folder / "kernels")
                for number, temperature in enumerate((COLD, WARM)):
                    if temperature == WARM and WARM not in temperatures:
                        continue
                    record: Record = {"scene": title, "way": way, "temperature": temperature, "asked": limit}
                    record["run"] = turn
                    try:
                        seed = 2 * turn + number
                        made = _image(staged, folder, way, limit, seed, cache)
                    except subprocess.CalledProcessError as failed:
                        print(f"{title}, {way}: {failed.stderr}", file=sys.stderr, flush=True)
                        record["failed"] = failed.returncode
                    else:
                        record |= {**made.figures, **errors(made.image)}
                    if temperature in temperatures:
                        found.append(record)
                        shown = {name: value for name, value in record.items() if name != "blocks"}
                        print(", ".join(f"{name} {value}" for name, value in shown.items()), flush=True)
                shutil.rmtree(cache)
    return found


def _image(staged: Staged, folder: Path, way: str, seconds: float, seed: int, cache: Path) -> Timed:
    if way == PEER:
        return by_mitsuba(staged, folder, seconds, seed, cache)
    return by_elps(staged, folder, seconds, seed, WAYS[way], cache)


def first_images(title: str, staged: Staged, folder: Path, temperatures: list[str], runs: int) -> list[Record]:
    """A service for each run and temperature; the warm one has the kernels of the cold one, but not its context."""
    bundle, found = _bundle(staged, folder), []
    for turn in range(runs):
        cache = _new(folder / "kernels")
        for number, temperature in enumerate((COLD, WARM)):
            if temperature == WARM and WARM not in temperatures:
                continue
            data = folder / f"data-{turn}-{number}"
            record: Record = {"scene": title, "way": AUTO, "temperature": temperature, "run": turn}
            try:
                record |= first_image(bundle, data, cache, seed=2 * turn + number)
            except (TimeoutError, RuntimeError, httpx.HTTPError) as failed:
                record["failed"] = str(failed)
            if temperature in temperatures:
                found.append(record)
                print(", ".join(f"{name} {value}" for name, value in record.items()), flush=True)
        shutil.rmtree(cache)
    return found


def _bundle(staged: Staged, folder: Path) -> Path:
    """The scene as one file to upload."""
    if is_archive(staged.source):
        return staged.source
    bundle = folder / "bundle.zip"
    with zipfile.ZipFile(bundle, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in _files(staged.source.resolve().parent):
            archive.write(path, path.relative_to(staged.source.resolve().parent))
    return bundle


def _files(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.rglob("*")) if path.is_file())


def _new(folder: Path) -> Path:
    folder.mkdir()
    return folder


if __name__ == "__main__":
    typer.run(main)
