"""``elps strategies``: what each strategy of bidirectional path tracing gives to an image."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from elps_core import options
from elps_core.errors import SettingsRejected
from elps_core.settings import VISIBLE, RenderSettings, with_overrides

if TYPE_CHECKING:
    from elps_core.context.store import GlobalContext
    from elps_core.io.pyramid import Linear, Pair, Row
    from elps_core.scene.loader import LoadedScene

DEPTH = 5
"""Longest paths by default: 19 images, and room for them on a screen."""
MAX_PICTURE_DEPTH = 12
"""At 13 images in the last row one cannot tell anything from them."""
SPP = 64
"""Samples per pixel of each image by default: about a minute on two cores."""
SIDE = 176
"""Longer side of an image in pixels by default."""
PYRAMID = "pyramid.png"
"""Name of the picture in a folder."""


def strategies(
    scene: options.Scene,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="A .png, or a folder for it and for each image alone.")
    ],
    unweighted: Annotated[
        bool, typer.Option("--unweighted", help="Show all that each strategy finds, not its weighted share.")
    ] = False,
    exr: Annotated[Path | None, typer.Option(help="Save the images here as well (EXR, a part for each).")] = None,
    spp: Annotated[int, typer.Option(help="Samples per pixel of each image.")] = SPP,
    size: options.Size = None,
    max_depth: Annotated[int, typer.Option(help="Longest path in segments: the last row.")] = DEPTH,
    sensor: options.Sensor = None,
    light_sampling: Annotated[
        str, typer.Option(help="uniform, power, adjoint or context (these measure the scene first).")
    ] = "power",
    seed: options.Seed = None,
    variant: options.Variant = None,
    assignments: options.Assignments = None,
    define: options.Defines = None,
    root: options.Root = None,
) -> None:
    """Picture every strategy of bidirectional path tracing: rows by path length, labelled s, t.

    s and t count the vertices that come from the light and from the camera. A row is exposed alike.
    """
    given = {
        "integrator": "bdpt",
        "light_sampling": light_sampling,
        "max_depth": max_depth,
        "sensor": sensor,
        "seed": seed,
        "variant": variant,
    }
    settings = options.settings_from(given, size, assignments)
    defines = options.defines_from(define)
    options.stop_from(spp, None, None)
    _check(settings, output, exr)

    from elps_core import device

    device.use(settings.variant)
    from elps_core.io.exr import write_exr
    from elps_core.io.preview import png
    from elps_core.io.pyramid import draw, rows_of

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        loaded = _load(scene, settings, root, defines)
        images = _images(loaded, settings, not unweighted, spp, progress)
    rows = rows_of(images)
    title = f"{'Unweighted' if unweighted else 'Weighted'} strategies of bidirectional path tracing"
    subtitle = f"{scene.stem}: s light and t eye vertices, row k: paths of k segments, {spp} samples per pixel each"
    picture = png(draw(rows, title, subtitle, weighted=not unweighted))
    if output.suffix.lower() == ".png":
        output.write_bytes(picture)
    else:
        _fill(output, picture, rows)
    if exr is not None:
        parts = {_name(pair): images[pair] for pair in sorted(images)}
        facts = {"scene": loaded.digest, "settings": settings.model_dump_json()}
        write_exr(exr, parts, {**facts, "samples": spp, "weighted": int(not unweighted)})
    console.print(f"{output}: {len(images)} strategies", highlight=False, markup=False, soft_wrap=True)


def _check(settings: RenderSettings, output: Path, exr: Path | None) -> None:
    if not 0 < settings.max_depth <= MAX_PICTURE_DEPTH:
        raise SettingsRejected(f"max_depth: at most {MAX_PICTURE_DEPTH} rows make a picture")
    if settings.integrator != "bdpt" or settings.bdpt.pairs() is not None:
        raise SettingsRejected("each strategy of bdpt is shown: leave integrator and bdpt.strategies as they are")
    if exr is not None:
        options.check_output(exr, (".exr",))
    if output.suffix.lower() == ".png":
        options.check_output(output, (".png",))
    elif not output.parent.is_dir():
        raise SettingsRejected("the folder of the output does not exist: create it first")
    if output.exists() and output.suffix.lower() != ".png" and not output.is_dir():
        raise SettingsRejected("the output is a file of another kind: give a .png or a folder")


def _fill(folder: Path, picture: bytes, rows: list[Row]) -> None:
    """The pyramid, and each image as it is there."""
    from elps_core.io.preview import to_png
    from elps_core.io.pyramid import TONE

    folder.mkdir(exist_ok=True)
    (folder / PYRAMID).write_bytes(picture)
    for row in rows:
        for pair, image in row.images.items():
            (folder / f"{_name(pair)}.png").write_bytes(to_png(image, row.exposure, TONE))


def pairs(max_depth: int, *, aperture: bool) -> list[tuple[int, int]]:
    """All strategies (s, t) up to a path length; ``aperture``: the sensor has one that light paths can meet."""
    least = 0 if aperture else 1
    longer = [(n - t, t) for n in range(3, max_depth + 2) for t in range(n, least - 1, -1)]
    return [VISIBLE, *longer]


def _name(pair: Pair) -> str:
    return f"s{pair[0]}t{pair[1]}"


def _load(scene: Path, settings: RenderSettings, root: Path | None, defines: dict[str, str]) -> LoadedScene:
    """The scene at the size asked for, or small."""
    from elps_core.scene.loader import load_scene

    def load(size: tuple[int, int] | None) -> LoadedScene:
        return load_scene(scene, settings.variant, sensor=settings.sensor, size=size, root=root, defines=defines)

    size = (settings.width, settings.height) if settings.width and settings.height else None
    loaded = load(size)
    longer = max(loaded.size)
    if size is None and longer > SIDE:
        width, height = (max(1, round(side * SIDE / longer)) for side in loaded.size)
        loaded = load((width, height))
    return loaded


def _images(
    scene: LoadedScene, settings: RenderSettings, weighted: bool, spp: int, progress: Progress
) -> dict[Pair, Linear]:
    """Each strategy's image, linear RGB [height, width, 3]."""
    from elps_core.commands.context import build_with_progress
    from elps_core.renderer import Renderer
    from elps_core.scene.sensors import Camera

    context: GlobalContext | None = None
    if settings.needs_context:
        context = build_with_progress(scene, settings.measured, progress)
    chosen = pairs(settings.max_depth, aperture=Camera(scene.sensor).has_aperture)
    task = progress.add_task("rendering", total=len(chosen))
    images = {}
    for s, t in chosen:
        alone = with_overrides(settings, {"bdpt.strategies": f"{s},{t}", "bdpt.weighted": weighted})
        images[s, t] = Renderer(scene, alone, context).render_chunk(0, spp).image[..., :3]
        progress.update(task, advance=1, description=f"rendering {s}, {t}")
    return images
