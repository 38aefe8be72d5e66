"""Contexts that are wrong in every way: they may cost samples, and must not move an image."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from elps_core.context.aims import POINTS, Aims
from elps_core.context.encoding import DirectionalTables
from elps_core.context.slits import LARGEST_CHANCE, MOST, Slits
from elps_core.context.store import DirectionalParts

Array = np.ndarray[Any, Any]
Kind = Literal["random", "spiked", "empty", "foreign"]
KINDS: tuple[Kind, ...] = ("random", "spiked", "empty", "foreign")
REGIONS, GRID, PIXELS = 24, (8, 16), (6, 8)


def parts(scene: Any, kind: Kind) -> DirectionalParts:
    """Regions strewn over the scene's box (``foreign``: far beside it) with tables that know nothing of it."""
    from elps_core.context.clustering import build_regions
    from elps_core.sampling.lights import pieces
    from elps_core.sampling.start import StartDensity
    from elps_core.scene.emission import Emission
    from tests.rendering import uneven_table

    rng = np.random.default_rng(KINDS.index(kind))
    box = scene.bbox()
    low, high = (np.array([float(x) for x in corner]) for corner in (box.min, box.max))
    low, high = (np.clip(corner, -10.0, 10.0) for corner in (low, high))
    position = low + rng.random((8 * REGIONS, 3)) * (high - low) + (100.0 if kind == "foreign" else 0.0)
    normal = rng.normal(size=position.shape)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    regions = build_regions(position, normal, REGIONS, seed=1)
    count = regions.count

    def tables(count: int = count) -> DirectionalTables:
        values = rng.random((count, *GRID)) ** 4
        if kind == "spiked":
            values = np.zeros((count, *GRID))
            values[np.arange(count), rng.integers(GRID[0], size=count), rng.integers(GRID[1], size=count)] = 1.0
        elif kind == "empty":
            values[: count // 2] = 0.0
        evidence = np.where(rng.random(count) < 0.3, 0, 1000)
        return DirectionalTables.of(values, rng.random(count) ** 2, evidence).encoded("log8")

    emission = Emission(scene)
    lights = rng.random((count, pieces(StartDensity(emission, uneven_table(emission))))) ** 3
    pilot = (rng.random(PIXELS) ** 2).astype(np.float32)
    leaving = tables(lights.shape[1]) if lights.shape[1] else None
    prospects = rng.random((count, 4)) ** 2 * np.array([1.0, 2.0, 0.5, 3.0])
    return DirectionalParts(
        regions,
        tables(),
        tables(),
        pilot,
        0.8,
        lights.astype(np.float32),
        np.zeros(PIXELS, np.uint16),
        np.zeros((2, 4, 4), np.float32),
        prospects.astype(np.float32),
        rng.uniform(0.05, 0.95, count).astype(np.float32),
        leaving,
        _aims(rng, low, high, count),
        _slits(rng, low, high, count),
    )


def _aims(rng: np.random.Generator, low: Array, high: Array, count: int) -> Aims:
    """Points anywhere in a box."""
    place = low + rng.random((count, POINTS, 3)) * (high - low)
    spread = (rng.uniform(0.02, 0.3, (count, POINTS, 1)) * np.linalg.norm(high - low)) ** 2
    roots = 0.2 * rng.random((count, POINTS)) ** 2
    return Aims(np.concatenate([place, spread], axis=-1).astype(np.float32), roots.astype(np.float32))


def _slits(rng: np.random.Generator, low: Array, high: Array, count: int) -> Slits:
    """Slits anywhere in a box."""
    ends = low + rng.random((MOST, 2, 3)) * (high - low)
    spread = 10.0 ** rng.uniform(-3.0, -0.5, MOST) * np.linalg.norm(high - low)
    chances = LARGEST_CHANCE / MOST * rng.random((2, count, MOST)) ** 2
    return Slits(ends.astype(np.float32), spread.astype(np.float32), chances.astype(np.float32))
