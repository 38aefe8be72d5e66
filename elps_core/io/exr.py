"""OpenEXR by OpenImageIO: several named parts, and the facts of the render as attributes."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass
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
"""Names of the channels of parts that do not name them, by their number."""
ORDER = ("R", "G", "B", "X", "Y", "Z", "A")
"""In which channels are read that others write in the order of the alphabet; other names keep the file's order."""
REC_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""Chromaticities of red, green, blue and white, x and y of each."""
MOST_HALF = 65504.0
"""The greatest number of 16 bits."""

Attribute = str | int | float


class ImageUnwritable(ElpsError):
    """An image file cannot be written: a full disk, a missing folder, no permission."""


@dataclass(frozen=True)
class Part:
    """An image of a file that holds several."""

    pixels: NDArray[Any]
    """[height, width, channels], or [height, width]."""
    channels: tuple[str, ...] = ()
    """Names; without any those of grey or of colours."""
    half: bool = False
    """Whether numbers have 16 bits, where they can hold every one of them: else they have 32."""


def write_exr(path: Path, parts: Mapping[str, Part | NDArray[Any]], attributes: dict[str, Attribute]) -> None:
    """Write images as the named parts of one file; an array [height, width] or [height, width, 3] is a whole part.

    ``attributes`` go into every part under the prefix ``elps:``. The file appears whole or not at
    all: OpenImageIO leaves an empty one until it is closed.

    Raises:
        ImageUnwritable: the file cannot be written there.
    """
    partial = partial_of(path)
    named = {name: part if isinstance(part, Part) else Part(part) for name, part in parts.items()}
    images = {name: _as_3d(part.pixels) for name, part in named.items()}
    specs = [_spec(name, named[name], image, attributes) for name, image in images.items()]
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


def partial_of(path: Path) -> Path:
    """A name beside ``path`` for a file that is not whole yet, however long that one's is."""
    return path.with_name(f".{secrets.token_hex(6)}.partial{path.suffix}")


def read_exr(path: Path) -> tuple[dict[str, NDArray[np.float32]], dict[str, Attribute]]:
    """The parts of an EXR by name, float32 [height, width, channels], and its ``elps:`` attributes.

    Channels come as red, green, blue or X, Y, Z, and alpha after them; others in the file's order.

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
            order = sorted(range(spec.nchannels), key=lambda k: _place(spec.channelnames[k]))
            name = spec.getattribute("oiio:subimagename") or f"part{number}"
            parts[name] = np.ascontiguousarray(np.asarray(pixels, np.float32)[..., order])
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


def _place(channel: str) -> int:
    return ORDER.index(channel) if channel in ORDER else len(ORDER)


def _as_3d(pixels: NDArray[Any]) -> NDArray[np.float32]:
    image = np.ascontiguousarray(pixels, np.float32)
    return image[..., None] if image.ndim == 2 else image


def _spec(name: str, part: Part, image: NDArray[np.float32], attributes: dict[str, Attribute]) -> oiio.ImageSpec:
    height, width, count = image.shape
    half = part.half and bool((np.abs(image) <= MOST_HALF).all())
    spec = oiio.ImageSpec(width, height, count, "half" if half else "float")
    channels = part.channels or CHANNELS[count]
    spec.channelnames = channels
    if channels[-1] == "A":
        spec.alpha_channel = count - 1
    spec.attribute("compression", COMPRESSION)
    spec.attribute("oiio:subimagename", name)
    if set(CHANNELS[3]) <= set(channels):
        spec.attribute("oiio:ColorSpace", "lin_rec709")
        spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), REC_709)
    spec.attribute("Software", "ELPS")
    for key, value in attributes.items():
        # 64-bit whole numbers have no type in EXR; text keeps them exact.
        spec.attribute(PREFIX + key, str(value) if isinstance(value, int) and abs(value) >= 2**31 else value)
    return spec
