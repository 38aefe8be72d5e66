"""``elps context``: build a global context ahead of rendering, and look at one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from elps_core import options
from elps_core.errors import SettingsRejected
from elps_core.settings import ContextSettings, RenderSettings

if TYPE_CHECKING:
    from elps_core.context.store import GlobalContext
    from elps_core.scene.loader import LoadedScene

LARGEST = 9
"""Emitters listed in a report."""
ADJOINT_SIZE = ("rows", "columns")
"""Statistics that a report gives in words, since tables have rows and columns too."""
MIB = 2.0**20

app = typer.Typer(help="Build and show global contexts.", no_args_is_help=True)


@app.command()
def build(
    scene: options.Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="Where to save the context.")],
    particles: Annotated[
        str | None, typer.Option(help="What fills the tables: walks, classical, bidirectional or metropolis.")
    ] = None,
    regions: Annotated[int | None, typer.Option(help="Regions with tables of directions; 0: no tables.")] = None,
    paths: Annotated[int | None, typer.Option(help="Most paths that are traced for the tables.")] = None,
    resolution: Annotated[int | None, typer.Option(help="Cells along a side of the adjoint image.")] = None,
    like: Annotated[
        Path | None, typer.Option(help="Context of the same scene by another camera: what it knows of light is reused.")
    ] = None,
    size: options.Size = None,
    sensor: options.Sensor = None,
    variant: options.Variant = None,
    assignments: options.Assignments = None,
    define: options.Defines = None,
    root: options.Root = None,
) -> None:
    """Measure a scene and save what was learnt."""
    given = {
        "integrator": "bdpt",  # Any that is content without tables
        "sensor": sensor,
        "variant": variant,
        "context.particles": particles,
        "context.regions": regions,
        "context.paths": paths,
        "context.resolution": resolution,
    }
    settings: RenderSettings = options.settings_from(given, size, assignments)
    defines = options.defines_from(define)
    options.check_output(output, ())
    # Without tables, so that renders which want none take the file for theirs.
    wanted = settings.context if settings.context.regions else settings.context.without_tables()

    from elps_core import device

    device.use(settings.variant)
    from elps_core.context import store
    from elps_core.scene.loader import load_scene

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        film = (settings.width, settings.height) if settings.width and settings.height else None
        other = store.load(like) if like else None
        loaded = load_scene(scene, settings.variant, sensor=settings.sensor, size=film, root=root, defines=defines)
        context = build_with_progress(loaded, wanted, progress, other)
    try:
        store.save(context, output)
    except OSError:
        raise SettingsRejected("the context cannot be saved: check the folder and its free space") from None
    _report(context, output, console)


@app.command()
def show(
    file: Annotated[Path, typer.Argument(help="A context file.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="A folder for pictures, or a .png for the adjoint image.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the facts as JSON.")] = False,
) -> None:
    """Show what a context file holds.

    Pictures: adjoint.png, the lights by what they give to the image; particles.png, where photons (left) and importons
    (right) are, from above; regions.png, the regions in view; tables.png, radiance and below it importance in the
    outlined regions, by direction, framed in their colours and placed as they are in the view.
    """
    from elps_core.context import store

    if output is not None:
        _check_folder(output)
        if output.exists() and output.is_dir() == _is_png(output):
            raise SettingsRejected("the output is there already and of another kind: give a folder or a .png")
    context = store.load(file)
    if output is not None:
        _draw(context, output)
    if as_json:
        typer.echo(json.dumps(_facts(context, file)))
    else:
        _report(context, file, Console())


def build_with_progress(
    scene: LoadedScene, settings: ContextSettings, progress: Progress, like: GlobalContext | None = None
) -> GlobalContext:
    """Measure the context of a scene, showing how far it is; ``like`` is another camera's."""
    from elps_core.context.build import ContextBuilder

    builder = ContextBuilder(scene, settings)
    if like is not None and not builder.begin_from(like):
        progress.console.print(
            "warning: the other context is of another scene, has other settings or knows too little of what "
            "this camera sees: measured anew",
            highlight=False,
            soft_wrap=True,
        )
    task = progress.add_task("measuring the scene", total=builder.steps)
    while builder.done < builder.steps:
        builder.step()
        progress.update(task, completed=builder.done, total=builder.steps)
    progress.remove_task(task)
    return builder.result()


def _check_folder(output: Path) -> None:
    if not output.parent.is_dir():
        raise SettingsRejected("the folder of the output does not exist: create it first")


def _is_png(path: Path) -> bool:
    return path.suffix.lower() == ".png"


def _draw(context: GlobalContext, output: Path) -> None:
    """All pictures into a folder, or the adjoint image alone into a file."""
    from elps_core.io.context_pictures import pictures
    from elps_core.io.exr import ImageUnwritable
    from elps_core.io.preview import adjoint_to_png, png

    try:
        if _is_png(output):
            output.write_bytes(adjoint_to_png(context.adjoint))
            return
        output.mkdir(exist_ok=True)
        for name, pixels in pictures(context).items():
            (output / name).write_bytes(png(pixels))
    except OSError:
        raise ImageUnwritable("the pictures cannot be written: check the folder and its free space") from None


def _facts(context: GlobalContext, file: Path) -> dict[str, Any]:
    """What the context in ``file`` is and holds, for JSON."""
    facts: dict[str, Any] = {
        "digest": context.digest,
        "scene": context.scene,
        "sensor": context.sensor,
        "bytes": file.stat().st_size,
        "adjoint": list(context.adjoint.shape),
        "tables": None,
    }
    if context.directions is not None:
        tables = context.directions.radiance
        shape = dict(zip(("regions", "rows", "columns"), tables.shape, strict=True))
        facts["tables"] = {**shape, "encoding": tables.encoding}
    return {**facts, "settings": context.settings.model_dump(), "statistics": context.statistics}


def _report(context: GlobalContext, file: Path, console: Console) -> None:
    """The facts of the context in ``file``, for eyes."""
    facts = _facts(context, file)
    tables = facts["tables"]
    lines: dict[str, object] = {name: facts[name] for name in ("digest", "scene", "sensor")}
    lines["adjoint image"] = "{} x {} cells".format(*facts["adjoint"])
    lines["regions"] = tables["regions"] if tables else "none"
    if tables:
        lines["tables"] = "{rows} x {columns} directions, {encoding}".format(**tables)
    lines["file"] = f"{facts['bytes'] / MIB:.2f} MiB"
    lines |= {name: value for name, value in context.statistics.items() if name not in ADJOINT_SIZE}
    emitters = context.emitters.shape[0]
    share = context.adjoint.reshape(context.adjoint.shape[0], emitters, -1).sum(axis=(0, 2))
    share = share / max(float(share.sum()), 1e-30)
    largest = sorted(enumerate(share), key=lambda item: -item[1])[:LARGEST]
    lines["light shares"] = ", ".join(f"emitter {index}: {100 * float(part):.1f}%" for index, part in largest)
    grid = Table(show_header=False, box=None)
    grid.add_column(no_wrap=True)
    grid.add_column(overflow="fold")
    for name, value in lines.items():
        shown = f"{value:.4g}" if isinstance(value, float) else str(value)
        grid.add_row(Text(name.replace("_", " ")), Text(shown))
    console.print(grid)
