"""Check an upload from end to end in a process of its own: ``python -m elps_core.scene.inspect UPLOAD``.

Prints one line of JSON: ``{"digest": ..., "summary": {...}}`` or ``{"error": "..."}``. A damaged mesh can
crash a reader, and a hostile one may try more; so the process that serves users starts this one and
believes only its answer.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from elps_core.errors import DeviceUnavailable, SceneRejected
from elps_core.scene import films, reading, sandbox, tensorfile
from elps_core.scene.bundle import open_regular, unpack
from elps_core.scene.files import Files
from elps_core.scene.markup import Node
from elps_core.scene.meshes import BadFileError
from elps_core.scene.sandbox import ChildDiedError, ChildLimits
from elps_core.scene.summary import SceneSummary

VARIANT = "scalar_rgb"
"""The variant that runs on every machine: a front end needs neither LLVM nor a GPU to check a scene."""
SPECTRAL = "scalar_spectral"
"""The same for scenes whose film keeps bands, or whose materials are measured by wavelength."""
MAX_ERROR_CHARACTERS = 400
_DEFINE = "-D"
"""Begins an argument of the child that sets a parameter of the scene."""

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


def inspect(upload: Path, defines: Mapping[str, str] | None = None) -> SceneReport:
    """Unpack, check and load an upload in this process; leaves nothing behind.

    Args:
        upload: a zip archive, XML file or folder.
        defines: values of the scene's parameters.

    Raises:
        SceneRejected: what is wrong with it, in one line.
    """
    from elps_core.scene.loader import load_scene  # here: the parent process never needs it

    with tempfile.TemporaryDirectory(prefix="elps-scene-") as folder:
        unpacked = unpack(upload, Path(folder))
        files = Files(unpacked.xml.parent, Path(folder))
        document = reading.read(unpacked.xml, files, defines)
        variant = SPECTRAL if _needs_spectra(document.root, files) else VARIANT
        loaded = load_scene(Path(folder), variant, defines=defines)
        summary = loaded.summary.model_copy(update={"ignored": unpacked.ignored})
        return SceneReport(digest=loaded.digest, summary=summary)


def _needs_spectra(root: Node, files: Files) -> bool:
    """Whether something below ``root`` has a meaning in variants with spectra alone: a film or a measured material."""
    if films.with_bands(root):
        return True
    measured = (node for node in root.objects() if (node.tag, node.type) == ("bsdf", "measured"))
    named = ((node, node.property("string", "filename")) for node in measured)
    return any(
        _holds_spectra(files.find(name.attributes.get("value", ""), str(node)))
        for node, name in named
        if name is not None
    )


def _holds_spectra(path: Path) -> bool:
    try:
        with open_regular(path) as file:
            return tensorfile.has_spectra(tensorfile.fields(file))
    except BadFileError:  # told where the file is checked
        return False


def inspect_in_child(
    upload: Path, limits: ChildLimits = DEFAULT_LIMITS, defines: Mapping[str, str] | None = None
) -> SceneReport:
    """Check an upload in a child process that can harm nothing here (:mod:`elps_core.scene.sandbox`).

    Takes about a second for a scene of a few MB.

    Args:
        upload: a zip archive, XML file or folder.
        limits: of the child.
        defines: values of the scene's parameters.

    Raises:
        SceneRejected: what is wrong with it, in one line; also where the child crashed or ran out of
            time or memory.
    """
    try:
        extra = [f"{_DEFINE}{name}={value}" for name, value in sorted((defines or {}).items())]
        answer = sandbox.run("elps_core.scene.inspect", upload, limits, extra)
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
    """Entry of the child: the upload, then limits as ``name=value`` and parameters of the scene as ``-Dname=value``."""
    if not arguments:
        print("usage: python -m elps_core.scene.inspect UPLOAD", file=sys.stderr)  # noqa: T201
        return 2
    upload, *settings = arguments
    limits = [text for text in settings if not text.startswith(_DEFINE)]
    pairs = (text.removeprefix(_DEFINE).partition("=") for text in settings if text.startswith(_DEFINE))
    defines = {name: value for name, _, value in pairs}
    given = {name: float(value) for name, _, value in (text.partition("=") for text in limits)}
    defaults = vars(DEFAULT_LIMITS)
    sandbox.restrict(ChildLimits(**{name: type(old)(given.get(name, old)) for name, old in defaults.items()}))
    try:
        line = inspect(Path(upload), defines).model_dump_json()
    except (SceneRejected, DeviceUnavailable) as error:
        line = json.dumps({"error": str(error)[:MAX_ERROR_CHARACTERS]})
    except MemoryError:
        line = json.dumps({"error": _DEATHS["memory"]})
    print(line, flush=True)  # noqa: T201  # the answer
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
