"""``elps render``: one image, in this process."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from elps_core import options
from elps_core.errors import SettingsRejected
from elps_core.estimate.stats import MIN_CHUNKS
from elps_core.settings import RenderSettings, StopCriterion, suited

if TYPE_CHECKING:
    from elps_core.context.store import GlobalContext
    from elps_core.estimate.film import Accumulation
    from elps_core.renderer import Renderer
    from elps_core.scene.loader import LoadedScene

RESERVE = 0.95
"""Share of the time left that the last chunk is sized for: rates vary by a few percent."""


def render(
    scene: options.Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="Where to save the image (EXR).")],
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
    stop = options.stop_from(spp, seconds, error)
    settings = suited(options.settings_from(given, size, assignments), stop)
    if not output.parent.is_dir():
        raise SettingsRejected("the folder of the output does not exist: create it first")

    from elps_core import device

    device.use(settings.variant)
    from elps_core.io.result import write_result
    from elps_core.renderer import Renderer
    from elps_core.scene import reach
    from elps_core.scene.digest import render_digest
    from elps_core.scene.loader import load_scene
    from elps_core.timing import KernelClock

    console = Console(stderr=True)
    with KernelClock() as kernels, _progress(console) as progress:
        task = progress.add_task("loading", total=None)
        wanted = (settings.width, settings.height) if settings.width and settings.height else None
        loaded = load_scene(scene, settings.variant, sensor=settings.sensor, size=wanted)
        reach.check(loaded.summary, settings)
        unreachable = reach.unreachable(loaded.summary, settings)
        for warning in (*loaded.summary.warnings, *unreachable):
            console.print(f"warning: {warning}", highlight=False, markup=False, soft_wrap=True)
        preparation = _Context(None, False, 0.0)
        if settings.needs_context:
            preparation = _prepare_context(loaded, settings, context, progress)
        renderer = Renderer(loaded, settings, preparation.context)
        merged = _render(renderer, stop, begin, progress, task)
    found = preparation.context
    write_result(
        output,
        merged,
        settings,
        scene=loaded.digest,
        render=render_digest(loaded.digest, settings, loaded.size),
        context=found.digest if found else None,
        unreachable=unreachable,
    )
    total = time.perf_counter() - begin
    figures = {
        "seconds_total": round(total, 3),
        "seconds_context": round(preparation.seconds, 3),
        "seconds_compile": round(kernels.compiling, 3),
        "spp": merged.spp,
        "context": {"digest": found.digest if found else None, "hit": preparation.hit},
        "choice": renderer.choice.report(),
        "relative_error": merged.relative_error(),
        "statistics": {name: statistic._asdict() for name, statistic in merged.statistics().items()},
        "warnings": [*loaded.summary.warnings, *unreachable],
        "output": str(output),
    }
    for line in renderer.choice.lines():
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    relative = figures["relative_error"]
    shown = "unknown" if relative is None else f"{100 * float(str(relative)):.2f}%"
    console.print(
        f"{output}: {merged.spp} samples per pixel in {total:.1f} s (context {preparation.seconds:.1f} s, "
        f"compilation {kernels.compiling:.1f} s), relative error {shown}",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )
    for name, (mean, error) in merged.statistics().items():
        spread = "" if error is None else f" (standard error {error:.2g})"
        console.print(f"{name.replace('_', ' ')} {mean:.4g}{spread}", highlight=False, markup=False)
    if as_json:
        typer.echo(json.dumps(figures))


@dataclass(frozen=True)
class _Context:
    context: GlobalContext | None
    hit: bool
    seconds: float


def _prepare_context(scene: LoadedScene, settings: RenderSettings, path: Path | None, progress: Progress) -> _Context:
    """Load the context from ``path``, or measure it (and save it there)."""
    from elps_core.commands.context import build_with_progress
    from elps_core.context import store

    begin = time.perf_counter()
    if path is not None and path.exists():
        context = store.load(path)
        if settings.keeps_to_tables and not context.statistics.get("thorough", True):
            progress.console.print(
                "warning: the tables of this context were not filled to the end, because 'auto' does not use them: "
                "remove the file to have them filled for this integrator",
                highlight=False,
                soft_wrap=True,
            )
        return _Context(context, True, time.perf_counter() - begin)
    context = build_with_progress(scene, settings.measured, progress)
    if path is not None:
        store.save(context, path)
    return _Context(context, False, time.perf_counter() - begin)


def _render(renderer: Renderer, stop: StopCriterion, begin: float, progress: Progress, task: object) -> Accumulation:
    """Chunks until the first limit of ``stop``."""
    from elps_core.estimate.film import Accumulation

    merged = Accumulation.empty(*renderer.size)
    for index, count in enumerate(_counts(renderer, stop, begin, merged)):
        merged.add(renderer.render_chunk(index, count))
        progress.update(
            task,  # type: ignore[arg-type]
            description=f"rendering, {merged.spp} spp",
            total=1.0,
            completed=_share(stop, merged, begin),
        )
    return merged


def _counts(renderer: Renderer, stop: StopCriterion, begin: float, merged: Accumulation) -> Iterator[int]:
    """Samples per pixel of each chunk, as long as there is one to render."""
    index = 0
    while True:
        count = renderer.chunk_spp(index)
        if stop.samples is not None:
            count = min(count, -(-stop.samples // MIN_CHUNKS), stop.samples - merged.spp)
        if stop.seconds is not None and merged.spp:
            left = begin + stop.seconds - time.perf_counter()
            count = min(count, int(RESERVE * left * merged.spp / merged.seconds))
        if stop.error is not None:
            error = merged.relative_error()
            if error is not None and len(merged.chunks) >= MIN_CHUNKS and error <= stop.error:
                return
        if count < 1:
            return
        yield count
        index += 1


def _share(stop: StopCriterion, merged: Accumulation, begin: float) -> float:
    """How much of the way to the nearest limit is done, 0 to 1."""
    shares = []
    if stop.samples is not None:
        shares.append(merged.spp / stop.samples)
    if stop.seconds is not None:
        shares.append((time.perf_counter() - begin) / stop.seconds)
    if stop.error is not None:
        error = merged.relative_error()
        shares.append(min(1.0, stop.error / error) ** 2 if error else 0.0)
    return min(1.0, max(shares))


def _progress(console: Console) -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
