"""Images with texels that are no light: they are replaced when the scene is loaded, and the file is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO
import pytest

from elps_core import device
from elps_core.scene import images
from elps_core.scene.loader import load_scene
from elps_core.settings import RenderSettings

from .conftest import load, scene_xml, texture, zip_of

HEIGHT, WIDTH = 6, 8
SPOT, HOLE = (1, 2), (4, 5)
"""Where a texel is infinite in all channels, and where one channel is not a number; row and column."""


def picture() -> np.ndarray[Any, Any]:
    """Numbers that half precision and RGBE hold exactly, 4 at most."""
    return np.asarray(
        2.0 ** np.random.default_rng(3).integers(-3, 3, (HEIGHT, WIDTH, 1)) * [1.0, 0.5, 0.25], np.float32
    )


def odd_picture() -> np.ndarray[Any, Any]:
    odd = picture()
    odd[SPOT] = np.inf
    odd[HOLE][1] = np.nan
    return odd


def write(path: Path, texels: np.ndarray[Any, Any], kind: str) -> bytes:
    if path.suffix == ".pfm":
        order = {"little": ("<f4", b"-1.0"), "big": (">f4", b"1.0")}[kind]
        return b"PF\n%d %d\n%s\n" % (WIDTH, HEIGHT, order[1]) + texels[::-1].astype(order[0]).tobytes()
    if path.suffix == ".hdr":  # Four bytes a texel without runs: the mantissas, and the exponent that they share
        mantissa, exponent = np.frexp(texels.max(axis=-1, keepdims=True))
        bytes_ = np.concatenate([texels * (256.0 * mantissa / texels.max(axis=-1, keepdims=True)), exponent + 128], -1)
        return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (HEIGHT, WIDTH) + bytes_.astype("u1").tobytes()
    output = OpenImageIO.ImageOutput.create(str(path))
    spec = OpenImageIO.ImageSpec(WIDTH, HEIGHT, 3, "float" if kind == "tiles" else kind)
    if kind == "tiles":
        spec.tile_width = spec.tile_height = 16
    assert output.open(str(path), spec)
    assert output.write_image(texels)
    output.close()
    return path.read_bytes()


def read(folder: Path, name: str, data: bytes) -> np.ndarray[Any, Any]:
    """As Mitsuba reads it."""
    mi = device.use("scalar_rgb")
    path = folder / f"read-{name}"
    path.write_bytes(data)
    bitmap = mi.Bitmap(str(path)).convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False)
    return np.array(bitmap)


@pytest.mark.parametrize(
    ("name", "kind"), [("a.exr", "half"), ("a.exr", "float"), ("a.exr", "tiles"), ("a.pfm", "little"), ("a.pfm", "big")]
)
def test_texels_that_are_no_light_are_replaced_and_all_others_stay(name: str, kind: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(write(path, odd_picture(), kind))
    assert not np.isfinite(read(tmp_path, name, path.read_bytes())).all()
    with path.open("rb") as file:
        found = images.mended(file, str(path))
    assert found is not None
    data, (told,) = found
    expected = picture()
    expected[HOLE][1] = 0.0
    expected[SPOT] = np.delete(picture().reshape(-1, 3), SPOT[0] * WIDTH + SPOT[1], axis=0).max()
    assert np.array_equal(read(tmp_path, name, data), expected)
    assert told.startswith("has texels that are infinite or no numbers, 2 of 48")


def test_the_greatest_number_of_rgbe_stands_for_infinity(tmp_path: Path) -> None:
    """The format has no infinity: a sum of two such texels is one."""
    path = tmp_path / "a.hdr"
    data = bytearray(write(path, picture(), "rgbe"))
    begin = len(data) - 4 * HEIGHT * WIDTH
    place = begin + 4 * (SPOT[0] * WIDTH + SPOT[1])
    data[place : place + 4] = b"\xff\xff\xff\xff"
    path.write_bytes(data)
    assert read(tmp_path, "a.hdr", bytes(data)).max() > 1e38
    with path.open("rb") as file:
        found = images.mended(file, str(path))
    assert found is not None
    expected = picture()
    expected[SPOT] = 4.0
    assert np.array_equal(read(tmp_path, "a.hdr", found[0]), expected)


@pytest.mark.parametrize(("name", "kind"), [("a.exr", "half"), ("a.exr", "float"), ("a.hdr", "rgbe"), ("a.pfm", "big")])
def test_other_images_are_taken_as_they_are(name: str, kind: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(write(path, picture(), kind))
    with path.open("rb") as file:
        assert images.mended(file, str(path)) is None


def test_an_environment_with_an_infinite_sun_lights_the_scene_and_is_named(tmp_path: Path) -> None:
    sky = '<emitter type="envmap"><string name="filename" value="skies/{}"/></emitter>'
    odd = write(tmp_path / "a.exr", odd_picture(), "half")
    even = odd_picture()
    even[SPOT], even[HOLE][1] = 4.0, 0.0
    device.use("llvm_ad_rgb")
    from elps_core.renderer import Renderer

    settings = RenderSettings(integrator="path", max_depth=2, light_sampling="power")
    found = {}
    for name, data in (("odd", odd), ("even", write(tmp_path / "b.exr", even, "half"))):
        bundle = {"scene.xml": scene_xml(light=sky.format(f"{name}.exr")), f"skies/{name}.exr": data}
        loaded = load_scene(zip_of(tmp_path / f"{name}.zip", bundle), "llvm_ad_rgb")
        told = [warning for warning in loaded.summary.warnings if "texel" in warning]
        assert len(told) == (name == "odd")
        assert all("'skies/odd.exr' has texels" in warning and "/tmp" not in warning for warning in told)
        found[name] = Renderer(loaded, settings).render_chunk(0, 16).image
    assert found["odd"].min() > 0.0
    assert np.allclose(found["odd"], found["even"], rtol=1e-4)


def test_a_texture_with_such_texels_is_named_by_its_owner(tmp_path: Path) -> None:
    data = write(tmp_path / "a.exr", odd_picture(), "float")
    (told,) = load(tmp_path, scene_xml(texture("a.exr")), {"a.exr": data}).summary.warnings
    assert told.startswith('<texture type="bitmap"') or "bitmap" in told
    assert "'a.exr' has texels" in told
