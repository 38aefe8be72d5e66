"""From photons of one step of training to slits that regions are lit through."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.context.lookup import RegionLookup
from elps_core.context.slits import Lines, Slits, find
from elps_core.context.walks import Thinned
from elps_core.particles.records import ParticleBuffer, Particles

KEPT = 16
"""Photons that are kept of a region, about: a quarter of a step's, where it brings so many."""
ROOM = 1 << 18
"""Photons that are kept, at most."""


def thinned(evidence: NDArray[np.float64], *, now: bool) -> Thinned:
    """What keeps some photons of a step that brings as many as all before it have: so many by region [K].

    Where it is not ``now`` it keeps none, by the same kernel.
    """
    chances = np.minimum(1.0, KEPT / np.maximum(evidence, 1.0)) if now else np.zeros_like(evidence)
    return Thinned(on_device(mi.Float, chances), ParticleBuffer(ROOM if now else 1))


def slits(
    kept: Thinned,
    lookup: RegionLookup,
    neighbourhoods: NDArray[np.uint32],
    lenders: NDArray[np.uint32],
    cell: float,
    seed: int,
) -> Slits | None:
    """Slits that the photons came through; groups of regions as of :func:`elps_core.context.slits.find`."""
    photons = kept.buffer.take()
    return find(_lines(photons, lookup, kept.chances), neighbourhoods, lenders, cell, seed) if len(photons) else None


def _lines(photons: Particles, lookup: RegionLookup, chances: mi.Float) -> Lines:
    side = mi.Vector3f(photons.normal) * dr.sign(dr.dot(photons.normal, photons.direction))
    region = lookup(photons.position, side)
    weight = photons.weight / dr.maximum(dr.gather(mi.Float, chances, region), 1e-9)
    place, line = (np.array(part, np.float64).T for part in (photons.position, photons.direction))
    return Lines(place, line, np.array(weight, np.float64), np.array(region, np.int64))
