"""Directional tables as data: what they hold, and how few bytes they can be kept in. Needs no Mitsuba."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from elps_core.errors import ContextMismatch

Encoding = Literal["float32", "float16", "log8"]

TYPES: dict[Encoding, type[np.generic]] = {"float32": np.float32, "float16": np.float16, "log8": np.uint8}
"""What a cell's value is stored as."""
NAMES = ("values", "scale", "irradiance", "evidence")
"""Arrays of a set of tables, as a file names them."""
LEVELS = 255
"""Values that an 8-bit table tells apart, beside the zero that code 0 stands for."""
OCTAVES = 24.0
"""Range of an 8-bit table: more than any floor leaves, so that one stray value cannot coarsen the steps."""
SMALLEST_RANGE = 1e-3
"""Octaves between the values of a constant table, which needs no steps but must not divide by their size."""
HALF_TOP = 2.0**15
"""What the largest value of a half precision table is scaled to, so that floors stay clear of denormals."""


@dataclass(frozen=True)
class DirectionalTables:
    """What arrives at each of K regions from each of rows x columns directions of equal solid angle.

    Cells are those of :class:`elps_core.context.directional.EqualAreaMap`. A region's values are the
    shares that the cells have in its irradiance, so that they sum to one; how large the irradiance
    itself is stands apart. Encoded values need no exact sum: whoever samples them normalises what
    it decodes, once, and evaluates the same (:class:`elps_core.context.field.DirectionalField`).
    """

    values: NDArray[Any]
    """[K, rows, columns], of the encoding's type."""
    scale: NDArray[np.float32]
    """[K, 2]: 8-bit: base-2 logarithm of code 1, octaves per step; half: factor, unused; float: unused."""
    irradiance: NDArray[np.float32]
    """[K]: luminance of radiance times cosine over all directions: per area, where the sources say the area."""
    evidence: NDArray[np.uint32]
    """[K]: records that were not zero."""

    def __post_init__(self) -> None:
        count = len(self.values)
        shapes = (self.scale.shape, self.irradiance.shape, self.evidence.shape)
        types = (self.scale.dtype.type, self.irradiance.dtype.type, self.evidence.dtype.type)
        if (
            self.values.ndim != 3
            or 0 in self.values.shape
            or self.values.dtype.type not in TYPES.values()
            or shapes != ((count, 2), (count,), (count,))
            or types != (np.float32, np.float32, np.uint32)
        ):
            raise ValueError("not a set of directional tables")

    @staticmethod
    def of(
        values: NDArray[np.floating[Any]], irradiance: NDArray[np.floating[Any]], evidence: NDArray[np.integer[Any]]
    ) -> DirectionalTables:
        """Tables from non-negative values [K, rows, columns] of any sum, in single precision."""
        total = values.sum(axis=(1, 2), keepdims=True, dtype=np.float64)
        share = np.divide(values, total, out=np.full(values.shape, 1.0 / values[0].size), where=total > 0.0)
        return DirectionalTables(
            share.astype(np.float32),
            np.ones((len(values), 2), np.float32),
            irradiance.astype(np.float32),
            evidence.astype(np.uint32),
        )

    @property
    def encoding(self) -> Encoding:
        """How the values are stored."""
        return next(name for name, kind in TYPES.items() if self.values.dtype == kind)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(regions, rows, columns)."""
        regions, rows, columns = self.values.shape
        return regions, rows, columns

    @property
    def nbytes(self) -> int:
        """Bytes that :meth:`arrays` takes in a file or in memory."""
        return sum(array.nbytes for array in self.arrays().values())

    def encoded(self, encoding: Encoding) -> DirectionalTables:
        """The same tables in another encoding.

        Half precision keeps a value to 2^-11 of itself down to 2^-29 of the table's largest. Eight
        bits keep it to half a step of a logarithmic scale from the table's smallest positive to its
        largest value: 2.6 % where they are 18.7 octaves apart, as a floor of 0.5 % over 64 x 32
        cells and one bright cell are; values more than :data:`OCTAVES` down are raised. Zero stays zero.
        """
        values = self.decoded()
        if encoding == "float32":
            return replace(self, values=values, scale=np.ones_like(self.scale))
        top = values.max(axis=(1, 2), keepdims=True)
        if encoding == "float16":
            first = np.where(top > 0.0, top / np.float32(HALF_TOP), np.float32(1.0))
            second = np.zeros_like(first)
            codes = values / first
        else:
            low = np.min(values, axis=(1, 2), keepdims=True, where=values > 0.0, initial=np.inf)
            first, high = np.log2(np.where(top > 0.0, (low, top), np.float32(1.0)))
            first = np.maximum(first, high - OCTAVES)
            second = np.maximum(high - first, SMALLEST_RANGE) / (LEVELS - 1)
            octaves = np.log2(values, out=first.repeat(values[0].size).reshape(values.shape), where=values > 0.0)
            codes = np.where(values > 0.0, np.rint(np.maximum(octaves - first, 0.0) / second) + 1.0, 0.0)
        scale = np.concatenate([first[:, 0], second[:, 0]], axis=1).astype(np.float32)
        return replace(self, values=codes.astype(TYPES[encoding]), scale=scale)

    def decoded(self) -> NDArray[np.float32]:
        """Shares [K, rows, columns] in single precision, each region's summing to one but for the encoding's error."""
        if self.encoding == "float32":
            return np.asarray(self.values, np.float32)
        first, second = self.scale[:, 0, None, None], self.scale[:, 1, None, None]
        if self.encoding == "float16":
            return np.asarray(self.values * first, np.float32)
        octaves = first + second * (self.values.astype(np.float32) - 1.0)
        return np.where(self.values > 0, np.exp2(octaves), np.float32(0.0))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything, by name, for a file."""
        return {name: getattr(self, name) for name in NAMES}

    @staticmethod
    def from_arrays(arrays: Mapping[str, NDArray[Any]]) -> DirectionalTables:
        """Take up what :meth:`arrays` gave; memory-mapped arrays stay on disk until they are used.

        Raises:
            ContextMismatch: shapes or types that do not belong together, or something missing.
        """
        try:
            tables = DirectionalTables(**{name: arrays[name] for name in NAMES})
        except (KeyError, ValueError):
            tables = None
        if tables is None or not np.isfinite(tables.irradiance).all():
            raise ContextMismatch("the tables of the context are damaged: build it again")
        return tables
