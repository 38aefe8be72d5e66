"""``elps scene``: look at a scene, or write one of the parametric ones.

Each generator is a command, its parameters the options.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from elps_core import options
from elps_core.scene.generate import GENERATORS, SceneDescription, write
from elps_core.settings import UNLIMITED, RenderSettings

if TYPE_CHECKING:
    from elps_core.scene.summary import SceneSummary

app = typer.Typer(help="Look at a scene, or write a parametric one as a bundle.", no_args_is_help=True)

Output = Annotated[Path, typer.Option("-o", "--output", help="Bundle to write: a .zip, else a folder.")]


def _command(generator: Callable[..., SceneDescription]) -> Callable[..., None]:
    """A command with the generator's own parameters and ``--output``."""

    def command(output: Path, **parameters: Any) -> None:
        write(generator(**parameters), output)

    hints = get_type_hints(inspect.unwrap(generator))
    command.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [
            inspect.Parameter("output", inspect.Parameter.KEYWORD_ONLY, annotation=Output),
            *(
                inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=given.default, annotation=hints[name])
                for name, given in inspect.signature(generator).parameters.items()
            ),
        ]
    )
    command.__doc__ = (inspect.getdoc(generator) or "").split("\n\n")[0]
    return command


@app.command()
def info(
    scene: options.Scene,
    define: options.Defines = None,
    root: options.Root = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the facts as JSON.")] = False,
) -> None:
    """Show what a scene holds, what its file says of its render, and what will be otherwise than it says."""
    from elps_core.scene.inspect import VARIANT
    from elps_core.scene.loader import load_scene

    loaded = load_scene(scene, VARIANT, root=root, defines=options.defines_from(define))
    if as_json:
        typer.echo(json.dumps({"digest": loaded.digest, "summary": loaded.summary.model_dump(mode="json")}))
        return
    for name, text in _facts(loaded.summary):
        typer.echo(f"{name:<12}{text}")
    typer.echo(f"{'digest':<12}{loaded.digest}")
    for warning in loaded.summary.warnings:
        typer.echo(f"warning: {warning}")


def _facts(summary: SceneSummary) -> Iterator[tuple[str, str]]:
    """What there is to say of a scene, line by line: a name and a text."""
    for number, sensor in enumerate(summary.sensors):
        yield f"sensor {number}", f"{sensor.type}, {sensor.width}x{sensor.height} pixels"
    yield "emitters", ", ".join(f"{each.count} {each.type}" for each in summary.emitters) or "none"
    yield "materials", ", ".join(summary.bsdfs) or "none"
    yield "shapes", f"{summary.shapes} with {summary.triangles} triangles"
    for parameter in summary.parameters:
        yield "parameter", f"{parameter.name} = {parameter.value}"
    given, usual = summary.defaults.settings(), RenderSettings()
    if summary.defaults.integrator:
        yield (
            "integrator",
            f"{summary.defaults.integrator}: advice only, the job's own renders ('auto' if none is named)",
        )
    depth, begin = summary.defaults.max_depth, given.get("rr_depth")
    yield "max_depth", "no limit: roulette ends paths" if depth == UNLIMITED else f"{depth}, as the file says"
    yield "rr_depth", f"{begin}, as the file says" if begin else f"{usual.rr_depth}, because the file says none"
    if given.get("hide_emitters"):
        yield "emitters", "hidden from the camera, as the file says"
    if summary.defaults.samples:
        yield "samples", f"{summary.defaults.samples} a pixel, unless the job says when to stop"
    if summary.ignored:
        yield "left out", ", ".join(summary.ignored)


for _name, _generator in GENERATORS.items():
    app.command(_name)(_command(_generator))
