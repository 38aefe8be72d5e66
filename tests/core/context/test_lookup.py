"""The table of regions: exact at the middles of its cells, near everywhere else, in range whatever is asked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elps_core import device
from elps_core.context.regions import BINS, SIDE_BITS, Regions, Table
from elps_core.scene.generate import door, maze, write
from elps_core.scene.loader import load_scene
from tests.core.context.test_regions import room, thesis_distance

Array = np.ndarray[Any, Any]

AXES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float32)
"""Directions of the bins."""


def surface_points(scene: Any, n: int, seed: int, bounces: int = 3) -> tuple[Array, Array]:
    """Points [n, 3] where random walks from the camera and from the lights meet a scene, and normals towards them."""
    import drjit as dr
    import mitsuba as mi

    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, n // bounces)
    camera, _ = scene.sensors()[0].sample_ray(0.0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d())
    light, _, _ = scene.sample_emitter_ray(0.0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d(), True)
    found: list[tuple[Array, Array]] = []
    for ray in (camera, light):
        ray, active = mi.Ray3f(ray.o, ray.d), mi.Bool(True)
        for _ in range(bounces):
            si = scene.ray_intersect(ray, active)
            active = si.is_valid()
            normal = dr.select(dr.dot(si.sh_frame.n, ray.d) > 0.0, -si.sh_frame.n, si.sh_frame.n)
            hit = np.array(active)
            found.append((np.array(si.p).T[hit], np.array(normal).T[hit]))
            direction = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
            ray = si.spawn_ray(direction)
    position, normals = (np.concatenate(part) for part in zip(*found, strict=True))
    chosen = np.random.default_rng(seed).permutation(len(position))[:n]
    return position[chosen], normals[chosen]


def plain_with_a_house(n: int, seed: int) -> tuple[Array, Array]:
    """A room of a few metres, and a tenth of the particles on the ground around it, up to 500 m away."""
    position, normal = room(n, seed)
    rng = np.random.default_rng(seed)
    outside = rng.choice(n, n // 10, replace=False)
    distance, angle = 8.0 * (500.0 / 8.0) ** rng.random(len(outside)), 2.0 * np.pi * rng.random(len(outside))
    position[outside] = np.stack([distance * np.cos(angle), distance * np.sin(angle), np.zeros_like(angle)], axis=1)
    normal[outside] = [0.0, 0.0, 1.0]
    return position, normal


def find(regions: Regions, position: Array, normal: Array, active: bool = True) -> Array:
    import mitsuba as mi

    from elps_core.context.lookup import RegionLookup

    found = RegionLookup(regions)(mi.Point3f(position.T), mi.Normal3f(normal.T), mi.Bool(active))
    return np.array(found)


def middles(table: Table) -> tuple[Array, Array]:
    """Middle of every voxel [voxels, 3] in the table's order, and the side of each."""
    place, side = [], []
    for z, y, x in np.ndindex(table.bricks.shape):
        n = int(table.bricks[z, y, x]) & (1 << SIDE_BITS) - 1
        assert int(table.bricks[z, y, x]) >> SIDE_BITS == sum(map(len, place)), "bricks follow one another"
        w, v, u = np.unravel_index(np.arange(n**3), (n, n, n))
        inside = (np.stack([u, v, w], axis=1) + 0.5) / n
        place.append(np.array(table.low) + table.brick * (np.array([x, y, z]) + inside))
        side.append(np.full(n**3, table.brick / n))
    return np.concatenate(place).astype(np.float32), np.concatenate(side)


@pytest.fixture(scope="module")
def walls() -> Regions:
    device.use("llvm_ad_rgb")
    from elps_core.context.clustering import build_regions

    return build_regions(*room(20_000), 300, 0)


def test_exact_at_the_middles_of_cells(walls: Regions) -> None:
    from elps_core.context.lookup import VOXELS_PER_REGION

    place, _ = middles(walls.table)
    assert walls.table.cells.shape == (BINS, len(place))
    assert 0.8 * VOXELS_PER_REGION * walls.count < len(place) <= VOXELS_PER_REGION * walls.count
    some = np.random.default_rng(1).choice(len(place), 3000, replace=False)
    for number, axis in enumerate(AXES):
        normal = np.tile(axis, (3000, 1))
        found = find(walls, place[some], normal)
        assert np.array_equal(found, walls.table.cells[number, some])
        distance = thesis_distance(place[some], normal, walls.centres, walls.normals, walls.alpha)
        assert (distance[np.arange(3000), found] - distance.min(axis=1)).max() < 1e-5


