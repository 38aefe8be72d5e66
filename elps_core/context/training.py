"""One step of training: eye and light paths, guided by the tables so far, and what they leave in the sums."""

from __future__ import annotations

import time
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from elps_core.arrays import on_device
from elps_core.context.directional import DirectionalAccumulator, even_tables
from elps_core.context.encoding import DirectionalTables
from elps_core.context.field import DirectionalField
from elps_core.context.lookup import RegionLookup
from elps_core.context.saved import DEPARTURES, Doubles, TableState
from elps_core.context.shares import ShareTrial
from elps_core.context.store import DirectionalParts
from elps_core.context.walks import Thinned, WalkRecorder
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
from elps_core.scene.sensors import Camera
from elps_core.settings import ContextSettings
from elps_core.timing import KernelClock

TRAINING_SHARE = 0.6
"""Chance of a direction from the tables so far: less than in renders, since they are to change."""
NOT_YET = 1e-6
"""The same of tables that know nothing yet."""
RECORDS = 1 << 20
"""Room for the records of one pass, 25 MB: longer paths have more, so that there are fewer of them. A pass takes a
third of a second; time that runs out ends a step after one."""
BY_ALBEDO = 2
"""Steps of filling with roulette by albedo: by what tables hold so far paths would end that have more to find."""
LIGHT_PART = 4
"""Eye paths for one light path: photons tell what eye paths cannot find. With one for each, the door's context took 2
of 11 seconds more and paths had 3% less variance; a bulb in glass asked for no more either."""
FED = 1000.0
"""Records that the middle one of all regions has to have: until then there is a light path for each eye path."""
TRAINING_NOISE = 2.0
"""Noise of a path, over its pixel, that roulette assumes: less than there is, so that it ends few paths by tables that
still change."""
LEAST_PASSES = 2
"""Passes of a step: each is a batch, so that noise is known."""


@dataclass(frozen=True)
class Tables:
    """What guides the paths of a step; all None: nothing is known yet."""

    radiance: DirectionalTables | None = None
    importance: DirectionalTables | None = None
    """None where light paths go by scattering, or are not traced."""
    known: DirectionalParts | None = None
    """Tables of another camera: there are no light paths then."""


@dataclass(frozen=True)
class Step:
    """Which step is taken, and with what."""

    number: int
    """Of filling, from 0 on; -1 before there are regions."""
    paths: int
    key: tuple[int, ...]
    until: float = float("inf")
    """Time of :func:`time.perf_counter` after which no more passes are begun."""
    kept: tuple[Thinned | None, Thinned | None] = (None, None)
    """Importons and photons that are kept one by one."""
    patience: float = float("inf")
    """Seconds that the first of the two kernels may take to compile."""


class CompilesTooLong(Exception):
    """The first kernel of training took longer to compile than the job can afford to lose."""


