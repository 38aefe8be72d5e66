"""From the channels of a merged image to those of its file, and back to what is shown of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from elps_core.estimate.film import RGB, RGBA
from elps_core.io.exr import Part
from elps_core.scene.summary import FilmSummary, PixelFormat

XYZ = ("X", "Y", "Z")
TO_XYZ = np.array([[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]])
"""CIE 1931 tristimulus values of linear RGB with the primaries and the white of Rec. 709, as Mitsuba has them."""
TO_LUMINANCE = TO_XYZ[1:2]
"""Its second row."""
_COLOURS: dict[PixelFormat, tuple[tuple[str, ...], NDArray[np.float64]]] = {
    "luminance": (("Y",), TO_LUMINANCE),
    "luminance_alpha": (("Y",), TO_LUMINANCE),
    "xyz": (XYZ, TO_XYZ),
    "xyza": (XYZ, TO_XYZ),
}
"""Names and values of the colours of a format, from linear RGB; formats that are not here keep what there is."""


def of_variant(film: FilmSummary, variant: str) -> FilmSummary:
    """The format that a film has in a variant: as in Mitsuba, one without colours writes luminance, and no alpha."""
    return film.model_copy(update={"pixels": "luminance"}) if variant.endswith("_mono") else film


def converted(
    image: NDArray[np.float32], channels: tuple[str, ...], film: FilmSummary
) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """Pixels [height, width, channels] as a film's file has them, and the names of their channels.

    Of standard errors the result is a bound, and no more than that where colours differ in what makes their noise:
    sd(a R + b G) <= a sd(R) + b sd(G), and all factors are positive.
    """
    if channels not in (RGB, RGBA) or film.pixels not in _COLOURS:
        return image, channels
    names, matrix = _COLOURS[film.pixels]
    colours = (image[..., : len(RGB)].astype(np.float64) @ matrix.T).astype(np.float32)
    return np.concatenate([colours, image[..., len(RGB) :]], axis=-1), (*names, *channels[len(RGB) :])


def shown(part: Part) -> NDArray[Any]:
    """Pixels of a file as linear RGB [height, width, 3], to look at; bands as grey, by their mean."""
    if part.channels[: len(XYZ)] == XYZ:
        return np.asarray(part.pixels[..., : len(XYZ)] @ np.linalg.inv(TO_XYZ).T)
    return _colours_or_grey(part)


def shown_error(part: Part) -> NDArray[Any]:
    """Standard errors of a file likewise; of X, Y and Z that of Y as grey."""
    if part.channels[: len(XYZ)] == XYZ:
        return np.repeat(part.pixels[..., 1:2], len(RGB), axis=-1)
    return _colours_or_grey(part)


def _colours_or_grey(part: Part) -> NDArray[Any]:
    if part.channels[: len(RGB)] == RGB:
        return part.pixels[..., : len(RGB)]
    grey = part.pixels[..., :1] if part.channels[:1] == ("Y",) else part.pixels.mean(axis=-1, keepdims=True)
    return np.repeat(grey, len(RGB), axis=-1)
