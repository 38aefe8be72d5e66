"""Files of measured materials, as small as they may be."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]
Fields = dict[str, Array]
"""Name -> numbers."""

REFLECTED = 0.1
"""What the material reflects: BSDF times cosine of each direction; 2 pi times it is the albedo."""
_CODES = {"uint8": 1, "uint16": 3, "float32": 10, "float64": 11}
"""Type of numbers -> its code in the file."""
_HEAD_BYTES = 18
"""Signature, version and number of fields."""


def numbers(*shape: int, value: float = 1.0) -> Array:
    """One number everywhere."""
    return np.full(shape, value, np.float32)


def material(**others: Array) -> Fields:
    """Fields of a material that reflects the same in all directions; ``others`` are in place of its own."""
    return {
        "description": np.frombuffer(b"even", np.uint8),
        "jacobian": np.zeros(1, np.uint8),
        "phi_i": numbers(1, value=0.0),
        "theta_i": np.linspace(0, np.pi / 2, 3, dtype=np.float32),
        "ndf": numbers(2, 2),
        "sigma": numbers(2, 2),
        "vndf": numbers(1, 3, 4, 5),
        "luminance": numbers(1, 3, 4, 4),
        "rgb": numbers(1, 3, 3, 4, 4, value=REFLECTED),
        **others,
    }


def written(fields: Fields, **entries: tuple[int, ...]) -> bytes:
    """A tensor file; ``entries`` says of some fields (offset, shape...) what is not so."""
    size = _HEAD_BYTES + sum(13 + len(name) + 8 * values.ndim for name, values in fields.items())
    table, data = b"", b""
    for name, values in fields.items():
        offset, *shape = entries.get(name, (size + len(data), *values.shape))
        table += struct.pack("<H", len(name)) + name.encode()
        table += struct.pack(f"<HBQ{values.ndim}Q", values.ndim, _CODES[values.dtype.name], offset, *shape)
        data += values.tobytes()
    return b"tensor_file\0" + struct.pack("<2BI", 1, 0, len(fields)) + table + data
