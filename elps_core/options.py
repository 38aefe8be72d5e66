"""Options that the commands share, and how their words become settings. Imports no Mitsuba."""

from __future__ import annotations

import json
import secrets
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import ValidationError

from elps_core.errors import SettingsRejected
from elps_core.settings import RenderSettings, StopCriterion, first_problem, with_overrides

Scene = Annotated[Path, typer.Argument(metavar="SCENE", help="An .xml, a .zip or a folder.")]
Integrator = Annotated[str | None, typer.Option(help="auto, path, light, bdpt or pssmlt; Mitsuba's own: mi_path ...")]
Preset = Annotated[str | None, typer.Option(help="enlightened or thesis: values for all that is not given.")]
LightSampling = Annotated[str | None, typer.Option(help="uniform, power, adjoint or context.")]
DirectionSampling = Annotated[str | None, typer.Option(help="scattering or context.")]
Roulette = Annotated[str | None, typer.Option(help="throughput, albedo, context or none.")]
Heuristic = Annotated[str | None, typer.Option(help="power, balance, maximum or cutoff.")]
Spp = Annotated[int | None, typer.Option(help="Stop after this many samples per pixel.")]
Seconds = Annotated[float | None, typer.Option(help="Stop after this time, everything counted.")]
Error = Annotated[float | None, typer.Option(help="Stop at this relative error.")]
Size = Annotated[str | None, typer.Option(metavar="WxH", help="Size in pixels; the scene's own if absent.")]
MaxDepth = Annotated[int | None, typer.Option(help="Longest path in segments; -1: no limit.")]
Sensor = Annotated[int | None, typer.Option(help="Which camera, from 0.")]
Seed = Annotated[int | None, typer.Option(help="Random stream.")]
Variant = Annotated[str | None, typer.Option(help="Mitsuba variant.")]
Assignments = Annotated[list[str] | None, typer.Option("--set", metavar="A.B=VALUE", help="Any setting by name.")]
Defines = Annotated[
    list[str] | None, typer.Option("-D", "--define", metavar="NAME=VALUE", help="A parameter that the scene declares.")
]
Root = Annotated[
    Path | None, typer.Option(help="Folder whose files an .xml may name; its own folder if absent.", show_default=False)
]

IMAGES = (".exr", ".png")
"""Endings of the images that are written."""


def check_output(path: Path, endings: tuple[str, ...] = IMAGES) -> None:
    """Refuse an output that cannot be written, before anything is computed, and leave nothing behind.

    ``endings`` are those that its name may have; any, where there are none.

    Raises:
        SettingsRejected: another ending than those allowed, a folder, or a place where no file can be made.
    """
    if endings and path.suffix.lower() not in endings:
        raise SettingsRejected(f"the output's name must end in {' or '.join(endings)}")
    try:
        if path.is_dir():
            raise SettingsRejected("the output is a folder: name a file in it")
        if not path.parent.is_dir():
            raise SettingsRejected("the folder of the output does not exist: create it first")
        path.exists()  # Raises where the name itself is none
    except (OSError, ValueError):
        raise SettingsRejected("the output's name cannot be used: choose a shorter one") from None
    trial = path.with_name(f".{secrets.token_hex(6)}.trial")
    try:
        trial.touch(exist_ok=False)
        trial.unlink()
    except OSError:
        raise SettingsRejected(
            "no file can be written into the folder of the output: check its permissions and the free space"
        ) from None


def size_from(text: str) -> tuple[int, int]:
    """(width, height) from ``640x480``.

    Raises:
        SettingsRejected: anything else.
    """
    width, separator, height = text.lower().partition("x")
    # Ten digits are more than any film has, and few enough for int() to read at once.
    digits = all(part.isascii() and part.isdecimal() and len(part) <= 10 for part in (width, height))
    if not (separator and digits and int(width) and int(height)):
        raise SettingsRejected("give the size as WxH, for example 640x480")
    return int(width), int(height)


def settings_from(given: dict[str, Any], size: str | None, assignments: list[str] | None) -> RenderSettings:
    """Settings from options (None: not given), ``--size`` and ``--set name=value``; the last wins.

    Raises:
        SettingsRejected: an unknown name, a refused value, or something not built yet.
    """
    values = {name: value for name, value in given.items() if value is not None}
    if size is not None:
        values["width"], values["height"] = size_from(size)
    for assignment in assignments or []:
        name, separator, text = assignment.partition("=")
        if not separator:
            raise SettingsRejected("give --set as NAME=VALUE, for example pssmlt.chains=4096")
        values[name] = _value(text)
    preset = values.pop("preset", None)
    try:
        start = RenderSettings.model_validate({"preset": preset} if preset else {})
    except ValidationError as error:
        raise SettingsRejected(first_problem(error)) from None
    return with_overrides(start, values)


def _value(text: str) -> Any:
    """A number (.5, too), true or false, else a word."""
    for read in (json.loads, float):
        try:
            return read(text)
        except ValueError:
            continue
    return text


def defines_from(assignments: list[str] | None) -> dict[str, str]:
    """Parameters of a scene from ``-D NAME=VALUE``; the last of a name holds.

    Raises:
        SettingsRejected: one has another form.
    """
    pairs = [assignment.partition("=") for assignment in assignments or []]
    if not all(name and separator for name, separator, _ in pairs):
        raise SettingsRejected("give -D as NAME=VALUE, for example spp=64")
    return {name: value for name, _, value in pairs}


def stop_from(spp: int | None, seconds: float | None, error: float | None) -> StopCriterion | None:
    """When to stop, from ``--spp``, ``--seconds`` and ``--error``; None where none is given.

    Raises:
        SettingsRejected: one is out of range.
    """
    if spp is None and seconds is None and error is None:
        return None
    try:
        return StopCriterion(samples=spp, seconds=seconds, error=error)
    except ValidationError as problem:
        raise SettingsRejected(first_problem(problem)) from None
