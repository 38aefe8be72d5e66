"""``elps render``: one image, in this process."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from elps_core import options
from elps_core.settings import RenderSettings, stop_or_default, suited, with_file_defaults

if TYPE_CHECKING:
    from elps_core.context.store import GlobalContext
    from elps_core.estimate.film import Accumulation


def render(
    scene: options.Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="Where to save the image: .exr, or .png to look at.")],
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
    context: Annotated[
        Path | None, typer.Option(help="Context file: used if it exists, else built and saved there.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON on the last line.")] = False,
) -> None:
    """Render one image here, without a server."""
    begin = time.perf_counter()
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
    asked, defines = options.stop_from(spp, seconds, error), options.defines_from(define)
    settings = options.settings_from(given, size, assignments)
    options.check_output(output)
    if context is not None:
        options.check_output(context, ())

    from elps_core import device

    device.use(settings.variant)
    from elps_core.context.store import save
    from elps_core.io.exr import Part
    from elps_core.io.formats import shown
    from elps_core.io.preview import write_png
    from elps_core.io.result import write_result
    from elps_core.progressive import ProgressiveRender
    from elps_core.scene import reach
    from elps_core.scene.digest import render_digest
    from elps_core.scene.loader import load_scene
    from elps_core.timing import KernelClock

    console = Console(stderr=True)
    with KernelClock() as kernels, _progress(console) as progress:
        task = progress.add_task("loading", total=None)
        wanted = (settings.width, settings.height) if settings.width and settings.height else None
        loaded = load_scene(
            scene, settings.variant, sensor=settings.sensor, size=wanted, root=root, defines=defines
        )  # fmt: skip
        defaults = loaded.summary.defaults
        stop = stop_or_default(asked, defaults.samples)
        settings = suited(with_file_defaults(settings, defaults.settings()), stop)
        loading = time.perf_counter() - begin
        reach.check(loaded.summary, settings)
        unreachable = reach.unreachable(loaded.summary, settings)
        told: set[str] = set()

        def warn(line: str) -> None:
            if line not in told:
                told.add(line)
                console.print(f"warning: {line}", highlight=False, markup=False, soft_wrap=True)

        for warning in (*loaded.summary.warnings, *unreachable):
            warn(warning)
        found = _saved(settings, context, progress)

        def report(what: str, share: float, merged: Accumulation | None = None) -> None:
            progress.update(task, description=what, total=1.0, completed=share)
            for line in merged.darkness if merged is not None else ():
                warn(line)

        rendered = ProgressiveRender(loaded, settings, stop, begin, report).run(found)
        if context is not None and rendered.context is not None and not rendered.hit:
            save(rendered.context, context)
        elif context is not None and rendered.context is None:
            console.print("warning: the image was ready before a context was: none is saved", highlight=False)
    merged, renderer, found = rendered.merged, rendered.renderer, rendered.context
    if output.suffix.lower() == ".png":
        write_png(output, shown(Part(merged.mean(), merged.channels)))
    else:
        write_result(
            output,
            merged,
            settings,
            scene=loaded.digest,
            render=render_digest(loaded.digest, settings, loaded.size),
            context=found.digest if found else None,
            unreachable=unreachable,
            film=loaded.summary.sensors[loaded.sensor_index].film,
        )
    total = time.perf_counter() - begin
    on_the_host = total - loading - kernels.compiling - kernels.running
    figures = {
        "seconds_total": round(total, 3),
        "seconds_loading": round(loading, 3),
        "seconds_preparing": round(rendered.preparing, 3),
        "seconds_rendering": round(merged.seconds, 3),
        "seconds_compiling": round(kernels.compiling, 3),
        "seconds_tracing": round(max(0.0, on_the_host), 3),
        "spp": merged.spp,
        "spp_before_context": rendered.meantime.spp if rendered.meantime else 0,
        "context": {"digest": found.digest if found else None, "hit": rendered.hit},
        "choice": renderer.choice.report(),
        "relative_error": merged.relative_error(),
        "statistics": {name: statistic._asdict() for name, statistic in merged.statistics().items()},
        "warnings": [*loaded.summary.warnings, *unreachable, *merged.warnings()],
        "output": str(output),
    }
    for warning in merged.warnings():
        warn(warning)
    for line in renderer.choice.lines():
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    relative = figures["relative_error"]
    accuracy = "unknown" if relative is None else f"{100 * float(str(relative)):.2f}%"
    console.print(
        f"{output}: {merged.spp} samples per pixel in {total:.1f} s (preparing {rendered.preparing:.1f} s, "
        f"compilation {kernels.compiling:.1f} s), relative error {accuracy}",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )
    for name, (mean, error) in merged.statistics().items():
        spread = "" if error is None else f" (standard error {error:.2g})"
        console.print(f"{name.replace('_', ' ')} {mean:.4g}{spread}", highlight=False, markup=False)
    if as_json:
        typer.echo(json.dumps(figures, allow_nan=False))


def _saved(settings: RenderSettings, path: Path | None, progress: Progress) -> GlobalContext | None:
    """The context that was saved at ``path``, where the render needs one and it is there."""
    from elps_core.context import store

    if path is None or not path.exists() or not settings.needs_context:
        return None
    context = store.load(path)
    if settings.keeps_to_tables and not context.statistics.get("thorough", True):
        progress.console.print(
            "warning: the tables of this context were not filled to the end, because 'auto' does not use them: "
            "remove the file to have them filled for this integrator",
            highlight=False,
            soft_wrap=True,
        )
    return context


def _progress(console: Console) -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
