"""Importance that counts more in one half of the film: importons say from which half they come, photons do not ask."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.core.particles.conftest import SAMPLERS, check, sampler, totals
from tests.core.particles.test_contract import ALBEDO, DEPTH, IMPORTON, PHOTON, RUNS, by_depth
from tests.zoo.stage import SIZE, area, camera, rgb

Array = np.ndarray[Any, Any]

LEFT, RIGHT = 1.0, 0.25
"""What importance counts in the halves of the film."""


def wide_sphere(mi: Any) -> Any:
    """A glowing sphere seen from inside, at so wide an angle that light walks join the sensor as often as not."""
    shape = {
        "type": "sphere",
        "flip_normals": True,
        "bsdf": {"type": "diffuse", "reflectance": rgb(ALBEDO)},
        "emitter": area(1.0),
    }
    sensor = camera(mi, (0.1, 0.2, -0.3), (0.5, 0.1, 0.6), fov=140.0)
    return mi.load_dict({"type": "scene", "sensor": sensor, "shape": shape})


def to_the_left(mi: Any, scene: Any) -> tuple[Array, Array]:
    """A point of the plane that halves the camera's view, and its normal: to that side lies what is on the left."""
    rays = [scene.sensors()[0].sample_ray(0.0, 0.5, mi.Point2f(x, 0.5), mi.Point2f(0.5))[0] for x in (0.0, 0.5, 1.0)]
    return np.array(rays[1].o).ravel(), np.array(rays[0].d - rays[2].d).ravel()


@pytest.mark.parametrize("kind", SAMPLERS)
def test_importance_counts_by_where_on_the_film_it_comes_from(mi: Any, kind: str) -> None:
    import drjit as dr

    scene = wide_sphere(mi)
    origin, across = to_the_left(mi, scene)

    def worth(position: Any) -> Any:
        return dr.select(position.x < SIZE[0] / 2, mi.Float(LEFT), mi.Float(RIGHT))

    def measure(arrays: Any) -> Array:
        everywhere = np.ones(len(arrays.weight), bool)
        left = (arrays.position - origin) @ across > 0.0
        seen = by_depth(arrays, IMPORTON, left, ~left, depth=1)
        sums = [by_depth(arrays, of, everywhere) for of in (IMPORTON, PHOTON)]
        return np.concatenate([part.ravel() for part in (seen, *sums)])

    bounces = ALBEDO ** np.arange(DEPTH)
    halves = np.array([LEFT, RIGHT]) / 2.0
    expected = np.concatenate([halves, halves.sum() * bounces, 4.0 * np.pi**2 * bounces])
    found = totals(sampler(kind, scene, max_depth=DEPTH, worth=worth), measure, runs=RUNS)
    varying = found.std(axis=0) > 1e-5 * expected
    assert np.allclose(found[:, ~varying], expected[~varying], rtol=1e-4)
    check(found[:, varying], expected[varying], bound=0.05)
