"""The main job's figures: speed beside Mitsuba's path tracer, what the adjoint image is worth, latencies.

``python -m tests.benchmarks.main_job`` takes about a quarter of an hour on two cores, prints a table and writes
docs/benchmarks.md. Run it on a machine that does nothing else. ``--seconds`` shortens the comparison.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated

import httpx
import numpy as np
import typer

from elps_core.estimate.stats import rel_mse, relative_squares
from elps_core.io.exr import read_exr
from tests.benchmarks.common import ELPS, TRIM, processor, render, run

REPORT = Path("docs/benchmarks.md")
SIZE = "256x256"
RUNS = 2
WAYS = {
    "bdpt, power": ["--light-sampling", "power"],
    "bdpt, adjoint": ["--light-sampling", "adjoint"],
    "mi_path": ["--integrator", "mi_path"],
}


def main(
    seconds: Annotated[float, typer.Option()] = 60.0, reference_seconds: Annotated[float, typer.Option()] = 150.0
) -> None:
    """Run all three benchmarks and write the report."""
    with tempfile.TemporaryDirectory(prefix="elps-bench-") as name:
        folder = Path(name)
        for kind in ("maze", "cornell"):
            run("scene", kind, "-o", str(folder / f"{kind}.zip"))
        text = [
            "# Benchmarks",
            "",
            f"Made by `make bench` on {processor()}, two cores. Ratios are between peers of the same run; times of one",
            "machine vary by about 10%.",
            "",
            *speed(folder),
            *efficiency(folder, seconds, reference_seconds),
            *latency(folder),
        ]
    REPORT.write_text("\n".join(text) + "\n")
    print("\n".join(text))


def speed(folder: Path) -> list[str]:
    """Samples a second at depth 6 on the Cornell box, kernels warm, taken in turns."""
    code = """
import sys, time, json
from pathlib import Path
from elps_core import device
device.use("llvm_ad_rgb")
from elps_core.renderer import Renderer
from elps_core.scene.loader import load_scene
from elps_core.settings import RenderSettings
scene = load_scene(Path(sys.argv[1]), "llvm_ad_rgb", size=(256, 256))
ways = {
    "bdpt": (Renderer(scene, RenderSettings(light_sampling="power", max_depth=6, roulette="none")), 32),
    "mi_path": (Renderer(scene, RenderSettings(integrator="mi_path", max_depth=6, roulette="none")), 96),
}
rates = {name: [] for name in ways}
for turn in range(6):
    for name, (renderer, spp) in ways.items():
        chunk = renderer.render_chunk(turn, spp)
        if turn:
            rates[name].append(256 * 256 * spp / chunk.seconds / 1e6)
print(json.dumps(rates))
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(folder / "cornell.zip")], check=True, stdout=subprocess.PIPE, text=True
    )
    rates: dict[str, list[float]] = json.loads(done.stdout.strip().splitlines()[-1])
    median = {name: float(np.median(values)) for name, values in rates.items()}
    ratios = np.array(rates["bdpt"]) / np.array(rates["mi_path"])
    return [
        "## Speed",
        "",
        "Cornell box, 256x256, depth 6, no roulette, `llvm_ad_rgb`; a sample of bdpt is an eye and a light path.",
        "",
        "| integrator | million samples a second (median of 5) |",
        "|---|---|",
        *(f"| {name} | {value:.2f} |" for name, value in median.items()),
        "",
        f"bdpt makes {np.median(ratios):.3f} of `mi_path`'s samples (turns: {ratios.min():.3f} to {ratios.max():.3f}).",
        "",
    ]


