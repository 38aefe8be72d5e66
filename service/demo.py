"""``elps demo``: the main job end to end, and what the global context is good for, in one picture.

The service is started as a user would start it, and everything else happens over HTTP.
"""

from __future__ import annotations

import contextlib
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

from rich.console import Console

from elps_core.settings import RenderSettings, StopCriterion
from service.client import Client, ServiceError
from service.figure import Panel, save_figure
from service.serve import ELPS, interruptible
from service.watch import watch
from worker.models import Job
from worker.pictures import ERROR_RANGE, error_legend_png

SIDE = 192
"""Width and height of the images, pixels: enough to see noise, small enough for two cores."""
EXPOSURE = 0.0
"""Stops by which both images are brightened in the figure."""
START_SECONDS = 60.0
"""Time for the first worker to come up: it loads its renderer first."""
STOP_SECONDS = 40.0
"""Time for the service to end; longer than it gives its workers."""
INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells have it."""
LEGEND_SIZE = (256, 16)
"""Width and height of the colour scale, pixels."""
TITLES = {"power": "light sampling by power", "adjoint": "light sampling by adjoint image"}


class Result(NamedTuple):
    """One finished render and its pictures as PNG."""

    job: Job
    seconds: float
    """Wall clock from the submission to the last image: loading, context, compilation and all."""
    image: bytes
    error: bytes

    @property
    def cost(self) -> float:
        """Squared relative error times seconds: the lower, the more efficient."""
        return float(self.job.relative_error or 0.0) ** 2 * self.seconds


def demo(out: Path, seconds: float) -> None:
    """Renders the maze with both ways to start light paths, for ``seconds`` each, and compares them.

    Writes ``partials/<way>_<number>.exr`` as they come and ``comparison.png``.

    Raises:
        ElpsError: a step failed; nothing keeps running.
    """
    console = Console()
    partials = out / "partials"
    partials.mkdir(parents=True, exist_ok=True)
    with interruptible(INTERRUPTED), tempfile.TemporaryDirectory(prefix="elps-demo-") as folder:
        console.print("starting the service")
        with _service(Path(folder) / "data") as url, Client(url) as client:
            scene = client.upload(_maze(Path(folder)))
            _await_worker(client)
            power = _render(client, scene.digest, "power", seconds, partials, console)
            adjoint = _render(client, scene.digest, "adjoint", seconds, partials, console)
            map_of_lights = client.file(f"/v1/contexts/{adjoint.job.context_digest}/adjoint.png")
    verdict = _verdict(power, adjoint)
    figure = out / "comparison.png"
    _draw(figure, power, adjoint, map_of_lights, verdict)
    for result in (power, adjoint):
        title = TITLES[result.job.settings.light_sampling]
        error = f"relative error {result.job.relative_error:.2%}"
        console.print(f"{title}: {error} after {result.seconds:.1f} s", highlight=False, soft_wrap=True)
    console.print(f"{verdict} (1 / (relative error^2 * seconds))", highlight=False, soft_wrap=True)
    console.print(f"see {figure} and the partial images in {partials}", highlight=False, markup=False, soft_wrap=True)


def _maze(folder: Path) -> Path:
    path = folder / "maze.zip"
    made = subprocess.run(  # noqa: S603
        [*ELPS, "scene", "maze", "-o", str(path)], stdout=subprocess.DEVNULL, check=False
    )
    if made.returncode:
        raise ServiceError("the maze could not be made: the lines above say why")
    return path


@contextlib.contextmanager
def _service(data: Path) -> Iterator[str]:
    """A service on a free port with one worker; the URL it listens on."""
    command = [*ELPS, "serve", "--port", "0", "--data", str(data)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)  # noqa: S603
    try:
        assert process.stdout is not None  # noqa: S101
        line = process.stdout.readline()
        if not line:
            raise ServiceError("the service did not start: the lines above say why")
        yield line.split()[-1]
    finally:
        process.terminate()
        try:
            process.wait(STOP_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()


def _await_worker(client: Client) -> None:
    """Waits until a worker is there, so that its start counts for neither render."""
    end = time.monotonic() + START_SECONDS
    while not client.workers():
        if time.monotonic() > end:
            raise ServiceError("no worker came up: the lines above say why")
        time.sleep(0.1)


def _render(
    client: Client, scene: str, way: Literal["power", "adjoint"], seconds: float, partials: Path, console: Console
) -> Result:
    console.print(f"{TITLES[way]}: {seconds:g} s", highlight=False)
    settings = RenderSettings(integrator="bdpt", light_sampling=way, width=SIDE, height=SIDE)
    job = client.submit(scene, settings, StopCriterion(seconds=seconds))
    saved = 0

    def save() -> None:
        nonlocal saved
        image = client.image(job.id, saved)
        if image is not None:
            saved, data = image
            (partials / f"{way}_{saved:04d}.exr").write_bytes(data)

    job = watch(client, job.id, console, save)
    if job.state != "completed" or job.finished is None:
        raise ServiceError(f"the render {job.state}: {job.message}")
    if job.relative_error is None:
        raise ServiceError("the time was too short for an error estimate: give more --seconds")
    save()
    image = client.file(f"/v1/jobs/{job.id}/image.png", exposure=EXPOSURE)
    return Result(job, job.finished - job.created, image, client.file(f"/v1/jobs/{job.id}/error.png"))


def _verdict(power: Result, adjoint: Result) -> str:
    better, worse = sorted((power, adjoint), key=lambda result: result.cost)
    winner, loser = (result.job.settings.light_sampling for result in (better, worse))
    return f"Light sampling by {winner} won: {worse.cost / better.cost:.1f} times as efficient as by {loser}"


def _draw(path: Path, power: Result, adjoint: Result, map_of_lights: bytes, verdict: str) -> None:
    low, high = ERROR_RANGE
    legend = Panel(error_legend_png(*LEGEND_SIZE), "relative standard error", f"{low:.0%} to {high:.0%}, logarithmic")
    lights = Panel(map_of_lights, "adjoint image", "which part of which lamp lights the picture", cells=True)
    rows = [
        [*(Panel(r.image, TITLES[r.job.settings.light_sampling], _numbers(r)) for r in (power, adjoint)), lights],
        [
            *(Panel(r.error, "its error per pixel", f"mean {r.job.relative_error:.1%}") for r in (power, adjoint)),
            legend,
        ],
    ]
    context = f"measuring the adjoint image took {adjoint.job.seconds_context:.0f} s of the second"
    subtitle = f"a maze, bidirectional path tracing, {power.seconds:.0f} s and {adjoint.seconds:.0f} s; {context}"
    save_figure(path, verdict, subtitle, rows)


def _numbers(result: Result) -> str:
    return f"{result.job.samples_done} samples per pixel in {result.seconds:.1f} s"
