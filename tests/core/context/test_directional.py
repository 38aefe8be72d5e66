"""Tables of directions: the map of the sphere, sums that stream, and what finishing does to them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.special import gamma

from elps_core.errors import ContextMismatch

Array = np.ndarray[Any, Any]
Records = tuple[Array, Array, Array]
"""Regions [n], directions [n, 3], weights [n]."""
GRIDS = [(32, 64), (16, 32), (1, 1), (2, 3), (5, 7), (33, 20)]


@pytest.fixture(autouse=True)
def _variant(mi: Any) -> None:
    """What is tested is a module of kernels."""


def sphere(n: int, seed: int) -> Array:
    directions = np.random.default_rng(seed).normal(size=(n, 3))
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True), np.float32)


def accumulated(batches: list[Records], regions: int, grid: tuple[int, int] = (8, 16), exposure: Any = None) -> Any:
    from elps_core.context.directional import DirectionalAccumulator

    result = DirectionalAccumulator(regions, *grid)
    for batch in batches:
        enter(result, batch)
        result.close_batch(exposure)
    return result


def table_of(estimate: Any) -> Array:
    """Irradiance through each cell, [K, cells]."""
    return np.array(estimate.shares, np.float64).reshape(len(estimate.irradiance), -1) * estimate.irradiance[:, None]


def enter(accumulator: Any, records: Records, active: Any = True) -> None:
    import mitsuba as mi

    region, direction, weight = records
    accumulator.add(
        mi.UInt32(region.astype(np.uint32)),
        mi.Vector3f(direction.T.astype(np.float32)),
        mi.Float(weight.astype(np.float32)),
        active,
    )


def cells_of(direction: Array, grid: tuple[int, int]) -> Array:
    """The map again, from its definition."""
    rows, columns = grid
    row = np.minimum((1.0 - direction[:, 2]) / 2.0 * rows, rows - 1).astype(int)
    phi = np.arctan2(direction[:, 1], direction[:, 0]) / (2.0 * np.pi) % 1.0
    return np.asarray(row * columns + np.minimum(phi * columns, columns - 1).astype(int))


def lit(n: int, seed: int, regions: int = 4, grid: tuple[int, int] = (8, 16)) -> tuple[Records, Array]:
    """Records with weights of great spread from known shares [regions, cells], and these."""
    rng = np.random.default_rng(seed)
    cells = grid[0] * grid[1]
    truth = np.random.default_rng(0).random((regions, cells)) ** 4
    truth /= truth.sum(axis=1, keepdims=True)
    region = rng.integers(0, regions, n)
    cell = np.zeros(n, int)
    for k in range(regions):
        here = region == k
        cell[here] = rng.choice(cells, here.sum(), p=truth[k])
    direction = centres(grid)[cell]
    return (region, direction, rng.exponential(1.0, n) ** 2 / 2.0), truth


def centres(grid: tuple[int, int]) -> Array:
    """Directions [cells, 3] of the middles of all cells, from the map's definition."""
    rows, columns = grid
    z = 1.0 - 2.0 * (np.arange(rows) + 0.5) / rows
    phi = 2.0 * np.pi * (np.arange(columns) + 0.5) / columns
    sine = np.sqrt(1.0 - z * z)[:, None]
    parts = np.broadcast_arrays(sine * np.cos(phi), sine * np.sin(phi), z[:, None])
    return np.asarray(np.stack(parts, axis=-1).reshape(-1, 3), np.float32)


# The map


