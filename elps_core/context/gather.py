"""Where paths meet surfaces: the particles that regions are made from [thesis 5.2.2]."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.context.saved import DENSITY_SIDE
from elps_core.errors import NothingScatters
from elps_core.particles.bidirectional import BidirectionalSampler
from elps_core.particles.caustics import CausticSampler
from elps_core.particles.classical import ClassicalSampler
from elps_core.particles.metropolis import MetropolisSampler
from elps_core.particles.records import (
    IMPORTON,
    PHOTON,
    ParticleArrays,
    Particles,
    ParticleSampler,
    Worth,
    everywhere,
)
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
HEAVIEST = 4.0
"""Weight of a particle, over the middle one's, above which it is no likelier to be a place of a region."""
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
    """Particles of both kinds by the sampler that the settings name, as many of one as of the other.

    Raises:
        SceneRejected: no path meets a surface that scatters.
    """
    wanted = wanted_of_each(settings)
    found: dict[int, list[ParticleArrays]] = {PHOTON: [], IMPORTON: []}
    for run in range(64):  # Bounded: a scene may have no surface that scatters
        counts = [sum(len(part.weight) for part in parts) for parts in found.values()]
        if min(counts) >= wanted or (run > 1 and not any(counts)):
            break
        key = (settings.seed, STREAM, PARTICLES, run)
        for particles in sampler(scene, camera, settings, lights, wanted, first_hits=True).run(key):
            for kind, parts in found.items():
                parts.append(particles.of(kind).arrays())
    return places(scene, settings, found, [], by_weight=False)


def wanted_of_each(settings: ContextSettings) -> int:
    """Particles of each kind that regions are made from, those of caustics apart."""
    return min(MOST_PARTICLES, max(PER_REGION * settings.regions, 1 << 14)) // 2


def places(
    scene: mi.Scene,
    settings: ContextSettings,
    found: Mapping[int, Sequence[ParticleArrays]],
    aimed: Iterable[Particles],
    *,
    by_weight: bool,
) -> Gathered:
    """Places of the particles ``found`` of each kind, and of photons that were ``aimed`` at mirrors and glass.

    With ``by_weight`` a particle is the likelier to be one of them, the more it carries: walks keep theirs at every
    vertex, whatever the materials have absorbed.

    Raises:
        SceneRejected: there is not one particle.
    """
    wanted = wanted_of_each(settings)
    rng = np.random.default_rng([settings.seed, STREAM])
    density = np.zeros((2, DENSITY_SIDE, DENSITY_SIDE), np.float32)
    chosen = []
    for kind, parts in found.items():
        if some := [part for part in parts if len(part.weight)]:
            position, normal = _some(some, wanted, rng, by_weight=by_weight)
            density[kind] = _from_above(scene, position)
            chosen.append((position, normal))
    if not chosen:
        raise NothingScatters("no path meets a surface that scatters: render without context")
    if caustic := [photons.arrays() for photons in aimed if len(photons)]:
        most = int(CAUSTIC_PART * sum(len(position) for position, _ in chosen))
        chosen.append(_some(caustic, most, rng, by_weight=False))
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


def _some(
    parts: Sequence[ParticleArrays], count: int, rng: np.random.Generator, *, by_weight: bool
) -> tuple[Floats, Floats]:
    """Up to ``count`` of all positions, with their normals to the side from which particles come."""
    position, normal, direction = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("position", "normal", "direction")
    )
    # Particles come in the order in which threads were done: an order of their own, the same in each run.
    factors = rng.integers(1 << 63, size=3, dtype=np.uint64) | np.uint64(1)
    order = position.view(np.uint32).astype(np.uint64) @ factors
    if by_weight:
        # Of exponential variates with the weights as rates the smallest are drawn in proportion to the weights.
        weight = np.concatenate([part.weight for part in parts]).astype(np.float64)
        even = (order >> np.uint64(11)).astype(np.float64) * 2.0**-53
        keep = np.argsort(-np.log1p(-even) / np.minimum(weight, HEAVIEST * np.median(weight)), kind="stable")[:count]
    else:
        keep = np.argsort(order)[:count]
    position, normal, direction = position[keep], normal[keep], direction[keep]
    behind = (normal * direction).sum(axis=1, keepdims=True) < 0.0
    return position, np.where(behind, -normal, normal)


def _from_above(scene: mi.Scene, position: Floats) -> Floats:
    """Shares of particles by place, seen from above: rows go with z, columns with x."""
    box = scene.bbox()
    low, high = (np.array([float(x) for x in corner]) for corner in (box.min, box.max))
    across = max(high[0] - low[0], high[2] - low[2])
    cell = np.clip((position[:, [2, 0]] - low[[2, 0]]) * (DENSITY_SIDE / across), 0, DENSITY_SIDE - 1).astype(int)
    counts = np.bincount(cell[:, 0] * DENSITY_SIDE + cell[:, 1], minlength=DENSITY_SIDE**2)
    return (counts.reshape(DENSITY_SIDE, DENSITY_SIDE) / len(position)).astype(np.float32)
