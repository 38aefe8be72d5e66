"""From particles and walks to regions and their tables: the directional part of a context [thesis 5.2.3, 5.2.4]."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.context.areas import region_areas
from elps_core.context.clustering import Clustering, groups_of
from elps_core.context.directional import DirectionalAccumulator, finish
from elps_core.context.encoding import DirectionalTables
from elps_core.context.field import DirectionalField
from elps_core.context.lookup import RegionLookup
from elps_core.context.regions import Regions
from elps_core.context.store import DirectionalParts
from elps_core.context.walks import WalkRecorder
from elps_core.errors import ContextMismatch, SceneRejected
from elps_core.integrators.bdpt import Bdpt
from elps_core.particles.bidirectional import BidirectionalSampler
from elps_core.particles.classical import ClassicalSampler
from elps_core.particles.metropolis import MetropolisSampler
from elps_core.particles.records import IMPORTON, PHOTON, Particles, ParticleSampler
from elps_core.paths import strategies
from elps_core.paths.roulette import RouletteRule
from elps_core.paths.stream import Stream
from elps_core.sampling.context import EYE_SHARE, LIGHT_SHARE, PixelWorth
from elps_core.sampling.direction import Guide, GuidedDirections
from elps_core.sampling.lights import pieces
from elps_core.sampling.start import StartDensity
from elps_core.scene.sensors import Camera
from elps_core.scene.spectrum import luminance
from elps_core.settings import ContextSettings

Doubles = NDArray[np.float64]
Arrays = dict[str, NDArray[Any]]

PER_REGION = 64
"""Particles of a region, from which its place follows."""
MOST_PARTICLES = 1 << 20
"""Particles that regions are made from, at most."""
CLUSTER_STEPS, CLUSTER_BATCH = 4, 3
"""Steps of a build for the clustering, and its own steps in each: 12 are enough for it."""
REGIONS_PER_GROUP = 16
"""Regions that lend each other what they know."""
FIRST_PATHS, MOST_PATHS = 1 << 15, 1 << 20
"""Paths of the first step of filling; each next one has twice as many, up to the most."""
LANES = 1 << 17
"""Paths side by side."""
UNROULETTED = 2
"""Steps of filling without roulette: what tables hold so far would end paths that have more to find."""
LENT = 0.1
"""Share of a region's table of lights that is its group's: what was not met there may be near."""
LIGHT_PART = 1
"""Eye paths for one light path: photons tell what eye paths cannot find."""
MOST_CHAINS, MUTATIONS = 32768, 16
"""Metropolis chains side by side, and their mutations where there are fewer."""
PILOT_PATHS = 1 << 19
"""Paths of the pilot image where particles fill the tables."""
LINES = 1 << 19
"""Random lines by which areas are measured."""
PILOT_SIDE = 96
"""Longer side of the pilot image in pixels."""
DENSITY_SIDE = 128
"""Side of the pictures of particles from above, in cells."""
NO_REGION = np.iinfo(np.uint16).max
"""What the view holds where no surface is seen."""
SOURCES = ("radiance", "photons", "importance")
"""Sums of what eye paths find, of what light paths bring, and of what eye paths bring."""
UNFIT = "the saved state of the context does not fit: measure it again"
STREAM = 0xD1AE
"""Sets the random numbers of the tables apart from those of renders with the same seed."""
PARTICLES, CLUSTERS, AREAS, FILLING = range(4)
"""Next part of their keys: what they are for."""


class TableBuilder:
    """Divides the surfaces of one scene into regions and fills their tables, step by step."""

    def __init__(self, scene: mi.Scene, camera: Camera, settings: ContextSettings) -> None:
        self.scene, self.camera, self.settings = scene, camera, settings
        self.filling = list(_filling(settings.paths))
        """Paths of each step that fills the tables."""
        self.steps = 1 + CLUSTER_STEPS + len(self.filling)
        self.done = 0
        self.paths = 0
        """Paths traced for the tables."""
        self.particles = 0
        """Particles that regions were made from."""
        width, height = (int(side) for side in camera.size)
        scale = PILOT_SIDE / max(width, height)
        self._shape = (max(1, round(height * scale)), max(1, round(width * scale)))
        self._clustering: Clustering | None = None
        self._areas: Doubles | None = None
        self._parents: NDArray[np.uint32] | None = None
        self._sources: dict[str, DirectionalAccumulator] = {}
        self._lights: Doubles = np.zeros((0, 0))  # What light sampling found, by region and piece of the lights
        self._pilot: Doubles = np.zeros((2, *self._shape))  # Sum of luminances, and of paths
        self._newest: Doubles = np.zeros((3, *self._shape))  # The same of the last step, and sum of squares
        self._density = np.zeros((2, DENSITY_SIDE, DENSITY_SIDE), np.float32)

    def step(self, lights: StartDensity) -> None:
        """Take the next step, light paths starting by ``lights``."""
        if self.done == 0:
            self._gather(lights)
        elif self._clustering and self.done <= CLUSTER_STEPS:
            for _ in range(CLUSTER_BATCH):
                self._clustering.step()
        else:
            self._fill(lights, self.done - 1 - CLUSTER_STEPS)
            if self.relative_error() <= self.settings.tolerance:
                self.done = self.steps - 1
        self.done += 1

    @property
    def regions(self) -> Regions:
        """The regions, once they are found."""
        if self._clustering is None:
            raise RuntimeError("there are no regions yet: take the steps that are left")
        return self._clustering.result()

    def relative_error(self) -> float:
        """Of the sums that guide eye paths; infinite before there are any."""
        errors = [self._sources[name].relative_error() for name in ("radiance", "photons") if name in self._sources]
        return min(errors, default=float("inf"))

    def result(self) -> DirectionalParts:
        """Tables fit to be sampled."""
        encoding = self.settings.encoding
        return DirectionalParts(
            regions=self.regions,
            radiance=self._finished("radiance", "photons").encoded(encoding),
            importance=self._finished("importance").encoded(encoding),
            pilot=self._pilot_image(),
            noise=self._noise(),
            lights=self._light_tables(),
            view=self._view(self.regions),
            density=self._density,
        )

    def _light_tables(self) -> NDArray[np.float32]:
        """Shares of the lights' pieces in each region [K, pieces], drawn a little towards those of its group."""
        if not self._lights.size:
            return np.zeros((self.regions.count, 0), np.float32)
        own = self._lights / np.maximum(self._lights.sum(axis=1, keepdims=True), 1e-30)
        parents = self._groups()
        group = np.zeros((int(parents.max()) + 1, own.shape[1]))
        np.add.at(group, parents, own)
        lent = group[parents] / np.maximum(group[parents].sum(axis=1, keepdims=True), 1e-30)
        return np.asarray((1.0 - LENT) * own + LENT * lent, np.float32)

    def _groups(self) -> NDArray[np.uint32]:
        if self._parents is None:
            regions = self.regions
            self._parents = groups_of(regions, max(1, regions.count // REGIONS_PER_GROUP), self.settings.seed)
        return self._parents

    def _finished(self, *names: str) -> DirectionalTables:
        sources = [self._sources[name] for name in names if name in self._sources]
        return finish(sources, self._groups(), self.regions.normals)

    # -- Checkpoints -----------------------------------------------------------------------------

    def arrays(self) -> Arrays:
        """Everything that the steps so far have made, by name."""
        parts: Arrays = {
            "counts": np.array([self.done, self.paths, self.particles], np.int64),
            "pilot": self._pilot,
            "newest": self._newest,
            "lights": self._lights,
            "density": self._density,
        }
        if self._clustering is not None:
            parts |= {f"clustering.{name}": array for name, array in self._clustering.arrays().items()}
        if self._areas is not None:
            parts["areas"] = self._areas
        for name, source in self._sources.items():
            parts |= {f"{name}.{key}": array for key, array in source.arrays().items()}
        return parts

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take up what :meth:`arrays` gave.

        Raises:
            ContextMismatch: it is incomplete, or belongs to other settings.
        """

        def part(prefix: str) -> Arrays:
            return {name.partition(".")[2]: array for name, array in arrays.items() if name.startswith(f"{prefix}.")}

        try:
            done, paths, particles = (int(n) for n in arrays["counts"])
            pilot, newest, density, lights = (arrays[name] for name in ("pilot", "newest", "density", "lights"))
        except (KeyError, ValueError):
            raise ContextMismatch(UNFIT) from None
        saved = part("clustering")
        clustering = Clustering.from_arrays(saved) if saved else None
        areas = arrays.get("areas")
        names = {name.partition(".")[0] for name in arrays} & set(SOURCES)
        sources = {name: DirectionalAccumulator.from_arrays(part(name)) for name in sorted(names)}
        found = clustering is not None and clustering.finished
        count = clustering.result().count if clustering and found else 0
        numbers = [pilot, newest, density, lights, *([] if areas is None else [areas])]
        if (
            not 0 <= done <= self.steps
            or (done > 0) != (clustering is not None)
            or (done > CLUSTER_STEPS and not found)
            or (pilot.shape, density.shape) != (self._pilot.shape, self._density.shape)
            or newest.shape != self._newest.shape
            or (bool(sources) or areas is not None) != (done > 1 + CLUSTER_STEPS)
            or (areas is not None and areas.shape != (count,))
            or (lights.size > 0 and (lights.ndim != 2 or len(lights) != count))
            or any((source.regions, source.map.cells) != (count, self._cells) for source in sources.values())
            or not all(part.dtype.kind == "f" and np.isfinite(part).all() for part in numbers)
        ):
            raise ContextMismatch(UNFIT)
        self.done, self.paths, self.particles = done, paths, particles
        self._pilot, self._density, self._lights = pilot.copy(), density.copy(), lights.copy()
        self._newest = newest.copy()
        self._clustering, self._areas, self._sources = clustering, areas, sources

    @property
    def _cells(self) -> int:
        return self.settings.rows * self.settings.columns

    # -- Regions ---------------------------------------------------------------------------------

    def _gather(self, lights: StartDensity) -> None:
        """Particles of both kinds, as many of one as of the other: eye paths meet regions, and light paths do."""
        wanted = min(MOST_PARTICLES, max(PER_REGION * self.settings.regions, 1 << 14)) // 2
        found: dict[int, list[tuple[Any, ...]]] = {PHOTON: [], IMPORTON: []}
        counts = {PHOTON: 0, IMPORTON: 0}
        for run in range(64):  # Bounded: a scene may have no surface that scatters
            if min(counts.values()) >= wanted or (run > 1 and not any(counts.values())):
                break
            key = (self.settings.seed, STREAM, PARTICLES, run)
            for particles in self._sampler(lights, wanted, first_hits=True).run(key):
                for kind in found:
                    position, normal = _turned(particles.of(kind))
                    found[kind].append((position, normal))
                    counts[kind] += len(position)
        if not any(counts.values()):
            raise SceneRejected("no path meets a surface that scatters: render without context")
        rng = np.random.default_rng([self.settings.seed, STREAM])
        chosen = []
        for kind, parts in found.items():
            if not counts[kind]:
                continue
            position, normal = (np.concatenate(part) for part in zip(*parts, strict=True))
            # Particles come in the order in which threads were done.
            keep = np.lexsort(position.T)[rng.permutation(len(position))[:wanted]]
            chosen.append((position[keep], normal[keep]))
            self._density[kind] = self._from_above(position)
        position, normal = (np.concatenate(part) for part in zip(*chosen, strict=True))
        self.particles = len(position)
        self._clustering = Clustering(position, normal, self.settings.regions, self.settings.seed)

    def _sampler(self, lights: StartDensity, paths: int, *, first_hits: bool) -> ParticleSampler:
        common: dict[str, Any] = {"max_depth": self.settings.max_depth, "first_hits": first_hits}
        if self.settings.particles == "bidirectional":
            return BidirectionalSampler(self.scene, self.camera, lights, paths=paths, **common)
        if self.settings.particles == "metropolis":
            chains = min(MOST_CHAINS, max(1024, paths // MUTATIONS))
            return MetropolisSampler(
                self.scene,
                self.camera,
                lights,
                iterations=max(1, paths // chains),
                chains=chains,
                **common,
            )
        return ClassicalSampler(self.scene, self.camera, lights, paths=paths, **common)

    def _from_above(self, position: NDArray[np.float32]) -> NDArray[np.float32]:
        """Shares of particles by place, seen from above: rows go with z, columns with x."""
        box = self.scene.bbox()
        low, high = (np.array([float(x) for x in corner]) for corner in (box.min, box.max))
        across = max(high[0] - low[0], high[2] - low[2])
        cell = np.clip((position[:, [2, 0]] - low[[2, 0]]) * (DENSITY_SIDE / across), 0, DENSITY_SIDE - 1).astype(int)
        counts = np.bincount(cell[:, 0] * DENSITY_SIDE + cell[:, 1], minlength=DENSITY_SIDE**2)
        return (counts.reshape(DENSITY_SIDE, DENSITY_SIDE) / len(position)).astype(np.float32)

    # -- Filling ---------------------------------------------------------------------------------

    def _fill(self, lights: StartDensity, number: int) -> None:
        """One more step of paths, guided by what the ones before have found."""
        regions = self.regions
        count, grid = regions.count, (self.settings.rows, self.settings.columns)
        finder = GuidedDirections(RegionLookup(regions), None, None)
        key = (self.settings.seed, STREAM, FILLING, number)
        if self._areas is None:
            key_areas = (self.settings.seed, STREAM, AREAS)
            areas = region_areas(self.scene, finder, count, LINES, key_areas, facing=regions.normals)
            # What no line has crossed is small, and not nothing.
            self._areas = np.maximum(areas, areas[areas > 0.0].min(initial=1e30))
        for name in SOURCES if self.settings.particles == "walks" else SOURCES[1:]:
            self._sources.setdefault(name, DirectionalAccumulator(count, *grid))
        paths = self.filling[number]
        if self.settings.particles == "walks":
            self._walk(lights, finder, self._areas, paths, number, key)
        else:
            self._collect(lights, finder, self._areas, paths, key)
        self.paths += paths

    def _walk(
        self,
        lights: StartDensity,
        finder: GuidedDirections,
        areas: Doubles,
        paths: int,
        number: int,
        key: tuple[int, ...],
    ) -> None:
        sources, size = self._sources, self.camera.size
        self._newest = np.zeros_like(self._newest)
        importance, directions, worth = sources["importance"], finder, None
        if number:
            radiance = DirectionalField(finder.lookup, self._finished("radiance", "photons"))
            # Light paths that know where the sensor is bring photons from what eye paths cannot find.
            known = number > 1
            light = Guide(DirectionalField(finder.lookup, self._finished("importance")), LIGHT_SHARE) if known else None
            directions = GuidedDirections(finder.lookup, Guide(radiance, EYE_SHARE), light)
            worth = PixelWorth(self._pilot_image(), self._noise(), size)
        else:  # What importance is worth is not known before there is a pilot.
            importance = DirectionalAccumulator(finder.lookup.count, self.settings.rows, self.settings.columns)
        bdpt = Bdpt(
            self.scene,
            self.camera,
            lights,
            max_depth=self.settings.max_depth,
            roulette=RouletteRule("none" if number < UNROULETTED else "context", 5),
            strategies=strategies.path(),
            directions=directions,
            worth=worth,
        )
        self._newest = np.zeros_like(self._newest)
        recorder = WalkRecorder(bdpt, finder)
        direct = mi.Float(self._lights.astype(np.float32).ravel())
        if not dr.width(direct):
            direct = dr.zeros(mi.Float, max(1, finder.lookup.count * pieces(lights)))
        passes = -(-paths // LANES)
        lanes = -(-paths // passes)
        # Two batches at least, so that noise is known.
        for part in range(max(2, passes)):
            here = lanes if passes > 1 else -(-lanes // 2)
            stream = Stream.of(here, *key, part, 0)
            place = stream.next_2d()
            found = recorder.eye_paths(place * mi.Point2f(size), stream, sources["radiance"], importance, direct)
            self._enter_pilot(place, found)
            sources["radiance"].close_batch()
            importance.close_batch(here * areas)
            lit = max(1, here // LIGHT_PART)
            recorder.light_paths(lit, Stream.of(lit, *key, part, 1), sources["photons"])
            sources["photons"].close_batch(lit * areas)
        if pieces(lights):
            self._lights = np.array(direct, np.float64).reshape(finder.lookup.count, -1)

    def _collect(
        self, lights: StartDensity, finder: GuidedDirections, areas: Doubles, paths: int, key: tuple[int, ...]
    ) -> None:
        """Particles of both kinds; each half of a step is a batch."""
        for part in range(2):
            for particles in self._sampler(lights, max(1024, paths // 2), first_hits=False).run((*key, part)):
                for kind, name in ((PHOTON, "photons"), (IMPORTON, "importance")):
                    # Light that comes straight from a lamp is the business of light sampling.
                    _enter(particles.of(kind), finder, self._sources[name], 2 if kind == PHOTON else 1)
            for name in ("photons", "importance"):
                self._sources[name].close_batch(areas)
        if not self._pilot.any():
            bdpt = Bdpt(
                self.scene,
                self.camera,
                lights,
                max_depth=self.settings.max_depth,
                roulette=RouletteRule("albedo", 5),
                strategies=strategies.path(),
            )
            streams = (Stream.of(PILOT_PATHS, *key, 2), Stream.of(1, *key, 3))
            place = streams[0].next_2d()
            radiance, wavelengths = bdpt.trace(place * mi.Point2f(self.camera.size), streams, lambda *_: None)
            self._enter_pilot(place, luminance(mi.UnpolarizedSpectrum(radiance), wavelengths))

    # -- Pilot -----------------------------------------------------------------------------------

    def _enter_pilot(self, place: mi.Point2f, found: mi.Float) -> None:
        """Add paths through ``place`` in [0, 1)^2 of the film that have found that luminance."""
        height, width = self._shape
        pixel = dr.minimum(mi.Point2u(place * mi.Point2f(width, height)), mi.Point2u(width - 1, height - 1))
        index = pixel.y * width + pixel.x
        found = dr.select(dr.isfinite(found), found, 0.0)
        sums = [dr.zeros(mi.Float, width * height) for _ in range(3)]
        for total, value in zip(sums, (found, mi.Float(1.0), dr.square(found)), strict=True):
            dr.scatter_reduce(dr.ReduceOp.Add, total, value, index)
        dr.eval(sums)
        entered = np.stack([np.array(total, np.float64).reshape(self._shape) for total in sums])
        self._pilot += entered[:2]
        self._newest += entered

    def _pilot_image(self) -> NDArray[np.float32]:
        sums, counts = (_blurred(part) for part in self._pilot)
        return np.asarray(sums / np.maximum(counts, 1e-9), np.float32)

    def _noise(self) -> float:
        """Standard deviation of one path of the last step over the value of its pixel, the median of all pixels."""
        mean, _, squares = self._newest / np.maximum(self._newest[1], 1.0)
        lit = mean > 0.0
        ratio = np.maximum(squares[lit] / np.square(mean[lit]) - 1.0, 0.0)
        return float(np.sqrt(np.median(ratio))) if lit.any() else 0.0

    def _view(self, regions: Regions) -> NDArray[np.uint16]:
        """Region that the middle of each pixel of the pilot image shows."""
        height, width = self._shape
        pixel = dr.arange(mi.UInt32, height * width)
        row = pixel // width
        middle = mi.Point2f((mi.Float(pixel - row * width) + 0.5) / width, (mi.Float(row) + 0.5) / height)
        ray = self.camera.sample_ray(middle * mi.Point2f(self.camera.size), mi.Float(0.5), mi.Point2f(0.5)).ray
        si = self.scene.ray_intersect(ray)
        finder = GuidedDirections(RegionLookup(regions), None, None)
        seen = dr.select(si.is_valid(), finder.region(si, si.wi, si.is_valid()), int(NO_REGION))
        return np.array(seen).astype(np.uint16).reshape(height, width)


def _blurred(image: Doubles) -> Doubles:
    """Each pixel with its neighbours, 1 : 2 : 1 along both axes."""
    for axis in (0, 1):
        last = image.shape[axis] - 1
        before, after = (np.clip(np.arange(last + 1) + step, 0, last) for step in (-1, 1))
        image = 0.25 * image.take(before, axis) + 0.5 * image + 0.25 * image.take(after, axis)
    return image


def _turned(particles: Particles) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Positions and normals, these to the side from which particles come."""
    arrays = particles.arrays()
    behind = (arrays.normal * arrays.direction).sum(axis=1, keepdims=True) < 0.0
    return arrays.position, np.where(behind, -arrays.normal, arrays.normal)


def _enter(particles: Particles, finder: GuidedDirections, table: DirectionalAccumulator, first: int) -> None:
    """Add particles of a depth of ``first`` or more."""
    if not len(particles):
        return
    side = dr.mulsign(mi.Vector3f(particles.normal), dr.dot(particles.normal, particles.direction))
    region = finder.lookup(particles.position, side)
    table.add(region, particles.direction, particles.weight, particles.depth >= first)
    dr.eval(table.state)


def _filling(paths: int) -> Iterator[int]:
    """Sizes of the steps that fill tables: each twice the one before, bounded, ``paths`` in all."""
    size = FIRST_PATHS
    while paths > 0:
        step = min(size, paths)
        # What would be left as less than a half belongs to this step.
        step = paths if paths - step < step // 2 else step
        yield step
        paths -= step
        size = min(2 * size, MOST_PATHS)
