"""The algorithms beside Mitsuba's path tracer: samples and rays a second, and equal time on a scene of others.

``python -m tests.benchmarks.algorithms`` prints tables and writes docs/algorithms.md and its pictures. Speed takes
three minutes on two cores. The comparison wants a scene that the project does not hold: ``--scene`` names it
(Veach's bidirectional scene), and it takes about a quarter of an hour. Run it on a machine that does nothing else.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from elps_core import device
from elps_core.scene.generate import cornell, write
from elps_core.settings import RenderSettings, with_overrides
from tests.benchmarks.common import in_turns, processor
from tests.benchmarks.equal_time import PLAIN, Duel, equal_time
from tests.benchmarks.rays import OwnRays

REPORT = Path("docs/algorithms.md")
SIDE = 256
DEPTH = 6
LANES = 1 << 18
TURNS = 7
WAYS: dict[str, tuple[dict[str, Any], int]] = {
    # Settings, and samples per pixel of a turn.
    "mi_path": ({"integrator": "mi_path"}, 64),
    "path": ({"integrator": "path"}, 64),
    "light": ({"integrator": "light"}, 64),
    "bdpt": ({"integrator": "bdpt"}, 32),
    "pssmlt": ({"integrator": "pssmlt", "pssmlt.multiplexed": False}, 32),
    "pssmlt, multiplexed": ({"integrator": "pssmlt", "pssmlt.multiplexed": True}, 32),
}
COMPARED: dict[str, list[str]] = {
    **PLAIN,
    "path": ["--integrator", "path"],
    "bdpt": ["--integrator", "bdpt"],
    "pssmlt": ["--integrator", "pssmlt", "--set", "pssmlt.multiplexed=false"],
    "pssmlt, multiplexed": ["--integrator", "pssmlt", "--set", "pssmlt.multiplexed=true"],
}
PICTURES = ("mi_path", "bdpt", "pssmlt")


def main(
    scene: Annotated[Path | None, typer.Option(help="Scene of the comparison at equal time.")] = None,
    seconds: Annotated[float, typer.Option()] = 60.0,
    reference_seconds: Annotated[float, typer.Option()] = 300.0,
    runs: Annotated[int, typer.Option()] = 2,
    size: Annotated[str, typer.Option()] = "256x256",
) -> None:
    """Run the benchmarks and write the report."""
    text = [
        "# Algorithms",
        "",
        f"Made by `make bench` on {processor()}, two cores. Ratios are between peers of the same run; times of one",
        "machine vary by about 10%.",
        "",
        *speed(),
    ]
    print("\n".join(text), flush=True)
    if scene is not None:
        title = scene.parent.name
        pictures = {way: REPORT.parent / f"{title}-{way.replace('_', '-')}.png" for way in PICTURES}
        duel = Duel(title, scene, COMPARED, ("--integrator", "bdpt"), size, pictures)
        compared = equal_time(duel, seconds, reference_seconds, runs)
        print("\n".join(compared))
        text += compared
    REPORT.write_text("\n".join(text) + "\n")


def speed() -> list[str]:
    """Samples and rays a second at depth 6 on the Cornell box, kernels warm, taken in turns."""
    device.use("llvm_ad_rgb")
    from elps_core.renderer import Renderer
    from elps_core.scene.loader import load_scene

    with tempfile.TemporaryDirectory(prefix="elps-bench-") as folder:
        write(cornell(), Path(folder) / "scene.zip")
        loaded = load_scene(Path(folder) / "scene.zip", "llvm_ad_rgb", size=(SIDE, SIDE))
    common = {"max_depth": DEPTH, "roulette": "none", "light_sampling": "power"}
    renderers = {
        name: Renderer(loaded, with_overrides(RenderSettings(), {**common, **options}))
        for name, (options, _) in WAYS.items()
    }

    def chunk(name: str) -> Callable[[int], object]:
        return lambda turn: renderers[name].render_chunk(turn, WAYS[name][1])

    bdpt = renderers["bdpt"].frames.bdpt
    own = OwnRays(bdpt, LANES)
    ways: dict[str, Callable[[int], object]] = {name: chunk(name) for name in WAYS}
    ways["rays"] = lambda _: own.replay(trace=True)
    ways["reading"] = lambda _: own.replay(trace=False)
    taken = in_turns(ways, TURNS)
    rate = {name: SIDE * SIDE * spp / taken[name] / 1e6 for name, (_, spp) in WAYS.items()}
    alone = taken["rays"] - taken["reading"]
    share = rate["bdpt"] * 1e6 / LANES * alone
    lines = [
        "## Speed",
        "",
        f"Cornell box, {SIDE}x{SIDE}, depth {DEPTH}, no roulette, `llvm_ad_rgb`, whole chunks. A sample of bdpt is an",
        "eye and a light path, one of pssmlt a mutation; its bootstrap counts.",
        "",
        f"| integrator | million samples a second (median of {TURNS}) | of `mi_path`'s (turns) |",
        "|---|---|---|",
    ]
    for name, values in rate.items():
        ratio = values / rate["mi_path"]
        lines.append(
            f"| {name} | {np.median(values):.2f} | {np.median(ratio):.3f} ({ratio.min():.3f} to {ratio.max():.3f}) |"
        )
    rays = own.per_sample * np.median(rate["bdpt"])
    limit = own.per_sample * LANES / np.median(alone) / 1e6
    lines += [
        "",
        f"A bdpt sample traces {own.per_sample:.1f} rays here: {rays:.1f} million a second. The same rays, recorded",
        "and traced alone (surfaces found, shadows tested, nothing shaded; reading them taken off), run at",
        f"{limit:.1f} million a second: bdpt works at {np.median(share):.3f} of the speed of its own rays",
        f"(turns: {share.min():.3f} to {share.max():.3f}).",
        "",
    ]
    for name in ("pssmlt", "pssmlt, multiplexed"):
        statistics = renderers[name].render_chunk(0, WAYS[name][1]).statistics
        lines.append(f"{name}: " + ", ".join(f"{key} {value:.4g}" for key, value in statistics.items()) + ".")
    return [*lines, ""]


if __name__ == "__main__":
    typer.run(main)
