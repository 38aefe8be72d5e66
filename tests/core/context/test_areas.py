"""Areas of regions: what random lines count is what geometry says, side by side and for each side apart."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

Array = np.ndarray[Any, Any]

LINES = 1 << 19
CRITICAL = 4.5
"""Standard errors that none of a few dozen correct areas exceeds but with a chance of 0.02%; seeds are fixed."""


@pytest.fixture(autouse=True)
def _variant(mi: Any) -> None:
    """What is tested is a module of kernels."""


def finder(centres: Array, normals: Array) -> Any:
    """One region around each centre, in some order; normals matter more than distances do."""
    from elps_core.context.clustering import build_regions
    from elps_core.context.lookup import RegionLookup

    regions = build_regions(centres, normals, len(centres), seed=0, alpha=0.1)
    assert regions.count == len(centres)
    return RegionLookup(regions)


def strewn(count: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(count, 3))
    return rng.uniform(-1.0, 1.0, (count, 3)), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def measured(scene: Any, directions: Any, count: int, lines: int = LINES) -> tuple[Array, Array]:
    """Areas and their standard errors."""
    from elps_core.context.areas import region_areas

    areas = region_areas(scene, directions, count, lines, (3,))
    sphere = scene.bbox().bounding_sphere()
    each = 4.0 * np.pi * float(sphere.radius) ** 2 / lines
    # Of independent crossings; a convex body's are fewer than that by chance of being met at all.
    return areas, np.sqrt(np.maximum(areas / each, 1.0)) * each


def check(areas: Array, exact: Array, error: Array) -> None:
    assert (np.abs(areas - exact) <= CRITICAL * error).all(), ((areas - exact) / error).round(1)
    assert np.median(error / exact) < 0.01, "too noisy to find a wrong factor for a part of the surfaces"


def test_sides_of_a_box(mi: Any) -> None:
    """A cube of edge 2: inside and outside of each face are regions of 4 each."""
    scene = mi.load_dict({"type": "scene", "box": {"type": "cube"}})
    faces = np.repeat(np.concatenate([np.eye(3), -np.eye(3)]), 2, axis=0)
    sides = faces * np.tile([[1.0], [-1.0]], (6, 1))
    areas, error = measured(scene, finder(faces, sides), 12)
    check(areas, np.full(12, 4.0), error)


def test_parts_of_a_sphere(mi: Any) -> None:
    """Against points that are uniform on the sphere, from its inside and from its outside."""
    import drjit as dr

    from elps_core.paths.stream import Stream

    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "center": [1, 2, 3], "radius": 2.0}})
    centres, normals = strewn(24)
    directions = finder(centres * 2.0 + [1.0, 2.0, 3.0], normals)
    areas, error = measured(scene, directions, 24)
    points = 1 << 20
    normal = mi.warp.square_to_uniform_sphere(Stream.of(points, 5).next_2d())
    exact, spread = np.zeros(24), np.zeros(24)
    for sign in (-1.0, 1.0):
        found = directions(mi.Point3f(1, 2, 3) + 2.0 * normal, sign * normal, dr.full(mi.Bool, True, points))
        share = np.bincount(np.array(found), minlength=24) / points
        exact += 16.0 * np.pi * share
        spread += (16.0 * np.pi) ** 2 * share / points
    some = exact > 0.0
    assert some.sum() > 12
    assert (areas[~some] == 0.0).all()
    check(areas[some], exact[some], np.hypot(error, np.sqrt(spread))[some])


def test_both_sides_of_a_thin_sheet_count_apart(mi: Any) -> None:
    turned = mi.ScalarTransform4f().rotate([0.6, 0.0, 0.8], 40)
    sheet = {"type": "rectangle", "to_world": turned @ mi.ScalarTransform4f().scale([3.0, 0.5, 1.0])}
    scene = mi.load_dict({"type": "scene", "sheet": sheet})
    normal = np.array(turned.matrix)[:3, 2]
    directions = finder(np.zeros((2, 3)), np.stack([normal, -normal]))
    areas, error = measured(scene, directions, 2)
    check(areas, np.full(2, 6.0), error)


def test_instances_count_where_they_stand_and_as_large_as_they_are(mi: Any) -> None:
    """Three copies of a ball, of one, two and four times its area."""
    place = mi.ScalarTransform4f
    scales = [1.0, 2.0**0.5, 2.0]
    instances = {
        f"copy{k}": {
            "type": "instance",
            "to_world": place().translate([4.0 * k, 0, 0]) @ place().scale(scales[k]),
            "shapes": {"type": "ref", "id": "group"},
        }
        for k in range(3)
    }
    group = {"type": "shapegroup", "id": "group", "ball": {"type": "sphere", "radius": 0.5}}
    scene = mi.load_dict({"type": "scene", "group": group, **instances})
    # Regions by place alone: each axis has both normals at each copy.
    sides = np.concatenate([np.eye(3), -np.eye(3)])
    centres = np.repeat(np.array([[0.0, 0, 0], [4, 0, 0], [8, 0, 0]]), 6, axis=0)
    directions = finder(centres, np.tile(sides, (3, 1)))
    areas, error = measured(scene, directions, 18, 2 * LINES)
    copy = np.array(directions(mi.Point3f(centres.T), mi.Vector3f(np.tile(sides, (3, 1)).T)))
    both_sides = 2.0 * np.pi * np.array([1.0, 2.0, 4.0])
    check(areas[copy].reshape(3, 6).sum(axis=1), both_sides, np.hypot.reduce(error[copy].reshape(3, 6), axis=1))


def test_lines_pass_what_is_behind(mi: Any) -> None:
    """Ten sheets in a row, one region all: a line that stopped at the first would find one."""
    sheets = {
        f"sheet{k}": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 0.1 * k])}
        for k in range(10)
    }
    scene = mi.load_dict({"type": "scene", **sheets})
    directions = finder(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))
    areas, error = measured(scene, directions, 1)
    # A line through all of them is counted ten times over.
    check(areas, np.full(1, 80.0), np.sqrt(10.0) * error)
