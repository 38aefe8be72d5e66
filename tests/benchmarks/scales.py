"""One room in many places and sizes, from near and far, by every algorithm: how far each image is off the usual one.

``python -m tests.benchmarks.scales`` prints a line for each comparison and writes docs/scales.md.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from elps_core.scene.loader import load_scene
from elps_core.settings import RenderSettings, with_overrides
from tests.agreement import Agreement, compare
from tests.benchmarks.validation import BLOCK, IMAGES, LEVEL, REFERENCE_SHARE, Array, estimate
from tests.rendering import Sampler
from tests.zoo.rooms import room

REPORT = Path("docs/scales.md")
ALGORITHMS = ("mi_path", "path", "light", "bdpt", "pssmlt")
VARIANT = "llvm_ad_rgb"
MAX_DEPTH = 4
CASES: Mapping[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "as it is": ({}, {}),
    **{f"{place:g} units off the origin": ({"place": place}, {}) for place in (1e2, 1e3, 1e5)},
    **{f"{size:g} of its size": ({"size": size}, {}) for size in (1e-6, 1e-3, 1e-2, 1e2, 1e5)},
    "a thousandth, 1e5 of its sizes off the origin": ({"size": 1e-3, "place": 1e5}, {}),
    "1e5 of its size, 1e5 of its sizes off the origin": ({"size": 1e5, "place": 1e5}, {}),
    **{f"camera at {eye:g} of the room": 2 * ({"eye": 4.0 * eye},) for eye in (10.0, 1e2, 1e3, 1e4)},
    **{f"spot at {lamp:g} of the room": 2 * ({"lamp": 4.0 * lamp},) for lamp in (1.0, 1e2, 1e3, 1e4)},
}
"""Name -> the room as it is rendered, and the one at home and of usual size whose image it must have. Cameras and
lamps far away light and see another room than those nearby, so that they are compared with ``mi_path`` alone."""


def draw(parameters: Mapping[str, Any], algorithm: str, seed: int) -> Sampler:
    """What renders independent images of the room, loaded as a user's file is."""
    with tempfile.TemporaryDirectory(prefix="elps-room-") as folder:
        path = Path(folder) / "scene.xml"
        path.write_text(room(**parameters))
        loaded = load_scene(path, VARIANT)
    from elps_core.renderer import Renderer  # here: it needs the variant that is set by now

    chosen = {"integrator": algorithm, "max_depth": MAX_DEPTH, "roulette": "none", "seed": seed}
    if not algorithm.startswith("mi_"):
        chosen["light_sampling"] = "power"
    renderer = Renderer(loaded, with_overrides(RenderSettings(), chosen))
    return lambda index, spp: renderer.render_chunk(index, spp).image


def main(
    seconds: Annotated[float, typer.Option(min=0.1, help="Longest time of one estimator in one room.")] = 2.0,
    output: Annotated[Path, typer.Option(help="Where the report goes.")] = REPORT,
) -> None:
    """Run every comparison and write the report; the exit code is 1 where some images disagree."""
    total = len(CASES) * len(ALGORITHMS)
    level = 1.0 - (1.0 - LEVEL) ** (1.0 / total)
    begin = time.perf_counter()
    usual: dict[str, Array] = {}
    rows: dict[str, dict[str, Agreement]] = {}
    for name, (parameters, at_home) in CASES.items():
        if (key := repr(at_home)) not in usual:
            usual[key], _ = estimate(draw(at_home, "mi_path", 1), seconds, REFERENCE_SHARE)
        rows[name] = {}
        for algorithm in ALGORITHMS:
            images, spp = estimate(draw(parameters, algorithm, 2), seconds, 1.0 - REFERENCE_SHARE)
            found = rows[name][algorithm] = compare(images, usual[key], block=BLOCK, level=level)
            verdict = "agrees" if found.agrees else f"DISAGREES at {found.where}"
            print(f"{name} by {algorithm}: {verdict}, {_shown(found)}, {spp} spp", flush=True)
    command = " ".join(["python -m tests.benchmarks.scales", *sys.argv[1:]])
    output.write_text(report(rows, command, (time.perf_counter() - begin) / 60.0))
    sys.exit(0 if all(found.agrees for row in rows.values() for found in row.values()) else 1)


def report(rows: Mapping[str, Mapping[str, Agreement]], command: str, minutes: float) -> str:
    """The text of docs/scales.md."""
    lines = [
        "# Scales",
        "",
        "A floor, a wall, a ball and a lamp, far from the origin, tiny and huge, seen and lit from afar. A cell holds",
        "the difference of the mean from the image of `mi_path` of the same room at home and of usual size, with other",
        "random numbers, and in brackets the relative bias that the comparison would have found with a chance of 95%.",
        "Bold cells disagree by Welch's t-test on means and on blocks of",
        f"{BLOCK}x{BLOCK} pixels of {IMAGES} images each, at a level of {LEVEL:.0%} for the whole table. Cameras and",
        "lamps far away are compared with `mi_path` of the same scene. ELPS moves and scales every scene at load, for",
        "Mitsuba's integrators as well: the column `mi_path` is not what plain Mitsuba makes of these files.",
        "",
        f"Made by `{command}` in {minutes:.0f} minutes.",
        "",
        "| room | " + " | ".join(ALGORITHMS) + " |",
        "|---|" + "---|" * len(ALGORITHMS),
    ]
    lines += [f"| {name} | " + " | ".join(_shown(row[a]) for a in ALGORITHMS) + " |" for name, row in rows.items()]
    return "\n".join([*lines, ""])


def _shown(found: Agreement) -> str:
    text = f"{found.mean_ratio - 1.0:+.2%} ({found.detectable:.2%})"
    return text if found.agrees else f"**{text}**"


if __name__ == "__main__":
    typer.run(main)
