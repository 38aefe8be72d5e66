"""Commands of the service: ``elps serve``, ``submit``, ``watch`` and ``demo``.

Imports of what a command needs stand in the command, so that ``elps --help`` answers at once.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from elps_core import options
from elps_core.errors import SettingsRejected

if TYPE_CHECKING:
    from worker.models import Job

URL = "http://127.0.0.1:8000"
PORT = 8000
DATA = Path("~/.local/share/elps")

Url = Annotated[str, typer.Option("--url", envvar="ELPS_URL", help="Where the service listens.")]
Output = Annotated[
    Path | None, typer.Option("-o", "--output", help="Wait for the end and save the image: .exr or .png.")
]


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
    scene: options.Scene,
    preset: options.Preset = None,
    integrator: options.Integrator = None,
    light_sampling: options.LightSampling = None,
    direction_sampling: options.DirectionSampling = None,
    roulette: options.Roulette = None,
    heuristic: options.Heuristic = None,
    spp: options.Spp = None,
    seconds: options.Seconds = None,
    error: options.Error = None,
    size: options.Size = None,
    max_depth: options.MaxDepth = None,
    sensor: options.Sensor = None,
    seed: options.Seed = None,
    variant: options.Variant = None,
    assignments: options.Assignments = None,
    define: options.Defines = None,
    root: options.Root = None,
    priority: Annotated[int, typer.Option(min=-9, max=9, help="Higher is sooner.")] = 0,
    url: Url = URL,
    wait: Annotated[bool, typer.Option("--watch", help="Show the progress until the end.")] = False,
    output: Output = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the whole job as JSON, not its id only.")] = False,
) -> None:
    """Send a scene to the service and have it rendered; prints the job's id."""
    from service.client import Client

    given = {
        "preset": preset,
        "integrator": integrator,
        "light_sampling": light_sampling,
        "direction_sampling": direction_sampling,
        "roulette": roulette,
        "heuristic": heuristic,
        "max_depth": max_depth,
        "sensor": sensor,
        "seed": seed,
        "variant": variant,
    }
    settings = options.settings_from(given, size, assignments)
    stop, defines = options.stop_from(spp, seconds, error), options.defines_from(define)
    if output is not None:
        options.check_output(output)
    with Client(url) as client, tempfile.TemporaryDirectory(prefix="elps-submit-") as folder:
        record = client.upload(_bundle(scene, Path(folder), root, defines))
        packed = scene.suffix.lower() == ".xml"  # Its parameters are put in
        job = client.submit(record.digest, settings, stop, priority, {} if packed else defines)
    _warn((*record.summary["warnings"], *job.warnings))
    if not as_json:
        typer.echo(job.id)
    if wait or output is not None:
        job = _watch(url, job.id, output)
        _warn(job.image_warnings)
    if as_json:
        typer.echo(job.model_dump_json())
    _exit(job)


def watch(
    job: Annotated[str, typer.Argument(help="The job's id.")],
    url: Url = URL,
    output: Output = None,
) -> None:
    """Show the progress of a job until it has ended."""
    if output is not None:
        options.check_output(output)
    ended = _watch(url, job, output)
    _warn((*ended.warnings, *ended.image_warnings))
    _exit(ended)


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the partial images and the figure.")] = Path("demo-out"),
    seconds: Annotated[float, typer.Option(min=1.0, help="Time for each of the two renders.")] = 35.0,
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
        image = None
        if output is not None and job.image_revision:
            image = client.file(f"/v1/jobs/{job_id}/image{output.suffix.lower()}")
    if output is not None and image is not None:
        output.write_bytes(image)
        console.print(f"saved {output}", highlight=False, markup=False)
    return job


def _warn(warnings: Iterable[str]) -> None:
    for warning in warnings:
        typer.echo(f"warning: {warning}", err=True)


def _exit(job: Job) -> None:
    """Ends with status 1 where the job ended without being completed."""
    if job.state in ("failed", "cancelled"):
        typer.echo(f"the job {job.state}: {job.message or 'it keeps its best image'}", err=True)
        raise typer.Exit(1)


def _bundle(scene: Path, folder: Path, root: Path | None, defines: dict[str, str]) -> Path:
    """The file to upload: an archive as it is; an .xml with all that it names, or a folder, as a zip in ``folder``."""
    import zipfile

    if not scene.exists():
        raise SettingsRejected("no such scene: give an .xml, a .zip or a folder")
    path = folder / f"{scene.resolve().stem}.zip"
    if scene.suffix.lower() == ".xml" and scene.is_file():
        from elps_core.scene.pack import pack

        pack(scene, path, root=root, defines=defines)
        return path
    if scene.is_file():
        return scene
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(scene.rglob("*")):
            if file.is_file() and not any(part.startswith(".") for part in file.relative_to(scene).parts):
                archive.write(file, file.relative_to(scene))
    return path
