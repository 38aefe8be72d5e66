"""Metropolis light transport: chains that find a known image, and both kinds of states against closed forms.

The zoo compares the algorithm with references in its default form; here are the parts, and the other form.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from elps_core import device
from elps_core.paths.strategies import chosen
from elps_core.settings import PssmltSettings, RenderSettings
from tests.agreement import compare
from tests.core.integrators.conftest import Agree
from tests.core.integrators.test_analytic import check, sphere, up_to
from tests.rendering import render

Array = np.ndarray[Any, Any]

OVER = ("bdpt", "unjoined", "path")
SIDE = 8
"""Side of the film of the toy, in pixels."""
FORMS = pytest.mark.parametrize("multiplexed", [False, True], ids=["bidirectional", "multiplexed"])


class Toy:
    """A target with a known image: a peak in group 0; in group 1 a ramp, and two splats a state."""

    groups = 2
    dimensions = (np.array([3, 3], np.uint32), np.array([1, 1], np.uint32))
    splats = (2,)
    broken = False
    """Whether one splat in a hundred is not a number."""

    def evaluate(self, streams: Any, group: Any, splat: Any) -> Any:
        import drjit as dr
        import mitsuba as mi

        at, height, across = streams[0].next_2d(), streams[0].next_1d(), streams[1].next_1d()
        peak = 100.0 * height * dr.exp(-200.0 * dr.squared_norm(at - 0.3))
        value = dr.select(group == 0, peak, 1.0 + at.x)
        bad = (across < 0.01) & self.broken

        def body(count: Any) -> Any:
            red = dr.select(bad & (count == 0), dr.nan, 0.5)
            where, chain = mi.Point2f(SIDE * across, SIDE * at.y), dr.arange(mi.UInt32, dr.width(group))
            splat(where, mi.Color3f(red, 0.5, across), mi.Color0f(), chain, group == 1)
            return (count + 1,)

        dr.while_loop((dr.zeros(mi.UInt32, dr.width(group)),), lambda count: count < 2, body)
        return SIDE * at, mi.Color3f(value, 0.5 * value, 0.1), mi.Color0f()

    def image(self) -> Array:
        """Its exact image, in units of the film's mean."""
        x = (np.arange(8000) + 0.5) / 8000
        peak, ramp, share = (
            values.reshape(SIDE, -1).mean(axis=1) for values in (np.exp(-200.0 * (x - 0.3) ** 2), 1.0 + x, x)
        )
        value = 50.0 * np.outer(peak, peak) + ramp[None, :]
        both = np.stack(np.broadcast_arrays(1.0, 1.0, 2.0 * share), axis=-1)
        return np.stack([value, 0.5 * value, np.full((SIDE, SIDE), 0.2)], axis=-1) + both


class Even:
    """A target that is the same everywhere."""

    groups = 1
    dimensions = (np.array([2], np.uint32), np.array([1], np.uint32))
    splats: tuple[int, ...] = ()

    def evaluate(self, streams: Any, group: Any, splat: Any) -> Any:
        import mitsuba as mi

        return SIDE * streams[0].next_2d(), mi.Color3f(1.0), mi.Color0f()


def images_of(
    mi: Any, target: Any, settings: PssmltSettings, mutations: int, count: int, **options: Any
) -> tuple[Array, list[Any]]:
    """Images [count, SIDE, SIDE, 3] of independent chain sets, and what each says of itself."""
    import drjit as dr

    from elps_core.integrators.metropolis import Metropolis

    sets, images, statistics = Metropolis(target, settings, **options), [], []
    for index in range(count):
        block = mi.ImageBlock(mi.ScalarVector2u(SIDE), mi.ScalarPoint2i(0), 4, mi.load_dict({"type": "box"}))

        def put(where: Any, rgb: Any, active: Any, block: Any = block) -> None:
            block.put(where, [*rgb, mi.Float(0.0)], active)
            dr.eval(block.tensor())

        statistics.append(sets.run(mutations, (3, index), put))
        images.append(np.array(block.tensor())[..., :3] * SIDE**2)
    return np.stack(images), statistics


def agrees_with(images: Array, exact: Array, bound: float) -> None:
    """Every pixel's mean is exact: Student's t, with a chance of 1e-4 of a false alarm over all."""
    from scipy import stats

    error = images.std(axis=0, ddof=1) / np.sqrt(len(images))
    t = np.abs(images.mean(axis=0) - exact) / np.maximum(error, 1e-4 * exact.mean())
    assert t.max() < stats.t.isf(0.5e-4 / exact.size, len(images) - 1), t.max()
    assert error.mean() < bound * exact.mean(), "too noisy to tell"


@pytest.mark.parametrize("mutations", [2048, 16384], ids=["short", "long"])
@pytest.mark.parametrize("large_step", [0.1, 1.0])
def test_chains_have_the_expected_image_from_their_first_state_on(mi: Any, mutations: int, large_step: float) -> None:
    settings = PssmltSettings(bootstrap=1024, chains=512, large_step=large_step)
    images, _ = images_of(mi, Toy(), settings, mutations, 64 if mutations < 10000 else 24)
    agrees_with(images, Toy().image(), 0.06)


