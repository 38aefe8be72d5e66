"""How often eye paths ask the tables: of a few chances the one by which they would have had the least noise.

A path that was drawn with density p and found z has the variance z^2 p / q if it is drawn with q instead. So every
path of training tells of every mixture of table and material at each of its vertices what it would have made of it.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]

CHANCES = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95)
"""What is compared: as many as fill packets of four, in which their sums travel."""
MOST = 30.0
"""What a path finds counts up to this many times its pixel's value: no single event is to decide for a region."""
OTHERS = 1e-3
"""Part that the variance of all regions together has in each one's, so that it decides where nothing was found."""


class ShareTrial:
    """Variance by region and chance, of paths whose mixture of table and material has a chance of ``share``."""

    def __init__(self, regions: int, share: float) -> None:
        self.sums = dr.zeros(mi.Float, regions * len(CHANCES))
        """[regions * chances]."""
        self._share = share

    def add(self, region: mi.UInt32, found: mi.Float, by_table: mi.Float, active: mi.Bool) -> None:
        """Enter directions that have brought ``found``, in units of a pixel's value; ``by_table`` is p_table / p."""
        by_material = dr.maximum(1.0 - self._share * by_table, 0.0) / (1.0 - self._share)
        square = dr.square(dr.minimum(found, MOST))
        some = active & (square > 0.0) & dr.isfinite(square)
        each = [square / (chance * by_table + (1.0 - chance) * by_material) for chance in CHANCES]
        packets = len(CHANCES) // 4
        for part in range(packets):
            index = packets * region + part
            dr.scatter_reduce(dr.ReduceOp.Add, self.sums, mi.Vector4f(*each[4 * part : 4 * part + 4]), index, some)


def best_shares(variance: Doubles, parents: NDArray[np.integer[Any]]) -> NDArray[np.float32]:
    """The chance of least ``variance`` [K, chances] for each region [K], by that of its group, ``parents`` [K], too."""
    groups = np.zeros((int(parents.max()) + 1, variance.shape[1]))
    np.add.at(groups, parents, variance)
    together = variance + groups[parents] + OTHERS * variance.sum(axis=0)
    best: NDArray[np.float32] = np.array(CHANCES, np.float32)[together.argmin(axis=1)]
    return best
