"""The command ``elps``: the renderer's own commands, and those that other packages add."""

from __future__ import annotations

import sys
from importlib.metadata import entry_points

import typer

from elps_core.commands import context, render, scene, strategies
from elps_core.errors import ElpsError

GROUP = "elps.commands"
"""Entry points under this name are functions that add commands to the application."""
REFUSED = 2
"""Exit status where the request was refused: nothing was done."""


def application() -> typer.Typer:
    """The command line with all commands."""
    app = typer.Typer(
        name="elps",
        help="Renders hard indirect light without bias, here or on a farm.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.command("render")(render.render)
    app.command("strategies")(strategies.strategies)
    app.add_typer(scene.app, name="scene")
    app.add_typer(context.app, name="context")
    for entry in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        entry.load()(app)
    return app


def main() -> None:
    """Run the command line; an error that the user can act on is one line and exit status 2."""
    try:
        application()()
    except ElpsError as error:
        print(f"elps: {error}", file=sys.stderr)  # noqa: T201 (the command line's own output)
        sys.exit(REFUSED)


if __name__ == "__main__":
    main()
