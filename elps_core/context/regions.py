"""Where: a division of the scene's surfaces into regions [thesis 5.2.3]. Needs no Mitsuba."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elps_core.errors import ContextMismatch

Floats = NDArray[np.float32]

MAX_REGIONS = 1 << 16
"""Regions that a 16-bit table can name; four times what the thesis uses."""
BINS = 6
"""Directions that a table tells apart: +x, -x, +y, -y, +z, -z."""
SIDE_BITS = 6
"""Bits of a brick's word that hold its side in voxels."""


@dataclass(frozen=True)
class Table:
    """Which region is nearest, for each of a set of cells: voxels times :data:`BINS` directions.

    A box is cut into equal cubes, the bricks, and each brick into its own number of voxels, many
    where regions are small.
    """

    low: tuple[float, float, float]
    """Corner of the first brick."""
    brick: float
    """Side of a brick, in the scene's unit."""
    bricks: NDArray[np.uint32]
    """[z, y, x]: number of the brick's first voxel << :data:`SIDE_BITS` | its side in voxels."""
    cells: NDArray[np.uint16]
    """[:data:`BINS`, voxels]: region of each cell; voxels of a brick in order of z, y, x."""


@dataclass(frozen=True)
class Regions:
    """Centres of regions, and a table that finds the region of a surface point.

    A surface point x with shading normal n belongs to the nearest centre c with normal n_c by
    ``alpha |x - c| + (1 - n . n_c)`` [thesis (5.16)]. The table holds the answer for the middle of each
    voxel and each of six directions; all other points take that of their voxel and of the
    direction next to their normal. Particles and samplers look up the same table, so in the end
    it is the table that says which region a point is in.
    """

    centres: Floats
    """[count, 3]"""
    normals: Floats
    """[count, 3], unit length."""
    alpha: float
    """What one unit of length weighs against the normals' part, which is 1 at a right angle."""
    table: Table

    @property
    def count(self) -> int:
        """Number of regions."""
        return len(self.centres)

    @staticmethod
    def undivided(count: int) -> Regions:
        """As many regions as there will be, the first of which holds everything.

        Dr.Jit compiles other kernels for sums into small arrays.
        """
        count = max(count, 2)
        normals = np.zeros((count, 3), np.float32)
        normals[:, 2] = 1.0
        table = Table((0.0, 0.0, 0.0), 1.0, np.ones((1, 1, 2), np.uint32), np.zeros((BINS, 2), np.uint16))
        return Regions(np.zeros((count, 3), np.float32), normals, 1.0, table)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything as arrays, for a file."""
        table = self.table
        return {
            "centres": self.centres,
            "normals": self.normals,
            "scale": np.array([self.alpha, table.brick, *table.low], np.float64),
            "bricks": table.bricks,
            "cells": table.cells,
        }

    @staticmethod
    def from_arrays(arrays: Mapping[str, NDArray[Any]]) -> Regions:
        """What :meth:`arrays` gave, taken over without copies, so that it may lie in a mapped file.

        Raises:
            ContextMismatch: the arrays do not fit each other, or are no regions at all. Kernels do not
                check their indices, so all that they rely on is checked here.
        """
        try:
            centres, normals, scale = (arrays[name] for name in ("centres", "normals", "scale"))
            bricks, cells = arrays["bricks"], arrays["cells"]
        except KeyError:
            raise ContextMismatch("the context has no regions: build it again") from None
        shapes = (
            centres.ndim == 2
            and centres.shape[1] == 3
            and 0 < len(centres) <= MAX_REGIONS
            and normals.shape == centres.shape
            and scale.shape == (5,)
            and bricks.ndim == 3
            and bricks.size > 0
            and cells.ndim == 2
            and cells.shape[0] == BINS
            and cells.shape[1] > 0
        )
        types = [part.dtype for part in (centres, normals, scale, bricks, cells)]
        if not (
            shapes
            and types == [np.float32, np.float32, np.float64, np.uint32, np.uint16]
            and all(np.isfinite(part).all() for part in (centres, normals, scale))
            and (scale[:2] > 0.0).all()
            and _in_range(bricks, cells, len(centres))
        ):
            raise ContextMismatch("the regions of the context are damaged: build it again")
        alpha, brick, x, y, z = (float(value) for value in scale)
        return Regions(centres, normals, alpha, Table((x, y, z), brick, bricks, cells))


def _in_range(bricks: NDArray[np.uint32], cells: NDArray[np.uint16], count: int) -> bool:
    side = (bricks & ((1 << SIDE_BITS) - 1)).astype(np.int64)
    ends = (bricks >> SIDE_BITS) + side**3
    return bool(side.min() > 0 and ends.max() <= cells.shape[1] and cells.max() < count)
