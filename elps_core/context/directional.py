"""What arrives from where: records of light paths and eye paths, summed into a table of directions per region.

Tables divide the sphere in world space into rows and columns of equal solid angle, after Peters
[thesis 5.2.4]. Sums stay on the device and take any number of records; a table is finished by a
slight blur, by borrowing from the regions around it as far as its own noise asks for it, and by a
floor under every direction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.context.encoding import DirectionalTables
from elps_core.errors import ContextMismatch

ROWS, COLUMNS = 32, 64
"""Default resolution: against it, guided paths were 1.5 times less efficient with half of it and 2.5 times with a
quarter; with twice, tables starved."""
BLUR = 0.3
"""Share of a cell's content that goes to its neighbours along each axis."""
FLOOR = 0.005
"""Share of every finished table that is spread evenly, so that no direction is lost."""
HORIZON = 0.2
"""Sine of the angle below and above the horizon within which what a region borrows fades out: as much as normals
vary in a region, and as a cell is wide."""
ENOUGH = 400.0
"""Effective records beyond which a region's shape counts no more in its group's: the group should not be its
one brightest region."""
MOST = 1e12
"""Records that no region is taken to be worth more than: halves may agree to the last digit."""
BELOW_ONE = float(np.nextafter(np.float32(1.0), np.float32(0.0)))


@dataclass(frozen=True)
class EqualAreaMap:
    """Directions to and from cells of equal solid angle: z = 1 - 2 (row + v) / rows, phi = 2 pi (column + u) / columns.

    Row 0 lies around +z; columns run counter-clockwise from +x.
    """

    rows: int
    columns: int

    @property
    def cells(self) -> int:
        """Cells of one table, each 4 pi / cells steradians."""
        return self.rows * self.columns

    def direction(self, row: mi.UInt32, column: mi.UInt32, inside: mi.Point2f) -> mi.Vector3f:
        """The unit vector at ``inside`` = (u, v), the fractions of column and row."""
        north = (mi.Float(row) + inside.y) / self.rows
        south = (mi.Float(self.rows - 1 - row) + (1.0 - inside.y)) / self.rows  # 1 - north, without its rounding
        sine = 2.0 * dr.sqrt(north * south)
        sin_phi, cos_phi = dr.sincos((mi.Float(column) + inside.x) * (dr.two_pi / self.columns))
        return mi.Vector3f(sine * cos_phi, sine * sin_phi, south - north)

    def locate(self, direction: mi.Vector3f) -> tuple[mi.UInt32, mi.UInt32, mi.Point2f]:
        """Row, column and fractions (u, v) in [0, 1) of unit vectors; any finite vector gets some cell."""
        # By the sine and not by 1 - |z|, which has lost its digits near the poles.
        polar = 0.5 * (dr.square(direction.x) + dr.square(direction.y)) / (1.0 + dr.abs(direction.z))
        north = direction.z >= 0.0
        from_pole = dr.minimum(polar * self.rows, 0.5 * self.rows)
        steps = mi.UInt32(from_pole)
        rest = from_pole - mi.Float(steps)
        row = dr.minimum(dr.select(north, steps, self.rows - 1 - steps), self.rows - 1)
        phi = dr.atan2(direction.y, direction.x) * (self.columns / dr.two_pi)
        phi = dr.maximum(dr.select(phi < 0.0, phi + self.columns, phi), 0.0)
        column = dr.minimum(mi.UInt32(phi), self.columns - 1)
        v = dr.select(north, rest, 1.0 - rest)
        return row, column, dr.clip(mi.Point2f(phi - mi.Float(column), v), 0.0, BELOW_ONE)


@dataclass
class Estimate:
    """What the records of one source say about every region, and how surely."""

    shares: mi.Float
    """[K * cells]: part of the region's irradiance that comes through each cell; zeros without records."""
    irradiance: NDArray[np.float64]
    """[K]"""
    noise: NDArray[np.float64]
    """[K]: variance of the shares, summed over the region's cells."""

    @property
    def precision(self) -> NDArray[np.float64]:
        """[K]: how many independent records of equal weight the region's table is worth; 0 without any."""
        return np.where(self.irradiance > 0.0, 1.0 / np.maximum(self.noise, 1.0 / MOST), 0.0)


