"""What the steps of a build have made so far, to be saved between any two and taken up elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elps_core.context.aims import Aims
from elps_core.context.clustering import Clustering
from elps_core.context.directional import DirectionalAccumulator
from elps_core.context.pilot_image import PilotImage
from elps_core.context.shares import CHANCES
from elps_core.context.slits import Slits
from elps_core.context.store import DirectionalParts
from elps_core.errors import ContextMismatch

Doubles = NDArray[np.float64]
Arrays = dict[str, NDArray[Any]]

DENSITY_SIDE = 128
"""Side of the pictures of particles from above, in cells."""
SOURCES = ("radiance", "photons", "importance")
"""Sums of what eye paths find, of what light paths bring, and of what eye paths bring."""
DEPARTURES = "departures"
"""Sums of the light that reaches the image, by how it leaves the pieces of the emitters."""
CAUSTICS = "caustics"
"""Sums of the light that mirrors and glass bring, squared: see :class:`elps_core.particles.caustics.CausticSampler`."""
UNFIT = "the saved state of the context does not fit: measure it again"


@dataclass
class TableState:
    """Regions and tables in the making."""

    pilot: PilotImage
    done: int = 0
    """Steps taken."""
    paths: int = 0
    """Paths traced for the tables."""
    particles: int = 0
    """Particles that regions were made from."""
    density: NDArray[np.float32] = field(default_factory=lambda: np.zeros((2, DENSITY_SIDE, DENSITY_SIDE), np.float32))
    """Photons and importons seen from above, in shares of all."""
    clustering: Clustering | None = None
    """From the first step on."""
    areas: Doubles | None = None
    """Of the regions, once tables are filled."""
    sources: dict[str, DirectionalAccumulator] = field(default_factory=dict)
    """By names of :data:`SOURCES`, :data:`DEPARTURES` and :data:`CAUSTICS`, once tables are filled."""
    lights: Doubles = field(default_factory=lambda: np.zeros((0, 0)))
    """What light sampling found, by region and piece of the lights."""
    colours: Doubles = field(default_factory=lambda: np.zeros((0, 3)))
    """Light by region, in linear RGB, as photons have brought it."""
    moments: Doubles = field(default_factory=lambda: np.zeros((3, 0)))
    """Of what eye paths have found before the last step, see :meth:`DirectionalAccumulator.moments`."""
    chances: Doubles = field(default_factory=lambda: np.zeros((0, len(CHANCES))))
    """Variance by region and chance of a direction from the tables, of the last step."""
    aims: Aims | None = None
    """Once tables are filled, in scenes with mirrors or glass."""
    slits: Slits | None = None
    """Once they have been looked for, in scenes with gaps that light comes through."""
    known: DirectionalParts | None = None
    """Tables of another camera in the same surroundings, in place of a clustering and of sums of radiance."""
    flux: Doubles = field(default_factory=lambda: np.zeros((2, 0, 0)))
    """Luminance that eye paths have brought from each cell of the lights, by halves of passes [2, rows, columns]."""
    flux_paths: Doubles = field(default_factory=lambda: np.zeros(2))
    """Eye paths of both halves."""

    def enter_flux(self, sums: Doubles, paths: Doubles) -> None:
        """Add what ``paths`` [2] have brought from the cells of the lights, ``sums`` [2, rows, columns]."""
        self.flux = self.flux + sums if self.flux.size else sums
        self.flux_paths = self.flux_paths + paths

    def fed(self, records: float) -> bool:
        """Whether most regions know where their light comes from, by so many records and more."""
        sources = [self.sources[name] for name in ("radiance", "photons") if name in self.sources]
        return bool(sources) and float(np.median(np.sum([each.evidence for each in sources], axis=0))) >= records

    def arrays(self) -> Arrays:
        """Everything, by name."""
        parts: Arrays = {
            "counts": np.array([self.done, self.paths, self.particles], np.int64),
            "pilot": self.pilot.sums,
            "newest": self.pilot.newest,
            "first": self.pilot.first,
            "lights": self.lights,
            "density": self.density,
            "colours": self.colours,
            "moments": self.moments,
            "chances": self.chances,
            "flux": self.flux,
            "flux_paths": self.flux_paths,
        }
        if self.clustering is not None:
            parts |= {f"clustering.{name}": array for name, array in self.clustering.arrays().items()}
        if self.areas is not None:
            parts["areas"] = self.areas
        if self.aims is not None:
            parts |= {f"aims.{name}": array for name, array in self.aims.arrays().items()}
        if self.slits is not None:
            parts |= {f"slits.{name}": array for name, array in self.slits.arrays().items()}
        if self.known is not None:
            parts |= {f"known.{name}": array for name, array in self.known.arrays().items()}
        for name, source in self.sources.items():
            parts |= {f"{name}.{key}": array for key, array in source.arrays().items()}
        return parts

    def restore(self, arrays: Mapping[str, NDArray[Any]], *, steps: int, first: int, cells: int) -> None:
        """Take up what :meth:`arrays` gave, of a build of ``steps`` at most.

        Tables have that many ``cells``, and are filled from the step ``first`` on where nothing is known.

        Raises:
            ContextMismatch: it is incomplete, or belongs to other settings. Nothing has changed then.
        """
        try:
            done, paths, particles = (int(n) for n in arrays["counts"])
            pilot, newest, density, lights = (arrays[name] for name in ("pilot", "newest", "density", "lights"))
            colours, moments, chances = arrays["colours"], arrays["moments"], arrays["chances"]
            flux, flux_paths, early = arrays["flux"], arrays["flux_paths"], arrays["first"]
        except (KeyError, ValueError):
            raise ContextMismatch(UNFIT) from None
        saved = _part(arrays, "clustering")
        clustering = Clustering.from_arrays(saved) if saved else None
        areas = arrays.get("areas")
        names = {name.partition(".")[0] for name in arrays} & {*SOURCES, DEPARTURES, CAUSTICS}
        sources = {name: DirectionalAccumulator.from_arrays(_part(arrays, name)) for name in sorted(names)}
        given = _part(arrays, "known")
        known = DirectionalParts.from_arrays(given) if given else None
        found = known is not None or (clustering is not None and clustering.finished)
        first = 0 if known else first
        count = known.regions.count if known else clustering.result().count if clustering and found else 0
        pieces = known.lights.shape[1] if known else lights.shape[-1]
        aimed, gaps = _part(arrays, "aims"), _part(arrays, "slits")
        aims = Aims.from_arrays(aimed, count) if aimed else None
        slits = Slits.from_arrays(gaps, count) if gaps else None
        numbers = [pilot, newest, early, density, lights, colours, moments, chances, flux, flux_paths]
        numbers += [] if areas is None else [areas]
        if (
            not 0 <= done <= steps
            or (done > 0 and not known) != (clustering is not None)
            or (done >= first and not found)
            or (pilot.shape, density.shape) != (self.pilot.sums.shape, self.density.shape)
            or (newest.shape, early.shape) != (self.pilot.newest.shape, self.pilot.first.shape)
            or (bool(sources) or areas is not None) != (done > first)
            or (areas is not None and areas.shape != (count,))
            or (lights.size > 0 and (lights.ndim != 2 or len(lights) != count))
            or colours.shape not in ((0, 3), (count, 3))
            or moments.shape not in ((3, 0), (3, count))
            or chances.shape not in ((0, len(CHANCES)), (count, len(CHANCES)))
            or (flux.ndim, len(flux), flux_paths.shape) != (3, 2, (2,))
            or any(
                (source.regions, source.map.cells) != (pieces if name == DEPARTURES else count, cells)
                for name, source in sources.items()
            )
            or not all(part.dtype.kind == "f" and np.isfinite(part).all() for part in numbers)
        ):
            raise ContextMismatch(UNFIT)
        self.done, self.paths, self.particles = done, paths, particles
        self.pilot.sums, self.pilot.newest, self.pilot.first = pilot.copy(), newest.copy(), early.copy()
        self.density, self.lights = density.copy(), lights.copy()
        self.colours, self.moments, self.chances = colours.copy(), moments.copy(), chances.copy()
        self.clustering, self.areas, self.sources, self.known = clustering, areas, sources, known
        self.aims, self.slits = aims, slits
        self.flux, self.flux_paths = flux.copy(), flux_paths.copy()


def _part(arrays: Mapping[str, NDArray[Any]], prefix: str) -> Arrays:
    return {name.partition(".")[2]: array for name, array in arrays.items() if name.startswith(f"{prefix}.")}
