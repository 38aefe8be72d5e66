"""Check an upload from end to end in a process of its own: ``python -m elps_core.scene.inspect UPLOAD``.

Prints one line of JSON: ``{"digest": ..., "summary": {...}}`` or ``{"error": "..."}``. A damaged mesh can
crash a reader, and a hostile one may try more; so the process that serves users starts this one and
believes only its answer.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from elps_core.errors import DeviceUnavailable, SceneRejected
from elps_core.scene import films, markup, sandbox
from elps_core.scene.bundle import unpack
from elps_core.scene.sandbox import ChildDiedError, ChildLimits
from elps_core.scene.summary import SceneSummary

VARIANT = "scalar_rgb"
"""The variant that runs on every machine: a front end needs neither LLVM nor a GPU to check a scene."""
SPECTRAL = "scalar_spectral"
"""The same for scenes whose film keeps bands."""
MAX_ERROR_CHARACTERS = 400

DEFAULT_LIMITS = ChildLimits()
_DEATHS = {
    "time": "checking the scene took too long: make it smaller or simpler",
    "memory": "the scene needs more memory than a check may use: make its meshes and images smaller",
    "crash": "the scene crashes the renderer: one of its files is damaged or needs too much memory",
}


class SceneReport(BaseModel):
    """What the check of an upload found."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    digest: Annotated[str, Field(pattern=r"^sha256:[0-9a-f]{64}$")]
    summary: SceneSummary


class _Refusal(BaseModel):
    model_config = ConfigDict(extra="forbid")

    error: Annotated[str, Field(max_length=MAX_ERROR_CHARACTERS)]


def inspect(upload: Path) -> SceneReport:
    """Unpack, check and load an upload in this process; leaves nothing behind.

    Raises:
        SceneRejected: what is wrong with it, in one line.
    """
    from elps_core.scene.loader import load_scene  # here: the parent process never needs it

    with tempfile.TemporaryDirectory(prefix="elps-scene-") as folder:
        xml = unpack(upload, Path(folder))
        loaded = load_scene(xml, SPECTRAL if films.with_bands(markup.read(xml)) else VARIANT)
        return SceneReport(digest=loaded.digest, summary=loaded.summary)


def inspect_in_child(upload: Path, limits: ChildLimits = DEFAULT_LIMITS) -> SceneReport:
    """Check an upload in a child process that can harm nothing here (:mod:`elps_core.scene.sandbox`).

    Takes about a second for a scene of a few MB.

    Args:
        upload: a zip archive, XML file or folder.
        limits: of the child.

    Raises:
        SceneRejected: what is wrong with it, in one line; also where the child crashed or ran out of
            time or memory.
    """
    try:
        answer = sandbox.run("elps_core.scene.inspect", upload, limits)
    except ChildDiedError as death:
        raise SceneRejected(_DEATHS[death.reason]) from None
    try:
        return SceneReport.model_validate_json(answer)
    except ValidationError:
        pass
    try:
        refusal = _Refusal.model_validate_json(answer)
    except ValidationError:
        raise SceneRejected(_DEATHS["crash"]) from None
    raise SceneRejected(" ".join(refusal.error.split()))


def main(arguments: list[str]) -> int:
    """Entry of the child: the upload, then limits as ``name=value``."""
    if not arguments:
        print("usage: python -m elps_core.scene.inspect UPLOAD", file=sys.stderr)  # noqa: T201
        return 2
    upload, *settings = arguments
    given = {name: float(value) for name, _, value in (text.partition("=") for text in settings)}
    defaults = vars(DEFAULT_LIMITS)
    sandbox.restrict(ChildLimits(**{name: type(old)(given.get(name, old)) for name, old in defaults.items()}))
    try:
        line = inspect(Path(upload)).model_dump_json()
    except (SceneRejected, DeviceUnavailable) as error:
        line = json.dumps({"error": str(error)[:MAX_ERROR_CHARACTERS]})
    except MemoryError:
        line = json.dumps({"error": _DEATHS["memory"]})
    print(line, flush=True)  # noqa: T201  # the answer
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
