"""Start densities: exact probabilities, inverses, and densities that fit what is drawn."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

Array = np.ndarray[Any, Any]


@pytest.fixture
def emission(mi: Any, shape_lights: Any) -> Any:
    from elps_core.scene.emission import Emission

    return Emission(shape_lights)


@pytest.fixture
def shape_lights(mi: Any) -> Any:
    """One area light on every shape that may carry one, each turned, moved and scaled."""
    place = mi.ScalarTransform4f
    area = {"type": "area", "radiance": {"type": "rgb", "value": 2.0}}
    turn = place().rotate([0.6, 0.0, 0.8], 33)
    mesh = mi.load_dict({"type": "cube", "to_world": place().translate([9, 0, 0]) @ turn, "emitter": area})
    return mi.load_dict(
        {
            "type": "scene",
            "rectangle": {"type": "rectangle", "to_world": turn @ place().scale([2, 0.5, 1]), "emitter": area},
            "sphere": {"type": "sphere", "center": [3, 1, 0], "radius": 0.7, "emitter": area},
            "turned": {
                "type": "sphere",
                "to_world": place().translate([-4, 0, 0]) @ turn @ place().scale(1.3),
                "emitter": area,
            },
            "disk": {
                "type": "disk",
                "to_world": place().translate([0, 4, 0]) @ turn @ place().scale(1.7),
                "emitter": area,
            },
            "cylinder": {"type": "cylinder", "p0": [0, -4, 0], "p1": [1, -5, 1], "radius": 0.3, "emitter": area},
            "mesh": mesh,
        }
    )


def test_inverse_undoes_f_on_every_shape(mi: Any, shape_lights: Any, emission: Any) -> None:
    import drjit as dr

    n = 20000
    rng = np.random.default_rng(1)
    u = mi.Point2f(rng.random(n, np.float32), rng.random(n, np.float32))
    index = dr.arange(mi.UInt32, n) % emission.count
    point = emission.point(index, u, mi.Color0f(), True)
    # Meet the point by a ray, as an eye path does, so that primitive index and uv are the ray's own.
    ray = mi.Ray3f(point.si.p + 0.05 * point.si.n, -point.si.n)
    si = shape_lights.ray_intersect(ray)
    assert bool(dr.all(si.is_valid()))
    hit = emission.index_of(si.emitter(shape_lights), True)
    assert bool(dr.all(hit == index))
    back = emission.inverse(index, si, True)
    distance = np.abs(np.array(back) - np.array(u)).max(axis=0)
    # Cylinders and spheres wrap around: 0 and 1 are one point of theirs.
    distance = np.minimum(distance, 1.0 - distance)
    assert np.quantile(distance, 0.999) < 2e-3
    assert np.median(distance) < 1e-5


def test_cells_are_drawn_with_their_probability(mi: Any, emission: Any) -> None:
    import drjit as dr

    from elps_core.paths.stream import Stream
    from elps_core.sampling.start import StartDensity

    rng = np.random.default_rng(2)
    table = rng.random((5, emission.count * 3)) ** 4
    table[:, 2] = 0.0
    density = StartDensity(emission, table)
    assert density.probability.sum() == pytest.approx(1.0, abs=1e-12)
    assert (density.probability > 0.0).all()
    n = 1 << 20
    stream = Stream.of(n, 3)
    start = density.sample(stream.next_2d(), stream.next_2d(), mi.Color0f(), dr.full(mi.Bool, True, n))
    counts = np.bincount(np.array(start.cell), minlength=table.size)
    wanted = density.probability.ravel() * n
    frequent = wanted >= 5
    p = stats.chisquare(
        [*counts[frequent], counts[~frequent].sum()], [*wanted[frequent], max(wanted[~frequent].sum(), 1e-9)]
    ).pvalue
    assert p > 1e-3


def test_density_of_a_point_is_that_of_drawing_it(mi: Any, shape_lights: Any, emission: Any) -> None:
    import drjit as dr

    from elps_core.paths.stream import Stream
    from elps_core.sampling.start import StartDensity

    table = np.random.default_rng(3).random((7, emission.count * 2)) + 0.01
    density = StartDensity(emission, table)
    n = 1 << 16
    stream = Stream.of(n, 4)
    start = density.sample(stream.next_2d(), stream.next_2d(), mi.Color0f(), dr.full(mi.Bool, True, n))
    si = shape_lights.ray_intersect(mi.Ray3f(start.point.si.p + 0.05 * start.point.si.n, -start.point.si.n))
    pdf, index, _ = density.pdf(si.emitter(shape_lights), si, dr.full(mi.Bool, True, n))
    same = np.isclose(np.array(pdf), np.array(start.pdf), rtol=1e-4)
    assert same.mean() > 0.998, "only points on the edges of cells may fall into the neighbour"
    # Density integrates to one: the mean of 1 / p over samples is the total area.
    total = float(sum(float(np.array(s.surface_area()).ravel()[0]) for s in shape_lights.shapes() if s.is_emitter()))
    inverse = 1.0 / np.array(start.pdf, np.float64)
    assert abs(inverse.mean() - total) < 4.0 * inverse.std() / np.sqrt(n)
    assert bool(dr.all(index == start.point.index))


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0, 1e6, allow_nan=False), min_size=1, max_size=300))
def test_quantized_probabilities_are_whole_steps(weights: list[float]) -> None:
    from elps_core.sampling.inversion import RESOLUTION, quantized

    steps = quantized(np.array(weights))
    assert steps.sum() == RESOLUTION
    assert (steps >= 1).all()
    if sum(weights) > 0:
        share = np.array(weights) / sum(weights)
        assert np.abs(steps / RESOLUTION - share).max() <= (len(weights) + 2) / RESOLUTION


def test_power_follows_radiance_and_area(mi: Any) -> None:
    from elps_core.scene.emission import Emission

    place = mi.ScalarTransform4f
    lights = {
        "type": "scene",
        "a": {"type": "rectangle", "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}},
        "b": {
            "type": "rectangle",
            "to_world": place().translate([5, 0, 0]) @ place().scale(2),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 3.0}},
        },
        "c": {"type": "point", "position": [0, 9, 0], "intensity": {"type": "rgb", "value": 1.0}},
    }
    power = sorted(Emission(mi.load_dict(lights)).power)
    assert power == pytest.approx(sorted([4 * np.pi, 4 * np.pi, 16 * 3 * np.pi]), rel=1e-3)


def test_order_of_emitters_is_that_of_their_geometry(mi: Any) -> None:
    from elps_core.scene.emission import Emission

    def scene(order: list[int]) -> Any:
        area = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
        place = mi.ScalarTransform4f
        shapes = {
            f"s{k}": {"type": "rectangle", "to_world": place().translate([3 * k, 0, 0]), "emitter": area} for k in order
        }
        return mi.load_dict({"type": "scene", **shapes})

    assert np.array_equal(Emission(scene([0, 1, 2, 3])).keys, Emission(scene([2, 0, 3, 1])).keys)
