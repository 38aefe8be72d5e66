"""What walks record inside a sphere, where all of it is known: every point gets the same light from everywhere.

The emitter is a point light at the centre of a unit sphere, as strong as gives an irradiance of pi; so what
arrives after j more bounces is ALBEDO^j from each direction, and nothing of it is for next event estimation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from elps_core import device
from tests import adversaries
from tests.core.integrators.test_analytic import ALBEDO, sphere

Array = np.ndarray[Any, Any]

GRID = (8, 16)
PATHS = (1 << 15) - 3
LANES = -(-PATHS // 8)
"""Lanes take eight paths each, some of them seven."""
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
    from elps_core.context.lookup import RegionLookup
    from elps_core.context.walks import WalkRecorder
    from elps_core.integrators.bdpt import Bdpt
    from elps_core.paths import strategies
    from elps_core.paths.roulette import RouletteRule
    from elps_core.paths.scattering import Materials
    from elps_core.sampling.context import guided
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
        directions=guided(Materials(scene), parts, eye=0.5, light=0.5) if kind else None,
        worth=worth,
    )
    return WalkRecorder(bdpt, RegionLookup(parts.regions)), parts.regions.count


def accumulators(count: int, number: int) -> list[Any]:
    from elps_core.context.directional import DirectionalAccumulator

    return [DirectionalAccumulator(count, *GRID) for _ in range(number)]


def film_paths(walks: Any, batch: int, radiance: Any, importance: Any, lanes: int = LANES) -> tuple[Any, Any]:
    """Takes :data:`PATHS` eye paths; returns where on the film they begin, and the luminance that each has found."""
    import drjit as dr
    import mitsuba as mi

    from elps_core.paths.stream import Stream

    position = Stream.of(PATHS, 1, batch, 0).next_2d() * mi.Point2f(walks.bdpt.camera.size)
    lights = dr.zeros(mi.Float, radiance.regions)
    return position, walks.eye_paths(position, Stream.of(lanes, 1, batch, 1), radiance, importance, lights)


def eye_paths(walks: Any, count: int, batch: int, lanes: int = LANES) -> tuple[Any, Any]:
    """Accumulators of radiance and importance after :data:`PATHS` eye paths."""
    radiance, importance = accumulators(count, 2)
    film_paths(walks, batch, radiance, importance, lanes)
    radiance.close_batch()
    importance.close_batch(np.full(count, PATHS / count))
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
    assert radiance.visits.sum() == PATHS * (depth - 1), "each vertex that a path leaves is a record"
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
        found.append(mean_irradiance(eye_paths(walks, count, batch, PATHS)[0]))
        # The same random numbers, a lane for each path: how many of the paths come to a second vertex.
        second = eye_paths(shorter, count, batch, PATHS)[1].visits.sum()
        expected.append(np.pi * albedo * PATHS / (PATHS + second))
    check(found, expected, bound=0.05)


@pytest.mark.parametrize("kind", [None, "random"])
def test_photons_give_the_irradiance_of_every_region(mi: Any, kind: adversaries.Kind | None) -> None:
    """After one to four bounces; what comes straight from the lamp is left out."""
    from elps_core.paths.stream import Stream

    scene = sphere(mi, "point")
    walks, count = recorder(scene, kind, 6)
    points = mi.warp.square_to_uniform_sphere(Stream.of(POINTS, 5).next_2d())
    areas = 4.0 * np.pi * np.bincount(np.array(walks._regions(points, -points)), minlength=count) / POINTS
    found = []
    for batch in range(BATCHES):
        (photons,) = accumulators(count, 1)
        walks.light_paths(PATHS, Stream.of(LANES, 2, batch), photons)
        photons.close_batch(PATHS * areas)
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
    from elps_core.paths.stream import Stream

    walks, count = recorder(sphere(mi, "point"), None, 6)
    eye, light, importance = accumulators(count, 3)
    for batch in range(4):
        film_paths(walks, batch, eye, importance)
        walks.light_paths(PATHS, Stream.of(LANES, 4, batch), light)
        eye.close_batch()
        light.close_batch(np.full(count, float(PATHS)))
    first, second = eye.estimate(), light.estimate()
    both = (eye.evidence > 1000) & (light.evidence > 1000)
    tables = [np.array(part.shares).reshape(count, -1)[both] for part in (first, second)]
    noise = (first.noise + second.noise)[both].sum()
    assert np.square(tables[0] - tables[1]).sum() < 2.0 * noise
    assert noise < 0.05 * np.square(tables[0]).sum(), "too noisy to tell"


def lamp(mi: Any, radiance: Array, **of_shape: Any) -> dict[str, Any]:
    """A square that emits ``radiance`` [rows, columns] on the side that its normal, +z, is on."""
    pixels = np.repeat(radiance[:, :, None], 3, axis=2).astype(np.float32)
    texture = {"type": "bitmap", "raw": True, "filter_type": "nearest", "bitmap": mi.Bitmap(pixels)}
    return {"type": "rectangle", "emitter": {"type": "area", "radiance": texture}, **of_shape}


def test_a_path_finds_what_its_own_pixel_shows(mi: Any) -> None:
    """Nothing but a lamp that half fills the film: each path is told apart by where it begins."""
    place = mi.ScalarTransform4f
    sensor = {
        "type": "orthographic",
        "to_world": place().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]) @ place().scale([2.0, 2.0, 1.0]),
        "film": {"type": "hdrfilm", "width": 16, "height": 16},
    }
    scene = mi.load_dict({"type": "scene", "sensor": sensor, "lamp": lamp(mi, np.arange(1.0, 5.0).reshape(2, 2))})
    walks, count = recorder(scene, None, 3)
    position, found = film_paths(walks, 0, *accumulators(count, 2))
    position, found = np.array(position).T, np.array(found)
    seen = ((position > 4.0) & (position < 12.0)).all(axis=1)
    assert seen.mean() == pytest.approx(0.25, abs=0.02)
    assert (found[~seen] == 0.0).all()
    quarter = (position[:, 1] > 8.0) * 2 + (position[:, 0] > 8.0)
    shown = [np.unique(found[seen & (quarter == number)]) for number in range(4)]
    assert sorted(np.concatenate(shown)) == pytest.approx([1.0, 2.0, 3.0, 4.0]), "one brightness in each quarter"


def test_a_path_that_starts_in_the_dark_holds_up_no_other(mi: Any) -> None:
    """Three quarters of a lamp in a sphere are black: no light path starts there, and its lane takes the next one."""
    from elps_core.paths.stream import Stream

    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": sphere(mi, "point").sensors()[0],
            "shape": {"type": "sphere", "flip_normals": True, "bsdf": {"type": "diffuse"}},
            "lamp": lamp(mi, np.array([[1.0, 0.0], [0.0, 0.0]]), to_world=mi.ScalarTransform4f().scale(0.1)),
        }
    )
    walks, count = recorder(scene, None, 4)
    (photons,) = accumulators(count, 1)
    walks.light_paths(PATHS, Stream.of(LANES, 1), photons)
    photons.close_batch(PATHS)
    # Photons of the second and of the third segment, of a quarter of all paths.
    drawn = photons.visits.sum() / (2 * PATHS)
    assert drawn == pytest.approx(0.25, abs=5.0 * np.sqrt(0.25 * 0.75 / PATHS) + 0.01)


def test_wavelengths_count_once() -> None:
    """In a spectral variant they have a weight, with which eye paths begin."""
    mi = device.use("llvm_ad_spectral")
    from elps_core.paths.stream import Stream
    from elps_core.scene.spectrum import luminance

    walks, count = recorder(sphere(mi, "area"), None, 3)
    found, expected = [], []
    for batch in range(BATCHES):
        position, luminances = film_paths(walks, batch, *accumulators(count, 2))
        found.append(np.array(luminances).mean(dtype=float))
        streams = (Stream.of(PATHS, 2, batch), Stream.of(1, 3, batch))
        radiance, wavelengths = walks.bdpt.trace(position, streams, lambda *_: None, light_scale=None)
        expected.append(np.array(luminance(mi.UnpolarizedSpectrum(radiance), wavelengths)).mean(dtype=float))
    check(found, expected)


def test_photons_and_eye_paths_count_in_one_unit() -> None:
    """In a spectral variant too, where the luminance of a throughput of one is not one."""
    ratios = {}
    for variant in ("llvm_ad_rgb", "llvm_ad_spectral"):
        mi = device.use(variant)
        from elps_core.paths.stream import Stream

        walks, count = recorder(sphere(mi, "point"), None, 3)
        radiance, _ = eye_paths(walks, count, 0)
        (photons,) = accumulators(count, 1)
        walks.light_paths(PATHS, Stream.of(LANES, 4), photons)
        photons.close_batch(PATHS * 4.0 * np.pi / count)
        ratios[variant] = mean_irradiance(photons) / mean_irradiance(radiance)
    assert ratios["llvm_ad_spectral"] == pytest.approx(ratios["llvm_ad_rgb"], rel=0.05)
