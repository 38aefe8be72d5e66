"""The statistical comparison of two estimators of one image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Agreement:
    """Outcome of comparing two estimators of one image."""

    worst_p: float
    """Smallest p-value over the blocks and the overall mean."""
    level: float
    """Level that it must stay above: Sidak-corrected for the number of tests."""
    mean_ratio: float
    """Overall mean of the first estimator over that of the second."""
    detectable: float
    """Smallest relative bias of the overall mean that the test finds with a chance of 95%."""

    @property
    def agrees(self) -> bool:
        """Whether no block and no mean differs significantly."""
        return self.worst_p >= self.level


def block_means(images: Array, block: int) -> NDArray[np.float64]:
    """Means over square blocks: [n, height, width, c] -> [n, blocks, c]; borders that do not fill a block count."""
    n, height, width, channels = images.shape
    rows, columns = max(1, height // block), max(1, width // block)
    parts = [
        part.reshape(n, -1, channels).astype(np.float64).mean(axis=1)
        for strip in np.array_split(images, rows, axis=1)
        for part in np.array_split(strip, columns, axis=2)
    ]
    return np.stack(parts, axis=1)


def compare(first: Array, second: Array, *, block: int = 16, level: float = 0.01) -> Agreement:
    """Welch's t-test on block means and on the overall mean of two sets of independent images.

    ``first`` [n, height, width, 3] and ``second`` [m, height, width, 3] hold independent, equally
    weighted chunks of two estimators; each contributes its own variance. ``level`` is the chance of
    a false alarm over all tests together.
    """
    a, b = block_means(first, block), block_means(second, block)
    overall_a, overall_b = a.mean(axis=1).mean(axis=-1), b.mean(axis=1).mean(axis=-1)
    # One value a block: channels of one path are strongly correlated, three tests would be one.
    tests_a = np.concatenate([a.mean(axis=-1), overall_a[:, None]], axis=1)
    tests_b = np.concatenate([b.mean(axis=-1), overall_b[:, None]], axis=1)
    constant = (tests_a.std(axis=0) == 0) & (tests_b.std(axis=0) == 0)
    p = np.ones(tests_a.shape[1])
    if not constant.all():
        varying = ~constant
        p[varying] = stats.ttest_ind(tests_a[:, varying], tests_b[:, varying], equal_var=False).pvalue
    p[constant] = np.where(np.isclose(tests_a[0, constant], tests_b[0, constant], rtol=1e-4), 1.0, 0.0)
    sidak = 1.0 - (1.0 - level) ** (1.0 / len(p))
    error = np.sqrt(overall_a.var(ddof=1) / len(overall_a) + overall_b.var(ddof=1) / len(overall_b))
    critical = stats.norm.isf(sidak / 2.0) + stats.norm.isf(0.05)
    mean_b = float(overall_b.mean())
    return Agreement(
        worst_p=float(np.nan_to_num(p, nan=0.0).min()),
        level=float(sidak),
        mean_ratio=float(overall_a.mean()) / mean_b if mean_b else float("nan"),
        detectable=float(critical * error / mean_b) if mean_b else float("inf"),
    )
