"""Metropolis particles lie where paths that matter pass [thesis (5.14)]."""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.core.particles.conftest import check, sampler, totals
from tests.zoo.stage import area, camera, diffuse, rgb

Array = np.ndarray[Any, Any]

DEPTH = 3
BINS = 8
RUNS = 8
PHOTON, IMPORTON = 0, 1
ITERATIONS = 10
"""Mutations of a chain: it starts with the right density, and has to keep it."""


def box(mi: Any) -> Any:
    """A closed box with a lamp under one half of the ceiling, a block, and a camera that looks at the other half."""
    place = mi.ScalarTransform4f
    lamp = place().translate([0.5, 0.99, 0.0]) @ place().rotate([1, 0, 0], 90) @ place().scale([0.5, 0.9, 1.0])
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": camera(mi, (0.8, 0.5, 0.7), (-0.6, -0.6, -0.3), fov=60.0),
            "box": {"type": "cube", "flip_normals": True, "bsdf": {"type": "diffuse", "reflectance": rgb(0.7)}},
            "block": {
                "type": "cube",
                "to_world": place().translate([-0.3, -0.6, -0.2]) @ place().scale([0.25, 0.4, 0.3]),
                "bsdf": diffuse(0.3),
            },
            "lamp": {"type": "rectangle", "to_world": lamp, "bsdf": diffuse(0.5), "emitter": area(4.0)},
        }
    )


def where(position: Array, direction: Array) -> Array:
    """A bin of position and direction, 0 to 7."""
    return (position[:, :2] > [0.0, -0.5]) @ [1, 2] + 4 * (direction[:, 1] > 0.0)


def eye_paths(mi: Any, scene: Any, count: int) -> tuple[list[Array], list[Array], list[Array], Array]:
    """Paths that meet the lamp by chance: vertices, directions on and back from there, L_e times beta by length."""
    random = mi.PCG32(count, initstate=11)
    next_2d = lambda: mi.Point2f(random.next_float32(), random.next_float32())  # noqa: E731
    ray, beta = scene.sensors()[0].sample_ray(0.0, 0.5, next_2d(), next_2d())
    places, onward, back, light = [], [], [], []
    for _ in range(DEPTH):
        si = scene.ray_intersect(ray)
        light.append(np.array(mi.luminance(beta * si.emitter(scene).eval(si))))
        sample, weight = si.bsdf().sample(mi.BSDFContext(), si, random.next_float32(), next_2d())
        places.append(np.array(si.p).T)
        back.append(np.array(-ray.d).T)
        ray = si.spawn_ray(si.to_world(sample.wo))
        onward.append(np.array(ray.d).T)
        beta = beta * weight
    return places, onward, back, np.array(light)


def test_particles_follow_radiance_times_importance(mi: Any) -> None:
    """Counts by kind, depth, place and direction, against f summed over eye paths that meet the lamp by chance."""
    from elps_core.integrators.metropolis import shares

    scene = box(mi)
    metropolis = sampler("metropolis", scene, max_depth=DEPTH, effort=0.5, iterations=ITERATIONS, uniform=False)
    visits = shares(metropolis.pilot()[0], metropolis.chains) * metropolis.iterations

    def measure(arrays: Any) -> Array:
        bins = where(arrays.position, arrays.direction)
        chosen = [(arrays.kind == kind) & (arrays.depth == depth) for kind in (PHOTON, IMPORTON) for depth in (1, 2)]
        return np.array([np.bincount(bins[of], minlength=BINS) for of in chosen], float)

    found = totals(metropolis, measure, runs=RUNS)
    # A state of k segments gives one photon of each depth below k and one importon of each up to k; all have light.
    assert (found.sum(axis=2) == [visits.sum(), visits[1], visits.sum(), visits.sum()]).all()

    places, onward, back, light = eye_paths(mi, scene, 1 << 20)
    to_light, to_sensor = ([where(place, d) for place, d in zip(places, ways, strict=True)] for ways in (onward, back))
    two, three = (light[k - 1] / light[k - 1].sum() * visits[k - 2] for k in (2, 3))
    # z_i of a path of k segments is the eye's vertex k - i, here from 0 on.
    parts = [
        [(to_light[0], two), (to_light[1], three)],
        [(to_light[0], three)],
        [(to_sensor[0], two), (to_sensor[0], three)],
        [(to_sensor[1], two), (to_sensor[1], three)],
    ]
    expected = np.array([sum(np.bincount(b, w, BINS) for b, w in part) for part in parts])
    error = np.array([np.sqrt(sum(np.bincount(b, w**2, BINS) for b, w in part)) for part in parts])
    # Bins that are hardly ever met have no distribution to speak of.
    often = expected > 0.02 * expected.sum(axis=1, keepdims=True)
    check(found[:, often], expected[often], error[often], bound=0.2)
