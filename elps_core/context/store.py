"""The global context as data, and as one memory-mapped file. Needs no Mitsuba."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save as save_tensors

from elps_core.errors import ContextMismatch
from elps_core.settings import ContextSettings

FORMAT = "elps-context-1"
"""Name and version of the file format: safetensors with the facts as JSON metadata."""
MAX_HEADER = 1 << 20
"""Bytes of metadata that a file may claim; ours have a few hundred."""
NUMPY_TYPES: dict[str, np.dtype[Any]] = {"F32": np.dtype(np.float32), "F64": np.dtype(np.float64)}


@dataclass(frozen=True)
class GlobalContext:
    """Immutable once built; shapes the densities of samplers and nothing else."""

    digest: str
    """Hash of scene, sensor, film aspect, :class:`ContextSettings` and format version."""
    scene: str
    """Digest of the scene it was measured in."""
    sensor: int
    settings: ContextSettings
    adjoint: NDArray[np.float32]
    """The adjoint image [rows, columns]: luminance flux to the film per cell, columns a multiple of
    the emitters in the order of :class:`elps_core.scene.emission.Emission` [thesis 5.2.1]."""
    emitters: NDArray[np.float32]
    """One key per emitter [count, 7], to recognise them in another load of the scene."""
    statistics: dict[str, Any]
    """Facts of the build: seconds, paths, emitters, flux."""

    def to_bytes(self) -> bytes:
        """The context as one safetensors record."""
        facts = {
            "digest": self.digest,
            "scene": self.scene,
            "sensor": self.sensor,
            "settings": self.settings.model_dump(),
            "statistics": self.statistics,
        }
        tensors = {"adjoint": np.ascontiguousarray(self.adjoint), "emitters": np.ascontiguousarray(self.emitters)}
        return save_tensors(tensors, metadata={"format": FORMAT, "facts": json.dumps(facts)})


def save(context: GlobalContext, path: Path) -> None:
    """Write ``context`` to ``path``, whole or not at all."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.write_bytes(context.to_bytes())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def load(path: Path) -> GlobalContext:
    """Open a context file; its tables are mapped into memory, not read.

    Raises:
        ContextMismatch: not a context file, or one of another format version.
    """
    try:
        with path.open("rb") as file:
            size = int.from_bytes(file.read(8), "little")
            if not 0 < size <= MAX_HEADER:
                raise ContextMismatch("not a context file: build one with 'elps context build'")
            header = json.loads(file.read(size))
        metadata = header.pop("__metadata__")
        if metadata["format"] != FORMAT:
            raise ContextMismatch("the context file has another format version: build it again")
        facts = json.loads(metadata["facts"])
        tensors = {name: _mapped(path, 8 + size, entry) for name, entry in header.items()}
        context = GlobalContext(
            digest=str(facts["digest"]),
            scene=str(facts["scene"]),
            sensor=int(facts["sensor"]),
            settings=ContextSettings.model_validate(facts["settings"]),
            adjoint=tensors["adjoint"],
            emitters=tensors["emitters"],
            statistics=dict(facts["statistics"]),
        )
    except OSError:
        raise ContextMismatch("the context file cannot be opened: check the path") from None
    except (KeyError, TypeError, ValueError):  # includes JSON, Unicode and pydantic errors
        raise ContextMismatch("not a context file: build one with 'elps context build'") from None
    if context.adjoint.ndim != 2 or context.emitters.ndim != 2:
        raise ContextMismatch("not a context file: build one with 'elps context build'")
    return context


def _mapped(path: Path, base: int, entry: dict[str, Any]) -> NDArray[Any]:
    start, end = entry["data_offsets"]
    dtype = NUMPY_TYPES[entry["dtype"]]
    shape = tuple(int(n) for n in entry["shape"])
    if start < 0 or end - start != dtype.itemsize * int(np.prod(shape)) or base + end > path.stat().st_size:
        raise ValueError("truncated")
    return np.memmap(path, dtype=dtype, mode="r", offset=base + start, shape=shape)
