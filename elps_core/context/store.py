"""The global context as data, and as one memory-mapped file. Needs no Mitsuba."""

from __future__ import annotations

import json
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save as save_tensors

from elps_core.context.aims import Aims
from elps_core.context.encoding import DirectionalTables
from elps_core.context.regions import Regions
from elps_core.context.slits import Slits
from elps_core.errors import ContextMismatch
from elps_core.settings import ContextSettings

FORMAT = "elps-context-7"
"""Name and version of the file format: safetensors with the facts as JSON metadata."""
MAX_HEADER = 1 << 20
"""Bytes of metadata that a file may claim; ours have a few hundred."""
MAX_SIDE = 4096
"""Side of a pilot image that a file may claim; ours have a few hundred."""
NUMPY_TYPES: dict[str, np.dtype[Any]] = {
    name: np.dtype(kind)
    for name, kind in {
        "F16": np.float16,
        "F32": np.float32,
        "F64": np.float64,
        "U8": np.uint8,
        "U16": np.uint16,
        "U32": np.uint32,
    }.items()
}


@dataclass(frozen=True)
class DirectionalParts:
    """Radiance and importance by region and direction [thesis 5.2.3, 5.2.4]."""

    regions: Regions
    radiance: DirectionalTables
    """Incident radiance times cosine: luminance per unit of surface."""
    importance: DirectionalTables
    """Incident importance times cosine, as a share of what the film's pixels receive."""
    pilot: NDArray[np.float32]
    """Estimate of the image [height, width], luminance, blurred, at a resolution of its own."""
    noise: float
    """Standard deviation of one guided path over the value of its pixel; the median of all pixels."""
    lights: NDArray[np.float32]
    """Which pieces of the emitters light a region straight [K, pieces]: see :mod:`elps_core.sampling.lights`."""
    view: NDArray[np.uint16]
    """Region that the middle of each of the pilot's pixels shows [height, width]; for eyes only."""
    density: NDArray[np.float32]
    """Photons and importons seen from above [2, n, n], in shares of all; for eyes only."""
    prospects: NDArray[np.float32] | None = None
    """What eye paths find that go on from a region [K, 4]: the mean of radiance times cosine over all directions, in
    linear RGB of the luminance that eye paths have found, and the standard deviation of one path over the mean; None
    where no eye paths have filled the tables."""
    shares: NDArray[np.float32] | None = None
    """Chance of a direction from the radiance table [K] by which eye paths would have had the least noise; None where
    no eye paths have filled the tables."""
    departures: DirectionalTables | None = None
    """Where light that reaches the image leaves the emitters' pieces to [pieces, rows, columns]; None: not measured."""
    aims: Aims | None = None
    """Where eye paths meet a lamp by way of mirrors and glass; None in scenes without."""
    slits: Slits | None = None
    """Gaps that regions are lit through; None where none was found."""

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything by name, for a file."""
        parts = {
            "regions": self.regions.arrays(),
            "radiance": self.radiance.arrays(),
            "importance": self.importance.arrays(),
            **({"departures": self.departures.arrays()} if self.departures else {}),
            **({} if self.prospects is None else {"prospects": {"eye": self.prospects}}),
            **({} if self.shares is None else {"shares": {"eye": self.shares}}),
            **({"aims": self.aims.arrays()} if self.aims else {}),
            **({"slits": self.slits.arrays()} if self.slits else {}),
        }
        named = {f"{part}.{name}": array for part, owned in parts.items() for name, array in owned.items()}
        noise = np.array([self.noise], np.float32)
        return {
            **named,
            "pilot": self.pilot,
            "noise": noise,
            "lights": self.lights,
            "view": self.view,
            "density": self.density,
        }

    @staticmethod
    def from_arrays(arrays: Mapping[str, NDArray[Any]]) -> DirectionalParts:
        """What :meth:`arrays` gave, taken over without copies.

        Raises:
            ContextMismatch: something is missing, or does not fit the rest.
        """

        def part(prefix: str) -> dict[str, NDArray[Any]]:
            return {name.partition(".")[2]: array for name, array in arrays.items() if name.startswith(f"{prefix}.")}

        regions = Regions.from_arrays(part("regions"))
        radiance, importance = (DirectionalTables.from_arrays(part(name)) for name in ("radiance", "importance"))
        leaving = part("departures")
        departures = DirectionalTables.from_arrays(leaving) if leaving else None
        aimed, gaps = part("aims"), part("slits")
        aims = Aims.from_arrays(aimed, regions.count) if aimed else None
        slits = Slits.from_arrays(gaps, regions.count) if gaps else None
        prospects, shares = (part(name).get("eye") for name in ("prospects", "shares"))
        try:
            pilot, lights, view, density = (arrays[name] for name in ("pilot", "lights", "view", "density"))
            noise = float(arrays["noise"][0])
        except (KeyError, IndexError):
            raise ContextMismatch("the tables of the context are damaged: build it again") from None
        if (
            pilot.ndim != 2
            or not 0 < min(pilot.shape) <= max(pilot.shape) <= MAX_SIDE
            or view.shape != pilot.shape
            or density.ndim != 3
            or density.shape != (2, density.shape[1], density.shape[1])
            or density.size == 0
            or [pilot.dtype, lights.dtype, view.dtype, density.dtype] != [np.float32, np.float32, np.uint16, np.float32]
            or not 0.0 <= noise < np.inf
            or lights.ndim != 2
            or len(lights) != regions.count
            or not all(np.isfinite(part).all() and (part >= 0.0).all() for part in (pilot, lights))
            or radiance.shape[0] != regions.count
            or importance.shape != radiance.shape
            or (departures and departures.shape[0] != lights.shape[1])
            or (prospects is not None and not _are_prospects(prospects, regions.count))
            or (shares is not None and not _are_shares(shares, regions.count))
        ):
            raise ContextMismatch("the tables of the context are damaged: build it again")
        return DirectionalParts(
            *(regions, radiance, importance, pilot, noise, lights, view, density),
            *(prospects, shares, departures, aims, slits),
        )


def _are_prospects(array: NDArray[Any], regions: int) -> bool:
    of_size = array.shape == (regions, 4) and array.dtype == np.float32
    return of_size and bool(np.isfinite(array).all() and (array >= 0.0).all())


def _are_shares(array: NDArray[Any], regions: int) -> bool:
    return array.shape == (regions,) and array.dtype == np.float32 and bool(((array > 0.0) & (array < 1.0)).all())


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
    directions: DirectionalParts | None = None
    """Tables of directions, where the settings ask for regions."""
    surroundings: str = ""
    """Digest of the scene without its cameras: what is known of light holds for all that share it."""

    def to_bytes(self) -> bytes:
        """The context as one safetensors record."""
        facts = {
            "digest": self.digest,
            "scene": self.scene,
            "surroundings": self.surroundings,
            "sensor": self.sensor,
            "settings": self.settings.model_dump(),
            "statistics": self.statistics,
        }
        tensors = {"adjoint": self.adjoint, "emitters": self.emitters}
        if self.directions is not None:
            tensors |= self.directions.arrays()
        tensors = {name: np.ascontiguousarray(array) for name, array in tensors.items()}
        return save_tensors(tensors, metadata={"format": FORMAT, "facts": json.dumps(facts)})


def save(context: GlobalContext, path: Path) -> None:
    """Write ``context`` to ``path``, whole or not at all."""
    partial = path.with_name(f".{secrets.token_hex(6)}.partial")
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
            directions=DirectionalParts.from_arrays(tensors) if "pilot" in tensors else None,
            surroundings=str(facts["surroundings"]),
        )
    except OSError:
        raise ContextMismatch("the context file cannot be opened: check the path") from None
    except (KeyError, TypeError, ValueError):  # includes JSON, Unicode and pydantic errors
        raise ContextMismatch("not a context file: build one with 'elps context build'") from None
    adjoint, emitters = context.adjoint, context.emitters
    if adjoint.ndim != 2 or emitters.ndim != 2 or not len(emitters) or adjoint.shape[1] % len(emitters):
        raise ContextMismatch("not a context file: build one with 'elps context build'")
    return context


def _mapped(path: Path, base: int, entry: dict[str, Any]) -> NDArray[Any]:
    start, end = entry["data_offsets"]
    dtype = NUMPY_TYPES[entry["dtype"]]
    shape = tuple(int(n) for n in entry["shape"])
    if start < 0 or end - start != dtype.itemsize * int(np.prod(shape)) or base + end > path.stat().st_size:
        raise ValueError("truncated")
    return np.memmap(path, dtype=dtype, mode="r", offset=base + start, shape=shape)