class Trainer:
    """Traces the paths that fill the tables of one scene.

    All steps run the same two kernels: what differs between them is data.
    """

    def __init__(self, scene: mi.Scene, camera: Camera, settings: ContextSettings) -> None:
        self.scene, self.camera, self.settings = scene, camera, settings
        self._materials = Materials(scene)

    def train(
        self,
        made: TableState,
        finder: RegionLookup,
        areas: Doubles,
        lights: StartDensity,
        tables: Tables,
        step: Step,
    ) -> int:
        """Enter what the paths of ``step`` find into the sums of ``made``; how many eye paths were traced.

        Regions have ``areas`` [K]. At least two passes are traced, whatever the time.

        Raises:
            CompilesTooLong: so it was; what was found until then is lost.
        """
        settings, known = self.settings, tables.known
        grid, regions = (settings.rows, settings.columns), finder.count
        bdpt = self._paths(made, finder, lights, tables, step)
        begun = step.number >= 0
        importance = made.sources["importance"]
        if not begun:  # What importance is worth is not known before there is a pilot.
            importance = DirectionalAccumulator(regions, *grid)
        made.pilot.begin_step()
        recorder = WalkRecorder(bdpt, finder)
        direct = on_device(mi.Float, made.lights)
        if not dr.width(direct):
            direct = dr.zeros(mi.Float, max(1, regions * pieces(lights)))
        if pieces(lights):
            made.sources.setdefault(DEPARTURES, DirectionalAccumulator(pieces(lights), *grid))
        leaving = made.sources.get(DEPARTURES)
        seen = made.sources.get("radiance") or DirectionalAccumulator(regions, *grid)
        photons = made.sources.get("photons")
        if not known:
            made.moments = seen.moments()
        colours = on_device(mi.Float, made.colours if made.colours.size else np.zeros((regions, 3)))
        trial = ShareTrial(regions, TRAINING_SHARE) if not known else None
        flux = [dr.zeros(mi.Float, lights.rows * lights.columns) for _ in range(2)]
        hungry = not made.fed(FED)
        passes = max(LEAST_PASSES, -(-step.paths * settings.max_depth // RECORDS))
        here = -(-step.paths // passes)
        lanes = min(here, LANES[dr.backend_v(mi.Float)])
        importons_kept, photons_kept = step.kept
        traced = 0
        for part in range(passes):
            if part >= LEAST_PASSES and time.perf_counter() > step.until:
                break
            place = Stream.of(here, *step.key, part, 2).next_2d()
            with KernelClock() as kernels:
                found = recorder.eye_paths(
                    place * mi.Point2f(self.camera.size),
                    Stream.of(lanes, *step.key, part, 0),
                    seen,
                    importance,
                    direct,
                    leaving,
                    trial,
                    importons_kept,
                    flux[part % 2],
                )
                traced += here
                made.pilot.enter(place, found)
                seen.close_batch()
            if kernels.compiling > step.patience:
                raise CompilesTooLong
            if leaving:
                leaving.close_batch(1.0)
            importance.close_batch(here * areas)
            if photons is None:
                continue
            lit = here if hungry else max(1, here // LIGHT_PART)
            stream = Stream.of(min(lit, lanes), *step.key, part, 1)
            recorder.light_paths(lit, stream, photons, colours, photons_kept)
            photons.close_batch(lit * areas)
        batches = np.stack([np.array(half, np.float64).reshape(lights.columns, lights.rows).T for half in flux])
        made.enter_flux(batches, here * np.array([-(-traced // here // 2), traced // here // 2]))
        if not known:
            made.colours = np.array(colours, np.float64).reshape(regions, 3)
        if trial and step.number > 0:
            made.chances = np.array(trial.sums, np.float64).reshape(regions, -1)
        if pieces(lights) and not known:
            made.lights = np.array(direct, np.float64).reshape(regions, -1)
        return traced

    def _paths(self, made: TableState, finder: RegionLookup, lights: StartDensity, tables: Tables, step: Step) -> Bdpt:
        """Path tracing by what is known before the step."""
        known, light = tables.known, None
        nothing = even_tables(finder.count, self.settings.rows, self.settings.columns)
        radiance = known.radiance if known else tables.radiance or nothing
        places = known or made
        aims = AimedDirections(places.aims, radiance.irradiance) if places.aims else None
        share = TRAINING_SHARE if tables.radiance or known else NOT_YET
        eye = Guide(DirectionalField(finder, radiance), share, towards(aims, places.slits, "eye"))
        if not known:
            # Light paths that know where the sensor is bring photons from what eye paths cannot find.
            share = TRAINING_SHARE if tables.importance else NOT_YET
            field = DirectionalField(finder, tables.importance or nothing)
            light = Guide(field, share, towards(None, made.slits, "light"))
        enough = NEVER if step.number < BY_ALBEDO else ENOUGH
        return Bdpt(
            self.scene,
            self.camera,
            lights,
            max_depth=self.settings.max_depth,
            roulette=RouletteRule("context", 5),
            strategies=strategies.path(),
            directions=GuidedDirections(self._materials, finder, eye, light, enough=enough),
            worth=PixelWorth(made.pilot.image(), TRAINING_NOISE, self.camera.size),
        )
