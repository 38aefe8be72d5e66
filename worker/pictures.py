"""Files and pictures made on demand from what a farm has published: previews, errors, adjoint images."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from elps_core.io.exr import Part, write_exr
from elps_core.io.preview import adjoint_to_png, to_png
from worker.farm import Farm

Tone = Literal["srgb", "filmic"]

ERROR_RANGE = (0.01, 1.0)
"""Relative standard errors at the two ends of the colour scale, logarithmic: invisible, and worthless."""
DARK_SHARE = 0.01
"""Share of the mean radiance that is added to each pixel's own, so that black pixels do not look worst."""
_RAMP = np.array(
    [
        [0.000, 0.000, 0.000],
        [0.030, 0.010, 0.150],
        [0.280, 0.020, 0.200],
        [0.900, 0.130, 0.030],
        [1.000, 0.560, 0.050],
        [1.000, 1.000, 0.800],
    ],
    dtype=np.float32,
)
"""False colours in linear RGB, evenly spaced: brightness rises all the way, so that they work in grey."""


def preview_png(farm: Farm, job: str, exposure: float, tone: Tone) -> tuple[int, bytes] | None:
    """Revision and PNG of the newest image of ``job``, brightened by ``exposure`` stops; None without one."""
    pixels = farm.pixels(job)
    if pixels is None:
        return None
    revision, mean, _ = pixels
    return revision, to_png(mean, exposure, tone)


def error_exr(farm: Farm, job: str) -> tuple[int, bytes] | None:
    """Revision and EXR of the standard error per pixel, in the unit of the image; None without an image."""
    found = farm.error_of_image(job)
    if found is None:
        return None
    revision, error = found
    return revision, _exr({"standard error": error}, {"job": job, "revision": revision})


def error_png(farm: Farm, job: str) -> tuple[int, bytes] | None:
    """Revision and PNG of the relative standard error per pixel in false colours; None without an image."""
    pixels = farm.pixels(job)
    if pixels is None:
        return None
    revision, mean, error = pixels
    radiance = mean.mean(axis=2)
    floor = DARK_SHARE * float(radiance.mean())
    relative = error.mean(axis=2) / np.maximum(radiance + floor, np.finfo(np.float32).tiny)
    return revision, to_png(_false_colours(relative))


def error_legend_png(width: int, height: int) -> bytes:
    """The colour scale of :func:`error_png`, left to right over ``ERROR_RANGE``, in pixels."""
    row = np.geomspace(*ERROR_RANGE, num=width, dtype=np.float32)
    return to_png(_false_colours(np.broadcast_to(row, (height, width))))


def adjoint_exr(farm: Farm, context: str) -> bytes | None:
    """EXR of the adjoint image of a ready context."""
    adjoint = farm.adjoint(context)
    return None if adjoint is None else _exr({"adjoint": adjoint[:, :, None]}, {"context": context})


def adjoint_png(farm: Farm, context: str) -> bytes | None:
    """PNG of the adjoint image of a ready context."""
    adjoint = farm.adjoint(context)
    return None if adjoint is None else adjoint_to_png(adjoint)


def _false_colours(relative: NDArray[np.float32]) -> NDArray[np.float32]:
    low, high = ERROR_RANGE
    position = np.log(np.clip(relative, low, high) / low) / np.log(high / low)
    stops = np.linspace(0.0, 1.0, len(_RAMP))
    channels = [np.interp(position, stops, _RAMP[:, channel]) for channel in range(3)]
    return np.stack(channels, axis=2).astype(np.float32)


def _exr(parts: Mapping[str, Part | NDArray[np.float32]], attributes: dict[str, str | int | float]) -> bytes:
    with tempfile.TemporaryDirectory(prefix="elps-exr-") as folder:
        path = Path(folder) / "out.exr"
        write_exr(path, parts, attributes)
        return path.read_bytes()
