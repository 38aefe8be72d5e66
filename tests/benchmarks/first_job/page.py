"""The page of the first job, made from the measurements alone."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.common import TRIM
from tests.benchmarks.first_job import results
from tests.benchmarks.first_job.ratios import LEVEL, Ratio, geometric_mean, ratio
from tests.benchmarks.first_job.results import AUTO, PEER, Record
from tests.benchmarks.first_job.scenes import JUDGED_ON, SCENES, TUNED_ON

TEMPERATURES = ("cold", "warm")
SEED = 1
"""Of the bootstrap: the same file makes the same page."""
HALF = {scene.title: "tuned on" for scene in TUNED_ON} | {scene.title: "judged on" for scene in JUDGED_ON}
NO_FIGURE = "-"
HIDDEN = "below the reference's noise"
FAILED = "failed"
GREAT_LOSS = 0.1
"""Ratio below which two decimals hold less than two digits."""
FOREIGN = "against another reference"

INTRODUCTION = f"""
# The first job

What a user gets who renders a scene for the first time: `elps render --integrator auto` beside Mitsuba as its own users
run it, `mi.load_file` and passes of `mi.render` with `path` until the time is over. Each run is a process of its own,
and all of its time counts: Python, loading, compilation, the context, pilots, rendering, saving. Both have depth 16,
roulette from depth 5 and `llvm_ad_rgb`. Losses stand beside wins.

- *cold*: Dr.Jit's kernel cache is empty. *warm*: it holds what a first run of the same way on the scene has left.
- *efficiency ratio*: mean over runs of relMSE x seconds of Mitsuba, over that of the other way; above 1 the other way
  wins. Seconds are those of the process from outside, relMSE is without the reference's own variance.
- Intervals hold {LEVEL:.0%} of a bootstrap over runs and blocks of pixels jointly. *wins* and *loses* are said where
  the whole interval is on one side of 1, else *undecided*.
- *geometric mean*: over the scenes that have a ratio; its interval is for these scenes, not for scenes at large.
- *tuned on*, *judged on*: constants that decide a choice are chosen on the first half of the scenes and checked on the
  second.