@pytest.mark.parametrize("grid", GRIDS)
def test_fractions_survive_the_way_to_the_sphere_and_back(mi: Any, grid: tuple[int, int]) -> None:
    from elps_core.context.directional import EqualAreaMap

    n = 50000
    rng = np.random.default_rng(1)
    area = EqualAreaMap(*grid)
    row, column = (mi.UInt32(rng.integers(0, size, n).astype(np.uint32)) for size in grid)
    # Off the very edges, where rounding may choose the neighbour.
    inside = mi.Point2f(rng.uniform(1e-4, 1.0 - 1e-4, (2, n)).astype(np.float32))
    direction = area.direction(row, column, inside)
    assert np.abs(np.linalg.norm(np.array(direction), axis=0) - 1.0).max() < 1e-6
    assert np.array_equal(cells_of(np.array(direction, np.float64).T, grid), np.array(row * grid[1] + column))
    row_back, column_back, back = area.locate(direction)
    assert np.array_equal(np.array(row_back), np.array(row))
    assert np.array_equal(np.array(column_back), np.array(column))
    u, v = np.abs(np.array(back, np.float64) - np.array(inside, np.float64))
    assert u.max() < 1e-6 * grid[1]
    assert v.max() < 1e-6 * max(grid[0], 2)


@pytest.mark.parametrize("grid", GRIDS)
def test_directions_survive_the_way_to_the_map_and_back(mi: Any, grid: tuple[int, int]) -> None:
    from elps_core.context.directional import EqualAreaMap

    area = EqualAreaMap(*grid)
    near_pole = sphere(20000, 2) * np.float32([1e-3, 1e-3, 1.0])  # The poles ...
    near_pole /= np.linalg.norm(near_pole, axis=1, keepdims=True)
    near_seam = sphere(20000, 3) * np.float32([1.0, 1e-6, 1.0])  # ... and both sides of the seam
    near_seam /= np.linalg.norm(near_seam, axis=1, keepdims=True)
    axes = np.float32(
        [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [1, -0.0, 0], [-1, -0.0, 0]]
    )
    directions = np.concatenate([sphere(20000, 4), near_pole, near_seam, axes])
    row, column, inside = area.locate(mi.Vector3f(directions.T))
    assert np.array(row).max() < grid[0]
    assert np.array(column).max() < grid[1]
    fractions = np.array(inside)
    assert fractions.min() >= 0.0
    assert fractions.max() < 1.0
    back = np.array(area.direction(row, column, inside)).T
    # The last digit of a fraction is an angle of 7e-4 at the poles themselves, where rows begin.
    polar = np.hypot(directions[:, 0], directions[:, 1])
    error = np.linalg.norm(back - directions, axis=1)
    assert error[polar > 1e-2].max() < 1e-5
    assert error.max() < 1e-3
    assert error[(directions[:, 2] > 0.0) & (polar > 0.0)].max() < 1e-5, "row 0 begins at zero, where floats are fine"


def test_cells_have_equal_solid_angles(mi: Any) -> None:
    from elps_core.context.directional import EqualAreaMap

    n, area = 1 << 18, EqualAreaMap(8, 16)
    row, column, _ = area.locate(mi.Vector3f(sphere(n, 5).T))
    counts = np.bincount(np.array(row * 16 + column), minlength=128)
    assert stats.chisquare(counts).pvalue > 1e-3


def test_whatever_is_no_direction_still_has_a_cell(mi: Any) -> None:
    from elps_core.context.directional import EqualAreaMap

    odd = [np.nan, np.inf, -np.inf, 0.0, -0.0, 1e30, -1e30, 1.0, -1.0]
    vectors = np.array(np.meshgrid(odd, odd, odd), np.float32).reshape(3, -1)
    row, column, _ = EqualAreaMap(5, 7).locate(mi.Vector3f(vectors))
    assert np.array(row).max() < 5
    assert np.array(column).max() < 7


# Sums


def test_sums_are_those_of_numpy() -> None:
    records, _ = lit(20000, 6)
    now = accumulated([records], 4).estimate()
    region, direction, weight = records
    wanted = np.bincount(region * 128 + cells_of(direction, (8, 16)), weight.astype(np.float32), 4 * 128)
    visits = np.bincount(region, minlength=4)
    wanted = wanted.reshape(4, 128)
    assert table_of(now) == pytest.approx(wanted / visits[:, None], rel=1e-4, abs=1e-9)
    assert now.irradiance == pytest.approx(wanted.sum(axis=1) / visits, rel=1e-5)


