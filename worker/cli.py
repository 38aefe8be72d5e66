"""The command ``elps worker``."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from elps_core.errors import ElpsError
from worker.settings import FarmSettings


def register(app: typer.Typer) -> None:
    """Add the commands of this package to ``elps``."""
    app.command("worker")(worker)


def worker(
    redis_url: Annotated[str | None, typer.Option(help="Coordination server; else REDIS_URL.")] = None,
    store_url: Annotated[str | None, typer.Option(help="Artefact store; else ELPS_STORE_URL.")] = None,
) -> None:
    """Render for a farm until SIGTERM or Ctrl-C; the chunk in hand is finished first."""
    from worker.run import run

    given: dict[str, Any] = {"redis_url": redis_url, "store_url": store_url}
    try:
        status = run(FarmSettings(**{key: value for key, value in given.items() if value is not None}))
    except ElpsError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(2) from None
    raise typer.Exit(status)
