"""Check the file of a measured material before Mitsuba maps it into memory.

Mitsuba believes every offset and size in it, and reads whatever lies there. The format is that of Mitsuba's tensor
files: a table of named fields, each with a type, an offset and a shape, and then their numbers. Imports no Mitsuba.
"""

from __future__ import annotations

import math
import struct
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from elps_core.scene.meshes import BadFileError, file_size

MAGIC = b"tensor_file\0"
VERSION = (1, 0)
"""The only one that was ever written."""
MAX_FIELDS = 64
"""Of one file; a measured material has ten."""
MAX_NAME_BYTES = 256
"""Of one field; the longest in use has eleven."""
MAX_RANK = 8
"""Dimensions of one field; the spectra of a measured material have five."""
GROWTH = 5
"""Memory over the size of the fields: Mitsuba keeps sums beside the numbers that it samples by, and both a second time
while it makes them."""

_TYPES = {1: "u1", 2: "i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<u8", 8: "<i8", 9: "<f2", 10: "<f4", 11: "<f8"}
"""Code in the file -> type of the numbers."""
_RANKS = {"theta_i": 1, "phi_i": 1, "ndf": 2, "sigma": 2, "vndf": 4, "luminance": 4}
"""Field in single precision that every measured material has -> its number of dimensions."""
_NOTES = ("description", "jacobian")
"""Fields of bytes that it has."""
_SPECTRAL, _COLOURS = ("wavelengths", "spectra"), ("rgb",)
"""Fields that hold what is reflected: by wavelength, or as three colours."""
_INCREASING = ("theta_i", "phi_i", "wavelengths")
"""Where the measurements stand: intervals are searched for among them."""
_SAMPLED = ("vndf", "luminance")
"""Densities that directions are drawn from, one for each direction of incidence."""
_DENSITIES = ("ndf", "sigma", *_SAMPLED)


class Field(NamedTuple):
    """One entry of the table."""

    kind: str
    """Type of its numbers, as NumPy names it."""
    offset: int
    """Bytes from the beginning of the file."""
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """Bytes that it takes."""
        return math.prod(self.shape) * np.dtype(self.kind).itemsize


def measured(file: BinaryIO, *_: object) -> int:
    """Check a measured material; see :func:`elps_core.scene.headers.check`."""
    found = fields(file)
    reflected = _SPECTRAL if has_spectra(found) else _COLOURS
    for name in (*_RANKS, *_NOTES, *reflected):
        if name not in found:
            raise BadFileError(f"has no field '{name}': it is not a measured material")
    _check_shapes(found, reflected)
    for name in (*_RANKS, *reflected):
        _check_numbers(name, _read(file, found[name]))
    return GROWTH * sum(field.size for field in found.values())


def has_spectra(found: dict[str, Field]) -> bool:
    """Whether the material is measured by wavelength, and not in three colours."""
    return "wavelengths" in found


def fields(file: BinaryIO) -> dict[str, Field]:
    """The table of a tensor file, every field of which lies inside the file.

    Raises:
        BadFileError: it is no such file, is cut off, or declares what it does not hold.
    """
    size = file_size(file)
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        raise BadFileError("is not a tensor file, as measured materials are")
    if _unpacked(file, "<2B") != VERSION:
        raise BadFileError("is a tensor file of an unknown version")
    (count,) = _unpacked(file, "<I")
    if count > MAX_FIELDS:
        raise BadFileError(f"declares {count} fields: at most {MAX_FIELDS} are allowed")
    found: dict[str, Field] = {}
    for _ in range(count):
        (length,) = _unpacked(file, "<H")
        if length > MAX_NAME_BYTES:
            raise BadFileError("has a field whose name is too long: it is damaged")
        name = file.read(length).decode("utf-8", "replace")
        rank, code, offset = _unpacked(file, "<HBQ")
        if rank > MAX_RANK or code not in _TYPES or name in found:
            raise BadFileError("has a field of unknown type, of too many dimensions or there twice: it is damaged")
        found[name] = field = Field(_TYPES[code], offset, _unpacked(file, f"<{rank}Q"))
        if offset + field.size > size:
            raise BadFileError("declares more numbers than it holds: it is cut off or damaged")
    return found


def _unpacked(file: BinaryIO, form: str) -> tuple[int, ...]:
    wanted = struct.calcsize(form)
    data = file.read(wanted)
    if len(data) < wanted:
        raise BadFileError("is a tensor file that is cut off")
    return struct.unpack(form, data)


def _check_shapes(found: dict[str, Field], reflected: tuple[str, ...]) -> None:
    """Refuse fields that do not fit one another."""
    phi, theta, luminance = (found[name].shape for name in ("phi_i", "theta_i", "luminance"))
    bands = found["wavelengths"].shape if reflected == _SPECTRAL else (3,)
    fits = all(found[name].kind == "<f4" and len(found[name].shape) == rank for name, rank in _RANKS.items())
    fits = fits and all(found[name].kind == "u1" and len(found[name].shape) == 1 for name in _NOTES)
    fits = fits and found["jacobian"].shape == (1,) and len(bands) == 1
    fits = fits and found["vndf"].shape[:2] == luminance[:2] == phi + theta and luminance[2] == luminance[3]
    fits = fits and found[reflected[-1]].shape == phi + theta + bands + luminance[2:]
    fits = fits and all(found[name].kind == "<f4" for name in reflected)
    if not fits:
        raise BadFileError("has fields whose types or sizes do not fit: it is damaged")
    sides = [side for name in _DENSITIES for side in found[name].shape[-2:]]
    if min(sides) < 2 or min(phi + theta + bands) < 1:
        raise BadFileError("has tables of less than two numbers each way: it is damaged")


def _read(file: BinaryIO, field: Field) -> NDArray[Any]:
    """The numbers of a field, which are not copied into memory."""
    return np.memmap(file, field.kind, "r", field.offset, field.shape)


def _check_numbers(name: str, values: NDArray[Any]) -> None:
    """Refuse numbers that directions cannot be drawn from, or found among."""
    if not np.isfinite(values).all():
        raise BadFileError(f"has numbers in '{name}' that are not finite")
    if name in _INCREASING and (np.diff(values) <= 0).any():
        raise BadFileError(f"has numbers in '{name}' that do not increase")
    if name in _DENSITIES and (values < 0).any():
        raise BadFileError(f"has numbers in '{name}' that are negative")
    if name in _SAMPLED and not (values.sum(axis=(2, 3), dtype=np.float64) > 0).all():
        raise BadFileError(f"has a direction in '{name}' from which nothing is reflected")