def test_all_of_a_cell_is_one_region(walls: Regions) -> None:
    place, side = middles(walls.table)
    rng = np.random.default_rng(2)
    some = rng.choice(len(place), 20_000)
    inside = place[some] + ((rng.random((20_000, 3)) - 0.5) * (0.99 * side[some])[:, None]).astype(np.float32)
    number = rng.integers(0, BINS, 20_000)
    tilt = AXES[number] + 0.57 * (2.0 * rng.random((20_000, 3)) - 1.0) * (AXES[number] == 0)
    normal = (tilt / np.linalg.norm(tilt, axis=1, keepdims=True)).astype(np.float32)
    assert np.array_equal(find(walls, inside, normal), walls.table.cells[number, some])


def test_outside_takes_what_is_next_to_it(walls: Regions) -> None:
    table = walls.table
    low = np.array(table.low)
    high = low + table.brick * np.array(table.bricks.shape[::-1])
    rng = np.random.default_rng(3)
    outside = (low + (high - low) * (5.0 * rng.random((5000, 3)) - 2.0)).astype(np.float32)
    edge = 1e-4 * table.brick
    normal = AXES[rng.integers(0, BINS, 5000)]
    inside = np.clip(outside, low + edge, high - edge).astype(np.float32)
    assert (outside != inside).any(axis=1).mean() > 0.9
    assert np.array_equal(find(walls, outside, normal), find(walls, inside, normal))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38, -3e38])
def test_nothing_leads_out_of_the_table(walls: Regions, value: float) -> None:
    position, normal = room(600)
    for axis in range(3):
        bad = position.copy()
        bad[:, axis] = value
        assert (find(walls, bad, normal) < walls.count).all()
        turned = normal.copy()
        turned[:, axis] = value
        assert (find(walls, position, turned) < walls.count).all()


def test_inactive_lanes_ask_for_nothing(walls: Regions) -> None:
    assert not find(walls, *room(100), active=False).any()


@pytest.mark.parametrize(
    ("name", "differ", "excess", "lost"),
    [("maze", 0.15, 0.08, 0.02), ("door", 0.15, 0.08, 0.02), ("plain with a house", 0.35, 0.15, 0.2)],
)
def test_error_on_surfaces(name: str, differ: float, excess: float, lost: float, tmp_path: Path) -> None:
    """Few points get another than the nearest region, and those that do get one that is hardly farther."""
    device.use("llvm_ad_rgb")
    from elps_core.context.clustering import build_regions
    from elps_core.context.nearest import PointSet

    if name == "plain with a house":
        particles, asked = plain_with_a_house(60_000, 1), plain_with_a_house(60_000, 2)
    else:
        write({"maze": maze, "door": door}[name](), tmp_path / "scene.zip")
        scene = load_scene(tmp_path / "scene.zip", "llvm_ad_rgb", size=(64, 64)).scene
        particles, asked = surface_points(scene, 60_000, 1), surface_points(scene, 60_000, 2)
    regions = build_regions(*particles, 2048, 0)
    points = PointSet(*asked, regions.alpha)
    nearest, least = points.nearest(regions.centres, regions.normals)
    found = find(regions, points.position, points.normal)
    distance = points.distance(regions.centres, regions.normals, found)
    assert (found != nearest).mean() < differ
    assert (distance - least).min() > -1e-5
    assert (distance - least).mean() < excess * least.mean()
    assert ((points.normal * regions.normals[found]).sum(axis=1) > 0.0).mean() > 0.999, "regions face the same way"
    assert len(np.unique(found)) > (1.0 - lost) * regions.count, "few regions are lost between voxels"


def test_without_narrower_bricks_a_plain_would_lose_the_house(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reason for bricks: with equal voxels the same memory finds few of the regions."""
    device.use("llvm_ad_rgb")
    from elps_core.context import lookup
    from elps_core.context.clustering import build_regions

    particles, asked = plain_with_a_house(30_000, 1), plain_with_a_house(30_000, 2)
    found = []
    for voxels_per_brick in (lookup.VOXELS_PER_BRICK, lookup.LEAST_SIDE**3):
        monkeypatch.setattr(lookup, "VOXELS_PER_BRICK", voxels_per_brick)
        regions = build_regions(*particles, 600, 0)
        found.append(len(np.unique(find(regions, *asked))))
    assert found[1] < 0.5 * found[0]


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    from elps_core.context import lookup
    from elps_core.context.clustering import build_regions

    monkeypatch.setattr(lookup, "VOXELS", 3000)
    for particles in (room(5000), plain_with_a_house(5000, 1)):
        table = build_regions(*particles, 500, 0).table
        assert 1500 < table.cells.shape[1] <= 3000
        assert table.bricks.size <= 3000 // lookup.VOXELS_PER_BRICK
