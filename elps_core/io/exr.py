"""OpenEXR by OpenImageIO: several named parts, and the facts of the render as attributes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from elps_core.errors import ElpsError

COMPRESSION = "zip"
"""Lossless; OpenImageIO silently turns htj2k into it."""
PREFIX = "elps:"
"""Namespace of our attributes."""
CHANNELS = {1: ("Y",), 3: ("R", "G", "B")}

Attribute = str | int | float


class ImageUnwritable(ElpsError):
    """An image file cannot be written: a full disk, a missing folder, no permission."""


def write_exr(path: Path, parts: dict[str, NDArray[Any]], attributes: dict[str, Attribute]) -> None:
    """Write float32 images [height, width] or [height, width, 3] as the named parts of one file.

    ``attributes`` go into every part under the prefix ``elps:``. The file appears whole or not at
    all: OpenImageIO leaves an empty one until it is closed.

    Raises:
        ImageUnwritable: the file cannot be written there.
    """
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial.exr")
    images = {name: _as_3d(pixels) for name, pixels in parts.items()}
    specs = [_spec(name, image, attributes) for name, image in images.items()]
    try:
        output = oiio.ImageOutput.create("exr")
        if output is None or not output.open(str(partial), tuple(specs)):
            raise ImageUnwritable("the image cannot be written: check the folder and the free space")
        try:
            for number, (spec, image) in enumerate(zip(specs, images.values(), strict=True)):
                if number and not output.open(str(partial), spec, "AppendSubimage"):
                    raise ImageUnwritable("the image cannot be written: check the free space")
                if not output.write_image(image):
                    raise ImageUnwritable("the image cannot be written: check the free space")
        finally:
            closed = output.close()
        if not closed:
            raise ImageUnwritable("the image cannot be written: check the free space")
        partial.replace(path)
    except OSError:
        raise ImageUnwritable("the image cannot be written: check the folder and the free space") from None
    finally:
        partial.unlink(missing_ok=True)


def read_exr(path: Path) -> tuple[dict[str, NDArray[np.float32]], dict[str, Attribute]]:
    """The parts of an EXR by name, float32 [height, width, channels], and its ``elps:`` attributes.

    Raises:
        ElpsError: not an image that OpenImageIO can read.
    """
    source = oiio.ImageInput.open(str(path))
    if source is None:
        oiio.geterror()  # Taken and dropped: it names the path.
        raise ElpsError("the file is not a readable image")
    try:
        parts: dict[str, NDArray[np.float32]] = {}
        attributes: dict[str, Attribute] = {}
        number = 0
        while source.seek_subimage(number, 0):
            spec = source.spec()
            pixels = source.read_image(number, 0, 0, spec.nchannels, "float")
            if pixels is None:
                raise ElpsError("the image file is damaged")
            parts[spec.getattribute("oiio:subimagename") or f"part{number}"] = np.asarray(pixels, np.float32)
            for entry in spec.extra_attribs:
                if entry.name.startswith(PREFIX):
                    value = entry.value
                    attributes[entry.name.removeprefix(PREFIX)] = (
                        value if isinstance(value, int | float) else str(value)
                    )
            number += 1
    finally:
        source.close()
    return parts, attributes


def _as_3d(pixels: NDArray[Any]) -> NDArray[np.float32]:
    image = np.ascontiguousarray(pixels, np.float32)
    return image[..., None] if image.ndim == 2 else image


def _spec(name: str, image: NDArray[np.float32], attributes: dict[str, Attribute]) -> oiio.ImageSpec:
    height, width, channels = image.shape
    spec = oiio.ImageSpec(width, height, channels, "float")
    spec.channelnames = CHANNELS[channels]
    spec.attribute("compression", COMPRESSION)
    spec.attribute("oiio:subimagename", name)
    spec.attribute("oiio:ColorSpace", "lin_rec709")
    spec.attribute("Software", "ELPS")
    for key, value in attributes.items():
        # 64-bit whole numbers have no type in EXR; text keeps them exact.
        spec.attribute(PREFIX + key, str(value) if isinstance(value, int) and abs(value) >= 2**31 else value)
    return spec
