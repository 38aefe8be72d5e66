"""From particles of one step of training to slits that light comes through."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.context.edges import edges
from elps_core.context.lookup import RegionLookup
from elps_core.context.slits import NONE, Lines, Slits, find
from elps_core.context.walks import Thinned
from elps_core.particles.records import ParticleBuffer

KEPT = 64
"""Particles that are kept of a region, about, where a step brings so many."""
ROOM, LEAST_ROOM = 4, 1 << 18
"""Times as many for which there is room, and particles for which there is in any case."""


def thinned(evidence: NDArray[np.float64], *, now: bool) -> Thinned:
    """What keeps some particles of a step that brings as many as all before it have: so many by region [K].

    Where it is not ``now`` it keeps none, by the same kernel.
    """
    chances = np.minimum(1.0, KEPT / np.maximum(evidence, 1.0)) if now else np.zeros_like(evidence)
    return Thinned(
        on_device(mi.Float, chances), ParticleBuffer(max(LEAST_ROOM, ROOM * KEPT * len(evidence)) if now else 1)
    )


def kept_evenly(chance: float, regions: int) -> Thinned:
    """What keeps particles with the same ``chance`` in all ``regions``, by the same kernel again."""
    return Thinned(on_device(mi.Float, np.full(regions, chance)), ParticleBuffer(LEAST_ROOM))


def slits(
    scene: mi.Scene,
    photons: Thinned,
    importons: Thinned,
    lookup: RegionLookup,
    lenders: NDArray[np.uint32],
    irradiance: NDArray[np.float64],
    cell: float,
    seed: int,
) -> Slits | None:
    """Slits that ``photons`` came through from where regions have more ``irradiance`` [K].

    Groups of regions ``lenders`` as of :func:`elps_core.context.slits.find`.
    """
    lit = _lines(scene, photons, lookup, irradiance)
    # What the sensor sees directly has come through no gap that paths need to be led to.
    seen = _lines(scene, importons, lookup, irradiance, first=2)
    return find(lit, seen, lenders, edges(scene), cell, seed)


def _lines(
    scene: mi.Scene, kept: Thinned, lookup: RegionLookup, irradiance: NDArray[np.float64], *, first: int = 1
) -> Lines:
    """What was kept of a depth of ``first`` or more."""
    particles = kept.buffer.take().deeper(first)
    if not len(particles):
        return NONE
    here, ray = lookup.back(particles)
    region = np.array(here, np.int64)
    met = scene.ray_intersect(ray)
    before = lookup(met.p, dr.mulsign(mi.Vector3f(met.sh_frame.n), mi.Frame3f.cos_theta(met.wi)), met.is_valid())
    there = np.where(np.array(met.is_valid()), irradiance[np.array(before)], 0.0)
    rise = there / np.maximum(irradiance[region], 1e-300)
    place, line = (np.array(part, np.float64).T for part in (particles.position, particles.direction))
    # By a grazing angle a particle may be on another side here than where it was kept.
    chances = np.array(kept.chances, np.float64)[region]
    weight = np.array(particles.weight, np.float64) / np.where(chances > 0.0, chances, 1.0)
    return Lines(place, line, weight, region, rise, np.array(particles.depth) == 1)
