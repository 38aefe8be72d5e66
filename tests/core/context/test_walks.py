"""What walks record inside a sphere, where all of it is known: every point gets the same light from everywhere.

The emitter is a point light at the centre of a unit sphere, as strong as gives an irradiance of pi; so what
arrives after j more bounces is ALBEDO^j from each direction, and nothing of it is for next event estimation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests import adversaries
from tests.core.integrators.test_analytic import ALBEDO, sphere

Array = np.ndarray[Any, Any]

GRID = (8, 16)
LANES = 1 << 15
BATCHES = 8
POINTS = 1 << 22
"""Points by which areas are known to 0.3%."""
CRITICAL = 6.5
"""Student's t with 7 degrees of freedom exceeds it with a chance of 0.03%."""
ROUNDING = 1e-4


class Quarter:
    """A pixel's worth of 0.25 under a gain, which is roulette's alone."""

    gain = 2.0

    def __call__(self, _: Any) -> float:
        return 0.25 * self.gain


@pytest.fixture(autouse=True)
def _variant(mi: Any) -> None:
    """What is tested is a module of kernels."""


def series(terms: int) -> float:
    """Radiance by 1 to ``terms`` bounces."""
    return sum(ALBEDO**j for j in range(1, terms + 1))


def half_mirror(mi: Any) -> Any:
    """The sphere, every other ray reflected as by a mirror."""
    parts = {
        "matt": {"type": "diffuse", "reflectance": {"type": "rgb", "value": ALBEDO}},
        "metal": {"type": "conductor"},
    }
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": sphere(mi, "point").sensors()[0],
            "shape": {"type": "sphere", "flip_normals": True, "bsdf": {"type": "blendbsdf", "weight": 0.5, **parts}},
            "light": {"type": "point", "intensity": {"type": "rgb", "value": float(np.pi)}},
        }
    )


def recorder(
    scene: Any, kind: adversaries.Kind | None, max_depth: int, roulette: Any = "none", worth: Any = None
) -> Any:
    """A recorder of walks that are guided by a table of that kind, and the number of its regions."""
    from elps_core.context.walks import WalkRecorder
    from elps_core.integrators.bdpt import Bdpt
    from elps_core.paths import strategies
    from elps_core.paths.roulette import RouletteRule
    from elps_core.sampling.context import guided
    from elps_core.sampling.direction import SCATTERING
    from elps_core.sampling.start import StartDensity, power_table
    from elps_core.scene.emission import Emission
    from elps_core.scene.sensors import Camera

    parts = adversaries.parts(scene, kind or "random")
    emission = Emission(scene)
    bdpt = Bdpt(
        scene,
        Camera(scene.sensors()[0]),
        StartDensity(emission, power_table(emission)),
        max_depth=max_depth,
        roulette=RouletteRule(roulette, 1),
        strategies=strategies.path(),
        directions=guided(parts, eye=0.5, light=0.5) if kind else SCATTERING,
        worth=worth,
    )
    return WalkRecorder(bdpt, guided(parts, eye=None, light=None)), parts.regions.count


def accumulators(count: int, number: int) -> list[Any]:
    from elps_core.context.directional import DirectionalAccumulator

    return [DirectionalAccumulator(count, *GRID) for _ in range(number)]


def eye_paths(walks: Any, count: int, batch: int) -> tuple[Any, Any]:
    """Accumulators of radiance and importance after :data:`LANES` eye paths."""
    import drjit as dr
    import mitsuba as mi

    from elps_core.paths.stream import Stream

    radiance, importance = accumulators(count, 2)
    stream = Stream.of(LANES, 1, batch)
    position = stream.next_2d() * mi.Point2f(walks.bdpt.camera.size)
    walks.eye_paths(position, stream, radiance, importance, dr.zeros(mi.Float, count))
    radiance.close_batch()
    importance.close_batch(np.full(count, LANES / count))
    return radiance, importance


def mean_irradiance(radiance: Any) -> float:
    """Over all visits."""
    return float(radiance.estimate().irradiance @ radiance.visits / radiance.visits.sum())


def check(found: list[Any], exact: list[Any] | float, bound: float = 0.02, slack: float = ROUNDING) -> None:
    """Of independent batches the mean is ``exact``, and known well enough to tell."""
    difference = np.array(found, float) / np.array(exact, float) - 1.0
    error = difference.std(ddof=1) / np.sqrt(len(difference))
    assert abs(difference.mean()) <= CRITICAL * error + slack, (difference.mean(), error)
    assert CRITICAL * error < bound, f"finds no bias below {CRITICAL * error:.1%}"


@pytest.mark.parametrize("depth", [2, 3, 6])
def test_irradiance_by_eye_paths(mi: Any, depth: int) -> None:
    """Records of all vertices but the last; a path finds fewer bounces the later it asks."""
    walks, count = recorder(sphere(mi, "point"), None, depth)
    radiance, _ = eye_paths(walks, count, 0)
    expected = np.mean([series(depth - 1 - vertex) for vertex in range(1, depth)])
    assert radiance.visits.sum() == LANES * (depth - 1), "each vertex that a path leaves is a record"
    # Any two points of a sphere see each other under the same geometry factor: no noise at all.
    assert mean_irradiance(radiance) == pytest.approx(np.pi * expected, rel=ROUNDING)


