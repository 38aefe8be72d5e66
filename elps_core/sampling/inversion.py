"""The inversion method on tables whose probabilities are exactly the frequencies of the draw."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

RESOLUTION = 1 << 23
"""Steps of a uniform float32 number. Cell probabilities are whole numbers of them, so that the
probability in the table is exactly the one with which the inversion method draws the cell."""


def quantized(weights: NDArray[np.float64]) -> NDArray[np.int64]:
    """Whole steps of :data:`RESOLUTION`, at least one each, proportional to ``weights`` [..., n].

    Raises:
        ValueError: more cells than steps.
    """
    n = weights.shape[-1]
    if n > RESOLUTION // 2:
        raise ValueError("too many cells for the resolution of a uniform number")
    total = weights.sum(axis=-1, keepdims=True)
    share = np.divide(weights, total, out=np.full(weights.shape, 1.0 / n), where=total > 0)
    edges = np.round(np.cumsum(share, axis=-1) * (RESOLUTION - n)).astype(np.int64)
    edges[..., -1] = RESOLUTION - n
    return np.asarray(np.diff(edges, axis=-1, prepend=0) + 1)


def cumulative(steps: NDArray[np.int64]) -> NDArray[np.float32]:
    """Cumulated probabilities [..., n + 1] of whole steps [..., n]: 0 first, 1 last, all exact in single precision."""
    zero = np.zeros((*steps.shape[:-1], 1), np.int64)
    return np.asarray(np.concatenate([zero, np.cumsum(steps, axis=-1)], axis=-1) / RESOLUTION, np.float32)


def interval(edges: mi.Float, first: mi.UInt32, size: int, x: mi.Float, active: mi.Bool) -> mi.UInt32:
    """Which of ``size`` intervals holds ``x``, by their ascending ``size`` + 1 edges from ``edges[first]`` on.

    What lies beyond the outer edges counts to the outer intervals.
    """
    return dr.binary_search(0, size - 1, lambda i: dr.gather(mi.Float, edges, first + i + 1, active) <= x)


def interval_of_many(edges: mi.Float, first: mi.UInt32, size: mi.UInt32, x: mi.Float, active: mi.Bool) -> mi.UInt32:
    """As :func:`interval`, of as many intervals as a kernel is told when it runs."""

    def halve(low: mi.UInt32, high: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        middle = (low + high) >> 1
        below = dr.gather(mi.Float, edges, first + middle + 1, active) <= x
        return dr.select(below, dr.minimum(middle + 1, high), low), dr.select(below, high, middle)

    state = (mi.UInt32(0) & first, size - 1 + (mi.UInt32(0) & first))
    low, _ = dr.while_loop(state, lambda low, high: active & (low < high), halve, label="elps interval")
    return low


def drawn(
    edges: mi.Float, first: mi.UInt32, size: int | mi.UInt32, x: mi.Float, fine: mi.Float, active: mi.Bool
) -> tuple[mi.UInt32, mi.Float]:
    """As :func:`interval`, and where ``x`` lies in it, in [0, 1): ``fine`` fills the step that ``x`` is rounded to."""
    if isinstance(size, int):
        index = interval(edges, first, size, x, active)
    else:
        index = interval_of_many(edges, first, size, x, active)
    low = dr.gather(mi.Float, edges, first + index, active)
    high = dr.gather(mi.Float, edges, first + index + 1, active)
    # A step at least, as every interval has: where nothing was read there is no width.
    inside = (x - low + fine / RESOLUTION) / dr.maximum(high - low, 1.0 / RESOLUTION)
    return index, dr.clip(inside, 0.0, mi.Float(dr.one_minus_epsilon(mi.Float)))