class DirectionalAccumulator:
    """Sums of one kind of records, by region and direction, over as many batches as it takes.

    Even and odd batches are summed apart: what differs between the two is noise, however the
    records of one batch depend on each other. So a batch is what is independent of the next one,
    such as the chains or the paths of one random stream, and two are the least.
    """

    def __init__(self, regions: int, rows: int = ROWS, columns: int = COLUMNS) -> None:
        self.map = EqualAreaMap(rows, columns)
        self.regions = regions
        self.batches = 0
        self.visits = np.zeros(regions)
        """[K]: records of closed batches, those of weight zero included."""
        self.evidence = np.zeros(regions)
        """[K]: records of closed batches that were not zero."""
        self._exposure = np.zeros((2, regions))
        self._sums = [dr.zeros(mi.Float, regions * self.map.cells) for _ in range(2)]
        self._squares = dr.zeros(mi.Float64, regions)
        self._counts = dr.zeros(mi.UInt32, 2 * regions)  # Of the open batch: records, non-zero records

    def add(self, region: mi.UInt32, direction: mi.Vector3f, weight: mi.Float, active: mi.Bool | bool = True) -> None:
        """Enter records into the open batch; may be called from within a loop's body.

        ``direction`` points to where light (or importance) comes from, as a unit vector in world
        space. ``weight`` is a luminance, with E[sum weight f(direction)] = exposure * integral of
        f L_i |cos| over the directions: the cosine at the region is part of it, as it is of a
        photon's flux. What is not finite or negative counts as zero. Regions out of range are left
        out: where all tables together are too large, ``region - first`` sums a range of them.
        """
        row, column, _ = self.map.locate(direction)
        inside = mi.Bool(active) & (region < dr.opaque(mi.UInt32, self.regions))
        some = inside & dr.isfinite(weight) & (weight > 0.0)
        cell = region * self.map.cells + row * self.map.columns + column
        dr.scatter_reduce(dr.ReduceOp.Add, self._sums[self.batches % 2], weight, cell, some)
        dr.scatter_reduce(dr.ReduceOp.Add, self._squares, dr.square(mi.Float64(weight)), region, some)
        count = mi.Vector2u(1, dr.select(some, mi.UInt32(1), mi.UInt32(0)))
        dr.scatter_reduce(dr.ReduceOp.Add, self._counts, count, region, inside)

    @property
    def state(self) -> list[Any]:
        """What kernels write to."""
        return [self._sums, self._squares, self._counts]

    def close_batch(self, exposure: float | NDArray[np.floating[Any]] | None = None) -> None:
        """End the open batch.

        ``exposure``, a number or [K], is what its sums are to be divided by for the irradiance:
        light paths times the region's area for photons, so that sources can be mixed (light paths
        alone give each region's flux instead). None stands for the number of the batch's records in
        each region: right for eye paths, which visit a region and leave a record each time.
        """
        dr.eval(self._sums, self._squares, self._counts)
        visits, some = np.array(self._counts, np.float64).reshape(-1, 2).T
        self.visits += visits
        self.evidence += some
        self._exposure[self.batches % 2] += visits if exposure is None else exposure
        self._counts = dr.zeros(mi.UInt32, 2 * self.regions)
        self.batches += 1

    def estimate(self) -> Estimate:
        """What the closed batches say."""
        cells = self.map.cells
        each, total = self._exposure, self._exposure.sum(axis=0)
        sums = np.array(dr.block_sum(self._sums[0] + self._sums[1], cells), np.float64)
        region = dr.arange(mi.UInt32, self.regions * cells) // cells

        def over(divisor: NDArray[np.float64]) -> mi.Float:
            return dr.gather(mi.Float, _single(_reciprocal(divisor)), region)

        shares = (self._sums[0] + self._sums[1]) * over(sums)
        # In units of the irradiance too, so that no square leaves the range of a float.
        irradiance = sums * _reciprocal(total)
        between = self._sums[0] * over(each[0] * irradiance) - self._sums[1] * over(each[1] * irradiance)
        differences = np.array(dr.block_sum(dr.square(between), cells), np.float64)
        dr.eval(shares)
        # From the variance of the halves' difference to that of both together. A region that one of them has
        # never met takes its records as independent: the variance of their sum is then the sum of their squares.
        paired = differences * each[0] * each[1] * np.square(_reciprocal(total))
        lone = np.array(self._squares) * np.square(_reciprocal(sums))
        return Estimate(shares, irradiance, np.where(each.min(axis=0) > 0.0, paired, lone))

    def moments(self) -> NDArray[np.float64]:
        """Of the closed batches, by region [3, K]: number of records, sum of weights, sum of their squares."""
        sums = dr.block_sum(self._sums[0] + self._sums[1], self.map.cells)
        return np.stack([self.visits, np.array(sums, np.float64), np.array(self._squares, np.float64)])

    def relative_error(self) -> float:
        """Root mean square error of a region's table over its root mean square, regions by how often they were met.

        Of sums as they are, before any finishing; falls with the square root of the records.
        Infinite while there is more noise than signal.
        """
        now = self.estimate()
        power = float(self.visits @ np.array(dr.block_sum(dr.square(now.shares), self.map.cells), np.float64))
        noise = float(self.visits @ now.noise)
        return float(np.sqrt(noise / (power - noise))) if power > noise else float("inf")

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The closed batches, by name, to go on with them elsewhere."""
        return {
            "sums": np.stack([np.array(half) for half in self._sums]).reshape(2, self.regions, *self._grid),
            "squares": np.array(self._squares),
            "exposure": self._exposure.copy(),
            "visits": self.visits.copy(),
            "evidence": self.evidence.copy(),
            "batches": np.array([self.batches]),
        }

    @staticmethod
    def from_arrays(arrays: Mapping[str, NDArray[Any]]) -> DirectionalAccumulator:
        """Go on where :meth:`arrays` was taken.

        Raises:
            ContextMismatch: shapes that do not belong together, or something missing.
        """
        try:
            halves, regions, rows, columns = arrays["sums"].shape
            result = DirectionalAccumulator(regions, rows, columns)
            # Copied, because Dr.Jit works on an array's own memory.
            result._sums = [on_device(mi.Float, half) for half in arrays["sums"]]
            result._squares = on_device(mi.Float64, arrays["squares"])
            result._exposure = arrays["exposure"].astype(np.float64)
            result.visits = arrays["visits"].astype(np.float64)
            result.evidence = arrays["evidence"].astype(np.float64)
            result.batches = int(arrays["batches"][0])
            each = (dr.width(result._squares), len(result.visits), len(result.evidence))
            fits = halves == 2 and result._exposure.shape == (2, regions) and each == (regions,) * 3
        except (KeyError, ValueError, IndexError):
            fits = False
        if not fits:
            raise ContextMismatch("the saved state of the context does not fit: measure it again")
        return result

    @property
    def _grid(self) -> tuple[int, int]:
        return self.map.rows, self.map.columns


def finish(
    sources: Sequence[DirectionalAccumulator],
    parents: NDArray[np.integer[Any]] | None = None,
    normals: NDArray[np.floating[Any]] | None = None,
    *,
    blur: float = BLUR,
    floor: float = FLOOR,
    peaks: DirectionalAccumulator | None = None,
) -> DirectionalTables:
    """Tables fit to be sampled, from sums of one or more sources that estimate the same quantity.

    In each region sources count by their precision. The mean is blurred, then drawn towards the
    table of its group, ``parents`` [K], which is drawn towards that of all regions, and that towards
    no preference at all: each time by the share of the difference that noise explains (James and
    Stein), so that what has converged stays as it is and what is empty takes over its group's.
    Regions of one group may face different ways: with ``normals`` [K, 3], none borrows what would
    come through its own surface. A share ``floor`` of every table is even over the whole sphere.

    ``peaks`` holds light that is seen in other directions from every point of a region, weighted by its radiance times
    cosine. Tables of mean radiance give it too little: the least variance of all points together is that of a density
    in proportion to the root of the mean square (Rath et al., "Variance-Aware Path Guiding", 2020), which each cell has
    in place of its mean for this light. All together it has half of a table at most.

    On the door scene, 9 degrees ajar, 800 regions with a median of 100 records other than zero, half of the
    directions guided, the variance was 0.49 of that without guidance with sums as they are, 0.31 with the
    blur, 0.29 with groups of 16 regions as well, 0.23 with normals as well.

    Raises:
        ValueError: sources of different size, or not one parent and normal for each region.
    """
    regions, grid = sources[0].regions, sources[0].map
    if any((source.regions, source.map) != (regions, grid) for source in sources):
        raise ValueError("sources must agree on regions and resolution")
    if (parents is not None and parents.shape != (regions,)) or (normals is not None and normals.shape != (regions, 3)):
        raise ValueError("give one parent and one normal for each region")
    merged = _merged([source.estimate() for source in sources])
    spread = np.square(np.square(1.0 - blur) + np.square(blur) / 2.0)  # What two blurs leave of independent noise
    levels = [] if parents is None else [parents.astype(np.int64)]
    levels.append(np.zeros(regions if parents is None else int(parents.max()) + 1, np.int64))
    visible = None if normals is None else _above_horizon(normals, grid)
    shares = _blurred(merged.shares, grid, blur)
    shares = _drawn_to_groups(shares, merged.precision / spread, levels, grid.cells, visible)
    if peaks is not None:
        bright = peaks.estimate()
        coming = _blurred(bright.shares, grid, blur)
        coming = _drawn_to_groups(coming, bright.precision / spread, levels, grid.cells, visible)
        shares = _with_peaks(shares, merged.irradiance, coming, bright.irradiance, grid.cells)
    shares = (1.0 - floor) * shares + floor / grid.cells
    evidence = np.sum([source.evidence for source in sources], axis=0)
    return DirectionalTables(
        np.array(shares).reshape(regions, grid.rows, grid.columns),
        np.ones((regions, 2), np.float32),
        merged.irradiance.astype(np.float32),
        np.minimum(evidence, np.iinfo(np.uint32).max).astype(np.uint32),
    )


def even_tables(regions: int, rows: int, columns: int) -> DirectionalTables:
    """Tables of regions of which nothing is known: no direction is preferred."""
    shares = np.full((regions, rows, columns), 1.0 / (rows * columns), np.float32)
    none = np.zeros(regions)
    return DirectionalTables(shares, np.ones((regions, 2), np.float32), none.astype(np.float32), none.astype(np.uint32))


def _with_peaks(
    shares: mi.Float,
    irradiance: NDArray[np.float64],
    coming: mi.Float,
    squared: NDArray[np.float64],
    cells: int,
) -> mi.Float:
    """Tables [K * cells] of sum one, from ``shares`` of ``irradiance`` [K] and from light that comes through each cell.

    Of that light ``squared`` [K] is the square of radiance times cosine, meant over the region and integrated over
    directions, and ``coming`` [K * cells] each cell's part of it.
    """
    region = dr.arange(mi.UInt32, dr.width(shares)) // cells
    # Of one cell: the root mean square of radiance times cosine, times the cell's solid angle.
    root = dr.sqrt(coming * dr.gather(mi.Float, _single(squared * (4.0 * np.pi / cells)), region))
    dr.eval(root)
    total = np.array(dr.block_sum(root, cells), np.float64)
    part = np.minimum(total, irradiance) * _reciprocal(irradiance + np.minimum(total, irradiance))
    keep, scale = (dr.gather(mi.Float, _single(values), region) for values in (1.0 - part, part * _reciprocal(total)))
    result = keep * shares + scale * root
    dr.eval(result)
    return result


def _merged(estimates: list[Estimate]) -> Estimate:
    """Shares are the mean of several estimates, each region's weighted by their precision there.

    Irradiance is the greatest: photons underrate it where a region's area counts surfaces that no light
    reaches, eye paths where they do not find the light, and paths that are ended because little is expected
    become fireflies.
    """
    if len(estimates) == 1:
        return estimates[0]
    precision = np.stack([estimate.precision for estimate in estimates])
    parts = precision * _reciprocal(precision.sum(axis=0))
    irradiance = np.max([estimate.irradiance for estimate in estimates], axis=0)
    size = dr.width(estimates[0].shares)
    region = dr.arange(mi.UInt32, size) // (size // len(irradiance))
    shares = dr.zeros(mi.Float, size)
    for estimate, part in zip(estimates, parts, strict=True):
        shares = shares + estimate.shares * dr.gather(mi.Float, _single(part), region)
    dr.eval(shares)
    noise = [np.square(part) * estimate.noise for estimate, part in zip(estimates, parts, strict=True)]
    return Estimate(shares, irradiance, np.sum(noise, axis=0))


def _blurred(table: mi.Float, grid: EqualAreaMap, share: float) -> mi.Float:
    """Each cell's content shared with its neighbours, round the seam and across the poles; sums stay."""
    index = dr.arange(mi.UInt32, dr.width(table))
    cell = index % grid.cells
    row, column = cell // grid.columns, cell % grid.columns
    first = index - column  # Of the row

    def blend(centre: mi.Float, one: mi.UInt32, other: mi.UInt32) -> mi.Float:
        pair = dr.gather(mi.Float, centre, one) + dr.gather(mi.Float, centre, other)
        result = (1.0 - share) * centre + 0.5 * share * pair
        dr.eval(result)
        return result

    along = blend(table, first + (column + 1) % grid.columns, first + (column + grid.columns - 1) % grid.columns)
    opposite = first + (column + grid.columns // 2) % grid.columns
    above = dr.select(row > 0, index - grid.columns, opposite)
    below = dr.select(row < grid.rows - 1, index + grid.columns, opposite)
    return blend(along, above, below)


def _above_horizon(normals: NDArray[np.floating[Any]], grid: EqualAreaMap) -> mi.Float:
    """How much of each cell [K * cells] counts as above each region's surface, in [0, 1]."""
    index = dr.arange(mi.UInt32, len(normals) * grid.cells)
    cell = index % grid.cells
    middle = grid.direction(cell // grid.columns, cell % grid.columns, mi.Point2f(0.5))
    normal = dr.gather(mi.Vector3f, on_device(mi.Float, normals), index // grid.cells)
    return dr.clip(0.5 + dr.dot(normal, middle) / (2.0 * HORIZON), 0.0, 1.0)


def _drawn_to_groups(
    shares: mi.Float,
    precision: NDArray[np.float64],
    levels: list[NDArray[np.int64]],
    cells: int,
    visible: mi.Float | None = None,
) -> mi.Float:
    """Tables [n * cells] of sum one (or zero), each drawn towards its group's, by the groups of the levels to come."""
    index = dr.arange(mi.UInt32, dr.width(shares))
    one = index // cells
    target = dr.full(mi.Float, 1.0 / cells, dr.width(shares))
    if levels:
        parents = levels[0]
        weight = np.minimum(precision, ENOUGH)
        evidence = np.bincount(parents, weight, int(parents.max()) + 1).astype(np.float64)
        part = weight * _reciprocal(evidence)[parents]
        group = dr.gather(mi.UInt32, on_device(mi.UInt32, parents), one) * cells + index % cells
        groups = dr.zeros(mi.Float, len(evidence) * cells)
        dr.scatter_reduce(dr.ReduceOp.Add, groups, shares * dr.gather(mi.Float, _single(part), one), group)
        dr.eval(groups)
        target = dr.gather(mi.Float, _drawn_to_groups(groups, evidence, levels[1:], cells), group)
    if visible is not None:
        target = (target + FLOOR / cells) * visible  # A group may hold nothing that the region can see
        dr.eval(target)
        target = target / dr.gather(mi.Float, dr.block_sum(target, cells), one)
        dr.eval(target)
    distance = np.array(dr.block_sum(dr.square(shares - target), cells), np.float64)
    explained = np.where(precision * distance > 0.0, _reciprocal(precision * distance), 1.0)
    keep = _single(np.clip(1.0 - explained, 0.0, 1.0))
    result = target + dr.gather(mi.Float, keep, one) * (shares - target)
    dr.eval(result)
    return result


def _single(values: NDArray[np.float64]) -> mi.Float:
    return on_device(mi.Float, values)


def _reciprocal(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """1 / values, and 0 for 0."""
    return np.divide(1.0, values, out=np.zeros_like(values), where=values > 0.0)
