"""Files that others read: EXR parts, names and attributes; PNG pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from elps_core.errors import ElpsError
from elps_core.estimate.film import Accumulation, Chunk
from elps_core.io.exr import ImageUnwritable, read_exr, write_exr
from elps_core.io.preview import adjoint_to_png, encode, to_png
from elps_core.io.result import ranges, write_result
from elps_core.settings import RenderSettings


def test_parts_and_attributes_come_back(tmp_path: Path) -> None:
    path = tmp_path / "image.exr"
    rng = np.random.default_rng(0)
    parts = {"image": rng.random((6, 9, 3), np.float32), "standard error": rng.random((6, 9), np.float32)}
    write_exr(path, parts, {"samples": 12, "seed": 2**32 - 1, "integrator": "bdpt", "share": 0.5})
    found, attributes = read_exr(path)
    assert list(found) == ["image", "standard error"]
    assert np.array_equal(found["image"], parts["image"])
    assert np.array_equal(found["standard error"][..., 0], parts["standard error"])
    assert attributes["samples"] == 12
    assert int(attributes["seed"]) == 2**32 - 1
    assert attributes["integrator"] == "bdpt"
    assert attributes["share"] == pytest.approx(0.5)
    assert [entry.name for entry in tmp_path.iterdir()] == ["image.exr"]


def test_a_result_tells_where_it_comes_from(tmp_path: Path) -> None:
    merged = Accumulation.empty(4, 3)
    for index in (0, 1, 3):
        merged.add(Chunk(index, 2, 0.1, np.full((3, 4, 3), index, np.float32), np.full((3, 4), 2, np.float32)))
    path = tmp_path / "result.exr"
    write_result(path, merged, RenderSettings(seed=5), scene="sha256:a", render="sha256:b", context="sha256:c")
    parts, attributes = read_exr(path)
    assert set(parts) == {"image", "standard error"}
    assert attributes["chunks"] == "0-1,3"
    assert attributes["samples"] == 6
    assert attributes["contextDigest"] == "sha256:c"
    assert attributes["version:mitsuba"] == "3.9.1"


def test_an_unwritable_place_is_one_line_without_a_path(tmp_path: Path) -> None:
    with pytest.raises(ImageUnwritable) as caught:
        write_exr(tmp_path / "missing" / "image.exr", {"image": np.zeros((2, 2, 3), np.float32)}, {})
    assert str(tmp_path) not in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_image_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "image.exr"
    path.write_bytes(b"not an image")
    with pytest.raises(ElpsError):
        read_exr(path)


def test_ranges_are_short() -> None:
    assert ranges({0, 1, 2, 5, 7, 8}) == "0-2,5,7-8"
    assert ranges(set()) == ""


def test_preview_is_srgb(tmp_path: Path) -> None:
    image = np.zeros((2, 3, 3))
    image[0, 0] = 0.2140
    image[0, 1] = [np.nan, np.inf, -1.0]
    pixels = encode(image)
    assert tuple(pixels[0, 0]) == (127, 127, 127) or tuple(pixels[0, 0]) == (128, 128, 128)
    assert tuple(pixels[0, 1]) == (0, 255, 0)
    assert encode(np.full((1, 1, 3), 0.107), exposure=1.0)[0, 0, 0] == pixels[0, 0, 0]
    path = tmp_path / "preview.png"
    path.write_bytes(to_png(image, tone="filmic"))
    spec = oiio.ImageInput.open(str(path)).spec()
    assert (spec.width, spec.height, spec.nchannels) == (3, 2, 3)


def test_adjoint_picture_has_a_block_a_cell(tmp_path: Path) -> None:
    path = tmp_path / "adjoint.png"
    path.write_bytes(adjoint_to_png(np.arange(12, dtype=np.float32).reshape(3, 4)))
    spec = oiio.ImageInput.open(str(path)).spec()
    assert (spec.width, spec.height) == (24, 18)
