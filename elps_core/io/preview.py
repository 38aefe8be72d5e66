"""Pictures for eyes: exposure, tone curve, PNG."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from elps_core.io.exr import ImageUnwritable, partial_of

Tone = Literal["srgb", "filmic"]


def encode(image: NDArray[Any], exposure: float = 0.0, tone: Tone = "srgb") -> NDArray[np.uint8]:
    """Linear RGB [height, width, 3] to 8-bit sRGB; ``exposure`` in stops.

    ``filmic`` rolls highlights off by x (1 + x / w^2) / (1 + x) with w = 4 (Reinhard et al. 2002, (4)).
    """
    x = np.maximum(np.nan_to_num(np.asarray(image, np.float64), nan=0.0, posinf=1e6), 0.0) * 2.0**exposure
    if tone == "filmic":
        white = 4.0
        x = x * (1.0 + x / white**2) / (1.0 + x)
    x = np.minimum(x, 1.0)
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1.0 / 2.4) - 0.055)
    return np.asarray(np.round(encoded * 255.0), np.uint8)


def png(pixels: NDArray[np.uint8]) -> bytes:
    """8-bit RGB [height, width, 3] as a PNG file."""
    height, width, channels = pixels.shape
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "preview.png"
        buffer = oiio.ImageBuf(oiio.ImageSpec(width, height, channels, "uint8"))
        buffer.set_pixels(oiio.ROI.All, np.ascontiguousarray(pixels))
        if not buffer.write(str(path)):
            raise ImageUnwritable("the picture cannot be written: check the free space for temporary files")
        return path.read_bytes()


def to_png(image: NDArray[Any], exposure: float = 0.0, tone: Tone = "srgb") -> bytes:
    """Linear RGB [height, width, 3] as a PNG file; ``exposure`` in stops."""
    return png(encode(image, exposure, tone))


def write_png(path: Path, image: NDArray[Any]) -> None:
    """Write linear RGB [height, width, 3] as a PNG file; it appears whole or not at all.

    Raises:
        ImageUnwritable: the file cannot be written there.
    """
    partial = partial_of(path)
    try:
        partial.write_bytes(to_png(image))
        partial.replace(path)
    except OSError:
        raise ImageUnwritable("the image cannot be written: check the folder and the free space") from None
    finally:
        partial.unlink(missing_ok=True)


def false_colour(values: NDArray[Any], low: float, high: float) -> NDArray[np.uint8]:
    """Positive values [height, width] on a logarithmic scale from ``low`` (dark violet) to ``high`` (yellow)."""
    span = max(np.log(high / low), 1e-9)
    t = np.clip(np.log(np.maximum(np.asarray(values, np.float64), low) / low) / span, 0.0, 1.0)
    stops = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    colours = np.array([[13, 8, 60], [94, 20, 130], [190, 55, 95], [245, 135, 45], [252, 240, 155]], np.float64)
    return np.stack([np.interp(t, stops, colours[:, c]) for c in range(3)], axis=-1).round().astype(np.uint8)


def adjoint_picture(adjoint: NDArray[Any], scale: int = 6) -> NDArray[np.uint8]:
    """The adjoint image [rows, columns] as a picture, ``scale`` pixels a cell, over three decades."""
    top = max(float(np.max(adjoint)), float(np.finfo(np.float32).tiny))
    return false_colour(np.repeat(np.repeat(adjoint, scale, axis=0), scale, axis=1), top * 1e-3, top)


def adjoint_to_png(adjoint: NDArray[Any]) -> bytes:
    """The adjoint image [rows, columns] as a PNG file, on a logarithmic scale of three decades."""
    return png(adjoint_picture(adjoint))