def test_chains_may_go_where_little_light_is(mi: Any) -> None:
    """Weights of film positions change what chains look for, and not what they find."""
    settings = PssmltSettings(bootstrap=1024, chains=512, large_step=0.3)
    images, statistics = images_of(mi, Toy(), settings, 16384, 24, weight=lambda at: 0.1 + at.x * at.x)
    agrees_with(images, Toy().image(), 0.06)
    mean = float(Toy().image().mean(axis=(0, 1)) @ [0.212671, 0.715160, 0.072169])
    assert abs(statistics[0]["b"] / mean - 1.0) > 0.5, "the target is another one"


@pytest.mark.parametrize(
    ("over", "lanes"), [("path", 2048), ("path", 128), ("unjoined", 2048), ("unjoined", 128), ("bdpt", 128)]
)
@pytest.mark.parametrize("emitter", ["area", "point"])
def test_lanes_may_take_chains_in_turn_and_states_be_fewer_strategies(
    mi: Any, emitter: str, over: str, lanes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    from elps_core.integrators import frame, pssmlt

    monkeypatch.setattr(pssmlt, "FEWER", min(frame.LANES.values()) // lanes)
    options = {"pssmlt__over": over, "pssmlt__bootstrap": 4096}
    images = render(sphere(mi, emitter, lens=0.25), "pssmlt", images=16, spp=64, max_depth=3, **options)
    check(images, up_to(emitter, 3), bound=0.03)


def test_each_kind_of_states_has_strategies_of_its_own() -> None:
    found = [chosen(RenderSettings(integrator="pssmlt", pssmlt={"over": over}), aperture=False) for over in OVER]
    assert [(each.light_paths, each.joins) for each in found] == [(True, True), (True, False), (False, False)]


@pytest.mark.parametrize("over", ["path", "unjoined"])
def test_multiplexed_strategies_are_all(over: Any) -> None:
    with pytest.raises(ValidationError, match=r"leave pssmlt.over"):
        PssmltSettings(over=over, multiplexed=True)


def test_what_is_not_a_number_counts_as_nothing_and_the_rest_stays(mi: Any) -> None:
    toy = Toy()
    toy.broken = True
    images, _ = images_of(mi, toy, PssmltSettings(bootstrap=1024, chains=512), 16384, 32)
    assert np.isfinite(images).all()
    # The first of the two splats is lost where it is broken, in a twelfth of the first column.
    expected = Toy().image()
    expected[:, 0] -= 0.01 * SIDE * np.array([0.5, 0.5, 0.005])
    agrees_with(images, expected, 0.03)


def test_old_and_new_state_share_every_mutation(mi: Any) -> None:
    """Where all states are alike nothing is left to chance: each mutation counts once, as a whole."""
    images, statistics = images_of(mi, Even(), PssmltSettings(bootstrap=1024, chains=512, large_step=1.0), 8192, 2)
    assert np.allclose(images.mean(axis=(1, 2)), 1.0, rtol=1e-4)
    assert statistics[0]["b"] == pytest.approx(1.0, rel=1e-5)
    assert statistics[0]["b_error"] == pytest.approx(0.0, abs=1e-5)
    assert statistics[0]["accepted_large"] == pytest.approx(1.0)


def test_b_is_the_mean_of_the_image_and_knows_its_error(mi: Any) -> None:
    _, statistics = images_of(mi, Toy(), PssmltSettings(bootstrap=2048, chains=512), 4096, 48)
    b = np.array([entry["b"] for entry in statistics])
    mean = float(Toy().image().mean(axis=(0, 1)) @ [0.212671, 0.715160, 0.072169])
    error = b.std(ddof=1) / np.sqrt(len(b))
    assert abs(b.mean() - mean) < 4.5 * error
    assert error < 0.005 * mean
    # The standard deviation of 48 values is known to a tenth.
    assert np.mean([entry["b_error"] for entry in statistics]) == pytest.approx(b.std(ddof=1), rel=0.45)


def test_initial_states_are_drawn_in_proportion() -> None:
    device.use("llvm_ad_rgb")
    from elps_core.integrators.metropolis import resample, shares

    rng = np.random.default_rng(1)
    values = np.concatenate([rng.random(50) ** 4, np.zeros(10)])
    samples, members = np.array([50, 10]), np.array([40, 6])
    drawn = [np.bincount(resample(values, samples, members, rng.random(2)), minlength=60) for _ in range(4000)]
    expected = 40 * values[:50] / values[:50].sum()
    assert all(np.abs(counts[:50] - expected).max() < 1.0 for counts in drawn), "rounded up or down"
    assert np.abs(np.mean(drawn, axis=0)[:50] - expected).max() < 4.5 * 0.5 / np.sqrt(4000)
    assert all(counts[50:].sum() == 6 for counts in drawn), "a dark group has its chains as well"
    parts = shares(np.array([0.0, 1.0, 3.0]), 1000)
    assert parts.sum() == 1000
    assert parts.min() >= 1
    assert list(shares(np.zeros(3), 3)) == [1, 1, 1]


@FORMS
@pytest.mark.parametrize(("lens", "roulette"), [(0.0, "none"), (0.25, "albedo")], ids=["pinhole", "lens"])
def test_as_many_numbers_are_kept_as_are_taken(mi: Any, multiplexed: bool, lens: float, roulette: Any) -> None:
    """One too few would be read beyond the vectors' end; inside a sphere every walk goes as far as it may."""
    import drjit as dr

    from elps_core.integrators.bdpt import Bdpt
    from elps_core.integrators.multiplexed import Multiplexed
    from elps_core.integrators.pssmlt import Samples
    from elps_core.paths.primary import PrimaryStream, Vectors
    from elps_core.paths.roulette import RouletteRule
    from elps_core.paths.stream import generator, opaque_key
    from elps_core.sampling.start import StartDensity, power_table
    from elps_core.scene.emission import Emission
    from elps_core.scene.sensors import Camera

    scene = sphere(mi, "area", lens)
    emission = Emission(scene)
    lights = StartDensity(emission, power_table(emission))
    rule = RouletteRule(roulette, 8)
    bdpt = Bdpt(scene, Camera(scene.sensors()[0]), lights, max_depth=3, roulette=rule)
    target = Multiplexed(bdpt) if multiplexed else Samples(bdpt)
    lanes = 256
    for group in range(target.groups):
        counters: list[list[Any]] = [[], []]

        def stream(number: int, group: int = group, counters: list[list[Any]] = counters) -> PrimaryStream:
            # A loop may write to an array from one place only: each call has its own, made before.
            spare = [dr.opaque(mi.UInt32, 0) for _ in range(300)]

            class Counting(Vectors):
                def read(self, dimension: Any, chain: Any) -> Any:
                    counter = spare.pop()
                    counters[number].append(counter)
                    dr.scatter_reduce(dr.ReduceOp.Max, counter, dimension + 1, 0)
                    return dr.zeros(mi.UInt32, lanes)

            lane = dr.arange(mi.UInt32, lanes)
            rng, vectors = generator(lane * 2 + number, opaque_key(group)), Counting(dr.zeros(mi.UInt32, lanes), lanes)
            return PrimaryStream(rng, dr.zeros(mi.UInt32, lanes), dr.full(mi.Bool, True, lanes), lane, vectors)

        found = target.evaluate((stream(0), stream(1)), dr.full(mi.UInt32, group, lanes), lambda *_: None)
        dr.eval(found)
        taken = [max(int(counter[0]) for counter in each) for each in counters]
        assert taken == [int(dimensions[group]) for dimensions in target.dimensions], group


@pytest.mark.parametrize(("light", "depth"), [("area", 2), ("point", 6)])
def test_radiance_in_a_sphere_by_states_of_all_strategies(mi: Any, light: str, depth: int) -> None:
    """The other form takes the tests of all algorithms (test_analytic)."""
    options = {"pssmlt__multiplexed": False, "pssmlt__bootstrap": 4096}
    images = render(sphere(mi, light), "pssmlt", images=16, spp=64, max_depth=depth, **options)
    check(images, up_to(light, depth), bound=0.02)


def test_lengths_whose_strategies_are_drawn(mi: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Long paths have one group each; here all have."""
    from elps_core.integrators import multiplexed

    monkeypatch.setattr(multiplexed, "APART", 0)
    images = render(sphere(mi, "area", lens=0.25), "pssmlt", images=16, spp=64, max_depth=3, pssmlt__bootstrap=4096)
    check(images, up_to("area", 3), bound=0.03)


@FORMS
def test_spectral_light_is_one_wavelength_on_both_sides(multiplexed: bool) -> None:
    mi = device.use("llvm_ad_spectral")
    options = {"pssmlt__multiplexed": multiplexed, "pssmlt__bootstrap": 4096}
    images = render(sphere(mi, "point"), "pssmlt", images=8, spp=96, max_depth=3, **options)
    check(images, up_to("point", 3), bound=0.04)


@FORMS
def test_chunks_add_up_whatever_their_size(mi: Any, multiplexed: bool) -> None:
    """Chunks of one mutation a pixel have the mean of larger ones, and are independent of each other."""
    scene = sphere(mi, "point")
    options = {"pssmlt__multiplexed": multiplexed, "pssmlt__bootstrap": 1024, "max_depth": 3}
    small = render(scene, "pssmlt", images=24, spp=1, **options)
    large = render(scene, "pssmlt", images=8, spp=32, seed=1, **options)
    agreement = compare(small, large, block=8, level=1e-3)
    assert agreement.agrees, agreement
    again = render(scene, "pssmlt", images=1, spp=1, **options)
    assert np.allclose(small[0], again[0], rtol=1e-3, atol=1e-4)
    means = small.mean(axis=(1, 2, 3))
    assert len(set(means)) == len(means), "chunks have numbers of their own"


@pytest.mark.parametrize("name", ["crop-gaussian", "caustic"])
def test_states_of_all_strategies_agree_with_the_reference(agree: Agree, name: str) -> None:
    agreement = agree(name, "pssmlt", pssmlt__multiplexed=False)
    assert agreement.agrees, agreement
    assert agreement.detectable < 0.03, agreement
