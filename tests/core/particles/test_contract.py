"""What particles promise, bounce by bounce [thesis (5.8), (5.9)].

Of photons E[sum weight W(x, omega)] = <W, L_i> for several W, of importons the same with L_e in place of W.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from elps_core import device
from tests.core.particles.conftest import SAMPLERS, check, sampler, totals
from tests.zoo import stage
from tests.zoo.stage import area, ball, camera, diffuse, rgb, scene

Array = np.ndarray[Any, Any]

PHOTON, IMPORTON = 0, 1
ALBEDO = 0.6
DEPTH = 3
RUNS = 10
CAP = 0.3
"""Height above which the sphere's cap begins."""
CONE = 0.8
"""Least cosine of a direction in a cone around the normal."""
RADIANCE = 3.0
LAMP = {"y": 2.6, "z": 0.4, "half": 1.2}


def by_depth(arrays: Any, kind: int, *tests: Array, depth: int = DEPTH) -> Array:
    """Sums of the weights of one kind, [depth, tests]."""
    chosen = [(arrays.kind == kind) & (arrays.depth == d + 1) for d in range(depth)]
    return np.array([[arrays.weight[of & test].sum(dtype=float) for test in tests] for of in chosen])


def sphere(mi: Any) -> Any:
    """A sphere that glows to its inside, with a camera in it."""
    shape = {
        "type": "sphere",
        "flip_normals": True,
        "bsdf": {"type": "diffuse", "reflectance": rgb(ALBEDO)},
        "emitter": area(1.0),
    }
    return mi.load_dict({"type": "scene", "sensor": camera(mi, (0.1, 0.2, -0.3), (0.5, 0.1, 0.6)), "shape": shape})


@pytest.mark.parametrize("kind", SAMPLERS)
def test_in_a_sphere_both_are_known(mi: Any, kind: str) -> None:
    """Photons through the whole surface, through a cap, and through a cone over the cap; all importons."""

    def measure(arrays: Any) -> Array:
        everywhere = np.ones(len(arrays.weight), bool)
        cap = arrays.position[:, 1] > CAP
        cone = (arrays.direction * arrays.normal).sum(axis=1) > CONE
        light = by_depth(arrays, PHOTON, everywhere, cap, cap & cone)
        return np.concatenate([light.ravel(), by_depth(arrays, IMPORTON, everywhere).ravel()])

    bounces = ALBEDO ** np.arange(DEPTH)
    share = (1.0 - CAP) / 2.0
    flux = 4.0 * np.pi**2 * np.array([1.0, share, share * (1.0 - CONE**2)])
    expected = np.concatenate([np.outer(bounces, flux).ravel(), bounces])
    found = totals(sampler(kind, sphere(mi), max_depth=DEPTH), measure, runs=RUNS)
    varying = found.std(axis=0) > 1e-5 * expected
    assert np.allclose(found[:, ~varying], expected[~varying], rtol=1e-4)
    check(found[:, varying], expected[varying], bound=0.05)


def test_wavelengths_count_once() -> None:
    """In a spectral variant both subpaths share wavelengths, which have a weight of their own."""
    mi = device.use("llvm_ad_spectral")

    def measure(arrays: Any) -> Array:
        everywhere = np.ones(len(arrays.weight), bool)
        return np.concatenate([by_depth(arrays, kind, everywhere).ravel() for kind in (PHOTON, IMPORTON)])

    whole = sphere(mi)
    plain = totals(sampler("classical", whole, max_depth=DEPTH), measure, runs=RUNS)
    found = totals(sampler("bidirectional", whole, max_depth=DEPTH, effort=0.5), measure, runs=RUNS)
    check(found, plain.mean(axis=0), plain.std(axis=0, ddof=1) / np.sqrt(RUNS), bound=0.05)


def half_mirror() -> dict[str, Any]:
    """Every other ray is reflected as by a mirror, the others are scattered."""
    parts = {"matt": {"type": "diffuse", "reflectance": rgb(0.5)}, "mirror": {"type": "conductor"}}
    return {"type": "blendbsdf", "weight": 0.5, **parts}


def room(mi: Any, *, sky: bool) -> Any:
    """Glass and rough metal on a floor that half mirrors, a lamp that looks down, a dim sky, a lens."""
    return mi.load_dict(
        scene(
            mi,
            sensor=camera(mi, type="thinlens", aperture_radius=0.1, focus_distance=3.4),
            ball=ball({"type": "dielectric"}, center=(-0.6, 0.45, 0.3), radius=0.45),
            floor=stage.room(mi=mi, floor=half_mirror())["floor"],
            metal=ball({"type": "roughconductor", "alpha": 0.3}, center=(0.6, 0.5, 0.0), radius=0.5),
            light={
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([0, LAMP["y"], LAMP["z"]])
                @ mi.ScalarTransform4f().rotate([1, 0, 0], 90)
                @ mi.ScalarTransform4f().scale(LAMP["half"]),
                "bsdf": diffuse(0.3),
                "emitter": area(RADIANCE),
            },
            sky={"type": "constant", "radiance": rgb(0.4)} if sky else None,
        )
    )


