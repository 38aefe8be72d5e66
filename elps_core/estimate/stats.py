"""Error measures of an image."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

DARK = 0.1
"""Pixels darker than this share of the image's mean count as if they were that bright, so that a
few nearly black pixels do not decide the figure."""

MIN_CHUNKS = 4
"""Chunks before a render may end by its error: with fewer, the scatter of the estimate is as large as itself."""

Array = NDArray[np.floating[Any]]


def relative_squares(difference: Array, reference: Array) -> NDArray[np.float64]:
    """difference^2 / (reference^2 + (DARK mean)^2) per pixel and channel, [height, width, channels]."""
    reference = reference.astype(np.float64)
    floor = (DARK * max(float(reference.mean()), float(np.finfo(np.float64).tiny))) ** 2
    return np.asarray(difference.astype(np.float64) ** 2 / (reference**2 + floor))


def relative_error(mean: Array, standard_error: Array) -> float:
    """Root of the mean relative variance of an image: an estimate of sqrt(relMSE) without a reference.

    Arguments are [height, width, 3] in linear RGB.
    """
    return float(np.sqrt(relative_squares(standard_error, mean).mean()))


def rel_mse(image: Array, reference: Array, *, trim: float = 0.0) -> float:
    """relMSE against a converged reference; ``trim`` leaves out that share of the worst pixels."""
    squares = np.sort(relative_squares(image - reference, reference).mean(axis=-1).ravel())
    keep = len(squares) - int(trim * len(squares))
    return float(squares[:keep].mean())
