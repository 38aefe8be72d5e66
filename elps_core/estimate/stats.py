"""Error measures of an image."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

DARK = 0.1
"""Pixels darker than this share of the image's mean count as if they were that bright, so that a
few nearly black pixels do not decide the figure."""

SMALLEST = 2.0**-149
"""The smallest positive number of an image, so that what is relative to a black one is finite."""
BLACK_CHUNKS = 8
"""Chunks after which an image that is still black may end by its error: with samples doubling from chunk to chunk, 128
samples per pixel of a small film. It has no relative error, and would never end by one."""
MIN_CHUNKS = 4
"""Chunks before a render may end by its error: with fewer, the scatter of the estimate is as large as itself."""

Array = NDArray[np.floating[Any]]


def relative_squares(difference: Array, reference: Array) -> NDArray[np.float64]:
    """difference^2 / (reference^2 + (DARK mean)^2) per pixel and channel, [height, width, channels].

    The mean is that of absolute values: filters with negative lobes leave pixels below zero.
    """
    reference = reference.astype(np.float64)
    floor = (DARK * max(float(np.abs(reference).mean()), SMALLEST)) ** 2
    return np.asarray(difference.astype(np.float64) ** 2 / (reference**2 + floor))


def relative_error(mean: Array, standard_error: Array) -> float | None:
    """Root of the mean relative variance of an image: an estimate of sqrt(relMSE) without a reference.

    Arguments are [height, width, channels], linear. None where the image is black: there is nothing to be relative to.
    """
    if not np.any(mean):
        return None
    return float(np.sqrt(relative_squares(standard_error, mean).mean()))


def ends_by_error(error: float | None, chunks: int, wanted: float) -> bool:
    """Whether so many chunks, whose image has this relative ``error``, are as good as ``wanted``.

    ``error`` is None for fewer than two chunks, and for a black image.
    """
    if error is None:
        return chunks >= BLACK_CHUNKS
    return chunks >= MIN_CHUNKS and error <= wanted


def rel_mse(image: Array, reference: Array, *, trim: float = 0.0) -> float:
    """relMSE against a converged reference; ``trim`` leaves out that share of the worst pixels."""
    squares = np.sort(relative_squares(image - reference, reference).mean(axis=-1).ravel())
    keep = len(squares) - int(trim * len(squares))
    return float(squares[:keep].mean())
