"""Agreement of bdpt with Mitsuba's path tracer at a power that the test suite has no time for.

``python -m tests.benchmarks.validation`` takes about ten minutes on two cores, prints a table and writes
docs/validation.md. The smallest bias that each line would have found stands beside its verdict.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from elps_core import device
from elps_core.scene.generate import SceneDescription, cornell, door, maze, write
from elps_core.settings import ContextSettings, RenderSettings
from tests.agreement import compare

REPORT = Path("docs/validation.md")
SIZE = (48, 48)
DEPTH = 8
CHUNKS = 24
CASES: dict[str, tuple[SceneDescription, float, float]] = {
    # Scene, share of the time, and how many of mi_path's samples a bdpt sample is given.
    "cornell, boxes": (cornell(), 1.0, 4.0),
    "cornell, glass and rough gold": (cornell(objects="spheres"), 1.0, 4.0),
    "cornell, sphere light": (cornell(objects="spheres", light_shape="sphere"), 1.0, 4.0),
    "maze 3x3, glass and rough gold": (maze(), 1.5, 4.0),
    "door 30 degrees, glass and rough metal": (door(angle=30), 1.5, 8.0),
}


def main(samples: Annotated[int, typer.Option(help="bdpt samples per pixel and chunk.")] = 512) -> None:
    """Run every case with both light samplings and write the report."""
    device.use("llvm_ad_rgb")
    from elps_core.context.build import ContextBuilder
    from elps_core.renderer import Renderer
    from elps_core.scene.loader import LoadedScene, load_scene

    def chunks(scene: LoadedScene, spp: int, context: Any = None, **settings: Any) -> np.ndarray[Any, Any]:
        renderer = Renderer(scene, RenderSettings(max_depth=DEPTH, **settings), context)
        return np.stack([renderer.render_chunk(index, spp).image for index in range(CHUNKS)])

    lines = [
        "# Validation",
        "",
        "bdpt against `mi_path` without roulette: Welch's t-test on the means of 12x12-pixel blocks and on the overall",
        f"mean of {CHUNKS} independent chunks each, {SIZE[0]}x{SIZE[1]} pixels, depth {DEPTH}, Sidak-corrected to a",
        "level of 1% a line. *Detectable* is the relative bias of the mean that the line would have found with a",
        "chance of 95%.",
        "Made by `make validate`.",
        "",
        "| scene | light sampling, roulette | mean ratio | detectable | smallest p (must exceed) | agrees |",
        "|---|---|---|---|---|---|",
    ]
    print("\n".join(lines))
    failed = False
    with tempfile.TemporaryDirectory(prefix="elps-validation-") as folder:
        for name, (description, share, factor) in CASES.items():
            path = Path(folder) / "scene.zip"
            write(description, path)
            scene = load_scene(path, "llvm_ad_rgb", size=SIZE)
            begin = time.perf_counter()
            spp = int(samples * share)
            reference = chunks(scene, int(spp * factor), integrator="mi_path", roulette="none")
            builder = ContextBuilder(scene, ContextSettings())
            while builder.done < builder.steps:
                builder.step()
            ways = {
                "power, albedo": chunks(scene, spp, light_sampling="power", roulette="albedo"),
                "adjoint, throughput": chunks(scene, spp, builder.result(), roulette="throughput"),
            }
            for way, images in ways.items():
                found = compare(images, reference, block=12)
                lines.append(
                    f"| {name} | {way} | {found.mean_ratio:.5f} | {found.detectable:.2%} "
                    f"| {found.worst_p:.2g} ({found.level:.2g}) | {'yes' if found.agrees else '**NO**'} |"
                )
                failed |= not found.agrees
                print(lines[-1], f"({time.perf_counter() - begin:.0f} s)", flush=True)
    REPORT.write_text("\n".join(lines) + "\n")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    typer.run(main)
