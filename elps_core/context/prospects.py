"""What eye paths find that go on from a region: what they are paid where roulette ends them, and how far that errs."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]

BORROWED = 256.0
"""Records that the spread of a region's group counts as beside its own: great values are rare, and make the spread."""
NEUTRAL = 1e-3
"""Part of the mean light of all regions that is added to each one's before its colour is told."""
RED, GREEN, BLUE = 0.212671, 0.715160, 0.072169
"""Luminance of linear RGB, as Mitsuba has it."""


def prospects_of(
    irradiance: NDArray[np.floating[Any]], moments: Doubles, parents: NDArray[np.integer[Any]], colours: Doubles
) -> NDArray[np.float32]:
    """Irradiance in linear RGB and relative standard deviation of one path's estimate of it [K, 4], of K regions.

    ``irradiance`` [K] is luminance of radiance times cosine; ``moments`` [3, K] count the newest records of eye paths
    and add up their weights and the squares of these; ``parents`` [K] are groups of regions; ``colours`` [K or 0, 3] is
    light by region in linear RGB, of any scale, none where it is not known.
    """
    spread = _spread(moments)
    groups = np.zeros((3, int(parents.max()) + 1))
    for total, part in zip(groups, moments, strict=True):
        np.add.at(total, parents, part)
    everywhere = float(_spread(moments.sum(axis=1, keepdims=True))[0])
    own, shared = np.where(moments[1] > 0.0, moments[0], 0.0), np.where(groups[1] > 0.0, _spread(groups), everywhere)
    squared = (own * spread + BORROWED * shared[parents]) / (own + BORROWED)
    colours = colours if len(colours) else np.zeros((len(irradiance), 3))
    mean = colours + NEUTRAL * colours.mean(axis=0)
    bright = mean @ np.array([RED, GREEN, BLUE])
    tint = np.divide(mean, bright[:, None], out=np.ones_like(mean), where=bright[:, None] > 0.0)
    return np.concatenate([irradiance[:, None] * tint, np.sqrt(squared)[:, None]], axis=1).astype(np.float32)


def _spread(moments: Doubles) -> Doubles:
    """Variance over the square of the mean, 0 where that is none."""
    count, total, squares = moments
    ratio = np.divide(count * squares, np.square(total), out=np.ones_like(total), where=total > 0.0)
    return np.asarray(np.maximum(ratio - 1.0, 0.0))
