"""Arrays of numpy in the memory of kernels."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike

ALIGNMENT = 64
"""Bytes: what Dr.Jit gives to memory of its own."""


def on_device(kind: type[Any], values: ArrayLike) -> Any:
    """A copy of ``values``, row after row, as an array of ``kind`` (``mi.Float``, ``mi.UInt32``).

    Dr.Jit compiles other loads for memory that numpy happens to have aligned otherwise. A kernel would then be found
    on disk, or not, by chance, and would read a table's rows in four pieces where one does.
    """
    source = np.asarray(values)
    dtype = np.dtype(dr.type_v(kind).name.lower())
    room = np.empty(source.size * dtype.itemsize + ALIGNMENT, np.uint8)
    start = -room.ctypes.data % ALIGNMENT
    aligned = room[start : start + source.size * dtype.itemsize].view(dtype)
    aligned[:] = source.ravel()
    return kind(aligned)
