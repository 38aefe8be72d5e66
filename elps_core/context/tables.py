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
from elps_core.sampling.context import EYE_SHARE, PixelWorth
from elps_core.sampling.direction import Guide, GuidedDirections
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
LIGHT_PART = 4
"""Eye paths for one light path: photons tell what eye paths cannot find, and little else."""
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
        self._pilot: Doubles = np.zeros((2, *self._shape))  # Sum of luminances, and of paths
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
            view=self._view(self.regions),
            density=self._density,
        )

    def _finished(self, *names: str) -> DirectionalTables:
        regions = self.regions
        if self._parents is None:
            self._parents = groups_of(regions, max(1, regions.count // REGIONS_PER_GROUP), self.settings.seed)
        sources = [self._sources[name] for name in names if name in self._sources]
        return finish(sources, self._parents, regions.normals)

    # -- Checkpoints -----------------------------------------------------------------------------

    def arrays(self) -> Arrays:
        """Everything that the steps so far have made, by name."""
        parts: Arrays = {
            "counts": np.array([self.done, self.paths, self.particles], np.int64),
            "pilot": self._pilot,
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
            pilot, density = arrays["pilot"], arrays["density"]
        except (KeyError, ValueError):
            raise ContextMismatch(UNFIT) from None
        if pilot.shape != self._pilot.shape or density.shape != self._density.shape or not 0 <= done <= self.steps:
            raise ContextMismatch(UNFIT)
        self.done, self.paths, self.particles = done, paths, particles
        self._pilot, self._density = pilot.copy(), density.copy()
        clustering = part("clustering")
        self._clustering = Clustering.from_arrays(clustering) if clustering else None
        self._areas = arrays.get("areas")
        names = {name.partition(".")[0] for name in arrays} & set(SOURCES)
        self._sources = {name: DirectionalAccumulator.from_arrays(part(name)) for name in sorted(names)}

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
            keep = rng.permutation(len(position))[:wanted]
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
            areas = region_areas(self.scene, finder, count, LINES, (self.settings.seed, STREAM, AREAS))
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
        importance, directions, worth = sources["importance"], finder, None
        if number:
            radiance = DirectionalField(finder.lookup, self._finished("radiance", "photons"))
            directions = GuidedDirections(finder.lookup, Guide(radiance, EYE_SHARE), None)
            worth = PixelWorth(self._pilot_image(), size)
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
        recorder = WalkRecorder(bdpt, finder)
        passes = -(-paths // LANES)
        lanes = -(-paths // passes)
        # Two batches at least, so that noise is known.
        for part in range(max(2, passes)):
            here = lanes if passes > 1 else -(-lanes // 2)
            stream = Stream.of(here, *key, part, 0)
            place = stream.next_2d()
            found = recorder.eye_paths(place * mi.Point2f(size), stream, sources["radiance"], importance)
            self._enter_pilot(place, found)
            sources["radiance"].close_batch()
            importance.close_batch(here * areas)
            # Light paths keep to scattering: importance is what they would be guided by.
            lit = max(1, here // LIGHT_PART)
            recorder.light_paths(lit, Stream.of(lit, *key, part, 1), sources["photons"])
            sources["photons"].close_batch(lit * areas)

    def _collect(
        self, lights: StartDensity, finder: GuidedDirections, areas: Doubles, paths: int, key: tuple[int, ...]
    ) -> None:
        """Particles of both kinds; each half of a step is a batch."""
        for part in range(2):
            for particles in self._sampler(lights, max(1024, paths // 2), first_hits=False).run((*key, part)):
                for kind, name in ((PHOTON, "photons"), (IMPORTON, "importance")):
                    _enter(particles.of(kind), finder, self._sources[name])
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
        sums, counts = (dr.zeros(mi.Float, width * height) for _ in range(2))
        dr.scatter_reduce(dr.ReduceOp.Add, sums, found, index, dr.isfinite(found))
        dr.scatter_reduce(dr.ReduceOp.Add, counts, mi.Float(1.0), index)
        dr.eval(sums, counts)
        self._pilot += np.stack([np.array(part, np.float64).reshape(self._shape) for part in (sums, counts)])

    def _pilot_image(self) -> NDArray[np.float32]:
        sums, counts = (_blurred(part) for part in self._pilot)
        return np.asarray(sums / np.maximum(counts, 1e-9), np.float32)

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


def _enter(particles: Particles, finder: GuidedDirections, table: DirectionalAccumulator) -> None:
    if not len(particles):
        return
    side = dr.mulsign(mi.Vector3f(particles.normal), dr.dot(particles.normal, particles.direction))
    table.add(finder.lookup(particles.position, side), particles.direction, particles.weight)
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
