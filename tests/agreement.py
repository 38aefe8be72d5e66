"""The statistical comparison of two estimators of one image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.floating[Any]]

POWER = 0.95
"""Chance of finding a bias of the size that is called detectable."""
ROUNDING = 1e-4
"""Relative difference that is no fault: single precision leaves as much after eight bounces."""


@dataclass(frozen=True)
class Agreement:
    """Outcome of comparing two estimators of one image."""

    worst_p: float
    """Smallest p-value over the blocks, the overall mean and the mean of each channel."""
    level: float
    """Level that it must stay above: Sidak-corrected for the number of tests."""
    mean_ratio: float
    """Overall mean of the first estimator over that of the second."""
    detectable: float
    """Smallest relative bias of the overall mean that the test finds with a chance of 95%."""
    where: str
    """The test with the smallest p-value: ``mean``, ``channel 0``, or ``block 1,2`` (row, column)."""
    ratio: float
    """The first estimator over the second there."""

    @property
    def agrees(self) -> bool:
        """Whether no block and no mean differs significantly."""
        return self.worst_p >= self.level


def block_means(images: Array, block: int) -> NDArray[np.float64]:
    """Means over square blocks: [n, height, width, c] -> [n, blocks, c]; borders that do not fill a block count."""
    n, _, _, channels = images.shape
    rows, columns = _grid(images, block)
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
    tests_a, tests_b = _tests(first, block), _tests(second, block)
    mean_a, mean_b = tests_a.mean(axis=0), tests_b.mean(axis=0)
    var_a, var_b = (tests.var(axis=0, ddof=1) / len(tests) for tests in (tests_a, tests_b))
    error = np.sqrt(var_a + var_b)
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = (var_a + var_b) ** 2 / (var_a**2 / (len(first) - 1) + var_b**2 / (len(second) - 1))
        p = 2.0 * stats.t.sf(np.abs(mean_a - mean_b) / error, freedom)
        ratios = mean_a / mean_b
    # Without noise, rounding or nothing decides.
    p = np.where(np.abs(mean_a - mean_b) <= ROUNDING * np.abs(mean_b), 1.0, np.nan_to_num(p, nan=0.0))
    sidak = 1.0 - (1.0 - level) ** (1.0 / len(p))
    worst = int(p.argmin())
    found = (
        error[0] * (stats.t.isf(sidak / 2.0, freedom[0]) + stats.t.isf(1.0 - POWER, freedom[0])) if error[0] else 0.0
    )
    return Agreement(
        worst_p=float(p[worst]),
        level=float(sidak),
        mean_ratio=float(ratios[0]),
        detectable=float(found / mean_b[0]) if mean_b[0] else float("inf"),
        where=_name(worst, first.shape[-1], _grid(first, block)[1]),
        ratio=float(ratios[worst]),
    )


def _tests(images: Array, block: int) -> NDArray[np.float64]:
    """What is tested, one row an image: the overall mean, that of each channel, and that of each block."""
    blocks = block_means(images, block)
    channels = images.astype(np.float64).mean(axis=(1, 2))
    # One value a block: channels of one path are strongly correlated, three tests would be one.
    return np.concatenate([channels.mean(axis=1, keepdims=True), channels, blocks.mean(axis=-1)], axis=1)


def _grid(images: Array, block: int) -> tuple[int, int]:
    """Rows and columns of blocks."""
    return max(1, images.shape[1] // block), max(1, images.shape[2] // block)


def _name(test: int, channels: int, columns: int) -> str:
    if test == 0:
        return "mean"
    if test <= channels:
        return f"channel {test - 1}"
    row, column = divmod(test - 1 - channels, columns)
    return f"block {row},{column}"