def radiance(mi: Any, scene: Any, ray: Any, depth: int, seed: int) -> Array:
    """Luminance along ``ray`` by paths of exactly 1, 2 .. ``depth`` segments, of Mitsuba's path tracer, [depth, n]."""
    import drjit as dr

    lanes = dr.width(ray)
    sums = [np.zeros(lanes)]
    for longest in range(1, depth + 1):
        path = mi.load_dict({"type": "path", "max_depth": longest, "rr_depth": depth + 1})
        numbers = mi.load_dict({"type": "independent"})
        # The same numbers for all depths: what shorter paths bring cancels exactly.
        numbers.seed(dr.opaque(mi.UInt32, seed), lanes)
        sums.append(np.array(mi.luminance(path.sample(scene, numbers, mi.RayDifferential3f(ray))[0])))
    return np.diff(np.array(sums), axis=0)


LOW, HIGH = np.array([-1.0, -0.9]), np.array([1.2, 1.0])
"""Corners (x, z) of a patch of the floor."""
RAYS = 1 << 19
ROOM_BOUND = {"classical": 0.12, "bidirectional": 0.2, "metropolis": 0.3}
"""Relative bias of half of the sums that is found with a chance of 95%."""


def from_where(direction: Array) -> list[Array]:
    """Which directions come from the upper left, and which from anywhere above."""
    return [(direction[:, 0] < 0) & (direction[:, 1] > 0.3), direction[:, 1] > 0.0]


def arriving(mi: Any) -> tuple[Array, Array]:
    """What reaches the patch by paths of 1, 2 .. segments, and the standard error, [depth * tests]."""
    import drjit as dr

    random = np.random.default_rng(5)
    place = LOW + (HIGH - LOW) * random.random((RAYS, 2))
    up, turn = np.sqrt(random.random(RAYS)), 2.0 * np.pi * random.random(RAYS)
    side = np.sqrt(1.0 - up**2)
    direction = np.stack([side * np.cos(turn), up, side * np.sin(turn)], axis=1)
    origin = np.stack([place[:, 0], np.full(RAYS, 1e-4), place[:, 1]], axis=1)
    ray = mi.Ray3f(mi.Point3f(origin.T.astype(np.float32)), mi.Vector3f(direction.T.astype(np.float32)))
    dr.eval(ray)
    light = radiance(mi, room(mi, sky=True), ray, DEPTH, 3) * np.pi * np.prod(HIGH - LOW)
    parts = np.array([[np.where(test, level, 0.0) for test in from_where(direction)] for level in light])
    return parts.mean(axis=-1).ravel(), parts.std(axis=-1).ravel() / np.sqrt(RAYS)


def seen(mi: Any) -> tuple[Array, Array]:
    """Mean over the film of the lamp's light by paths of 2, 3 .. segments, and the standard error."""
    import drjit as dr

    # Importance does not ask what shines: the sky is left out of the picture only.
    whole = room(mi, sky=False)
    random = np.random.default_rng(6)
    film, lens = (mi.Point2f(random.random((2, RAYS)).astype(np.float32)) for _ in range(2))
    ray, _ = whole.sensors()[0].sample_ray(0.0, 0.5, film, lens)
    dr.eval(ray)
    light = radiance(mi, whole, ray, DEPTH, 4)[1:]
    return light.mean(axis=1), light.std(axis=1) / np.sqrt(RAYS)


@cache
def reference() -> tuple[Array, Array]:
    """Sums and their standard errors, the same for all samplers."""
    mi = device.use("llvm_ad_rgb")
    sums, error = np.concatenate([arriving(mi), seen(mi)], axis=1)
    return sums, error


@pytest.mark.parametrize("kind", SAMPLERS)
def test_in_a_furnished_room_both_are_those_of_path_tracing(mi: Any, kind: str) -> None:
    """Photons on a patch of the floor; importons on the lamp, times what it emits."""

    def measure(arrays: Any) -> Array:
        x, y, z = arrays.position.T
        patch = (np.abs(y) < 1e-4) & (x > LOW[0]) & (x < HIGH[0]) & (z > LOW[1]) & (z < HIGH[1])
        lamp = (np.abs(y - LAMP["y"]) < 1e-3) & (np.abs(x) < LAMP["half"]) & (np.abs(z - LAMP["z"]) < LAMP["half"])
        photons = by_depth(arrays, PHOTON, *(patch & test for test in from_where(arrays.direction)))
        importons = by_depth(arrays, IMPORTON, lamp & (arrays.direction[:, 1] < 0.0))[1:] * RADIANCE
        return np.concatenate([photons.ravel(), importons.ravel()])

    expected, error = reference()
    found = totals(sampler(kind, room(mi, sky=True), max_depth=DEPTH, effort=2.0), measure, runs=RUNS)
    check(found, expected, error, bound=ROOM_BOUND[kind])
