"""Inside a sphere of albedo rho the radiance is a partial geometric series, known for every depth."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from elps_core import device

Array = np.ndarray[Any, Any]

ROUNDING = 2e-4
"""Relative error of single precision after eight bounces: 1.3e-4 was seen, and does not shrink with samples."""
ALBEDO = 0.7


def sphere(mi: Any, light: str) -> Any:
    shape: dict[str, Any] = {
        "type": "sphere",
        "flip_normals": True,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": ALBEDO}},
    }
    scene: dict[str, Any] = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 60,
            "near_clip": 0.05,
            "to_world": mi.ScalarTransform4f().look_at([0.1, 0.2, -0.3], [0.5, 0.1, 0.6], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 16, "height": 12, "rfilter": {"type": "box"}},
        },
        "shape": shape,
    }
    if light == "point":
        scene["light"] = {"type": "point", "intensity": {"type": "rgb", "value": float(np.pi)}}
    else:
        shape["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    return mi.load_dict(scene)


def expected(light: str, depth: int) -> float:
    # The point light at the centre lights every point alike: one bounce more, no visible emission.
    return sum(ALBEDO**bounce for bounce in range(1 if light == "point" else 0, depth))


@pytest.mark.parametrize("light", ["area", "point"])
@pytest.mark.parametrize("depth", range(1, 9))
def test_radiance_in_a_sphere_is_the_partial_sum(
    mi: Any, render_bdpt: Callable[..., Array], light: str, depth: int
) -> None:
    images = render_bdpt(sphere(mi, light), images=6, spp=192, max_depth=depth)
    means = images.mean(axis=(1, 2, 3))
    exact = expected(light, depth)
    error = means.std(ddof=1) / np.sqrt(len(means))
    # Student's t with 5 degrees of freedom exceeds 6.9 with a chance of 0.1%.
    assert abs(means.mean() - exact) <= 6.9 * error + ROUNDING * exact
    assert error <= 0.002 * max(exact, 1e-6), "too noisy to find a bias of half a percent"


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"])
@pytest.mark.parametrize("light", ["area", "point"])
def test_other_variants_agree(render_bdpt: Callable[..., Array], variant: str, light: str) -> None:
    mi = device.use(variant)
    mi.set_log_level(mi.LogLevel.Error)  # The film announces that it turns monochrome.
    images = render_bdpt(sphere(mi, light), images=6, spp=512, max_depth=4)
    means = images.mean(axis=(1, 2, 3))
    error = means.std(ddof=1) / np.sqrt(len(means))
    assert abs(means.mean() - expected(light, 4)) <= 6.9 * error + ROUNDING * expected(light, 4)
    assert error <= 0.005 * expected(light, 4)


@pytest.mark.parametrize("roulette", ["none", "throughput", "albedo"])
def test_roulette_leaves_the_mean_alone(mi: Any, render_bdpt: Callable[..., Array], roulette: str) -> None:
    images = render_bdpt(sphere(mi, "area"), images=6, spp=192, max_depth=8, roulette=roulette)
    means = images.mean(axis=(1, 2, 3))
    error = means.std(ddof=1) / np.sqrt(len(means))
    assert abs(means.mean() - expected("area", 8)) <= 6.9 * error + ROUNDING * expected("area", 8)
