"""Inside a sphere of albedo rho the radiance is a partial geometric series, known for every depth.

Any two points of a sphere see each other under the same geometry factor, so that joined paths have no noise
but that of their weights: errors of a few parts in a thousand show in seconds.
"""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pytest

from elps_core import device
from elps_core.settings import HeuristicKind
from tests.rendering import render

Array = np.ndarray[Any, Any]

ROUNDING = 2e-4
"""Relative error of single precision after eight bounces: 1.3e-4 was seen, and does not shrink with samples."""
ALBEDO = 0.7
IMAGES = 16
CRITICAL = 5.3
"""Student's t with 15 degrees of freedom exceeds it with a chance of 0.01%."""
BOUND = 0.01
"""Relative bias that a test must be able to find."""
DEPTH = 5
PAIRS = [(s, t) for s in range(DEPTH + 2) for t in range(1, DEPTH + 2) if 3 <= s + t <= DEPTH + 1]
"""Strategies (s, t) of paths with one bounce to :data:`DEPTH` - 1."""


def sphere(mi: Any, light: str, lens: float = 0.0, albedo: float = ALBEDO) -> Any:
    """A camera inside a sphere that glows, or has a point light at its centre; ``lens`` is the aperture's radius."""
    shape: dict[str, Any] = {
        "type": "sphere",
        "flip_normals": True,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}},
    }
    sensor: dict[str, Any] = {
        "type": "perspective",
        "fov": 60,
        "near_clip": 0.05,
        "to_world": mi.ScalarTransform4f().look_at([0.1, 0.2, -0.3], [0.5, 0.1, 0.6], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 16, "height": 12, "rfilter": {"type": "box"}},
    }
    if lens:
        sensor |= {"type": "thinlens", "aperture_radius": lens, "focus_distance": 0.8}
    scene: dict[str, Any] = {"type": "scene", "sensor": sensor, "shape": shape}
    if light == "point":
        scene["light"] = {"type": "point", "intensity": {"type": "rgb", "value": float(np.pi)}}
    else:
        shape["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    return mi.load_dict(scene)


def of_length(light: str, segments: int) -> float:
    """Radiance by paths of a number of segments."""
    # The point light at the centre lights every point alike: no visible emission.
    return 0.0 if light == "point" and segments == 1 else ALBEDO ** (segments - 1)


def up_to(light: str, depth: int) -> float:
    """Radiance by all paths of at most ``depth`` segments."""
    return sum(of_length(light, segments) for segments in range(1, depth + 1))


def check(images: Array, exact: float, bound: float = BOUND) -> None:
    """The mean over independent images is ``exact``, and known well enough to tell."""
    means = images.mean(axis=(1, 2, 3))
    error = float(means.std(ddof=1)) / np.sqrt(len(means))
    assert abs(means.mean() - exact) <= CRITICAL * error + ROUNDING * exact, (means.mean() / exact, error / exact)
    assert CRITICAL * error <= bound * exact, f"finds no bias below {CRITICAL * error / exact:.2%}"


@pytest.mark.parametrize("light", ["area", "point"])
@pytest.mark.parametrize("depth", range(1, 9))
def test_bdpt_at_every_depth(mi: Any, light: str, depth: int) -> None:
    images = render(sphere(mi, light), "bdpt", images=IMAGES, spp=96, max_depth=depth)
    check(images, up_to(light, depth))


OTHERS = [
    *[
        (algorithm, light, depth)
        for algorithm in ("path", "light")
        for light in ("area", "point")
        for depth in (1, 2, 3, 8)
    ],
    # A chain's kernels take longest to build.
    *[("pssmlt", "area", 1), ("pssmlt", "point", 8)],
]


@pytest.mark.parametrize(("algorithm", "light", "depth"), OTHERS)
def test_the_others_at_the_depths_that_differ(mi: Any, algorithm: str, light: str, depth: int) -> None:
    images = render(sphere(mi, light), algorithm, images=IMAGES, spp=288, max_depth=depth)
    check(images, up_to(light, depth), bound=0.02)


def test_chance_alone(mi: Any) -> None:
    """Paths that meet the light, and light paths that meet the lens."""
    check(render(sphere(mi, "area"), "path pure", images=IMAGES, spp=96, max_depth=4), up_to("area", 4))
    images = render(sphere(mi, "area", lens=0.25), "light pure", images=IMAGES, spp=1024, max_depth=4)
    check(images, up_to("area", 4), bound=0.05)


@pytest.mark.parametrize("light", ["area", "point"])
def test_every_strategy_alone_is_the_whole_of_its_paths(mi: Any, light: str) -> None:
    """Unweighted, (s, t) carries all light of s + t - 1 segments; without extent, a light is not met by chance."""
    scene = sphere(mi, light)
    for s, t in PAIRS:
        one = {"bdpt__strategies": f"{s},{t}", "bdpt__weighted": False, "roulette": "none"}
        # Light paths fall on other pixels than those of their lane; the rest has hardly any noise.
        images = render(scene, "bdpt", images=IMAGES, spp=384 if t == 1 else 32, max_depth=DEPTH, **one)
        if s == 0 and light == "point":
            assert images.max() == 0.0
        else:
            check(images, of_length(light, s + t - 1), bound=0.05)


def test_every_strategy_that_meets_the_lens(mi: Any) -> None:
    scene = sphere(mi, "area", lens=0.25)
    for s in (3, DEPTH + 1):
        one = {"bdpt__strategies": f"{s},0", "bdpt__weighted": False, "roulette": "none"}
        images = render(scene, "bdpt", images=IMAGES, spp=768, max_depth=DEPTH, **one)
        check(images, of_length("area", s - 1), bound=0.1)


@pytest.mark.parametrize("heuristic", get_args(HeuristicKind))
@pytest.mark.parametrize("lens", [0.0, 0.25], ids=["pinhole", "lens"])
def test_weights_of_all_strategies_sum_to_one(mi: Any, heuristic: str, lens: float) -> None:
    """For each length apart: an excess of one would else hide what another lacks."""
    scene = sphere(mi, "area", lens)
    for segments in range(2, DEPTH + 1):
        pairs = " ".join(f"{s},{segments + 1 - s}" for s in range(segments + 1 + bool(lens)))
        options = {"bdpt__strategies": pairs, "heuristic": heuristic}
        images = render(scene, "bdpt", images=IMAGES, spp=64, max_depth=DEPTH, **options)
        check(images, of_length("area", segments), bound=0.02)


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"])
@pytest.mark.parametrize("light", ["area", "point"])
def test_other_variants_agree(variant: str, light: str) -> None:
    mi = device.use(variant)
    mi.set_log_level(mi.LogLevel.Error)  # The film announces that it turns monochrome.
    # Five samples a lane, and in the last turn some lanes have none.
    images = render(sphere(mi, light), "bdpt", images=IMAGES, spp=171, max_depth=4)
    check(images, up_to(light, 4), bound=0.03)


@pytest.mark.parametrize("roulette", ["none", "throughput", "albedo"])
def test_roulette_leaves_the_mean_alone(mi: Any, roulette: str) -> None:
    images = render(sphere(mi, "area"), "bdpt", images=IMAGES, spp=96, max_depth=8, roulette=roulette)
    check(images, up_to("area", 8))


BRIGHT = 0.95
"""Albedo of which a series of 16 terms has little more than half."""


@pytest.mark.parametrize(
    ("algorithm", "options"),
    [("path", {}), ("path", {"roulette": "throughput"}), ("light", {}), ("bdpt", {"bdpt__joins": False})],
    ids=["path", "path by throughput", "light", "unjoined"],
)
def test_paths_without_a_greatest_depth(mi: Any, algorithm: str, options: dict[str, Any]) -> None:
    images = render(sphere(mi, "area", albedo=BRIGHT), algorithm, images=IMAGES, spp=256, max_depth=-1, **options)
    check(images, 1.0 / (1.0 - BRIGHT))


def test_what_keeps_vertices_goes_as_far_as_it_can(mi: Any) -> None:
    images = render(sphere(mi, "area", albedo=BRIGHT), "bdpt", images=IMAGES, spp=12, max_depth=-1)
    check(images, 1.0 / (1.0 - BRIGHT), 0.03)
