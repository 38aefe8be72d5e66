"""Commands of the service: ``elps serve``, ``submit``, ``watch`` and ``demo``.

Imports of what a command needs stand in the command, so that ``elps --help`` answers at once.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from elps_core.settings import RenderSettings, StopCriterion
    from worker.models import Job

URL = "http://127.0.0.1:8000"
PORT = 8000
DATA = Path("~/.local/share/elps")

Url = Annotated[str, typer.Option("--url", envvar="ELPS_URL", help="Where the service listens.")]
Output = Annotated[Path | None, typer.Option("-o", "--output", help="Wait for the end and save the image here (EXR).")]


def register(app: typer.Typer) -> None:
    """Adds the commands to ``app``."""
    for command in (serve, submit, watch, demo):
        app.command()(command)


def serve(
    host: Annotated[str, typer.Option(help="Loopback address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to listen on; 0 takes a free one.")] = PORT,
    workers: Annotated[int, typer.Option(min=0, help="Worker processes to start here.")] = 1,
    data: Annotated[Path, typer.Option(help="Folder for scenes, images and the queue.")] = DATA,
) -> None:
    """Run the service on this machine: API, queue and workers, until it is interrupted."""
    from service.serve import serve as run

    run(data.expanduser(), host, port, workers, lambda url: typer.echo(f"listening on {url}"))


def submit(
    scene: Annotated[Path, typer.Argument(exists=True, help="Scene: an .xml, a .zip or a folder.")],
    integrator: Annotated[str | None, typer.Option(help="bdpt, or mi_path and other integrators of Mitsuba.")] = None,
    light_sampling: Annotated[str | None, typer.Option(help="uniform, power or adjoint.")] = None,
    direction_sampling: Annotated[str | None, typer.Option(help="scattering or context.")] = None,
    roulette: Annotated[str | None, typer.Option(help="throughput, albedo, context or none.")] = None,
    spp: Annotated[int | None, typer.Option(help="Stop after this many samples per pixel.")] = None,
    seconds: Annotated[float | None, typer.Option(help="Stop after this time, everything counted.")] = None,
    error: Annotated[float | None, typer.Option(help="Stop at this relative error.")] = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Size in pixels; the scene's own if absent.")] = None,
    max_depth: Annotated[int | None, typer.Option(help="Longest path in segments.")] = None,
    sensor: Annotated[int | None, typer.Option(help="Which camera, from 0.")] = None,
    seed: Annotated[int | None, typer.Option(help="Random stream.")] = None,
    variant: Annotated[str | None, typer.Option(help="Mitsuba variant.")] = None,
    assignments: Annotated[list[str] | None, typer.Option("--set", metavar="A.B=VALUE", help="Any setting.")] = None,
    priority: Annotated[int, typer.Option(help="Higher is sooner.")] = 0,
    url: Url = URL,
    wait: Annotated[bool, typer.Option("--watch", help="Show the progress until the end.")] = False,
    output: Output = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the whole job as JSON, not its id only.")] = False,
) -> None:
    """Send a scene to the service and have it rendered; prints the job's id."""
    from service.client import Client

    given: dict[str, Any] = {
        "integrator": integrator,
        "light_sampling": light_sampling,
        "direction_sampling": direction_sampling,
        "roulette": roulette,
        "max_depth": max_depth,
        "sensor": sensor,
        "seed": seed,
        "variant": variant,
    }
    if size is not None:
        given["width"], given["height"] = _size(size)
    settings = _settings(given, assignments or [])
    stop = _stop(spp, seconds, error)
    with Client(url) as client, tempfile.TemporaryDirectory(prefix="elps-submit-") as folder:
        record = client.upload(_bundle(scene, Path(folder)))
        job = client.submit(record.digest, settings, stop, priority)
    if not as_json:
        typer.echo(job.id)
    if wait or output is not None:
        job = _watch(url, job.id, output)
    if as_json:
        typer.echo(job.model_dump_json())
    _exit(job)


def watch(
    job: Annotated[str, typer.Argument(help="The job's id.")],
    url: Url = URL,
    output: Output = None,
) -> None:
    """Show the progress of a job until it has ended."""
    _exit(_watch(url, job, output))


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the partial images and the figure.")] = Path("demo-out"),
    seconds: Annotated[float, typer.Option(min=1.0, help="Time for each of the two renders.")] = 40.0,
) -> None:
    """Render a maze twice, with and without knowledge of where useful light starts, and compare."""
    from service.demo import demo as run

    run(out, seconds)


def _watch(url: str, job_id: str, output: Path | None) -> Job:
    from rich.console import Console

    from service.client import Client
    from service.watch import watch as show

    console = Console(stderr=True)
    with Client(url) as client:
        try:
            job = show(client, job_id, console)
        except KeyboardInterrupt:
            console.print(f"the job goes on: see it again with 'elps watch {job_id}'", highlight=False)
            raise
        image = client.image(job_id) if output is not None else None
    if output is not None and image is not None:
        output.write_bytes(image[1])
        console.print(f"saved {output}", highlight=False, markup=False)
    return job


def _exit(job: Job) -> None:
    """Ends with status 1 where the job ended without being completed."""
    if job.state in ("failed", "cancelled"):
        typer.echo(f"the job {job.state}: {job.message or 'it keeps its best image'}", err=True)
        raise typer.Exit(1)


def _size(text: str) -> tuple[int, int]:
    width, separator, height = text.lower().partition("x")
    if not (separator and width.isdecimal() and height.isdecimal()):
        raise typer.BadParameter("give the size as WxH, for example 640x480")
    return int(width), int(height)


def _settings(given: dict[str, Any], assignments: list[str]) -> RenderSettings:
    from elps_core.settings import RenderSettings, with_overrides

    values = {name: value for name, value in given.items() if value is not None}
    for assignment in assignments:
        name, separator, text = assignment.partition("=")
        if not separator:
            raise typer.BadParameter("give --set as NAME=VALUE, for example context.resolution=32")
        try:
            values[name] = json.loads(text)
        except ValueError:
            values[name] = text
    return with_overrides(RenderSettings(), values)


def _stop(spp: int | None, seconds: float | None, error: float | None) -> StopCriterion:
    from pydantic import ValidationError

    from elps_core.errors import SettingsRejected
    from elps_core.settings import StopCriterion, first_problem

    if spp is None and seconds is None and error is None:
        raise typer.BadParameter("say when to stop: --spp, --seconds or --error")
    try:
        return StopCriterion(samples=spp, seconds=seconds, error=error)
    except ValidationError as problem:
        raise SettingsRejected(first_problem(problem)) from None


def _bundle(scene: Path, folder: Path) -> Path:
    """The file to upload: ``scene`` itself, or a zip of it below ``folder`` where it is a folder."""
    if not scene.is_dir():
        return scene
    import zipfile

    path = folder / f"{scene.resolve().name}.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(scene.rglob("*")):
            if file.is_file() and not any(part.startswith(".") for part in file.relative_to(scene).parts):
                archive.write(file, file.relative_to(scene))
    return path
