"""Image files: look at one before Mitsuba allocates what its header declares; write it anew where texels are no light.

Imports no Mitsuba, which takes infinite texels and those that are no numbers as they are: one of them in an environment
makes its whole table of directions useless, and every pixel that it lights.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import OpenImageIO
from numpy.typing import NDArray

from elps_core.scene.meshes import BadFileError

MAX_SIDE = 16384
"""Pixels; the largest textures in use (16k)."""
MAX_CHANNELS = 64
"""Of one image; layers of a multi-channel EXR count."""
MOST_TEXEL = 1e30
"""Greatest value that is taken for light: the sum over as many texels as an image may have is then finite, too. What
is greater counts as infinite; formats without infinity write their greatest number for it."""

_MAGIC = (
    (b"\x89PNG\r\n\x1a\n", "png"),
    (b"\xff\xd8\xff", "jpeg"),
    (b"\x76\x2f\x31\x01", "openexr"),
    (b"#?", "hdr"),
    (b"PF", "pnm"),
    (b"Pf", "pnm"),
    (b"P6", "pnm"),
    (b"BM", "bmp"),
)
"""First bytes -> OpenImageIO's name of the format, for the formats that Mitsuba reads."""
_FLOAT_MAP = re.compile(rb"P([Ff])\s+(\d{1,9})\s+(\d{1,9})\s+(\S{1,40})\s")
"""Head of a PFM file: channels, width, height, and a scale that is negative where numbers are little endian."""
_HEAD_BYTES = 128


def memory(file: BinaryIO, path: str, _part: int = 0) -> int:
    """Bytes that Mitsuba keeps of an image at most; see :func:`elps_core.scene.headers.check`."""
    with _opened(file, path) as image:
        spec = image.spec()
        # Mitsuba keeps images of 8 bits in half precision, others in single.
        return int(spec.width * spec.height * spec.nchannels) * (2 if spec.format.size() == 1 else 4)


def mended(file: BinaryIO, path: str) -> tuple[bytes, list[str]] | None:
    """The image without texels that are infinite or no numbers, and what was done; None where it has none.

    Raises:
        BadFileError: it is damaged, or no image.
    """
    with _opened(file, path) as image:
        if image.spec().format.basetype not in (OpenImageIO.HALF, OpenImageIO.FLOAT, OpenImageIO.DOUBLE):
            return None
        file.seek(0)
        head = _FLOAT_MAP.match(file.read(_HEAD_BYTES))
        if head is not None:
            return _mended_float_map(file, head)
        kind = "float" if image.spec().channelformats else image.spec().format
        texels = image.read_image(kind)
        # Mitsuba reads EXR data in a thread of its own, where an error ends the whole process.
        if texels is None:
            image.geterror()
            raise BadFileError("is an image that is cut off or damaged")
        told = _replace(texels)
        return (_written(image, texels, Path(path).suffix), [told]) if told else None


@contextmanager
def _opened(file: BinaryIO, path: str) -> Iterator[Any]:
    """An image whose header has passed all checks.

    Raises:
        BadFileError: it has not.
    """
    file.seek(0)
    start = file.read(16)
    expected = next((name for magic, name in _MAGIC if start.startswith(magic)), None)
    if expected is None and path.lower().endswith(".tga"):
        expected = "targa"  # has no signature; Mitsuba goes by the name, too
    if expected is None:
        raise BadFileError("is not an image in PNG, JPEG, EXR, HDR, PFM, PPM, BMP or TGA format")
    image = OpenImageIO.ImageInput.open(path)
    if image is None:
        OpenImageIO.geterror()  # quotes the path; read it so that it does not pile up
        raise BadFileError("is an image with a damaged header")
    try:
        spec = image.spec()
        if image.format_name() != expected:
            raise BadFileError("is an image whose content does not match its extension: rename it")
        width, height = int(spec.width), int(spec.height)
        if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
            raise BadFileError(f"has {width}x{height} pixels: at most {MAX_SIDE} a side are allowed")
        if spec.nchannels > MAX_CHANNELS:
            raise BadFileError(f"has {spec.nchannels} channels: at most {MAX_CHANNELS} are allowed")
        yield image
    finally:
        image.close()


def _mended_float_map(file: BinaryIO, head: re.Match[bytes]) -> tuple[bytes, list[str]] | None:
    """A PFM file, in place: OpenImageIO writes its rows in another order than it reads them."""
    channels = 3 if head[1] == b"F" else 1
    count = channels * int(head[2]) * int(head[3])
    file.seek(head.end())
    data = file.read(4 * count)
    if len(data) < 4 * count:
        raise BadFileError("is an image that is cut off or damaged")
    texels = np.frombuffer(data, "<f4" if head[4].startswith(b"-") else ">f4").reshape(-1, 1, channels).copy()
    told = _replace(texels)
    return (head[0] + texels.tobytes(), [told]) if told else None


def _replace(texels: NDArray[Any]) -> str:
    """Put numbers in the place of texels [height, width, channels] that are none; what was done, or nothing."""
    odd = ~(np.abs(texels) <= np.float32(MOST_TEXEL))
    if not odd.any():
        return ""
    infinite = odd & (texels > 0)
    greatest = texels.max(where=~odd, initial=0)
    texels[odd] = 0
    texels[infinite] = greatest
    count, all_of_it = int(odd.any(axis=-1).sum()), odd[..., 0].size
    return (
        f"has texels that are infinite or no numbers, {count} of {all_of_it}: "
        f"the greatest number of the image, {float(greatest):g}, stands for what is infinite, and 0 for the rest"
    )


def _written(image: Any, texels: NDArray[Any], suffix: str) -> bytes:
    """A file like ``image`` with other texels, losslessly packed."""
    spec = OpenImageIO.ImageSpec(image.spec())
    spec.tile_width = spec.tile_height = spec.tile_depth = 0
    spec.attribute("compression", "zip")
    with tempfile.TemporaryDirectory(prefix="elps-image-") as folder:
        path = Path(folder) / f"image{suffix}"
        output = OpenImageIO.ImageOutput.create(str(path))
        done = output is not None and output.open(str(path), spec) and output.write_image(texels) and output.close()
        if not done:
            OpenImageIO.geterror()
            raise BadFileError("has texels that are infinite or no numbers: write it anew without them")
        return path.read_bytes()
