"""What photons of caustics make of the context: points to aim at, and peaks of tables where those are of no use.

Neither eye paths nor other light paths meet what mirrors and glass bring often enough to learn it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.context.aims import Aims, Photons, fit
from elps_core.context.directional import DirectionalAccumulator
from elps_core.context.lookup import RegionLookup
from elps_core.particles.records import Particles
from elps_core.sampling.aims import AimedDirections


@dataclass(frozen=True)
class Places:
    """Regions, and what is to be known of them here."""

    lookup: RegionLookup
    areas: NDArray[np.float64]
    """[K]"""
    neighbours: NDArray[np.uint32]
    """[K]: groups that see mirrored lamps at the same points."""
    grid: tuple[int, int]
    """Rows and columns of their tables."""


def mirrored(
    scene: mi.Scene, places: Places, batches: Iterable[Particles]
) -> tuple[Aims, DirectionalAccumulator] | None:
    """Points, and sums for tables, from photons of :class:`elps_core.particles.caustics.CausticSampler`; None of none.

    In the sums a photon counts the less, the more likely points lead to where it came from.
    """
    photons = _seen_by_regions(scene, places.lookup, batches)
    if not len(photons.weight):
        return None
    cell = 4.0 * np.pi / (places.grid[0] * places.grid[1])
    aims = fit(photons, places.areas, places.neighbours, cell)
    # Under a ball of glass lamps are seen at no one point, and so near that cells are fine enough.
    peaks = DirectionalAccumulator(places.lookup.count, *places.grid)
    towards = AimedDirections(aims, aims.roots.sum(axis=1))
    where, line = (on_device(mi.Float, part) for part in (photons.position, photons.direction))
    number = dr.arange(mi.UInt32, len(photons.weight))
    region, direction = on_device(mi.UInt32, photons.region), dr.gather(mi.Vector3f, line, number)
    aimed = towards.mixed(mi.Float(0.0), dr.gather(mi.Point3f, where, number), region, direction, mi.Bool(True))
    peaks.add(region, direction, on_device(mi.Float, photons.weight) / (1.0 + aimed * cell))
    peaks.close_batch(places.areas)
    return aims, peaks


def _seen_by_regions(scene: mi.Scene, lookup: RegionLookup, batches: Iterable[Particles]) -> Photons:
    """Photons on the host, by region, with the way back to the mirror or the glass."""
    nothing = np.zeros((0, 3))
    found = [(nothing, nothing, nothing[:, 0], nothing[:, 0], np.zeros(0, np.int64))]
    for photons in batches:
        if not len(photons):
            continue
        region, ray = lookup.back(photons)
        distance = scene.ray_intersect_preliminary(ray).t
        distance = dr.select(dr.isfinite(distance), distance, 0.0)
        place, line = (np.array(part, np.float64).T for part in (photons.position, photons.direction))
        far, weight = (np.array(part, np.float64) for part in (distance, photons.weight))
        found.append((place, line, far, weight, np.array(region, np.int64)))
    return Photons(*(np.concatenate(part) for part in zip(*found, strict=True)))
