"""``elps context``: build a global context ahead of rendering, and look at one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from elps_core import options
from elps_core.settings import ContextSettings, RenderSettings

if TYPE_CHECKING:
    from elps_core.context.store import GlobalContext
    from elps_core.scene.loader import LoadedScene

app = typer.Typer(help="Build and show global contexts.", no_args_is_help=True)


@app.command()
def build(
    scene: options.Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="Where to save the context.")],
    resolution: Annotated[int | None, typer.Option(help="Cells along a side of the adjoint image.")] = None,
    size: options.Size = None,
    sensor: options.Sensor = None,
    variant: options.Variant = None,
    assignments: options.Assignments = None,
) -> None:
    """Measure a scene and save what was learnt."""
    given = {"sensor": sensor, "variant": variant, "context.resolution": resolution}
    settings: RenderSettings = options.settings_from(given, size, assignments)

    from elps_core import device

    device.use(settings.variant)
    from elps_core.context import store
    from elps_core.scene.loader import load_scene

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        wanted = (settings.width, settings.height) if settings.width and settings.height else None
        loaded = load_scene(scene, settings.variant, sensor=settings.sensor, size=wanted)
        context = build_with_progress(loaded, settings.context, progress)
    store.save(context, output)
    _report(context, console)


@app.command()
def show(
    file: Annotated[Path, typer.Argument(help="A context file.")],
    picture: Annotated[Path | None, typer.Option("-o", "--output", help="Save the adjoint image here (PNG).")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the facts as JSON.")] = False,
) -> None:
    """Show what a context file holds."""
    from elps_core.context import store
    from elps_core.io.preview import adjoint_to_png

    context = store.load(file)
    if picture is not None:
        picture.write_bytes(adjoint_to_png(context.adjoint))
    if as_json:
        facts = {"digest": context.digest, "scene": context.scene, "sensor": context.sensor}
        typer.echo(json.dumps({**facts, "settings": context.settings.model_dump(), "statistics": context.statistics}))
    else:
        _report(context, Console())


def build_with_progress(scene: LoadedScene, settings: ContextSettings, progress: Progress) -> GlobalContext:
    """Measure the context of a scene, showing how far it is."""
    from elps_core.context.build import ContextBuilder

    builder = ContextBuilder(scene, settings)
    task = progress.add_task("measuring the scene", total=builder.steps)
    while builder.done < builder.steps:
        builder.step()
        progress.update(task, completed=builder.done)
    progress.remove_task(task)
    return builder.result()


def _report(context: GlobalContext, console: Console) -> None:
    table = Table(show_header=False, box=None)
    table.add_row("digest", context.digest)
    table.add_row("scene", context.scene)
    table.add_row("sensor", str(context.sensor))
    for name, value in context.statistics.items():
        table.add_row(name.replace("_", " "), f"{value:.4g}" if isinstance(value, float) else str(value))
    emitters = context.emitters.shape[0]
    share = context.adjoint.reshape(context.adjoint.shape[0], emitters, -1).sum(axis=(0, 2))
    share = share / max(float(share.sum()), 1e-30)
    largest = sorted(enumerate(share), key=lambda item: -item[1])[:LARGEST]
    table.add_row("light shares", ", ".join(f"emitter {index}: {100 * float(part):.1f}%" for index, part in largest))
    console.print(table)


LARGEST = 9
"""Emitters listed in a report."""
