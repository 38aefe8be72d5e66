"""The field's densities: what is drawn is what is evaluated, whatever the tables say."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy import stats

from elps_core.context.encoding import DirectionalTables, Encoding
from elps_core.errors import ContextMismatch

Array = np.ndarray[Any, Any]
MIB = 2**20
GRIDS = [(32, 64), (16, 32), (1, 1), (5, 7), (9, 70), (3, 513)]
ENCODINGS: list[Encoding] = ["float32", "float16", "log8"]
LEVEL = 1e-4
"""Probability with which a test of a correct density fails; seeds are fixed, so it fails never or always."""


@pytest.fixture(autouse=True)
def _variant(mi: Any) -> None:
    """What is tested is a module of kernels."""


@cache
def row_of_regions(count: int) -> Any:
    """Regions around x = 0, 1, 2 ... in some order."""
    from elps_core.context.clustering import build_regions

    position = np.zeros((count, 3), np.float32)
    position[:, 0] = np.arange(count)
    return build_regions(position, np.tile(np.float32([0, 0, 1]), (count, 1)), count, seed=0)


def field_of(tables: DirectionalTables) -> Any:
    from elps_core.context.field import DirectionalField
    from elps_core.context.lookup import RegionLookup

    return DirectionalField(RegionLookup(row_of_regions(len(tables.values))), tables)


def kinds(grid: tuple[int, int]) -> Array:
    """Random, spiked, empty, smooth, half empty, and finished tables: [6, rows, columns]."""
    rng = np.random.default_rng(3)
    rows, columns = grid
    values = np.zeros((6, rows, columns))
    values[0] = rng.random(grid) ** 8
    values[1, rows // 2, columns // 3] = 1.0
    values[3] = 2.0 + np.outer(np.cos(np.arange(rows) / rows * 3.0), np.sin(np.arange(columns) / columns * 2.0 * np.pi))
    values[4, : (rows + 1) // 2] = 1.0
    values[5] = 0.005 / values[5].size
    values[5, rows // 3, : (columns + 1) // 2] += 0.995 / ((columns + 1) // 2)
    return values


def tables(values: Array) -> DirectionalTables:
    count = len(values)
    single = np.asarray(values, np.float32)
    return DirectionalTables(
        single, np.ones((count, 2), np.float32), np.arange(count, dtype=np.float32), np.arange(count, dtype=np.uint32)
    )


def chance_of(field: Any, count: int) -> Array:
    return np.stack([field.probabilities(region) for region in range(count)])


def draw(field: Any, count: int, each: int, seed: int) -> tuple[Any, Any, Any, Any]:
    """Regions in turn, numbers, directions and densities."""
    import drjit as dr
    import mitsuba as mi

    from elps_core.paths.stream import Stream

    stream = Stream.of(count * each, seed)
    region = dr.arange(mi.UInt32, count * each) % count
    u = stream.next_2d()
    return region, u, *field.sample(region, u)


def chi_squared(counts: Array, wanted: Array) -> float:
    """p-value, with cells of fewer than five expected counts pooled."""
    rare = wanted < 5.0
    if wanted[rare].sum() < 5.0:
        rare |= wanted == wanted[~rare].min()
    counts = np.append(counts[~rare], counts[rare].sum())
    wanted = np.append(wanted[~rare], wanted[rare].sum())
    return float(stats.chisquare(counts, wanted * counts.sum() / wanted.sum()).pvalue) if len(wanted) > 1 else 1.0


@pytest.mark.parametrize("grid", GRIDS)
def test_directions_are_drawn_with_their_probability(grid: tuple[int, int]) -> None:
    values = kinds(grid)
    field = field_of(tables(values))
    chance = chance_of(field, 6)
    region, _, direction, _ = draw(field, 6, 1 << 17, 1)
    row, column, inside = (np.array(part) for part in field.map.locate(direction))
    # Quarters of cells, so that the place inside a cell is tested too.
    quarter = 2 * (inside[1] >= 0.5) + (inside[0] >= 0.5)
    index = ((np.array(region) * grid[0] + row) * grid[1] + column) * 4 + quarter
    counts = np.bincount(index, minlength=6 * grid[0] * grid[1] * 4).reshape(6, -1)
    wanted = np.repeat(chance.reshape(6, -1), 4, axis=1) / 4.0 * (1 << 17)
    p = [chi_squared(counts[k], wanted[k]) for k in range(6)]
    assert min(p) > LEVEL, p


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("grid", GRIDS)
def test_probabilities_follow_the_tables(grid: tuple[int, int], encoding: Encoding) -> None:
    values = kinds(grid)
    encoded = tables(values).encoded(encoding)
    chance = chance_of(field_of(encoded), 6)
    assert chance.sum(axis=(1, 2)) == pytest.approx(np.ones(6), abs=1e-12)
    assert (chance > 0.0).all()
    wanted = encoded.decoded().astype(np.float64)
    wanted[2] = 1.0  # Empty tables are even
    wanted /= wanted.sum(axis=(1, 2), keepdims=True)
    # Each row and column keeps one step in 2^16 and is rounded to the next: that much and no more.
    steps = (np.array(grid) + 2.0) / (1 << 16)
    rows = wanted.sum(axis=2)
    assert np.abs(chance.sum(axis=2) - rows).max() <= steps[0]
    inner = wanted / np.where(rows > 0.0, rows, 1.0)[..., None]
    inner[rows == 0.0] = 1.0 / grid[1]
    assert np.abs(chance / chance.sum(axis=2, keepdims=True) - inner).max() <= steps[1]


@pytest.mark.parametrize("grid", GRIDS)
def test_density_integrates_to_one_over_the_sphere(mi: Any, grid: tuple[int, int]) -> None:
    import drjit as dr

    field = field_of(tables(kinds(grid)))
    cells = grid[0] * grid[1]
    index = dr.arange(mi.UInt32, 6 * cells)
    cell = index % cells
    middle = field.map.direction(cell // grid[1], cell % grid[1], mi.Point2f(0.5))
    pdf = np.array(field.pdf(index // cells, middle), np.float64).reshape(6, cells)
    assert pdf.sum(axis=1) * 4.0 * np.pi / cells == pytest.approx(np.ones(6), abs=1e-6)
    wanted = chance_of(field, 6).reshape(6, cells) * cells / (4.0 * np.pi)
    assert np.abs(pdf / wanted - 1.0).max() < 1e-6


def test_density_of_a_drawn_direction_is_that_of_asking_for_it() -> None:
    field = field_of(tables(kinds((32, 64))))
    region, _, direction, pdf = draw(field, 6, 1 << 16, 2)
    assert np.array_equal(np.array(pdf), np.array(field.pdf(region, direction)))
    assert np.array(pdf).min() > 0.0
    assert np.abs(np.linalg.norm(np.array(direction), axis=0) - 1.0).max() < 1e-6
    # And it is that of the cell that was meant: drawn points keep off the edges.
    row, column, _ = (np.array(part) for part in field.map.locate(direction))
    meant = chance_of(field, 6)[np.array(region), row, column] * 2048 / (4.0 * np.pi)
    assert np.abs(np.array(pdf) / meant - 1.0).max() < 1e-6


@pytest.mark.parametrize("grid", [(32, 64), (5, 7), (9, 70)])
def test_inversion_inverts(grid: tuple[int, int]) -> None:
    """F(F^-1(u)) = u, with F from the exact probabilities; so F^-1 grows with u, as small mutations need it."""
    field = field_of(tables(kinds(grid)))
    chance = chance_of(field, 6)
    in_row = chance.sum(axis=2)
    in_column = chance / in_row[..., None]
    region, u, direction, _ = draw(field, 6, 1 << 15, 3)
    k = np.array(region)
    row, column, inside = (np.array(part) for part in field.map.locate(direction))
    below_row = np.cumsum(in_row, axis=1) - in_row
    below_column = np.cumsum(in_column, axis=2) - in_column
    y = below_row[k, row] + in_row[k, row] * inside[1]
    x = below_column[k, row, column] + in_column[k, row, column] * inside[0]
    # A tenth of a percent of a cell: what float32 leaves of a fraction near the map's far end.
    wrong_x = np.abs(x - np.array(u.x)) > 1e-5 + 1e-3 * in_column[k, row, column]
    wrong_y = np.abs(y - np.array(u.y)) > 1e-5 + 1e-3 * in_row[k, row]
    assert not wrong_x.any()
    assert not wrong_y.any()


def test_the_ends_of_the_unit_square_are_inside(mi: Any) -> None:
    field = field_of(tables(kinds((5, 7))))
    last = 1.0 - 2.0**-23
    ends = np.array(np.meshgrid([0.0, 1e-30, last], [0.0, 1e-30, last]), np.float32).reshape(2, -1)
    for region in range(6):
        direction, pdf = field.sample(mi.UInt32(region), mi.Point2f(ends))
        assert np.isfinite(np.array(direction)).all()
        assert np.array(pdf).min() > 0.0
        row, column, _ = (np.array(part) for part in field.map.locate(direction))
        assert np.array_equal(row, np.where(ends[1] > 0.5, 4, 0))
        assert np.array_equal(column, np.where(ends[0] > 0.5, 6, 0))


def test_mitsuba_finds_the_density_right(mi: Any) -> None:
    from mitsuba.python.chi2 import ChiSquareTest, SphericalDomain

    from elps_core.context.directional import EqualAreaMap

    grid = EqualAreaMap(64, 128)
    index = np.arange(grid.cells, dtype=np.uint32)
    middle = np.array(grid.direction(mi.UInt32(index // 128), mi.UInt32(index % 128), mi.Point2f(0.5)))
    lobes = 0.2 + np.maximum(middle.T @ [0.6, 0.0, 0.8], 0.0) ** 2 + np.maximum(-middle[1], 0.0)
    field = field_of(tables(lobes.reshape(1, 64, 128)))
    test = ChiSquareTest(
        domain=SphericalDomain(),
        sample_func=lambda u: field.sample(mi.UInt32(0), u)[0],
        pdf_func=lambda d: field.pdf(mi.UInt32(0), d),
        sample_count=1 << 19,
        res=64,
        ires=16,
    )
    assert test.run(), test.messages


@pytest.mark.filterwarnings("ignore:overflow encountered in cast")
def test_hostile_tables_still_make_densities() -> None:
    """What a file may hold: each table has its own kind of nonsense, and some good cells."""
    values = np.tile(np.float32(np.arange(64).reshape(1, 8, 8)), (7, 1, 1))
    for table, nonsense in zip(values, [np.nan, np.inf, -np.inf, -5.0, 1e38, 1e-45, 0.0], strict=True):
        table[2:5] = nonsense
    values[6] = np.nan
    for stored in (values, values.astype(np.float16)):
        made = tables(np.ones_like(values))
        damaged = DirectionalTables(stored, made.scale, made.irradiance, made.evidence)
        chance = chance_of(field_of(damaged), 7)
        assert chance.sum(axis=(1, 2)) == pytest.approx(np.ones(7), abs=1e-12)
        assert (chance > 0.0).all()
        assert chance[6] == pytest.approx(np.full((8, 8), 1.0 / 64), rel=1e-3)
    for number in (np.nan, np.inf, -np.inf, 1e30):
        made = tables(np.ones((1, 8, 8))).encoded("log8")
        scale = np.full((1, 2), number, np.float32)
        damaged = DirectionalTables(made.values + np.uint8(3), scale, made.irradiance, made.evidence)
        assert chance_of(field_of(damaged), 1).sum() == pytest.approx(1.0, abs=1e-12)


def test_regions_are_found_and_know_their_light(mi: Any) -> None:
    field = field_of(tables(kinds((5, 7))))
    wanted = [4, 0, 5, 1]
    points = mi.Point3f(row_of_regions(6).centres[wanted].T)
    region = field.region(points, mi.Normal3f(0, 0, 1))
    assert np.array(region).tolist() == wanted
    assert np.array(field.irradiance(region)).tolist() == wanted
    assert np.array(field.evidence(region)).tolist() == wanted


def test_lanes_that_are_off_read_nothing(mi: Any) -> None:
    field = field_of(tables(kinds((5, 7))))
    region = mi.UInt32([1, 0xFFFFFFF0, 3])
    active = mi.Bool([True, False, True])
    direction, pdf = field.sample(region, mi.Point2f([0.3, 0.3, 0.3], [0.3, 0.3, 0.3]), active)
    assert np.array(pdf)[1] == 0.0
    assert (np.array(pdf)[[0, 2]] > 0.0).all()
    assert np.array(field.pdf(region, direction, active)).tolist() == np.array(pdf).tolist()
    assert np.array(field.irradiance(region, active)).tolist() == [1.0, 0.0, 3.0]
    assert np.array(field.evidence(region, active)).tolist() == [1, 0, 3]


def test_a_context_of_the_largest_size_fits_into_memory() -> None:
    per_region = field_of(tables(np.ones((64, 16, 32)))).nbytes / 64
    assert 16384 * per_region <= 40 * MIB


def test_what_does_not_fit_is_refused() -> None:
    from elps_core.context.field import DirectionalField
    from elps_core.context.lookup import RegionLookup

    field = field_of(tables(kinds((5, 7))))
    assert field.nbytes > 0
    with pytest.raises(ValueError, match="rows and columns"):
        field_of(tables(np.ones((1, 1025, 2))))
    with pytest.raises(ContextMismatch, match="other regions"):
        DirectionalField(RegionLookup(row_of_regions(1)), tables(kinds((5, 7))))