def test_what_light_sampling_covers_is_no_part_of_a_direction(mi: Any) -> None:
    """A glowing sphere: both ways to the light are equally likely, so that a direction keeps half of its emission."""
    walks, count = recorder(sphere(mi, "area"), None, 4)
    found = [mean_irradiance(eye_paths(walks, count, batch)[0]) for batch in range(BATCHES)]
    expected = np.mean([0.5 + series(3 - vertex) for vertex in range(1, 4)])
    check(found, np.pi * float(expected))


GUIDED = [
    pytest.param(None, "none", "diffuse", id="unguided"),
    pytest.param("random", "none", "diffuse", id="random"),
    pytest.param("spiked", "none", "diffuse", id="spiked"),
    pytest.param(None, "albedo", "diffuse", id="roulette by albedo"),
    pytest.param("random", "context", "diffuse", id="roulette by random"),
    pytest.param(None, "none", "half a mirror", id="half a mirror"),
    pytest.param("random", "none", "half a mirror", id="half a mirror, random"),
]


@pytest.mark.parametrize(("kind", "roulette", "material"), GUIDED)
def test_irradiance_whatever_guides_the_paths(
    mi: Any, kind: adversaries.Kind | None, roulette: str, material: str
) -> None:
    """One bounce is found beyond the first vertex and none beyond the second: both kinds of visits are counted."""
    scene = sphere(mi, "point") if material == "diffuse" else half_mirror(mi)
    albedo = ALBEDO if material == "diffuse" else 0.5 * ALBEDO
    walks, count = recorder(scene, kind, 3, roulette)
    shorter, _ = recorder(scene, kind, 2, roulette)
    found, expected = [], []
    for batch in range(BATCHES):
        found.append(mean_irradiance(eye_paths(walks, count, batch)[0]))
        # The same random numbers: how many of the paths come to a second vertex.
        second = eye_paths(shorter, count, batch)[1].visits.sum()
        expected.append(np.pi * albedo * LANES / (LANES + second))
    check(found, expected, bound=0.05)


@pytest.mark.parametrize("kind", [None, "random"])
def test_photons_give_the_irradiance_of_every_region(mi: Any, kind: adversaries.Kind | None) -> None:
    """After one to four bounces; what comes straight from the lamp is left out."""
    from elps_core.paths.stream import Stream

    scene = sphere(mi, "point")
    walks, count = recorder(scene, kind, 6)
    points = mi.warp.square_to_uniform_sphere(Stream.of(POINTS, 5).next_2d())
    areas = 4.0 * np.pi * np.bincount(np.array(walks._regions.lookup(points, -points)), minlength=count) / POINTS
    found = []
    for batch in range(BATCHES):
        (photons,) = accumulators(count, 1)
        walks.light_paths(LANES, Stream.of(LANES, 2, batch), photons)
        photons.close_batch(LANES * areas)
        found.append(photons.estimate().irradiance)
    expected = np.pi * series(4)
    check([each @ areas / (4.0 * np.pi) for each in found], expected)
    large = areas > 0.3
    assert areas[large].sum() > 6.0
    unsure = np.sqrt(4.0 * np.pi / np.maximum(areas, 1e-9) / POINTS)
    for region in np.flatnonzero(large):
        check([each[region] for each in found], expected, bound=0.15, slack=4.0 * unsure[region])


@pytest.mark.parametrize("kind", [None, "random"])
def test_importance_is_what_the_albedo_leaves(mi: Any, kind: adversaries.Kind | None) -> None:
    """At all vertices but the first; in units of what the pixel is worth."""
    walks, count = recorder(sphere(mi, "point"), kind, 5, worth=Quarter())
    found = [eye_paths(walks, count, batch)[1].estimate().irradiance.mean() for batch in range(BATCHES)]
    check(found, 0.25 * series(4), bound=0.05)


def test_both_say_where_light_comes_from(mi: Any) -> None:
    """Tables by eye and by light paths differ by noise alone."""
    import drjit as dr

    from elps_core.paths.stream import Stream

    walks, count = recorder(sphere(mi, "point"), None, 6)
    eye, light, importance = accumulators(count, 3)
    for batch in range(4):
        stream = Stream.of(LANES, 3, batch)
        position = stream.next_2d() * mi.Point2f(walks.bdpt.camera.size)
        walks.eye_paths(position, stream, eye, importance, dr.zeros(mi.Float, count))
        walks.light_paths(LANES, Stream.of(LANES, 4, batch), light)
        eye.close_batch()
        light.close_batch(np.full(count, float(LANES)))
    first, second = eye.estimate(), light.estimate()
    both = (eye.evidence > 1000) & (light.evidence > 1000)
    tables = [np.array(part.shares).reshape(count, -1)[both] for part in (first, second)]
    noise = (first.noise + second.noise)[both].sum()
    assert np.square(tables[0] - tables[1]).sum() < 2.0 * noise
    assert noise < 0.05 * np.square(tables[0]).sum(), "too noisy to tell"