""".strip()
PLUS = "A plus marks files that differed from the commit."
TRIMMED = f"""
The worst {TRIM:.0%} of the pixels of either image are left out: what a few fireflies decide shows in the difference
from the table above. No intervals, because which pixels are left out depends on both ways. Fireflies behind the doors
are caustics of the ball of glass and the teapot, which eye paths of all ways meet by chance.
""".strip()
FIGURES = """
Means over runs. *over* is the time above what was asked for, of the process from outside and by its own clock.
""".strip()
CLOCK = """
Cold. Seconds above what was asked for: of the process from outside; by its own clock; and samples per pixel. Means over
runs.
""".strip()
FIRST_IMAGE = """
Seconds from the POST of an `auto` job of 512x512 pixels and 60 s until its EXR is there, by a service with one worker
that has done nothing before: mean and range over runs.
""".strip()

Column = tuple[str, float]
"""A temperature, and the seconds that were asked for."""


def write(measurements: Path) -> None:
    """Write the page beside the file of measurements."""
    measurements.with_suffix(".md").write_text("\n".join(lines(results.load(measurements))) + "\n")


def lines(held: dict[str, list[Record]]) -> list[str]:
    """The page as lines of Markdown."""
    runs = held["runs"]
    text = [*_head(held), *_left_out(held["left_out"])]
    for way in dict.fromkeys(record["way"] for record in (*runs, {"way": AUTO})):
        if way != PEER and any(record["way"] == way for record in runs):
            text += [*_efficiency(way, runs), *_trimmed(way, runs)]
    if runs:
        text += [*_figures(runs), *_times(runs)]
    if held["clock"]:
        text += _clock(held["clock"])
    if held["first_image"]:
        text += _first_image(held["first_image"])
    if held["references"]:
        text += _references(held["references"])
    return text[:-1]


def _head(held: dict[str, list[Record]]) -> list[str]:
    records = [record for kind in held.values() for record in kind]
    made = sorted({f"{record['commit']} ({record['date']}, {record['processor']})" for record in records})
    when = "; ".join(made) or "no commit yet: there are no measurements"
    return [*INTRODUCTION.splitlines(), "", f"Made by `python -m tests.benchmarks.first_job` at {when}.", PLUS, ""]


def _left_out(records: list[Record]) -> list[str]:
    if not records:
        return []
    return ["Left out:", "", *(f"- {record['scene']}: {record['why']}" for record in records), ""]


def _efficiency(way: str, runs: list[Record]) -> list[str]:
    """Ratios by scene, cold beside warm, and their geometric means."""
    columns, generator = _columns(runs), np.random.default_rng(SEED)
    found: dict[str, dict[Column, Ratio | str]] = {
        scene: {column: _ratio(runs, scene, way, column, generator) for column in columns} for scene in _titles(runs)
    }
    rows = [[scene, HALF[scene], *(_shown(cells[column]) for column in columns)] for scene, cells in found.items()]
    for name, half in (("all", None), ("tuned on", "tuned on"), ("judged on", "judged on")):
        row = [f"**geometric mean, {name}**", ""]
        for column in columns:
            known = [cells[column] for scene, cells in found.items() if half in (None, HALF[scene])]
            ratios = [cell for cell in known if isinstance(cell, Ratio)]
            mean = geometric_mean(ratios)
            row.append(f"{_shown(mean)}, {len(ratios)} scene{'s' * (len(ratios) != 1)}" if mean else NO_FIGURE)
        rows.append(row)
    score = ["**wins, loses, undecided**", ""]
    for column in columns:
        verdicts = [cell.verdict for cells in found.values() if isinstance(cell := cells[column], Ratio)]
        score.append(", ".join(str(verdicts.count(verdict)) for verdict in ("wins", "loses", "undecided")))
    title = f"## Efficiency ratios of `{way}` to Mitsuba at equal time"
    return [title, "", *_table(["scene", "half", *map(_name, columns)], [*rows, score])]


def _trimmed(way: str, runs: list[Record]) -> list[str]:
    columns = _columns(runs)
    rows = [
        [scene, *(_trimmed_ratio(_of(runs, scene, PEER, column), _of(runs, scene, way, column)) for column in columns)]
        for scene in _titles(runs)
    ]
    return [
        f"## Efficiency ratios of `{way}` without the worst pixels",
        "",
        *TRIMMED.splitlines(),
        "",
        *_table(["scene", *map(_name, columns)], rows),
    ]


def _figures(runs: list[Record]) -> list[str]:
    rows = []
    for series in _series(runs):
        good = _good(series)
        first = series[0]
        row = [first["scene"], first["way"], _name((first["temperature"], first["asked"]))]
        if good:
            choices = dict.fromkeys(str(record["choice"]) for record in good if record["choice"])
            row += [_mean(good, "relmse", "{:.3g}"), _mean(good, "trimmed", "{:.3g}"), _mean(good, "spp", "{:.0f}")]
            row += [_mean(good, name, "{:.2f}") for name in ("seconds_process", "overshoot_process", "overshoot")]
            row.append(", ".join(choices) or NO_FIGURE)
        else:
            row += [NO_FIGURE] * 7
        failures = len(series) - len(good)
        row.append(f"{len(series)}, {failures} {FAILED}" if failures else str(len(series)))
        rows.append(row)
    head = ["scene", "way", "", "relMSE", "trimmed", "samples per pixel", "seconds", "over", "over, by its own clock"]
    return [
        "## Errors, samples and times",
        "",
        *FIGURES.splitlines(),
        "",
        *_table([*head, "chosen", "runs"], rows),
    ]


def _times(runs: list[Record]) -> list[str]:
    """The parts of the time that each way tells, at the shortest time that was asked for."""
    shortest = min(record["asked"] for record in runs)
    text = [
        "## Where the time goes",
        "",
        f"Means over runs of {shortest:g} s, in seconds, as each way tells them itself; parts may lie in each other.",
        "",
    ]
    for way in dict.fromkeys(record["way"] for record in runs):
        told = _good(record for record in runs if record["way"] == way and record["asked"] == shortest)
        named = dict.fromkeys(name for record in told for name in record if name.startswith("seconds_"))
        parts = [name for name in named if name not in ("seconds_total", "seconds_process")]
        rows = [
            [series[0]["scene"], series[0]["temperature"], *(_mean(series, name, "{:.2f}") for name in parts)]
            for series in _series(told)
        ]
        head = [name.removeprefix("seconds_").replace("_", " ") for name in parts]
        text += [f"`{way}`:", "", *_table(["scene", "", *head], rows)]
    return text


def _clock(records: list[Record]) -> list[str]:
    asked = sorted({record["asked"] for record in records})
    rows = []
    for scene in _titles(records):
        row = [scene]
        for limit in asked:
            series = [record for record in records if record["scene"] == scene and record["asked"] == limit]
            good = _good(series)
            cell = [_mean(good, "overshoot_process", "{:+.2f}"), _mean(good, "overshoot", "{:+.2f}")]
            cell.append(_mean(good, "spp", "{:.0f}"))
            row.append("; ".join(cell) if good else FAILED if series else NO_FIGURE)
        rows.append(row)
    return [
        "## Does `auto` keep its time?",
        "",
        *CLOCK.splitlines(),
        "",
        *_table(["scene", *(f"{limit:g} s" for limit in asked)], rows),
    ]


def _first_image(records: list[Record]) -> list[str]:
    rows = []
    for scene in _titles(records):
        cells = []
        for temperature in TEMPERATURES:
            series = [record for record in records if (record["scene"], record["temperature"]) == (scene, temperature)]
            cells.append(_spread([record["seconds_first_image"] for record in _good(series)], len(series)))
        rows.append([scene, *cells])
    return [
        "## First partial image of the service",
        "",
        *FIRST_IMAGE.splitlines(),
        "",
        *_table(["scene", *TEMPERATURES], rows),
    ]


def _references(records: list[Record]) -> list[str]:
    rows = [
        [r["scene"], r["rendered_by"], r["size"], f"{r['seconds_asked']:g}", str(r["spp"]), f"{r['own']:.3g}"]
        for r in sorted(records, key=lambda record: list(SCENES).index(record["scene"]))
    ]
    head = ["scene", "rendered by", "size", "seconds", "samples per pixel", "own relative variance"]
    return ["## References", "", *_table(head, rows)]


def _ratio(runs: list[Record], scene: str, way: str, column: Column, generator: np.random.Generator) -> Ratio | str:
    """The ratio, or why there is none: a failed run is not forgiven."""
    peer, other = _of(runs, scene, PEER, column), _of(runs, scene, way, column)
    if not peer or not other:
        return NO_FIGURE
    failed = [name for name, series in ((PEER, peer), (way, other)) if len(_good(series)) < len(series)]
    if failed:
        return f"{' and '.join(failed)} {FAILED}"
    if not _comparable(peer, other):
        return FOREIGN
    return ratio(_products(peer), _products(other), generator) or HIDDEN


def _comparable(*series: list[Record]) -> bool:
    """Whether all errors are against the same reference: a page may hold series of different days."""
    return len({record["against"] for runs in series for record in runs}) == 1


def _products(series: list[Record]) -> NDArray[np.float64]:
    """relMSE x seconds by block, [runs, blocks]."""
    return np.array([np.array(record["blocks"]) * record["seconds_process"] for record in series])


def _trimmed_ratio(peer: list[Record], other: list[Record]) -> str:
    if not peer or not other or len(_good([*peer, *other])) < len(peer) + len(other) or not _comparable(peer, other):
        return NO_FIGURE
    above, below = (np.mean([run["trimmed"] * run["seconds_process"] for run in runs]) for runs in (peer, other))
    return _number(above / below) if min(above, below) > 0 else NO_FIGURE


def _shown(cell: Ratio | str) -> str:
    if isinstance(cell, str):
        return cell
    text = f"{_number(cell.value)} ({_number(cell.low)} to {_number(cell.high)})"
    return f"{text}, {cell.verdict}" if cell.verdict != "loses" else f"**{text}, {cell.verdict}**"


def _number(value: float) -> str:
    """Two decimals, or two digits where a loss is so great that decimals would hide it."""
    return f"{value:.2f}" if value >= GREAT_LOSS else f"{value:.2g}"


def _columns(records: Iterable[Record]) -> list[Column]:
    """By time, cold beside warm."""
    there = {(record["temperature"], record["asked"]) for record in records}
    return sorted(there, key=lambda column: (column[1], TEMPERATURES.index(column[0])))


def _name(column: Column) -> str:
    return f"{column[1]:g} s {column[0]}"


def _titles(records: Iterable[Record]) -> list[str]:
    there = {record["scene"] for record in records}
    return [title for title in SCENES if title in there]


def _of(records: list[Record], scene: str, way: str, column: Column) -> list[Record]:
    wanted = (scene, way, *column)
    return [r for r in records if (r["scene"], r["way"], r["temperature"], r["asked"]) == wanted]


def _series(records: list[Record]) -> list[list[Record]]:
    """Runs of the same scene, way, temperature and time together, scenes and columns in their order."""
    ways = list(dict.fromkeys(record["way"] for record in records))
    every = (
        _of(records, scene, way, column) for scene in _titles(records) for column in _columns(records) for way in ways
    )
    return [series for series in every if series]


def _good(records: Iterable[Record]) -> list[Record]:
    return [record for record in records if FAILED not in record]


def _mean(records: Sequence[Record], name: str, form: str) -> str:
    values = [record[name] for record in records if name in record]
    return form.format(np.mean(values)) if values else NO_FIGURE


def _spread(values: list[float], runs: int) -> str:
    if not values:
        return FAILED if runs else NO_FIGURE
    text = f"{np.mean(values):.1f}" + (f" ({min(values):.1f} to {max(values):.1f})" if len(values) > 1 else "")
    return text + (f", {runs - len(values)} {FAILED}" if runs > len(values) else "")


def _table(head: list[str], rows: list[list[str]]) -> list[str]:
    every = [head, ["---"] * len(head), *rows]
    return [*(f"| {' | '.join(row)} |" for row in every), ""]
