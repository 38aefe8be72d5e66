"""Channels of the file that a film asks for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

from elps_core.estimate.film import RGB, RGBA, Accumulation, Chunk
from elps_core.io.exr import Part, read_exr
from elps_core.io.formats import converted, of_variant, shown, shown_error
from elps_core.io.result import write_result
from elps_core.scene.summary import FilmSummary
from elps_core.settings import RenderSettings

WHITE = np.ones((1, 1, 3), np.float32)
D65 = [0.95046, 1.0, 1.08875]
"""X, Y and Z of the white of Rec. 709."""


def test_white_has_the_luminance_of_white() -> None:
    assert converted(WHITE, RGB, FilmSummary(pixels="luminance"))[0] == pytest.approx(np.ones((1, 1, 1)), abs=1e-5)
    assert converted(WHITE, RGB, FilmSummary(pixels="xyz"))[0][0, 0] == pytest.approx(D65, abs=1e-4)


@pytest.mark.parametrize(
    ("pixels", "names"),
    [
        ("luminance", ("Y",)),
        ("luminance_alpha", ("Y", "A")),
        ("rgb", ("R", "G", "B")),
        ("rgba", ("R", "G", "B", "A")),
        ("xyz", ("X", "Y", "Z")),
        ("xyza", ("X", "Y", "Z", "A")),
        ("bands", ("near", "blue")),
    ],
)
@pytest.mark.parametrize("half", [True, False])
def test_the_file_has_the_channels_of_the_film(tmp_path: Path, pixels: str, names: tuple[str, ...], half: bool) -> None:
    film = FilmSummary.model_validate({"pixels": pixels, "half": half})
    channels = names if pixels == "bands" else RGBA if film.has_alpha else RGB
    rng = np.random.default_rng(1)
    merged = Accumulation.empty(4, 3)
    for index in range(3):
        image = rng.random((3, 4, len(channels)), np.float32)
        merged.add(Chunk(index, 2, 0.1, image, np.full((3, 4), 2, np.float32), channels=channels))
    path = tmp_path / "image.exr"
    write_result(path, merged, RenderSettings(), scene="a", render="b", context=None, film=film)
    file = oiio.ImageInput.open(str(path))
    for number, part in enumerate(("image", "standard error")):
        assert file.seek_subimage(number, 0)
        spec = file.spec()
        assert spec.getattribute("oiio:subimagename") == part
        assert set(spec.channelnames) == set(names)
        assert spec.getattribute("PixelAspectRatio") == 1.0
        assert spec.getattribute("compression") == "zip"
        assert str(spec.format) == ("half" if half and part == "image" else "float")
        assert (spec.alpha_channel >= 0) is film.has_alpha
    file.close()
    parts, attributes = read_exr(path)
    wanted = converted(merged.mean(), channels, film)[0]
    order = sorted(range(len(names)), key=lambda k: names[k]) if pixels == "bands" else list(range(len(names)))
    assert parts["image"] == pytest.approx(wanted[..., order], rel=1e-3)
    assert attributes["channels"] == ",".join(names)
    if film.has_alpha:
        assert parts["image"][..., -1] == pytest.approx(merged.mean()[..., -1], rel=1e-3)
    if pixels != "bands":
        grey = pixels.startswith("luminance")
        looks = shown(Part(parts["image"], names))
        assert looks == pytest.approx(np.repeat(wanted[..., :1], 3, -1) if grey else merged.mean()[..., :3], abs=2e-3)


def test_the_file_of_a_crop_window_is_laid_out_as_mitsubas(tmp_path: Path, mi: Any) -> None:
    """Only the window, from (0, 0) on: neither file says where in the film it lay."""
    window = {"crop_offset_x": 7, "crop_offset_y": 5, "crop_width": 20, "crop_height": 10}
    film = mi.load_dict({"type": "hdrfilm", "width": 40, "height": 30, "pixel_format": "rgba", **window})
    film.prepare([])
    film.write(mi.filesystem.path(str(tmp_path / "theirs.exr")))
    merged = Accumulation.empty(20, 10)
    image = np.zeros((10, 20, 4), np.float32)
    merged.add(Chunk(0, 1, 0.1, image, image[..., 0] + 1.0, channels=RGBA))
    asked = FilmSummary(pixels="rgba")
    write_result(tmp_path / "ours.exr", merged, RenderSettings(), scene="a", render="b", context=None, film=asked)
    theirs, ours = (oiio.ImageInput.open(str(tmp_path / name)).spec() for name in ("theirs.exr", "ours.exr"))
    for name in ("roi", "roi_full", "channelnames", "alpha_channel"):
        assert getattr(ours, name) == getattr(theirs, name), name
    assert (ours.width, ours.height) == (20, 10)
    assert ours.channelnames == ("R", "G", "B", "A")


def test_numbers_that_16_bits_do_not_hold_have_32(tmp_path: Path) -> None:
    merged = Accumulation.empty(2, 1)
    merged.add(Chunk(0, 1, 0.1, np.full((1, 2, 3), 1e6, np.float32), np.ones((1, 2), np.float32)))
    path = tmp_path / "image.exr"
    write_result(path, merged, RenderSettings(), scene="a", render="b", context=None, film=FilmSummary(half=True))
    assert (read_exr(path)[0]["image"] == 1e6).all()


def test_standard_errors_are_bounded_whatever_colours_have_in_common() -> None:
    rng = np.random.default_rng(2)
    film = FilmSummary(pixels="xyz")
    for common in (0.0, 1.0):
        noise = common * rng.normal(size=(4000, 1)) + (1.0 - common) * rng.normal(size=(4000, 3))
        images = noise[:, None, :].astype(np.float32)
        actual = converted(images, RGB, film)[0].std(axis=0)
        bound = converted(images.std(axis=0, keepdims=True), RGB, film)[0][0]
        assert (actual <= bound * 1.001).all()
        if common:
            assert bound == pytest.approx(actual, rel=1e-3)


def test_variants_without_colours_write_luminance() -> None:
    film = FilmSummary(pixels="rgb")
    assert of_variant(film, "llvm_ad_mono").pixels == "luminance"
    assert of_variant(film, "llvm_ad_rgb") == film


def test_errors_of_tristimulus_values_are_shown_by_luminance() -> None:
    error = np.array([[[1.0, 2.0, 3.0]]], np.float32)
    assert (shown_error(Part(error, ("X", "Y", "Z"))) == 2.0).all()
    assert (shown_error(Part(error, RGB)) == error).all()
