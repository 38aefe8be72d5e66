"""What the tests of particles share: how a sampler is made, and how its sums are compared."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import stats

Array = np.ndarray[Any, Any]
Measure = Callable[[Any], Array]
"""From the ``ParticleArrays`` of a batch to sums over them."""

LEVEL = 1e-3
"""Chance of a false alarm of a whole comparison."""
POWER = 0.95
"""Chance of finding a bias of the size that is called detectable."""

SAMPLERS = ("classical", "bidirectional", "metropolis")


def sampler(kind: str, scene: Any, *, max_depth: int, effort: float = 1.0, **options: Any) -> Any:
    """A sampler for the first sensor of ``scene``; ``effort`` scales its number of paths."""
    from elps_core.particles.bidirectional import BidirectionalSampler
    from elps_core.particles.classical import ClassicalSampler
    from elps_core.particles.metropolis import MetropolisSampler
    from elps_core.sampling.start import StartDensity
    from elps_core.scene.emission import Emission
    from elps_core.scene.sensors import Camera
    from tests.rendering import uneven_table

    emission = Emission(scene)
    where = (scene, Camera(scene.sensors()[0]), StartDensity(emission, uneven_table(emission)))
    options = {"max_depth": max_depth, "first_hits": True, **options}
    if kind == "classical":
        return ClassicalSampler(*where, paths=int(effort * 2**16), **options)
    if kind == "bidirectional":
        return BidirectionalSampler(*where, paths=int(effort * 2**17), **options)
    chains = {"chains": int(effort * 2**14), "iterations": 3, "bootstrap": int(effort * 2**15)}
    return MetropolisSampler(*where, **{**chains, **options})


def totals(sampler: Any, measure: Measure, *, runs: int) -> Array:
    """``measure`` summed over all batches of each of ``runs`` independent runs, [runs, ...]."""
    return np.array([sum(measure(batch.arrays()) for batch in sampler.run((run,))) for run in range(runs)])


def check(found: Array, expected: Array, error: Array | float = 0.0, *, bound: float) -> None:
    """The mean of independent sums [runs, n] is ``expected`` [n], known to ``error`` (standard, of the mean).

    Fails, too, where no relative bias of less than ``bound`` would be found in most of the n.
    """
    runs = len(found)
    mean, own = found.mean(axis=0), found.std(axis=0, ddof=1) / np.sqrt(runs)
    spread = np.sqrt(own**2 + np.square(error))
    level = 1.0 - (1.0 - LEVEL) ** (1.0 / mean.size)
    critical = stats.t.isf(level / 2.0, runs - 1)
    deviation = np.abs(mean - expected) / spread
    assert (deviation <= critical).all(), (deviation.round(1), (mean / expected).round(3))
    detectable = (critical + stats.t.isf(1.0 - POWER, runs - 1)) * spread / expected
    assert np.median(detectable) < bound, f"finds no bias below {np.median(detectable):.1%}"
