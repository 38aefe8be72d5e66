"""Regions: the thesis' distance, exact neighbours, k-means that never gets worse, and what it does with odd input."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from elps_core.context.regions import SIDE_BITS, Regions
from elps_core.errors import ContextMismatch

Array = np.ndarray[Any, Any]

pytestmark = pytest.mark.usefixtures("mi")


def unit(vectors: Array) -> Array:
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def thesis_distance(x: Array, n: Array, c: Array, n_c: Array, alpha: float) -> Array:
    """(5.16) as it is printed, in double precision, of every point [n] to every centre [k]."""
    x, n, c, n_c = (part.astype(np.float64) for part in (x, n, c, n_c))
    return alpha * np.linalg.norm(x[:, None] - c, axis=2) + (1.0 - n @ n_c.T)


def room(n: int, seed: int = 0, size: tuple[float, float, float] = (4.0, 6.0, 2.5)) -> tuple[Array, Array]:
    """Points [n, 3] on the walls of a box, more of them near one corner, and their inward normals."""
    rng = np.random.default_rng(seed)
    position = rng.random((n, 3)) ** 2 * size
    side = rng.integers(0, 6, n)
    rows, axis, high = np.arange(n), side // 2, side % 2
    position[rows, axis] = high * np.array(size)[axis]
    normal = np.zeros((n, 3))
    normal[rows, axis] = 1.0 - 2.0 * high
    return position.astype(np.float32), normal.astype(np.float32)


def curved(n: int, seed: int = 0) -> tuple[Array, Array]:
    """Points in a cube with normals in all directions: the hardest case for a search."""
    rng = np.random.default_rng(seed)
    return rng.random((n, 3)).astype(np.float32), unit(rng.normal(size=(n, 3)))


def test_distance_is_that_of_the_thesis() -> None:
    from elps_core.context.nearest import PointSet

    position, normal = curved(500)
    centres, normals = curved(20, seed=1)
    points = PointSet(position, normal, 3.7)
    wanted = thesis_distance(points.position, points.normal, centres, normals, 3.7)
    for k in range(20):
        index = np.full(500, k, np.uint32)
        assert points.distance(centres, normals, index) == pytest.approx(wanted[:, k], rel=1e-5, abs=1e-6)


def test_distance_of_one_pair_by_hand() -> None:
    from elps_core.context.nearest import PointSet

    # 3-4-5 triangle, normals at 60 degrees: 0.2 * 5 + (1 - 0.5).
    points = PointSet(np.array([[1, 2, 3]], np.float32), np.array([[0, 0, 1]], np.float32), 0.2)
    centre = np.array([[4, 2, 7]], np.float32), np.array([[np.sin(np.pi / 3), 0, 0.5]], np.float32)
    index, distance = points.nearest(*centre)
    assert index.tolist() == [0]
    assert distance == pytest.approx([1.5], rel=1e-6)


@pytest.mark.parametrize("alpha", [0.01, 1.0, 30.0])
@pytest.mark.parametrize("surfaces", [room, curved])
def test_nearest_is_nearest_of_all(surfaces: Any, alpha: float) -> None:
    from elps_core.context.nearest import PointSet

    position, normal = surfaces(20_000)
    centres, normals = surfaces(700, seed=1)
    points = PointSet(position, normal, alpha)
    index, distance = points.nearest(centres, normals)
    assert sorted(points.order) == list(range(20_000))
    assert np.array_equal(points.position, position[points.order])
    some = np.random.default_rng(2).choice(20_000, 1000, replace=False)
    wanted = thesis_distance(points.position[some], points.normal[some], centres, normals, alpha)
    assert distance[some] == pytest.approx(wanted.min(axis=1), rel=1e-5, abs=1e-6 * max(1.0, alpha))
    chosen = wanted[np.arange(1000), index[some]]
    assert (chosen - wanted.min(axis=1)).max() < 1e-5 * max(1.0, alpha)


def test_nearest_far_from_the_origin() -> None:
    from elps_core.context.nearest import PointSet

    position, normal = room(5000)
    centres, normals = room(100, seed=1)
    shift = np.array([8192, -8192, 4096], np.float32)
    near = PointSet(position + shift - shift, normal, 1.0)  # rounded as the far ones are
    far = PointSet(position + shift, normal, 1.0)
    centres = centres + shift - shift
    assert np.array_equal(near.nearest(centres, normals)[0], far.nearest(centres + shift, normals)[0])


def test_of_equal_centres_the_first_counts() -> None:
    from elps_core.context.nearest import PointSet

    position, normal = room(3000)
    centres, normals = room(64, seed=1)
    points = PointSet(position, normal, 1.0)
    once = points.nearest(centres, normals)[0]
    twice = points.nearest(np.repeat(centres, 3, axis=0), np.repeat(normals, 3, axis=0))[0]
    assert np.array_equal(twice, 3 * once)


def test_nearest_within_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    from elps_core.context import nearest

    position, normal = curved(10_000)
    centres, normals = curved(500, seed=1)
    points = nearest.PointSet(position, normal, 1.0)
    wanted = points.nearest(centres, normals)
    for limit in (0, 20_000):
        monkeypatch.setattr(nearest, "MAX_CANDIDATES", limit)
        for part, again in zip(wanted, points.nearest(centres, normals), strict=True):
            assert np.array_equal(part, again)


def test_without_normals_only_positions_count() -> None:
    from elps_core.context.nearest import PointSet

    position, centres = curved(5000)[0], curved(100, seed=1)[0]
    points = PointSet(position, np.zeros_like(position), 2.0)
    index, distance = points.nearest(centres, np.zeros_like(centres))
    wanted = np.linalg.norm(points.position[:, None] - centres, axis=2)
    assert distance == pytest.approx(2.0 * wanted.min(axis=1), rel=1e-5, abs=1e-6)
    assert wanted[np.arange(5000), index] == pytest.approx(wanted.min(axis=1), rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("surfaces", [room, curved])
def test_mean_distance_never_rises(surfaces: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from elps_core.context import clustering
    from elps_core.context.nearest import PointSet

    monkeypatch.setattr(clustering, "LEAST_GAIN", 0.0)
    monkeypatch.setattr(clustering, "MAX_ITERATIONS", 25)
    points = PointSet(*surfaces(10_000), 1.0)
    means = clustering.k_means(points, 200, 3)
    history = means.history
    assert len(history) > 10
    assert (np.diff(history) <= 1e-7).all()
    assert history[-1] < 0.85 * history[0]
    assert points.nearest(means.centres, means.normals)[1].mean() == pytest.approx(history[-1], rel=1e-5)
    assert np.linalg.norm(means.normals, axis=1) == pytest.approx(1.0, abs=1e-5)


def test_seeds_decide() -> None:
    from elps_core.context.clustering import build_regions

    position, normal = room(5000)
    first, again, other = (build_regions(position, normal, 100, seed).arrays() for seed in (1, 1, 2))
    assert all(np.array_equal(first[name], again[name]) for name in first)
    assert not np.array_equal(first["centres"], other["centres"])


def sparse(n: int) -> tuple[Array, Array]:
    """Most points of a room at one place: initial centres that find no points, in several iterations."""
    position, normal = room(n)
    position[n // 8 :], normal[n // 8 :] = position[0], normal[0]
    return position, normal


@pytest.mark.parametrize("surfaces", [curved, sparse])
def test_interruptions_change_nothing(surfaces: Any) -> None:
    from elps_core.context.clustering import MAX_ITERATIONS, Clustering, build_regions

    position, normal = surfaces(4000)
    wanted = build_regions(position, normal, 300, 7).arrays()
    clustering, steps = Clustering(position, normal, 300, 7), 0
    while not clustering.finished:
        with pytest.raises(RuntimeError, match="steps"):
            clustering.result()
        clustering = Clustering.from_arrays(load_tensors(save_tensors(clustering.arrays())))
        clustering.step()
        steps += 1
    assert 3 < steps <= MAX_ITERATIONS + 2
    clustering.step()  # None is left
    again = Clustering.from_arrays(load_tensors(save_tensors(clustering.arrays())))
    assert again.finished
    for regions in (clustering.result(), again.result()):
        assert all(np.array_equal(regions.arrays()[name], wanted[name]) for name in wanted)


def test_size_of_the_scene_does_not_matter() -> None:
    from elps_core.context.clustering import build_regions

    position, normal = room(5000)
    metres, large = build_regions(position, normal, 100, 1), build_regions(1024 * position, normal, 100, 1)
    assert np.array_equal(1024 * metres.centres, large.centres)
    assert np.array_equal(metres.table.cells, large.table.cells)


def test_regions_are_smaller_where_particles_are_denser() -> None:
    from elps_core.context.clustering import build_regions

    rng = np.random.default_rng(4)
    half = np.arange(20_000) < 16_000
    position = np.stack([rng.random(20_000) - half, rng.random(20_000), np.zeros(20_000)], axis=1)
    regions = build_regions(position, np.tile([0.0, 0.0, 1.0], (20_000, 1)), 400, 0)
    assert 0.7 < (regions.centres[:, 0] < 0).mean() < 0.9


def test_no_region_spans_a_thin_wall() -> None:
    from elps_core.context.clustering import build_regions
    from elps_core.context.nearest import PointSet

    rng = np.random.default_rng(5)
    behind = np.arange(8000) % 2
    position = np.stack([4 * rng.random(8000), 0.001 * behind, 3 * rng.random(8000)], axis=1).astype(np.float32)
    normal = np.zeros((8000, 3), np.float32)
    normal[:, 1] = 2 * behind - 1
    regions = build_regions(position, normal, 60, 0)
    points = PointSet(position, normal, regions.alpha)
    index, _ = points.nearest(regions.centres, regions.normals)
    assert ((points.normal * regions.normals[index]).sum(axis=1) > 0.99).all()


def test_centres_without_particles_find_some() -> None:
    from elps_core.context.clustering import build_regions

    # Nearly all initial centres fall on the one heavy point; the four light ones must still get theirs.
    places = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], np.float32)
    position = np.repeat(places, [4000, 1, 1, 1, 1], axis=0)
    normal = np.tile(np.array([0, 0, 1], np.float32), (len(position), 1))
    regions = build_regions(position, normal, 5, 0)
    assert sorted(map(tuple, regions.centres)) == sorted(map(tuple, places))


def test_fewer_particles_than_regions() -> None:
    from elps_core.context.clustering import build_regions

    position, normal = curved(7)
    regions = build_regions(np.repeat(position, 2, axis=0), np.repeat(normal, 2, axis=0), 50, 0)
    assert sorted(map(tuple, regions.centres)) == sorted(map(tuple, position))


def test_particles_at_one_point_are_one_region() -> None:
    from elps_core.context.clustering import build_regions

    regions = build_regions(np.full((1000, 3), 2.5), np.tile([0.0, 1.0, 0.0], (1000, 1)), 64, 0)
    assert regions.centres.tolist() == [[2.5, 2.5, 2.5]]
    assert regions.normals.tolist() == [[0.0, 1.0, 0.0]]
    assert not regions.table.cells.any()


@pytest.mark.parametrize("flat", [(0,), (2,), (0, 1)])
def test_flat_scenes(flat: tuple[int, ...]) -> None:
    from elps_core.context.clustering import build_regions

    position, normal = curved(5000)
    position[:, flat] = 3.0
    normal[:] = [0.0, 0.0, -1.0]
    regions = build_regions(position, normal, 50, 0)
    assert regions.count == 50
    assert regions.centres[:, flat] == pytest.approx(3.0)
    assert all(regions.table.bricks.shape[::-1][axis] == 1 for axis in flat)


def test_opposite_normals_that_cancel_keep_a_direction() -> None:
    from elps_core.context.clustering import build_regions

    position = np.zeros((100, 3))
    normal = np.tile([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], (50, 1))
    regions = build_regions(position, normal, 1, 0)
    assert np.abs(regions.normals).tolist() == [[0.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position": np.full((10, 3), np.nan)}, "finite"),
        ({"normal": np.full((10, 3), np.inf)}, "finite"),
        ({"normal": np.full((10, 3), 1.0)}, "unit length"),
        ({"position": np.zeros((9, 3))}, "arrays"),
        ({"position": np.zeros((0, 3)), "normal": np.zeros((0, 3))}, "at least one"),
        ({"position": np.zeros((10, 2)), "normal": np.zeros((10, 2))}, "arrays"),
        ({"count": 0}, "between"),
        ({"count": 1 << 17}, "between"),
        ({"seed": -1}, "seed"),
        ({"seed": 1 << 64}, "seed"),
        ({"alpha": 0.0}, "alpha"),
        ({"alpha": np.inf}, "alpha"),
    ],
)
def test_bad_input_is_refused(change: dict[str, Any], message: str) -> None:
    from elps_core.context.clustering import build_regions

    position, normal = room(10)
    with pytest.raises(ValueError, match=message):
        build_regions(**({"position": position, "normal": normal, "count": 4, "seed": 0} | change))


@pytest.fixture(scope="module")
def regions() -> Regions:
    from elps_core import device

    device.use("llvm_ad_rgb")
    from elps_core.context.clustering import build_regions

    return build_regions(*room(4000), 60, 0)


def test_groups_gather_neighbours(regions: Regions) -> None:
    from elps_core.context.clustering import groups_of

    groups = groups_of(regions, 8, 0)
    assert groups.shape == (60,)
    assert set(groups) == set(range(8))
    assert np.array_equal(groups, groups_of(regions, 8, 0))
    centre = regions.centres.astype(np.float64)
    within = np.concatenate([np.ptp(centre[groups == g], axis=0) for g in range(8)])
    assert within.mean() < 0.6 * np.ptp(centre, axis=0).mean()
    with pytest.raises(ValueError, match="positive"):
        groups_of(regions, 0, 0)


def test_arrays_and_back(regions: Regions) -> None:
    again = Regions.from_arrays(load_tensors(save_tensors(regions.arrays())))
    assert (again.count, again.alpha) == (regions.count, regions.alpha)
    assert (again.table.low, again.table.brick) == (regions.table.low, regions.table.brick)
    for name, array in regions.arrays().items():
        assert np.array_equal(again.arrays()[name], array)
        assert again.arrays()[name].dtype == array.dtype


def _with(array: Array, value: float) -> Array:
    changed = array.copy()
    changed.flat[-1] = value
    return changed


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("centres", lambda a: a[:0]),
        ("centres", lambda a: a[:-1]),
        ("centres", lambda a: _with(a, np.nan)),
        ("centres", lambda a: a.astype(np.float64)),
        ("normals", lambda a: a[:, :2]),
        ("normals", lambda a: _with(a, np.inf)),
        ("scale", lambda a: a[:4]),
        ("scale", lambda a: _with(a, np.nan)),
        ("scale", lambda a: -a),
        ("bricks", lambda a: a[:0]),
        ("bricks", lambda a: a.ravel()),
        ("bricks", lambda a: _with(a, 0)),
        ("bricks", lambda a: _with(a, (1 << 32) - 1)),
        ("bricks", lambda a: _with(a, (a.flat[-1] >> SIDE_BITS) + 1 << SIDE_BITS | a.flat[-1] & 63)),
        ("cells", lambda a: a[:5]),
        ("cells", lambda a: a[:, :-1]),
        ("cells", lambda a: _with(a, 60)),
        ("cells", lambda a: a.astype(np.uint32)),
    ],
)
def test_damaged_arrays_are_refused(regions: Regions, name: str, change: Any) -> None:
    arrays = regions.arrays()
    with pytest.raises(ContextMismatch, match="build it again"):
        Regions.from_arrays({**arrays, name: change(arrays[name])})
    with pytest.raises(ContextMismatch, match="build it again"):
        Regions.from_arrays({key: array for key, array in arrays.items() if key != name})


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("position", lambda a: a[:-1]),
        ("position", lambda a: a.astype(np.float64)),
        ("normal", lambda a: _with(a, np.nan)),
        ("normal", lambda a: 2 * a),
        ("alpha", lambda a: -a),
        ("alpha", lambda a: a[:0]),
        ("seed", lambda a: a[:0]),
        ("centres", lambda a: a[:0]),
        ("centres", lambda a: _with(a, np.inf)),
        ("centres", lambda a: a.astype(np.float64)),
        ("normals", lambda a: a[:-1]),
        ("normals", lambda a: 0 * a),
        ("history", lambda a: _with(a, np.nan)),
        ("history", lambda a: np.repeat(a, 100)),
        ("history", lambda a: a[None]),
        ("cells", lambda a: _with(a, 60)),
        ("bricks", lambda a: a[:0]),
    ],
)
def test_damaged_checkpoints_are_refused(finished: dict[str, Array], name: str, change: Any) -> None:
    from elps_core.context.clustering import Clustering

    with pytest.raises(ContextMismatch, match="again"):
        Clustering.from_arrays({**finished, name: change(finished[name])})
    if name != "cells":  # Without them the table is still to be made.
        with pytest.raises(ContextMismatch, match="again"):
            Clustering.from_arrays({key: array for key, array in finished.items() if key != name})


@pytest.fixture(scope="module")
def finished() -> dict[str, Array]:
    from elps_core import device

    device.use("llvm_ad_rgb")
    from elps_core.context.clustering import Clustering

    clustering = Clustering(*room(4000), 60, 0)
    while not clustering.finished:
        clustering.step()
    return clustering.arrays()