def efficiency(folder: Path, seconds: float, reference_seconds: float) -> list[str]:
    """Equal time on the maze, everything counted, against a converged reference of another seed."""
    scene = folder / "maze.zip"
    reference_path = folder / "reference.exr"
    made = render(scene, reference_path, SIZE, reference_seconds, 999, "--light-sampling", "adjoint")
    parts, _ = read_exr(reference_path)
    reference = parts["image"]
    # A reference has noise of its own, which every difference from it holds too.
    own = float(relative_squares(parts["standard error"], reference).mean())
    rows: dict[str, list[tuple[float, float, float, int]]] = {name: [] for name in WAYS}
    for turn in range(RUNS):
        for number, (name, options) in enumerate(WAYS.items()):
            output = folder / f"{number}-{turn}.exr"
            figures = render(scene, output, SIZE, seconds, turn, *options)
            picture = read_exr(output)[0]["image"]
            time_taken = float(figures["seconds_total"])
            error, trimmed = rel_mse(picture, reference) - own, rel_mse(picture, reference, trim=TRIM) - own
            rows[name].append((1 / (error * time_taken), 1 / (trimmed * time_taken), error, int(figures["spp"])))
    base = np.mean([row[0] for row in rows["bdpt, power"]]), np.mean([row[1] for row in rows["bdpt, power"]])
    lines = [
        "## The adjoint image",
        "",
        f"Maze of 3x3 rooms, {SIZE}, depth 16, {seconds:.0f} s a render with loading, compilation and the context",
        f"counted; {RUNS} runs each, in turns. relMSE is taken against {made['spp']} samples per pixel of another",
        f"seed; *trimmed* leaves out the worst {TRIM:.0%} of the pixels. Efficiency is 1 / (relMSE seconds), here",
        f"over that of bdpt with power. The reference's own relative variance, {own:.5f}, is taken off.",
        "",
        "| | samples per pixel | relMSE | efficiency | range over runs | efficiency, trimmed |",
        "|---|---|---|---|---|---|",
    ]
    for name, results in rows.items():
        plain, trimmed = [row[0] / base[0] for row in results], [row[1] / base[1] for row in results]
        lines.append(
            f"| {name} | {np.mean([row[3] for row in results]):.0f} | {np.mean([row[2] for row in results]):.5f} "
            f"| {np.mean(plain):.2f} | {min(plain):.2f} to {max(plain):.2f} | {np.mean(trimmed):.2f} |"
        )
    return [*lines, ""]


def latency(folder: Path) -> list[str]:
    """From the POST of a job to its first image: a cold scene, and a second job on the same scene."""
    command = [str(ELPS), "serve", "--port", "0", "--data", str(folder / "data")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        url = process.stdout.readline().split()[-1]
        with httpx.Client(base_url=url, timeout=60) as client:
            while not client.get("/v1/workers").json()["workers"]:
                time.sleep(0.2)
            with (folder / "maze.zip").open("rb") as file:
                scene = (
                    client.post("/v1/scenes", files={"file": ("maze.zip", file)}).raise_for_status().json()["digest"]
                )
            first = first_image(client, scene, seed=1)
            second = first_image(client, scene, seed=2)
    finally:
        process.terminate()
        process.wait(60)
    return [
        "## Latency",
        "",
        "Service with one worker, maze at 512x512, kernels compiled before; from the POST of the job to its first EXR.",
        "",
        "| | seconds | context |",
        "|---|---|---|",
        f"| first job on the scene | {first[0]:.2f} | {'hit' if first[1] else 'built'} |",
        f"| second job, other seed | {second[0]:.2f} | {'hit' if second[1] else 'built'} |",
        "",
    ]


def first_image(client: httpx.Client, scene: str, seed: int) -> tuple[float, bool]:
    """Seconds from the POST until an EXR is there, and whether the context was."""
    body = {"scene": scene, "settings": {"seed": seed}, "stop": {"seconds": 20}}
    begin = time.perf_counter()
    job = client.post("/v1/jobs", json=body).raise_for_status().json()["id"]
    while client.get(f"/v1/jobs/{job}/image.exr").status_code != httpx.codes.OK:
        time.sleep(0.02)
    taken = time.perf_counter() - begin
    hit = bool(client.get(f"/v1/jobs/{job}").json()["context_hit"])
    client.post(f"/v1/jobs/{job}:cancel").raise_for_status()
    return taken, hit


if __name__ == "__main__":
    typer.run(main)
