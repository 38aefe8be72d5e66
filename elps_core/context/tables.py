"""From particles and walks to regions and their tables: the directional part of a context [thesis 5.2.3, 5.2.4]."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.context.aims import Aims
from elps_core.context.areas import region_areas
from elps_core.context.clustering import Clustering, groups_of
from elps_core.context.collect import collect
from elps_core.context.directional import DirectionalAccumulator, finish
from elps_core.context.encoding import DirectionalTables
from elps_core.context.gaps import kept_evenly, slits, thinned
from elps_core.context.gather import (
    AIMED_FOR_REGIONS,
    AIMED_FOR_TABLES,
    AREAS,
    FILLING,
    KNOWING,
    PARTICLES,
    STREAM,
    Gathered,
    caustics,
    gather,
    places,
    wanted_of_each,
)
from elps_core.context.lookup import RegionLookup
from elps_core.context.mirrored import Places, mirrored
from elps_core.context.pilot_image import PilotImage, regions_in_view
from elps_core.context.plan import FIRST_PATHS, filling
from elps_core.context.prospects import prospects_of
from elps_core.context.regions import Regions
from elps_core.context.saved import CAUSTICS, DEPARTURES, SOURCES, Arrays, Doubles, TableState
from elps_core.context.shares import best_shares
from elps_core.context.store import DirectionalParts
from elps_core.context.surroundings import SHARE, sees_enough, with_pieces
from elps_core.context.training import BY_ALBEDO, Step, Tables, Trainer
from elps_core.context.walks import Thinned
from elps_core.particles.records import IMPORTON, PHOTON, ParticleArrays
from elps_core.sampling.start import StartDensity
from elps_core.scene.meeting import Meeting
from elps_core.scene.sensors import Camera
from elps_core.settings import MOST_PATHS, USUAL_PATHS, ContextSettings
from elps_core.timing import KernelClock

CLUSTER_STEPS, CLUSTER_BATCH = 4, 3
"""Steps of a build for the clustering, and its own steps in each: 12 are enough for it."""
REGIONS_PER_GROUP, REGIONS_PER_AIM = 16, 8
"""Regions that lend each other what they know, and that see mirrored lamps at the same points."""
SLITS_FROM, SLITS_AT = 2, 3
"""First step of filling whose photons may tell of slits, and that after which they are looked for, or before if it is
the last one: of the door's room, 3 degrees ajar, step 3 has 3300 photons that may."""
WORTHWHILE, SURELY = 0.1, 1.0
"""Part of a path's variance that a step has to win, if it could be that many standard errors more, for the next to be
taken: that one takes about a tenth of a render's time. In the maze, with a quarter of the paths, tables are as good."""
LENT = 0.1
"""Share of a region's table of lights that is its group's: what was not met there may be near."""
GATHERING = 1 << 15
"""Paths of each kind that are traced before there are regions."""
KEPT_FOR_REGIONS = 0.5
"""Part of their vertices that is kept: eight times as many as regions are made from, of which these are drawn."""
GATHERED = 2
"""Times that so many are traced, at most, where few of them meet a surface that scatters."""
HASTY = 0.5
"""A step that would have less than this part of the paths of the one before is not worth its fixed costs."""
SEARCH = 1.5
"""Seconds that have to be left for slits to be looked for: it takes 0.3 to 2."""
LINES = 1 << 19
"""Random lines by which areas are measured."""


