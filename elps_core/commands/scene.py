"""``elps scene``: write one of the parametric scenes. Each generator is a command, its parameters the options."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from elps_core.scene.generate import GENERATORS, SceneDescription, write

app = typer.Typer(help="Write a parametric scene as a bundle.", no_args_is_help=True)

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


for _name, _generator in GENERATORS.items():
    app.command(_name)(_command(_generator))