def test_streamed_sums_are_those_of_one_batch_in_any_order() -> None:
    (region, direction, weight), _ = lit(60000, 7)
    pieces = [(region[i::6], direction[i::6], weight[i::6]) for i in range(6)]
    whole = accumulated([(region, direction, weight)], 4)
    for order in ([0, 1, 2, 3, 4, 5], [5, 1, 3, 0, 4, 2]):
        streamed = accumulated([pieces[i] for i in order], 4)
        assert np.array_equal(streamed.evidence, whole.evidence)
        assert np.array_equal(streamed.visits, whole.visits)
        assert table_of(streamed.estimate()) == pytest.approx(table_of(whole.estimate()), rel=1e-4)
    halved = accumulated(pieces, 4), accumulated(pieces[::-1], 4)  # The halves change places
    assert halved[0].relative_error() == pytest.approx(halved[1].relative_error(), rel=1e-4)


def test_records_may_come_from_inside_a_loop(mi: Any) -> None:
    import drjit as dr

    from elps_core.context.directional import DirectionalAccumulator

    (region, direction, weight), _ = lit(4096, 8)
    outside = accumulated([(np.tile(region, 3), np.tile(direction, (3, 1)), np.tile(weight, 3))], 4)
    inside = DirectionalAccumulator(4, 8, 16)
    keys, vectors, weights = mi.UInt32(region.astype(np.uint32)), mi.Vector3f(direction.T), mi.Float(weight)

    def body(step: Any) -> tuple[Any]:
        inside.add(keys, vectors, weights, step < 3)
        return (step + 1,)

    dr.while_loop((dr.zeros(mi.UInt32, 4096),), lambda step: step < 3, body)
    inside.close_batch()
    assert np.array_equal(inside.evidence, outside.evidence)
    assert table_of(inside.estimate()) == pytest.approx(table_of(outside.estimate()), rel=1e-4)


def test_what_is_not_a_record_is_left_out(mi: Any) -> None:
    from elps_core.context.directional import DirectionalAccumulator

    accumulator = DirectionalAccumulator(3, 4, 4)
    weights = np.array([1.0, np.nan, np.inf, -1.0, 0.0, 5.0, 7.0])
    region = np.array([0, 0, 0, 0, 0, 9, 1])
    enter(accumulator, (region, sphere(7, 9), weights), mi.Bool([True] * 6 + [False]))
    accumulator.close_batch()
    assert accumulator.visits.tolist() == [5, 0, 0], "records of nothing count as visits"
    assert accumulator.evidence.tolist() == [1, 0, 0]
    assert accumulator.estimate().irradiance == pytest.approx([1.0 / 5.0, 0.0, 0.0])


def test_light_paths_and_eye_paths_estimate_the_same() -> None:
    """Radiance 1 from above, 3 from one octant, on two regions of different area, by both kinds of record."""
    from elps_core.context.directional import finish

    rng = np.random.default_rng(10)
    area = np.array([2.0, 0.5])

    def radiance(direction: Array) -> Array:
        return np.where((direction[:, :2] > 0.0).all(axis=1), 3.0, 1.0) * (direction[:, 2] > 0.0)

    def eye(n: int) -> Records:
        direction, region = sphere(n, int(rng.integers(1 << 30))), rng.integers(0, 2, n)
        return region, direction, radiance(direction) * direction[:, 2] * 4.0 * np.pi

    def light(n: int) -> Records:  # From n paths, points by area, directions by cosine
        region = (rng.random(n) > area[0] / area.sum()).astype(int)
        direction = sphere(n, int(rng.integers(1 << 30))) + np.float32([0.0, 0.0, 1.0])
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return region, direction, radiance(direction) * np.pi * area.sum()

    eyes = accumulated([eye(1 << 16) for _ in range(2)], 2)
    lights = accumulated([light(1 << 16) for _ in range(2)], 2, exposure=(1 << 16) * area)
    mixed = finish([eyes, lights], blur=0.0, floor=0.0)
    wanted = np.array([1.5, 1.5]) * np.pi  # A quarter of the upper hemisphere at 3, the rest at 1
    for irradiance in (eyes.estimate().irradiance, lights.estimate().irradiance, mixed.irradiance):
        assert irradiance == pytest.approx(wanted, rel=0.03)
    tables = [table_of(source.estimate()).reshape(2, 8, 16) for source in (eyes, lights)]
    assert tables[0] == pytest.approx(tables[1], abs=0.1 * float(tables[1].max()))
    both = mixed.values * mixed.irradiance[:, None, None]
    assert both == pytest.approx(np.mean(tables, axis=0), abs=0.1 * float(tables[1].max()))


