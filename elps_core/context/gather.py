"""Where paths meet surfaces: the particles that regions are made from [thesis 5.2.2]."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.context.saved import DENSITY_SIDE
from elps_core.errors import SceneRejected
from elps_core.particles.bidirectional import BidirectionalSampler
from elps_core.particles.caustics import CausticSampler
from elps_core.particles.classical import ClassicalSampler
from elps_core.particles.metropolis import MetropolisSampler
from elps_core.particles.records import IMPORTON, PHOTON, Particles, ParticleSampler, Worth, everywhere
from elps_core.sampling.start import StartDensity
from elps_core.scene.sensors import Camera
from elps_core.settings import ContextSettings

PER_REGION = 32
"""Particles of a region, from which its place follows."""
MOST_PARTICLES = 1 << 20
"""Particles that regions are made from, at most, those of caustics apart."""
CAUSTIC_PATHS = 1 << 19
"""Light paths that are aimed at mirrors and glass, for the regions, and twice as many for their tables: 10000 photons
where one ball is of glass, and its lamp in the next room."""
CAUSTIC_PHOTONS, MORE_PATHS, FEWER_FOR_REGIONS = 1 << 15, 8, 4
"""Photons below which there are more paths; how many times as many at most, in 0.6 s, and for the regions. With the
door to the next room ajar by 3 degrees, 3000 photons taught tables little of what the ball of glass brings to the table
under it, and that was 104 of a second moment of 383 and 225 of 553; with 27000 it was 44 of 359 and 15 of 504. With
eight times as many for the regions it was 0 to 34, but these leave fewer regions to the rest."""
TRIAL, TRIAL_PATHS = 0xFFFF, 1 << 16
"""Keeps the random numbers of the paths that tell how many are needed apart, and how many tell it."""
CAUSTIC_PART = 0.25
"""Photons that they bring, at most, for each other particle that regions are made from. Under a ball of glass every
step shows the lamp in another direction, and small regions know where."""
MOST_CHAINS, MUTATIONS = 32768, 16
"""Metropolis chains side by side, and their mutations where there are fewer."""
STREAM = 0xD1AE
"""Sets the random numbers of the tables apart from those of renders with the same seed."""
PARTICLES, AREAS, FILLING, KNOWING, AIMED_FOR_REGIONS, AIMED_FOR_TABLES = range(6)
"""Next part of their keys: what they are for."""

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Gathered:
    """Places where regions are wanted."""

    position: Floats  # [n, 3]
    normal: Floats  # [n, 3], to the side from which a path came
    density: Floats  # [2, n, n]: photons and importons seen from above, in shares of all


def gather(scene: mi.Scene, camera: Camera, settings: ContextSettings, lights: StartDensity) -> Gathered:
    """Particles of both kinds, as many of one as of the other: eye paths meet regions, and light paths do.

    Raises:
        SceneRejected: no path meets a surface that scatters.
    """
    wanted = min(MOST_PARTICLES, max(PER_REGION * settings.regions, 1 << 14)) // 2
    found: dict[int, list[tuple[Floats, Floats]]] = {PHOTON: [], IMPORTON: []}
    counts = {PHOTON: 0, IMPORTON: 0}
    for run in range(64):  # Bounded: a scene may have no surface that scatters
        if min(counts.values()) >= wanted or (run > 1 and not any(counts.values())):
            break
        key = (settings.seed, STREAM, PARTICLES, run)
        for particles in sampler(scene, camera, settings, lights, wanted, first_hits=True).run(key):
            for kind in found:
                position, normal = _turned(particles.of(kind))
                found[kind].append((position, normal))
                counts[kind] += len(position)
    if not any(counts.values()):
        raise SceneRejected("no path meets a surface that scatters: render without context")
    rng = np.random.default_rng([settings.seed, STREAM])
    density = np.zeros((2, DENSITY_SIDE, DENSITY_SIDE), np.float32)
    chosen = []
    for kind, parts in found.items():
        if counts[kind]:
            density[kind] = _from_above(scene, np.concatenate([position for position, _ in parts]))
            chosen.append(_some(parts, wanted, rng))
    if settings.particles == "walks":
        aimed = [_turned(photons) for photons in caustics(scene, settings, lights, AIMED_FOR_REGIONS) if len(photons)]
        if aimed:
            chosen.append(_some(aimed, int(CAUSTIC_PART * sum(len(position) for position, _ in chosen)), rng))
    position, normal = (np.concatenate(part) for part in zip(*chosen, strict=True))
    return Gathered(position, normal, density)


def sampler(
    scene: mi.Scene,
    camera: Camera,
    settings: ContextSettings,
    lights: StartDensity,
    paths: int,
    *,
    first_hits: bool = False,
    worth: Worth = everywhere,
) -> ParticleSampler:
    """What makes the particles that the settings name, by about so many paths of each kind."""
    common: dict[str, Any] = {"max_depth": settings.max_depth, "first_hits": first_hits, "worth": worth}
    if settings.particles == "bidirectional":
        return BidirectionalSampler(scene, camera, lights, paths=paths, **common)
    if settings.particles == "metropolis":
        chains = min(MOST_CHAINS, max(1024, paths // MUTATIONS))
        iterations = max(1, paths // chains)
        return MetropolisSampler(scene, camera, lights, iterations=iterations, chains=chains, **common)
    return ClassicalSampler(scene, camera, lights, paths=paths, **common)


def caustics(scene: mi.Scene, settings: ContextSettings, lights: StartDensity, purpose: int) -> Iterator[Particles]:
    """Batches of photons that mirrors and glass have brought; none in scenes without."""
    key = (settings.seed, STREAM, purpose)
    paths = (2 if purpose == AIMED_FOR_TABLES else 1) * CAUSTIC_PATHS
    trial = CausticSampler(scene, lights, max_depth=settings.max_depth, paths=TRIAL_PATHS)
    found = sum(len(photons) for photons in trial.run((*key, TRIAL)))
    if not found:
        return iter(())
    more = math.ceil(CAUSTIC_PHOTONS * trial.paths / (found * paths))
    paths *= min(max(more, 1), FEWER_FOR_REGIONS if purpose == AIMED_FOR_REGIONS else MORE_PATHS)
    return CausticSampler(scene, lights, max_depth=settings.max_depth, paths=paths).run(key)


def _some(parts: list[tuple[Floats, Floats]], count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Up to ``count`` of all positions, with their normals."""
    position, normal = (np.concatenate(part) for part in zip(*parts, strict=True))
    # Particles come in the order in which threads were done: an order of their own, the same in each run.
    factors = rng.integers(1 << 63, size=3, dtype=np.uint64) | np.uint64(1)
    keep = np.argsort(position.view(np.uint32).astype(np.uint64) @ factors)[:count]
    return position[keep], normal[keep]


def _from_above(scene: mi.Scene, position: Floats) -> Floats:
    """Shares of particles by place, seen from above: rows go with z, columns with x."""
    box = scene.bbox()
    low, high = (np.array([float(x) for x in corner]) for corner in (box.min, box.max))
    across = max(high[0] - low[0], high[2] - low[2])
    cell = np.clip((position[:, [2, 0]] - low[[2, 0]]) * (DENSITY_SIDE / across), 0, DENSITY_SIDE - 1).astype(int)
    counts = np.bincount(cell[:, 0] * DENSITY_SIDE + cell[:, 1], minlength=DENSITY_SIDE**2)
    return (counts.reshape(DENSITY_SIDE, DENSITY_SIDE) / len(position)).astype(np.float32)


def _turned(particles: Particles) -> tuple[Floats, Floats]:
    """Positions and normals, these to the side from which particles come."""
    arrays = particles.arrays()
    behind = (arrays.normal * arrays.direction).sum(axis=1, keepdims=True) < 0.0
    return arrays.position, np.where(behind, -arrays.normal, arrays.normal)
