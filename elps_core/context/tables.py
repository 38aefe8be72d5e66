"""From particles and walks to regions and their tables: the directional part of a context [thesis 5.2.3, 5.2.4]."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.context.areas import region_areas
from elps_core.context.clustering import Clustering, groups_of
from elps_core.context.collect import collect
from elps_core.context.directional import DirectionalAccumulator, even_tables, finish
from elps_core.context.encoding import DirectionalTables
from elps_core.context.field import DirectionalField
from elps_core.context.gaps import slits, thinned
from elps_core.context.gather import (
    AIMED_FOR_TABLES,
    AREAS,
    FILLING,
    KNOWING,
    STREAM,
    caustics,
    gather,
)
from elps_core.context.lookup import RegionLookup
from elps_core.context.mirrored import Places, mirrored
from elps_core.context.pilot_image import PilotImage, regions_in_view
from elps_core.context.plan import FIRST_PATHS, filling
from elps_core.context.prospects import prospects_of
from elps_core.context.regions import Regions
from elps_core.context.saved import CAUSTICS, DEPARTURES, SOURCES, Arrays, Doubles, TableState
from elps_core.context.shares import ShareTrial, best_shares
from elps_core.context.store import DirectionalParts
from elps_core.context.surroundings import SHARE, sees_enough, with_pieces
from elps_core.context.walks import WalkRecorder
from elps_core.integrators.bdpt import Bdpt
from elps_core.integrators.frame import LANES
from elps_core.paths import strategies
from elps_core.paths.roulette import RouletteRule
from elps_core.paths.scattering import Materials
from elps_core.paths.stream import Stream
from elps_core.sampling.aims import AimedDirections
from elps_core.sampling.context import PixelWorth, towards
from elps_core.sampling.direction import ENOUGH, NEVER, Guide, GuidedDirections
from elps_core.sampling.lights import pieces
from elps_core.sampling.start import StartDensity
from elps_core.scene.meeting import Meeting
from elps_core.scene.sensors import Camera
from elps_core.settings import USUAL_PATHS, ContextSettings

CLUSTER_STEPS, CLUSTER_BATCH = 4, 3
"""Steps of a build for the clustering, and its own steps in each: 12 are enough for it."""
REGIONS_PER_GROUP, REGIONS_PER_AIM = 16, 8
"""Regions that lend each other what they know, and that see mirrored lamps at the same points."""
SLITS_AT = 3
"""Step of filling whose photons tell of slits: of the door's room, 3 degrees ajar, it has 3300 that may."""
TRAINING_SHARE = 0.6
"""Chance of a direction from the tables so far: less than in renders, since they are to change."""
NOT_YET = 1e-6
"""The same of tables that know nothing yet."""
RECORDS = 1 << 21
"""Room for the records of one pass, 50 MB: longer paths have more, so that there are fewer of them."""
BY_ALBEDO = 2
"""Steps of filling with roulette by albedo: by what tables hold so far paths would end that have more to find."""
WORTHWHILE, SURELY = 0.1, 1.0
"""Part of a path's variance that a step has to win, if it could be that many standard errors more, for the next to be
taken: that one takes about a tenth of a render's time. In the maze, with a quarter of the paths, tables are as good."""
LENT = 0.1
"""Share of a region's table of lights that is its group's: what was not met there may be near."""
LIGHT_PART = 4
"""Eye paths for one light path: photons tell what eye paths cannot find. With one for each, the door's context took 2
of 11 seconds more and paths had 3% less variance; a bulb in glass asked for no more either."""
FED = 1000.0
"""Records that the middle one of all regions has to have: until then there is a light path for each eye path."""
TRAINING_NOISE = 2.0
"""Noise of a path, over its pixel, that roulette assumes: less than there is, so that it ends few paths by tables that
still change."""
MOST, NOISY = 0.5, 1.2
"""Part of the pixels, and noise of a path over its pixel: where less of them is lit, paths do not know enough to be
compared, and where they have less noise, they do well."""
LINES = 1 << 19
"""Random lines by which areas are measured."""