def test_a_range_of_regions_can_be_summed_alone(mi: Any) -> None:
    (region, direction, weight), _ = lit(5000, 14)
    whole = accumulated([(region, direction, weight)], 4)
    part = accumulated([(region - 1, direction, weight)], 2)  # Wraps below zero, as it does in kernels
    assert np.array_equal(part.evidence, whole.evidence[1:3])
    assert table_of(part.estimate()) == pytest.approx(table_of(whole.estimate())[1:3], rel=1e-5)


# Convergence


@pytest.mark.parametrize("scale", [1e-25, 1e25])
def test_units_do_not_matter(scale: float) -> None:
    from elps_core.context.directional import finish

    batches = [lit(4000, seed)[0] for seed in (15, 16)]
    scaled = [(region, direction, weight * scale) for region, direction, weight in batches]
    one, other = accumulated(batches, 4), accumulated(scaled, 4)
    assert other.relative_error() == pytest.approx(one.relative_error(), rel=1e-4)
    assert accumulated(scaled[:1], 4).relative_error() == pytest.approx(
        accumulated(batches[:1], 4).relative_error(), rel=1e-4
    )
    assert np.abs(finish([other]).values - finish([one]).values).max() < 1e-6


def test_error_is_what_it_says_and_falls_with_the_root_of_the_records() -> None:
    errors = []
    for n in (4000, 64000):
        batches = [lit(n // 8, 100 * n + i) for i in range(8)]
        truth = batches[0][1]
        sums = accumulated([records for records, _ in batches], 4)
        table = np.array(sums.estimate().shares).reshape(4, 128)
        true = np.sqrt(np.square(table - truth).sum() / np.square(truth).sum())
        errors.append(sums.relative_error())
        assert errors[-1] == pytest.approx(true, rel=0.35)
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.3)


def test_error_sees_that_records_of_a_chain_repeat() -> None:
    def repeated(n: int, seed: int, times: int) -> Records:
        region, direction, weight = lit(n // times, seed)[0]
        return np.tile(region, times), np.tile(direction, (times, 1)), np.tile(weight, times)

    independent = accumulated([repeated(8000, i, 1) for i in range(8)], 4)
    chained = accumulated([repeated(8000, i, 16) for i in range(8)], 4)
    assert chained.relative_error() == pytest.approx(4.0 * independent.relative_error(), rel=0.35)


def test_error_is_known_from_one_batch_and_infinite_before() -> None:
    from elps_core.context.directional import DirectionalAccumulator

    assert DirectionalAccumulator(4, 8, 16).relative_error() == float("inf")
    one = accumulated([lit(32000, 11)[0]], 4).relative_error()
    two = accumulated([lit(16000, i)[0] for i in (11, 12)], 4).relative_error()
    assert one == pytest.approx(two, rel=0.3)


# Finishing


@pytest.mark.parametrize("grid", [(8, 16), (5, 7), (1, 4), (3, 2)])
def test_blur_keeps_the_sum_and_reaches_round_seam_and_poles(mi: Any, grid: tuple[int, int]) -> None:
    from elps_core.context.directional import EqualAreaMap, _blurred

    rows, columns = grid
    for row, column in ((0, 0), (rows - 1, columns - 1), (rows // 2, 0)):
        spike = np.zeros((2, *grid), np.float32)
        spike[1, row, column] = 1.0
        result = np.array(_blurred(mi.Float(spike.ravel()), EqualAreaMap(*grid), 0.3)).reshape(2, rows, columns)
        assert result[1].sum() == pytest.approx(1.0, abs=1e-6)
        assert (result[0] == 0.0).all(), "regions do not touch"
        if grid == (8, 16):
            assert result[1, row, column] == pytest.approx(0.49)
            assert result[1, row, (column + 1) % 16] == pytest.approx(0.105)
            assert result[1, row, (column - 1) % 16] == pytest.approx(0.105)
            if row in (0, 7):
                assert result[1, row, (column + 8) % 16] == pytest.approx(0.105), "across the pole"
    even = np.full(2 * rows * columns, 0.25, np.float32)
    assert np.array(_blurred(mi.Float(even), EqualAreaMap(*grid), 0.3)) == pytest.approx(even)


def group_of_lookalikes(counts: list[int], seed: int = 0) -> tuple[Any, Array]:
    """Regions of one same truth with so many records each, the last one alone of another; and the truths."""
    rng = np.random.default_rng(seed)
    truth = rng.random((2, 128)) ** 6
    truth /= truth.sum(axis=1, keepdims=True)
    shapes = np.repeat(truth[:1], len(counts), axis=0)
    shapes[-1] = truth[1]
    batches = []
    for _ in range(2):
        region = np.repeat(np.arange(len(counts)), [count // 2 for count in counts])
        cell = np.concatenate([rng.choice(128, count // 2, p=shapes[k]) for k, count in enumerate(counts)])
        batches.append((region, centres((8, 16))[cell], rng.exponential(1.0, len(region))))
    return accumulated(batches, len(counts)), shapes.reshape(-1, 8, 16)


def distance(one: Array, other: Array) -> Array:
    return np.asarray(np.sqrt(np.square(one - other).sum(axis=(1, 2)) / np.square(other).sum(axis=(1, 2))))


def test_shrinkage_pulls_what_starves_and_keeps_what_has_converged() -> None:
    from elps_core.context.directional import finish

    counts = [40] * 20 + [0, 200000]
    sums, truth = group_of_lookalikes(counts)
    alone = finish([sums], np.arange(22), blur=0.0, floor=0.0).values
    raw = np.array(sums.estimate().shares).reshape(22, 8, 16)
    together = finish([sums], np.zeros(22, int), blur=0.0, floor=0.0).values
    apart = finish([sums], np.array([0] * 21 + [1]), blur=0.0, floor=0.0).values
    starved = slice(0, 20)
    assert distance(apart, truth)[starved].mean() < 0.4 * distance(raw, truth)[starved].mean()
    assert distance(together, truth)[starved].mean() < distance(raw, truth)[starved].mean()
    assert distance(alone, truth)[starved].mean() < distance(raw, truth)[starved].mean(), "even all regions are a help"
    assert distance(apart, truth)[20] < 0.4, "a region without records takes over its group's"
    for result in (alone, together, apart):
        moved = distance(result[21:], raw[21:])
        assert moved < 0.01, "what has converged does not follow its group"
        assert moved < 0.5 * distance(raw[21:], truth[21:])


def test_a_group_is_not_its_best_known_region() -> None:
    from elps_core.context.directional import finish

    sums, truth = group_of_lookalikes([2000] * 10 + [0, 100000])
    empty = finish([sums], np.zeros(12, int), blur=0.0, floor=0.0).values[10:11]
    assert distance(empty, truth[:1]) < 0.3 * distance(empty, truth[11:])


def test_floor_and_evidence_and_sum() -> None:
    from elps_core.context.directional import finish

    sums, _ = group_of_lookalikes([100, 0, 1000])
    result = finish([sums], np.zeros(3, int))
    assert result.values.min() >= 0.005 / 128 * 0.999
    assert np.abs(result.values.sum(axis=(1, 2)) - 1.0).max() < 1e-5
    assert result.evidence.tolist() == [100, 0, 1000]
    assert result.irradiance[1] == 0.0


def test_nothing_at_all_gives_even_tables() -> None:
    from elps_core.context.directional import DirectionalAccumulator, even_tables, finish

    result = finish([DirectionalAccumulator(3, 8, 16)], np.array([0, 1, 1]))
    for got, expected in zip(vars(result).values(), vars(even_tables(3, 8, 16)).values(), strict=True):
        assert got.dtype == expected.dtype
        assert got == pytest.approx(expected)
    assert result.values == pytest.approx(np.full((3, 8, 16), 1.0 / 128))
    up = np.tile([0.0, 0.0, 1.0], (3, 1))
    result = finish([DirectionalAccumulator(3, 8, 16)], None, up, floor=0.0)
    assert result.values[:, :4].sum(axis=(1, 2)).min() > 0.95
    assert (result.values[:, 6:] == 0.0).all()


def test_a_region_borrows_nothing_from_below_its_surface() -> None:
    from elps_core.context.directional import finish

    sums, _ = group_of_lookalikes([40, 40, 40, 0, 0, 20000])
    down = np.float32([[0, 0, -1]])
    borrowed = finish([sums], None, np.repeat(down, 6, axis=0), blur=0.0, floor=0.005)
    assert borrowed.values[4, :3].sum() < 0.005, "of an empty region only the floor lies above"
    free = finish([sums], None, blur=0.0, floor=0.005)
    assert free.values[4, :3].sum() > 0.05
    assert borrowed.values[5] == pytest.approx(free.values[5], abs=1e-3), "measured light stays wherever it comes from"


def test_sources_count_by_their_precision() -> None:
    from elps_core.context.directional import DirectionalAccumulator, finish

    rng = np.random.default_rng(13)

    def source(n: int, z: float, spread: float) -> Any:
        weights = [rng.exponential(1.0, n) ** spread for _ in range(2)]
        direction = np.tile(np.float32([np.sqrt(1 - z * z), 0.01, z]), (n, 1))
        return accumulated([(np.zeros(n, int), direction, weight / gamma(1.0 + spread)) for weight in weights], 1)

    good, poor, empty = source(4000, 0.5, 1.0), source(40, -0.5, 3.0), DirectionalAccumulator(1, 8, 16)
    result = finish([good, poor, empty], blur=0.0, floor=0.0)
    upper = result.values[0, :4].sum()
    assert 0.9 < upper < 1.0
    assert result.evidence[0] == 2 * 4040
    alone = finish([good, empty], blur=0.0, floor=0.0)
    assert alone.values == pytest.approx(finish([good], blur=0.0, floor=0.0).values, abs=1e-5)


def test_precisions_of_sources_add_up() -> None:
    from elps_core.context.directional import _merged

    one, other = (accumulated([lit(n, seed)[0] for seed in (n, n + 1)], 4).estimate() for n in (20000, 60000))
    both = _merged([one, other])
    assert both.precision == pytest.approx(one.precision + other.precision, rel=0.05)
    assert both.irradiance == pytest.approx(np.maximum(one.irradiance, other.irradiance))
    share = (one.precision / (one.precision + other.precision))[:, None]
    shapes = [table_of(estimate) / estimate.irradiance[:, None] for estimate in (one, other, both)]
    assert shapes[2] == pytest.approx(share * shapes[0] + (1.0 - share) * shapes[1], rel=1e-4)


def test_what_does_not_belong_together_is_refused() -> None:
    from elps_core.context.directional import DirectionalAccumulator, finish

    three, four = DirectionalAccumulator(3, 8, 16), DirectionalAccumulator(4, 8, 16)
    with pytest.raises(ValueError, match="agree"):
        finish([three, four])
    with pytest.raises(ValueError, match="agree"):
        finish([three, DirectionalAccumulator(3, 16, 8)])
    with pytest.raises(ValueError, match="one parent"):
        finish([three], np.zeros(4, int))
    with pytest.raises(ValueError, match="one normal"):
        finish([three], None, np.zeros((4, 3)))


# Checkpoints


def test_sums_go_on_elsewhere() -> None:
    from elps_core.context.directional import DirectionalAccumulator

    pieces = [lit(4000, seed)[0] for seed in range(5)]
    whole = accumulated(pieces, 4)
    state = {name: array.copy() for name, array in accumulated(pieces[:3], 4).arrays().items()}
    resumed = DirectionalAccumulator.from_arrays(state)
    for array in state.values():
        array[...] = 0  # It must have copied what it adds to
    for piece in pieces[3:]:
        enter(resumed, piece)
        resumed.close_batch()
    assert resumed.batches == whole.batches
    for name, array in whole.arrays().items():
        assert resumed.arrays()[name] == pytest.approx(array, rel=1e-4), name


@pytest.mark.parametrize(
    "damage",
    [
        lambda state: state.pop("squares"),
        lambda state: state.update(sums=state["sums"][0]),
        lambda state: state.update(sums=state["sums"][:1]),
        lambda state: state.update(exposure=state["exposure"][:, :1]),
        lambda state: state.update(visits=state["visits"][:1]),
        lambda state: state.update(batches=np.zeros(0)),
    ],
)
def test_a_damaged_state_is_refused(damage: Callable[[dict[str, Array]], object]) -> None:
    from elps_core.context.directional import DirectionalAccumulator

    state = accumulated([lit(100, 1)[0]], 4).arrays()
    damage(state)
    with pytest.raises(ContextMismatch):
        DirectionalAccumulator.from_arrays(state)


def test_light_that_moves_within_a_region_has_the_root_of_its_mean_square() -> None:
    from elps_core.context.directional import finish

    cells = centres((8, 16))
    region = np.zeros(256, int)
    even = accumulated([(region, np.tile(cells, (2, 1)), np.full(256, 1.0))] * 2, 1)
    plain = finish([even], blur=0.0, floor=0.0)
    irradiance = plain.irradiance[0]
    # In two cells, one with four times the other's mean square
    share = 0.1
    squares = np.square(share * irradiance * np.array([2.0, 1.0]) / 3.0) / (4.0 * np.pi / 128)
    records = (np.zeros(2000, int), cells[np.repeat([5, 77], 1000)], np.repeat(squares / 1000, 1000))
    peaks = accumulated([records] * 2, 1, exposure=1.0)
    result = finish([even], blur=0.0, floor=0.0, peaks=peaks)
    assert result.irradiance[0] == pytest.approx(irradiance), "it is no more light than before"
    more = result.values.reshape(-1) - plain.values.reshape(-1) / (1.0 + share)
    assert more[[5, 77]] == pytest.approx(np.array([2.0, 1.0]) / 3.0 * share / (1.0 + share), rel=0.02)
    assert np.abs(np.delete(more, [5, 77])).max() < 1e-4
    bright = accumulated([(records[0], records[1], 1e6 * records[2])] * 2, 1, exposure=1.0)
    most = finish([even], blur=0.0, floor=0.0, peaks=bright).values.reshape(-1)
    assert most[[5, 77]].sum() == pytest.approx(0.5, abs=0.01), "half of a table at most"
    none = finish([even], blur=0.0, floor=0.0, peaks=accumulated([], 1))
    assert none.values == pytest.approx(plain.values)
