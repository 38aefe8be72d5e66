"""Pixels from filtered samples: what they are divided by, and on which of them samples fall."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from elps_core.estimate.film import Accumulation, Chunk
from tests.rendering import render

Array = np.ndarray[Any, Any]

LOBES = ["catmullrom", "lanczos", "mitchell"]
"""Filters whose weights are negative in places."""
CROP = {"crop_offset_x": 3, "crop_offset_y": 2, "crop_width": 9, "crop_height": 7}
CRITICAL = 5.0
"""Standard errors that one of a few hundred pixels exceeds in no more than one of a thousand runs."""


def glowing(mi: Any, filter_name: str, size: tuple[int, int] = (16, 12), **film: Any) -> Any:
    """A checkered lamp that the camera looks at from near, so that the film has edges, and borders with light."""
    look = mi.ScalarTransform4f().look_at([0.13, 0.07, 2.0], [0.1, 0.1, 0.0], [0.1, 1, 0])
    pattern = {"type": "checkerboard", "color0": {"type": "rgb", "value": 0.1}, "color1": {"type": "rgb", "value": 1.0}}
    turned = mi.ScalarTransform3f().scale([4.0, 4.0])
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": look,
                "film": {
                    "type": "hdrfilm",
                    "width": size[0],
                    "height": size[1],
                    "rfilter": {"type": filter_name},
                    **film,
                },
            },
            "lamp": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale(2.0),
                "emitter": {"type": "area", "radiance": {**pattern, "to_uv": turned}},
            },
        }
    )


def even(mi: Any, filter_name: str, size: tuple[int, int]) -> Any:
    """Radiance 1 everywhere."""
    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": filter_name}}
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 45, "film": film},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}},
            "far": {"type": "sphere", "center": [0.0, -500.0, 0.0]},
        }
    )


def chunks(scene: Any, spp: int, count: int, max_depth: int = 1) -> list[Chunk]:
    """Independent chunks by path tracing."""
    from elps_core.integrators import make
    from elps_core.sampling.start import StartDensity, power_table
    from elps_core.scene.emission import Emission
    from elps_core.settings import RenderSettings

    emission = Emission(scene)
    lights = StartDensity(emission, power_table(emission))
    settings = RenderSettings(integrator="path", light_sampling="power", max_depth=max_depth)
    frames = make.frames(scene, scene.sensors()[0], lights, settings)
    drawn = (frames.render(spp, (0, index)) for index in range(count))
    return [
        Chunk(
            index,
            spp,
            0.1,
            np.array(frame.image),
            np.array(frame.weight),
            filtered=None if frame.filtered is None else np.array(frame.filtered),
        )
        for index, frame in enumerate(drawn)
    ]


def merged(parts: list[Chunk]) -> Accumulation:
    height, width, _ = parts[0].image.shape
    total = Accumulation.empty(width, height)
    total.add_all(parts)
    return total


@pytest.mark.parametrize(
    ("name", "spp", "crop"),
    [
        ("gaussian", 4, {}),
        ("gaussian", 64, CROP),
        ("lanczos", 4, {}),
        ("lanczos", 64, CROP),
        ("catmullrom", 4, CROP),
        ("mitchell", 64, {}),
    ],
)
def test_chunks_add_up_to_the_image_that_mitsuba_has(mi: Any, name: str, spp: int, crop: dict[str, int]) -> None:
    scene = glowing(mi, name, **crop)
    ours = merged(chunks(scene, spp, 1024 // spp))
    reference = render(scene, "mi_path", images=16, spp=2048, max_depth=1)
    error = np.hypot(ours.standard_error(), reference.std(axis=0, ddof=1) / 4.0) + 1e-4
    assert (np.abs(ours.mean() - reference.mean(axis=0)) < CRITICAL * 1.3 * error).all()
    assert np.median(error) < 0.01
    z = (ours.mean() - reference.mean(axis=0)) / error
    assert 0.6 < np.sqrt((z**2).mean()) < 1.4


@pytest.mark.parametrize("name", LOBES)
def test_one_sample_per_pixel_is_no_quotient_by_next_to_nothing(mi: Any, name: str) -> None:
    (chunk,) = chunks(even(mi, name, (128, 96)), 1, 1)
    assert np.abs(chunk.image).max() < 4.0
    assert (chunk.weight > 0.0).all()
    assert chunk.image[4:-4, 4:-4].mean() == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("name", LOBES)
def test_the_noise_of_the_filter_is_part_of_the_error_while_there_is_some(mi: Any, name: str) -> None:
    parts = chunks(even(mi, name, (64, 48)), 1, 8)
    few, many = merged(parts[:7]), merged(parts)
    actual = float(np.sqrt(((few.mean() - 1.0) ** 2).mean()))
    assert few.relative_error() == pytest.approx(actual, rel=0.15)
    assert actual > 0.05
    assert np.abs(many.mean() - 1.0).max() < 1e-4
    assert many.relative_error() == pytest.approx(0.0, abs=1e-4)


def test_filters_without_lobes_have_no_noise_of_their_own(mi: Any) -> None:
    (chunk,) = chunks(even(mi, "gaussian", (64, 48)), 1, 1)
    assert np.abs(chunk.image - 1.0).max() < 1e-5


def test_samples_fall_on_their_own_pixels_however_wide_the_film_is(mi: Any) -> None:
    import drjit as dr

    from elps_core.integrators.canvas import corner, within

    width = 16384
    pixel = dr.arange(mi.UInt32, width)
    first = corner(pixel, width)
    last = within(first, mi.Point2f(1.0 - 2.0**-23))
    assert np.array_equal(np.floor(np.array(last)), np.array(first))
    assert not np.array_equal(np.floor(np.array(first + (1.0 - 2.0**-23))), np.array(first))
    middle = np.array(within(first, mi.Point2f(0.5)))
    assert np.array_equal(middle, np.array(first) + 0.5)


def test_no_pixel_of_a_wide_film_is_black(mi: Any) -> None:
    for part in chunks(even(mi, "box", (16384, 4)), 1, 2):
        assert (part.image == 1.0).all()