class TableBuilder:
    """Divides the surfaces of one scene into regions and fills their tables, step by step."""

    def __init__(self, scene: mi.Scene, camera: Camera, settings: ContextSettings) -> None:
        self.scene, self.camera, self.settings = scene, camera, settings
        self._paths = settings.paths or (USUAL_PATHS if settings.seconds is None else MOST_PATHS)
        self._trainer = Trainer(scene, camera, settings)
        self._rate: float | None = None
        self._kept: tuple[Thinned, Thinned] | None = None
        self._aimed: bool | None = None
        self.seeks_slits = True
        """Whether gaps that light comes through are looked for, in a second or two: of use where it is hard to find."""
        self._made = TableState(PilotImage(camera.size))
        self._parents: NDArray[np.uint32] | None = None
        self._rays: Meeting | None = None
        self._ready: dict[tuple[str, ...], DirectionalTables] = {}

    @property
    def filling(self) -> list[int]:
        """Paths of each step that fills the tables."""
        if self._made.known is None:
            return list(filling(self._paths))
        fewer = max(FIRST_PATHS, int(SHARE * self._paths))
        return [fewer // 4, fewer - fewer // 4]

    @property
    def steps(self) -> int:
        """Steps in all."""
        return len(self.filling) + (1 + CLUSTER_STEPS if self._made.known is None else 0)

    @property
    def done(self) -> int:
        """Steps taken."""
        return self._made.done

    @property
    def knows_nothing(self) -> bool:
        """Whether all is measured here, with nothing known of another camera's tables."""
        return self._made.known is None

    @property
    def filled(self) -> int:
        """Steps of filling taken."""
        return max(0, self._made.done - (1 + CLUSTER_STEPS if self.knows_nothing else 0))

    def stop(self) -> None:
        """Take no more steps: the tables are good enough, or not worth it. Once filling has begun."""
        self._made.done = self.steps

    def begin_from(self, known: DirectionalParts, lights: StartDensity) -> bool:
        """Take over the regions and the radiance of another camera's tables, if this one sees enough of them.

        Raises:
            RuntimeError: steps have been taken.
        """
        if self._made.done:
            raise RuntimeError("the tables have been begun")
        key = (self.settings.seed, STREAM, KNOWING)
        if sees_enough(self.scene, self.camera, lights, known, self.settings.max_depth, key):
            self._made.known, self._made.density = known, known.density.copy()
        return self._made.known is not None

    @property
    def paths(self) -> int:
        """Paths traced for the tables."""
        return self._made.paths

    @property
    def particles(self) -> int:
        """Particles that regions were made from."""
        return self._made.particles

    def flux(self, rows: int, columns: int) -> Doubles:
        """Luminance that eye paths have brought from each cell of the lights, in two estimates [2, rows, columns]."""
        if not self._made.flux.size:
            return np.zeros((2, rows, columns))
        return self._made.flux / np.maximum(self._made.flux_paths, 1.0)[:, None, None]

    @property
    def gain(self) -> float:
        """Times that a path of the last step had less variance than one before there were tables."""
        return self._made.pilot.gain()

    @property
    def flux_paths(self) -> int:
        """Eye paths that have told it."""
        return int(self._made.flux_paths.sum())

    @property
    def slits_found(self) -> bool:
        """Whether there are gaps that light comes through."""
        return self._made.slits is not None

    @property
    def caustics(self) -> bool:
        """Whether mirrors or glass bring light to surfaces that scatter it."""
        return self._made.aims is not None

    def step(self, lights: StartDensity, left: float = float("inf"), patience: float = float("inf")) -> None:
        """Take the next step, light paths starting by ``lights``; no more paths are begun ``left`` seconds later.

        Raises:
            CompilesTooLong: the first kernel took more than ``patience`` seconds to compile; nothing was found.
        """
        until = time.perf_counter() + left
        self._rays = lights.emission.rays
        if self._made.known is not None:
            self._fill(lights, self._made.done, until)
        elif self._made.done == 0:
            self._gather(lights, patience)
        elif self._made.clustering and self._made.done <= CLUSTER_STEPS:
            for _ in range(CLUSTER_BATCH):
                self._made.clustering.step()
        else:
            self._fill(lights, self._made.done - 1 - CLUSTER_STEPS, until)
            if self._converged:
                self.stop()
                return
        self._made.done += 1

    def worth_going_on(self, left: float) -> bool:
        """Whether in ``left`` seconds a step can be filled with at least a part of the paths of the one before."""
        if self._rate is None:
            return left > 0.0
        return left * self._rate > HASTY * self.filling[self.filled - 1]

    @property
    def _converged(self) -> bool:
        """Whether more paths would hardly improve the tables."""
        # Steps with another roulette are no measure of what the tables are worth to those with this one.
        won = self._made.pilot.won(SURELY) if self.filled >= BY_ALBEDO + 1 else float("inf")
        tolerance = self.settings.tolerance
        return self.relative_error() <= tolerance or (tolerance > 0.0 and won < WORTHWHILE)

    @property
    def regions(self) -> Regions:
        """The regions, once they are found."""
        if self._made.known is not None:
            return self._made.known.regions
        if self._made.clustering is None:
            raise RuntimeError("there are no regions yet: take the steps that are left")
        return self._made.clustering.result()

    def relative_error(self) -> float:
        """Of the sums that guide eye paths; infinite before there are any."""
        sources = self._made.sources
        names = ("radiance", "photons") if self._made.known is None else ("importance",)
        errors = [sources[name].relative_error() for name in names if name in sources]
        return min(errors, default=float("inf"))

    def result(self) -> DirectionalParts:
        """Tables fit to be sampled."""
        encoding, pilot, known = self.settings.encoding, self._made.pilot, self._made.known
        return DirectionalParts(
            regions=self.regions,
            radiance=known.radiance if known else self._finished("radiance", "photons").encoded(encoding),
            importance=self._finished("importance").encoded(encoding),
            pilot=pilot.image(),
            noise=pilot.noise(),
            lights=known.lights if known else self._light_tables(),
            view=regions_in_view(self._rays or self.scene, self.camera, self.regions, pilot.shape),
            density=self._made.density,
            prospects=self._prospects(),
            shares=self._shares(),
            departures=self._departures(),
            aims=known.aims if known else self._made.aims,
            slits=known.slits if known else self._made.slits,
        )

    def _light_tables(self) -> NDArray[np.float32]:
        """Shares of the lights' pieces in each region [K, pieces], drawn a little towards those of its group."""
        if not self._made.lights.size:
            return np.zeros((self.regions.count, 0), np.float32)
        own, parents = _normalised(self._made.lights), self._groups()
        group = np.zeros((int(parents.max()) + 1, own.shape[1]))
        np.add.at(group, parents, own)
        return np.asarray((1.0 - LENT) * own + LENT * _normalised(group)[parents], np.float32)

    def _prospects(self) -> NDArray[np.float32] | None:
        """What eye paths find, where they have filled the tables."""
        if self._made.known:
            return self._made.known.prospects
        source, moments = self._made.sources.get("radiance"), self._made.moments
        if source is None or not moments.size:
            return None
        irradiance = source.estimate().irradiance
        return prospects_of(irradiance, source.moments() - moments, self._groups(), self._made.colours)

    def _shares(self) -> NDArray[np.float32] | None:
        """Chances of directions from the radiance tables, where eye paths have tried some."""
        if self._made.known:
            return self._made.known.shares
        return best_shares(self._made.chances, self._groups()) if self._made.chances.any() else None

    def _departures(self) -> DirectionalTables | None:
        source = self._made.sources.get(DEPARTURES)
        return finish([source]).encoded(self.settings.encoding) if source and source.batches else None

    def _groups(self) -> NDArray[np.uint32]:
        if self._parents is None:
            self._parents = self._neighbours(REGIONS_PER_GROUP)
        return self._parents

    def _neighbours(self, number: int) -> NDArray[np.uint32]:
        regions = self.regions
        return groups_of(regions, max(1, regions.count // number), self.settings.seed)

    def _finished(self, *names: str) -> DirectionalTables:
        """Of the sources of these names, until the next step; trials and the step after them ask for the same."""
        if names not in self._ready:
            self._ready[names] = self._finish(*names)
        return self._ready[names]

    def _finish(self, *names: str) -> DirectionalTables:
        sources = [self._made.sources[name] for name in names if name in self._made.sources]
        peaks = self._made.sources.get(CAUSTICS) if "radiance" in names else None
        return finish(sources, self._groups(), self.regions.normals, peaks=peaks)

    # -- Checkpoints -----------------------------------------------------------------------------

    def arrays(self) -> Arrays:
        """Everything that the steps so far have made, by name."""
        return self._made.arrays()

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take up what :meth:`arrays` gave.

        Raises:
            ContextMismatch: it is incomplete, or belongs to other settings.
        """
        cells = self.settings.rows * self.settings.columns
        self._made.restore(arrays, steps=self.steps, first=1 + CLUSTER_STEPS, cells=cells)
        self._parents = None
        self._ready.clear()

    # -- Regions ---------------------------------------------------------------------------------

    def _gather(self, lights: StartDensity, patience: float) -> None:
        settings, made = self.settings, self._made
        if settings.particles == "walks":
            gathered = self._from_walks(lights, patience)
        else:
            gathered = gather(self.scene, self.camera, settings, lights)
        made.particles, made.density = len(gathered.position), gathered.density
        made.clustering = Clustering(gathered.position, gathered.normal, settings.regions, settings.seed)

    def _from_walks(self, lights: StartDensity, patience: float) -> Gathered:
        """Places that the first paths of training visit, before there are regions."""
        aimed = list(caustics(self.scene, self.settings, lights, AIMED_FOR_REGIONS))
        undivided = RegionLookup(Regions.undivided(self.settings.regions))
        scratch = TableState(self._made.pilot)
        self._aimed = any(len(photons) for photons in aimed)
        if self._aimed:  # The kernel of later steps, which know where to aim at
            scratch.aims = Aims.nowhere(undivided.count)
        for name in SOURCES:
            scratch.sources[name] = DirectionalAccumulator(undivided.count, self.settings.rows, self.settings.columns)
        kept = kept_evenly(KEPT_FOR_REGIONS, undivided.count), kept_evenly(KEPT_FOR_REGIONS, undivided.count)
        found: dict[int, list[ParticleArrays]] = {IMPORTON: [], PHOTON: []}
        for run in range(GATHERED):
            key = (self.settings.seed, STREAM, PARTICLES, run)
            step = Step(-1, GATHERING, key, kept=kept, patience=patience)
            self._trainer.train(scratch, undivided, np.ones(undivided.count), lights, Tables(), step)
            for (kind, parts), particles in zip(found.items(), kept, strict=True):
                parts.append(particles.buffer.take().of(kind).arrays())
            wanted = wanted_of_each(self.settings)
            if all(sum(len(part.weight) for part in parts) >= wanted for parts in found.values()):
                break
        self._made.enter_flux(scratch.flux, scratch.flux_paths)
        return places(self.scene, self.settings, found, aimed, by_weight=True)

    # -- Filling ---------------------------------------------------------------------------------

    def _fill(self, lights: StartDensity, number: int, until: float) -> None:
        """One more step of paths, guided by what the ones before have found."""
        made, regions = self._made, self.regions
        count, grid = regions.count, (self.settings.rows, self.settings.columns)
        finder = RegionLookup(regions)
        key = (self.settings.seed, STREAM, FILLING, number)
        if made.areas is None:
            key_areas = (self.settings.seed, STREAM, AREAS)
            areas = region_areas(lights.emission.rays, finder, count, LINES, key_areas, facing=regions.normals)
            # What no line has crossed is small, and not nothing.
            made.areas = np.maximum(areas, areas[areas > 0.0].min(initial=1e30))
        known = made.known
        walks = known is not None or self.settings.particles == "walks"
        names = SOURCES[2:] if known is not None else SOURCES if walks else SOURCES[1:]
        for name in names:
            made.sources.setdefault(name, DirectionalAccumulator(count, *grid))
        paths = self.filling[number]
        if self._rate is not None:  # As many as there is time for
            paths = int(min(paths, max(FIRST_PATHS, self._rate * (until - time.perf_counter()))))
        if walks and not known and number == 0 and self._aimed is not False:
            aims = Places(finder, made.areas, self._neighbours(REGIONS_PER_AIM), grid)
            found = mirrored(self.scene, aims, caustics(self.scene, self.settings, lights, AIMED_FOR_TABLES))
            if found:
                made.aims, made.sources[CAUSTICS] = found
        if walks:
            paths = self._walk(lights, finder, made.areas, Step(number, paths, key, until))
        else:
            collect(self.scene, self.camera, self.settings, lights, finder, made, paths, key)
        made.paths += paths
        self._ready.clear()

    def _walk(self, lights: StartDensity, finder: RegionLookup, areas: Doubles, step: Step) -> int:
        """Fill tables by walks; how many paths were traced."""
        made, known, number = self._made, self._made.known, step.number
        if known:
            known = made.known = with_pieces(known, lights)
        # From the first step of each kernel on, so that there is one only.
        now = self.seeks_slits and SLITS_FROM <= number <= SLITS_AT and not known and made.slits is None
        photons = made.sources.get("photons")
        of_eye = thinned(made.sources["importance"].evidence, now=now)
        of_light = thinned(photons.evidence, now=now) if photons else None
        tables = Tables(
            radiance=self._finished("radiance", "photons") if number and not known else None,
            importance=self._finished("importance") if number > 1 and not known else None,
            known=known,
        )
        begin = time.perf_counter()
        with KernelClock() as kernels:
            step = replace(step, kept=(of_eye, of_light))
            traced = self._trainer.train(made, finder, areas, lights, tables, step)
        # Kernels that were compiled now will be there for the next step.
        self._rate = traced / max(time.perf_counter() - begin - kernels.compiling, 1e-3)
        if now and of_light:
            self._kept = of_light, of_eye
            if number == SLITS_AT and time.perf_counter() + SEARCH < step.until:
                self.look_for_slits()
        return traced

    def look_for_slits(self) -> None:
        """Look for gaps by the particles that the last step has kept, unless that was done."""
        made, photons = self._made, self._made.sources.get("photons")
        if self._kept is None or photons is None or made.areas is None:
            return
        cell = 4.0 * np.pi / (self.settings.rows * self.settings.columns)
        lenders, flux = self._groups(), photons.moments()[1]
        bright = np.bincount(lenders, flux)[lenders] / np.bincount(lenders, made.areas)[lenders]
        finder = RegionLookup(self.regions)
        made.slits = slits(self.scene, *self._kept, finder, lenders, bright, cell, self.settings.seed)
        self._kept = None
        self._ready.clear()

    @property
    def yet_to_come(self) -> float:
        """Seconds that it takes to look for gaps when the last step is taken."""
        return SEARCH if self._kept and self.seeks_slits else 0.0


def _normalised(sums: Doubles) -> Doubles:
    """Of each row's total; zeros where that is none."""
    total = sums.sum(axis=1, keepdims=True)
    found: Doubles = np.divide(sums, total, out=np.zeros_like(sums), where=total > 0.0)
    return found