class TableBuilder:
    """Divides the surfaces of one scene into regions and fills their tables, step by step."""

    def __init__(self, scene: mi.Scene, camera: Camera, settings: ContextSettings) -> None:
        self.scene, self.camera, self.settings = scene, camera, settings
        self._paths = settings.paths or USUAL_PATHS
        self._materials = Materials(scene)
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
    def _starved(self) -> bool:
        """Whether most regions hardly know where their light comes from."""
        sources = [self._made.sources[name] for name in ("radiance", "photons") if name in self._made.sources]
        return not sources or float(np.median(np.sum([source.evidence for source in sources], axis=0))) < FED

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

    @property
    def finds_noise(self) -> bool:
        """Whether paths have found light in most pixels, and in most of these more noise than light."""
        return self._made.pilot.lit() > MOST and self._made.pilot.noise() > NOISY

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
    def doublings_left(self) -> float:
        """How many times the number of paths will double, if all are traced."""
        return max(0.0, math.log2(self._paths / max(self._made.paths, 1)))

    @property
    def particles(self) -> int:
        """Particles that regions were made from."""
        return self._made.particles

    def step(self, lights: StartDensity) -> None:
        """Take the next step, light paths starting by ``lights``."""
        self._rays = lights.emission.rays
        if self._made.known is not None:
            self._fill(lights, self._made.done)
        elif self._made.done == 0:
            self._gather(lights)
        elif self._made.clustering and self._made.done <= CLUSTER_STEPS:
            for _ in range(CLUSTER_BATCH):
                self._made.clustering.step()
        else:
            self._fill(lights, self._made.done - 1 - CLUSTER_STEPS)
            if self._converged:
                self.stop()
                return
        self._made.done += 1

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
        """Of the sources of these names, until the next step; scouts and the step after them ask for the same."""
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

    def _gather(self, lights: StartDensity) -> None:
        places = gather(self.scene, self.camera, self.settings, lights)
        self._made.particles, self._made.density = len(places.position), places.density
        self._made.clustering = Clustering(places.position, places.normal, self.settings.regions, self.settings.seed)

    # -- Filling ---------------------------------------------------------------------------------

    def _fill(self, lights: StartDensity, number: int) -> None:
        """One more step of paths, guided by what the ones before have found."""
        regions = self.regions
        count, grid = regions.count, (self.settings.rows, self.settings.columns)
        finder = RegionLookup(regions)
        key = (self.settings.seed, STREAM, FILLING, number)
        if self._made.areas is None:
            key_areas = (self.settings.seed, STREAM, AREAS)
            areas = region_areas(lights.emission.rays, finder, count, LINES, key_areas, facing=regions.normals)
            # What no line has crossed is small, and not nothing.
            self._made.areas = np.maximum(areas, areas[areas > 0.0].min(initial=1e30))
        known = self._made.known
        walks = known is not None or self.settings.particles == "walks"
        names = SOURCES[2:] if known is not None else SOURCES if walks else SOURCES[1:]
        for name in names:
            self._made.sources.setdefault(name, DirectionalAccumulator(count, *grid))
        paths = self.filling[number]
        if walks and not known and number == 0:
            places = Places(finder, self._made.areas, self._neighbours(REGIONS_PER_AIM), grid)
            found = mirrored(self.scene, places, caustics(self.scene, self.settings, lights, AIMED_FOR_TABLES))
            if found:
                self._made.aims, self._made.sources[CAUSTICS] = found
        if walks:
            self._walk(lights, finder, self._made.areas, paths, number, key)
        else:
            collect(self.scene, self.camera, self.settings, lights, finder, self._made, paths, key)
        self._made.paths += paths
        self._ready.clear()

    def _walk(
        self,
        lights: StartDensity,
        finder: RegionLookup,
        areas: Doubles,
        paths: int,
        number: int,
        key: tuple[int, ...],
    ) -> None:
        if self._made.known:
            self._made.known = with_pieces(self._made.known, lights)
        pilot, size, known = self._made.pilot, self.camera.size, self._made.known
        importance, places, light = self._made.sources["importance"], known or self._made, None
        # The kernels of the steps that follow: first with tables that know nothing, then with roulette by albedo.
        nothing = even_tables(finder.count, self.settings.rows, self.settings.columns)
        tables = known.radiance if known else self._finished("radiance", "photons") if number else nothing
        aims = AimedDirections(places.aims, tables.irradiance) if places.aims else None
        share = TRAINING_SHARE if number or known else NOT_YET
        eye = Guide(DirectionalField(finder, tables), share, towards(aims, places.slits, "eye"))
        if not known:
            # Light paths that know where the sensor is bring photons from what eye paths cannot find.
            where, share = (self._finished("importance"), TRAINING_SHARE) if number > 1 else (nothing, NOT_YET)
            light = Guide(DirectionalField(finder, where), share, towards(None, self._made.slits, "light"))
        enough = NEVER if number < BY_ALBEDO else ENOUGH
        if number == 0:  # What importance is worth is not known before there is a pilot.
            importance = DirectionalAccumulator(finder.count, self.settings.rows, self.settings.columns)
        bdpt = Bdpt(
            self.scene,
            self.camera,
            lights,
            max_depth=self.settings.max_depth,
            roulette=RouletteRule("context", 5),
            strategies=strategies.path(),
            directions=GuidedDirections(self._materials, finder, eye, light, enough=enough),
            worth=PixelWorth(pilot.image(), TRAINING_NOISE, size),
        )
        pilot.begin_step()
        hungry = self._starved
        recorder, regions = WalkRecorder(bdpt, finder), finder.count
        grid = (self.settings.rows, self.settings.columns)
        direct = on_device(mi.Float, self._made.lights)
        if not dr.width(direct):
            direct = dr.zeros(mi.Float, max(1, finder.count * pieces(lights)))
        if pieces(lights):
            self._made.sources.setdefault(DEPARTURES, DirectionalAccumulator(pieces(lights), *grid))
        leaving = self._made.sources.get(DEPARTURES)
        seen = self._made.sources.get("radiance") or DirectionalAccumulator(finder.count, *grid)
        photons = self._made.sources.get("photons")
        # From the first step of each kernel on, so that there is one only.
        now = number == SLITS_AT and not known
        of_eye = thinned(importance.evidence, now=now)
        of_light = thinned(photons.evidence, now=now) if photons else None
        if not known:
            self._made.moments = seen.moments()
        colours = on_device(mi.Float, self._made.colours if self._made.colours.size else np.zeros((regions, 3)))
        trial = ShareTrial(regions, TRAINING_SHARE) if not known else None
        # Two passes at least, each a batch, so that noise is known.
        passes = max(2, -(-paths * self.settings.max_depth // RECORDS))
        here = -(-paths // passes)
        lanes = min(here, LANES[dr.backend_v(mi.Float)])
        for part in range(passes):
            stream = Stream.of(lanes, *key, part, 0)
            place = Stream.of(here, *key, part, 2).next_2d()
            found = recorder.eye_paths(
                place * mi.Point2f(size), stream, seen, importance, direct, leaving, trial, of_eye
            )
            pilot.enter(place, found)
            seen.close_batch()
            if leaving:
                leaving.close_batch(1.0)
            importance.close_batch(here * areas)
            if photons is None:
                continue
            lit = here if hungry else max(1, here // LIGHT_PART)
            recorder.light_paths(lit, Stream.of(min(lit, lanes), *key, part, 1), photons, colours, of_light)
            photons.close_batch(lit * areas)
        if now and photons and of_light:
            cell = 4.0 * np.pi / (grid[0] * grid[1])
            lenders, flux = self._groups(), photons.moments()[1]
            bright = np.bincount(lenders, flux)[lenders] / np.bincount(lenders, areas)[lenders]
            finding = (finder, lenders, bright, cell, self.settings.seed)
            self._made.slits = slits(self.scene, of_light, of_eye, *finding)
        if not known:
            self._made.colours = np.array(colours, np.float64).reshape(regions, 3)
        if trial and number:
            self._made.chances = np.array(trial.sums, np.float64).reshape(regions, -1)
        if pieces(lights) and not known:
            self._made.lights = np.array(direct, np.float64).reshape(finder.count, -1)


def _normalised(sums: Doubles) -> Doubles:
    """Of each row's total; zeros where that is none."""
    total = sums.sum(axis=1, keepdims=True)
    found: Doubles = np.divide(sums, total, out=np.zeros_like(sums), where=total > 0.0)
    return found
