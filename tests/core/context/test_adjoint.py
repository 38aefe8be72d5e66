"""The adjoint image: its sum is the picture's flux, and no table moves the picture's mean."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.agreement import compare

Array = np.ndarray[Any, Any]


@pytest.fixture
def two_lights(mi: Any, camera_dict: Callable[..., dict[str, Any]]) -> Any:
    """A box with a wall between two lights: the camera sees the half that one of them lights."""
    place = mi.ScalarTransform4f
    grey = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.6}}}

    def light(x: float) -> dict[str, Any]:
        return {
            "type": "rectangle",
            "to_world": place().translate([x, 0.98, 0]) @ place().rotate([1, 0, 0], 90) @ place().scale(0.2),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [6.0, 5.0, 4.0]}},
        }

    return mi.load_dict(
        {
            "type": "scene",
            "sensor": camera_dict([-0.9, 0.3, 0.9], [-1.2, -0.4, -0.5]),
            "box": {"type": "cube", "to_world": place().scale([2, 1, 1]), "bsdf": grey},
            "wall": {
                "type": "cube",
                "to_world": place().translate([0, -0.3, 0]) @ place().scale([0.05, 0.7, 1]),
                "bsdf": grey,
            },
            "near": light(-1.0),
            "far": light(1.0),
        }
    )


def measurement(scene: Any, **options: Any) -> Any:
    from elps_core.context.adjoint import STEPS, AdjointMeasurement
    from elps_core.scene.emission import Emission
    from elps_core.scene.sensors import Camera
    from elps_core.settings import ContextSettings

    result = AdjointMeasurement(
        scene, Camera(scene.sensors()[0]), Emission(scene), ContextSettings(resolution=16, **options)
    )
    for _ in range(STEPS):
        result.step()
    return result


def test_sum_is_the_mean_luminance_of_the_picture(mi: Any, two_lights: Any, render_path: Callable[..., Array]) -> None:
    measured = measurement(two_lights, samples_per_cell=512, max_depth=6)
    flux = measured.batches.sum(axis=(1, 2))
    weights = np.array([0.212671, 0.715160, 0.072169])
    picture = (render_path(two_lights, images=8, spp=512, max_depth=6) @ weights).mean(axis=(1, 2))
    error = np.hypot(flux.std(ddof=1), picture.std(ddof=1)) / np.sqrt(8)
    assert abs(flux.mean() - picture.mean()) < 4.5 * error
    assert error < 0.01 * picture.mean()
    assert measured.image().sum() == pytest.approx(flux.mean(), rel=1e-6)


def test_the_light_behind_the_wall_gets_its_small_share(two_lights: Any) -> None:
    measured = measurement(two_lights)
    shares = measured.image().reshape(measured.rows, 2, -1).sum(axis=(0, 2))
    shares = shares / shares.sum()
    near = int(np.argmin(measured.emission.keys[:, 0]))
    assert shares[near] > 0.8
    assert 0.0 < shares[1 - near] < 0.2


@pytest.mark.parametrize("kind", ["random", "spiked", "empty"])
def test_no_table_moves_the_mean(
    two_lights: Any, render_bdpt: Callable[..., Array], render_path: Callable[..., Array], kind: str
) -> None:
    from elps_core.context.adjoint import grid, start_table

    def table(emission: Any) -> Array:
        rows, columns = grid(emission.count, 16)
        image = np.zeros((rows, columns))
        if kind == "random":
            image = np.random.default_rng(5).random((rows, columns)) ** 3
        if kind == "spiked":
            image[3, 5] = 1.0
        if kind == "measured":
            image = measurement(two_lights, max_depth=6).image()
        return start_table(image, emission, 0.1)

    images = render_bdpt(two_lights, images=12, spp=256, max_depth=6, table=table)
    agreement = compare(images, render_path(two_lights, images=12, spp=512, max_depth=6), block=8)
    assert agreement.agrees, agreement
    assert agreement.detectable < 0.03, agreement


def test_a_table_without_the_safety_share_keeps_every_cell_alive(two_lights: Any) -> None:
    from elps_core.sampling.start import StartDensity
    from elps_core.scene.emission import Emission

    spike = np.zeros((16, 16))
    spike[0, 0] = 1.0
    density = StartDensity(Emission(two_lights), spike)
    assert (density.probability > 0.0).all()
    assert density.probability[0, 0] > 0.99


def test_grid_columns_are_a_multiple_of_the_emitters() -> None:
    from elps_core.context.adjoint import grid

    for emitters in (1, 2, 3, 9, 64, 65, 100, 1000, 10000):
        rows, columns = grid(emitters, 64)
        assert columns % emitters == 0
        assert rows >= 1
        assert rows * columns <= max(2 * 64 * 64, emitters)


def test_shrinkage_keeps_signal_and_removes_noise() -> None:
    from elps_core.context.adjoint import shrunk

    rng = np.random.default_rng(6)
    signal = np.linspace(0.0, 1.0, 256).reshape(16, 16)
    clean = shrunk(np.stack([signal + 1e-6 * rng.standard_normal((16, 16)) for _ in range(8)]), 2)
    assert np.abs(clean - signal).max() < 1e-5
    noisy = np.stack([1.0 + rng.standard_normal((16, 16)) for _ in range(8)])
    assert shrunk(noisy, 2).std() < 0.3 * noisy.mean(axis=0).std()


@pytest.mark.parametrize(("rows", "columns", "emitters"), [(16, 16, 1), (16, 32, 2), (9, 15, 3), (1, 7, 1), (1, 4, 4)])
def test_shrinkage_keeps_the_sum_of_every_emitter(rows: int, columns: int, emitters: int) -> None:
    from elps_core.context.adjoint import shrunk

    batches = np.random.default_rng(7).exponential(size=(4, rows, columns)) ** 3
    batches[:, :, : columns // emitters] *= 0.0 if emitters > 1 else 1.0  # One gives nothing
    drawn = shrunk(batches, emitters)
    assert (drawn >= 0.0).all()

    def sums(image: Array) -> Array:
        return np.asarray(image.reshape(rows, emitters, -1).sum(axis=(0, 2)))

    assert sums(drawn) == pytest.approx(sums(batches.mean(axis=0)), rel=1e-12)


def test_shrinkage_finds_what_is_bright_in_noise() -> None:
    """A quarter of a lamp that counts, by records as rare as they are: each cell alone is hardly known."""
    from elps_core.context.adjoint import shrunk

    rng, signal = np.random.default_rng(8), np.full((64, 64), 0.1)
    signal[:32, 32:] = 1.0
    batches = rng.poisson(signal, size=(8, 64, 64)).astype(float)
    off = np.square(shrunk(batches, 1) / signal - 1.0).mean()
    assert off < 0.05 * np.square(batches.mean(axis=0) / signal - 1.0).mean()
    assert off < 0.05


def test_eye_paths_tell_where_they_met_a_lamp_in_the_first_batch_too(
    mi: Any, camera_dict: Callable[..., dict[str, Any]]
) -> None:
    """The density is flat on a lamp then, so that nobody else would ask for the cell."""
    lamp = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, -1]),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
    }
    scene = mi.load_dict({"type": "scene", "sensor": camera_dict([0, 0, 2], [0, 0, -1]), "lamp": lamp})
    first = measurement(scene, samples_per_cell=512).batches[0]
    assert first.max() < 4.0 * first.mean()


def test_a_context_of_other_lights_is_refused(two_lights: Any, mi: Any) -> None:
    from elps_core.context.build import check_lights
    from elps_core.context.store import GlobalContext
    from elps_core.errors import ContextMismatch
    from elps_core.scene.emission import Emission
    from elps_core.settings import ContextSettings

    emission = Emission(two_lights)
    context = GlobalContext(
        "d", "s", 0, ContextSettings(), np.ones((4, 4), np.float32), emission.keys + np.float32(0.5), {}
    )
    with pytest.raises(ContextMismatch):
        check_lights(context, emission)
