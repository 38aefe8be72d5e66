"""``elps strategies``: every strategy has its place, and together they are the image."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from elps_core.commands.strategies import pairs
from elps_core.io.exr import read_exr
from elps_core.io.preview import encode
from elps_core.io.pyramid import BACKGROUND, TONE, Linear, Pair, draw, rows_of

SPP = 8
SIZE = (40, 30)


def elps(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "elps_core.cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "box.zip"
    assert elps("scene", "cornell", "-o", str(path)).returncode == 0
    return path


def test_the_weighted_strategies_add_up_to_the_image(box: Path, tmp_path: Path) -> None:
    picture, exr = tmp_path / "pyramid.png", tmp_path / "all.exr"
    size = ("--size", "x".join(map(str, SIZE)))
    done = elps(
        "strategies", str(box), "-o", str(picture), "--exr", str(exr), "--spp", str(SPP), "--max-depth", "4", *size
    )
    assert done.returncode == 0, done.stderr
    parts, attributes = read_exr(exr)
    assert set(parts) == {f"s{s}t{t}" for s, t in pairs(4, aperture=False)}
    assert attributes["samples"] == SPP

    from elps_core.renderer import Renderer
    from elps_core.scene.loader import load_scene
    from elps_core.settings import RenderSettings

    scene = load_scene(box, "llvm_ad_rgb", size=SIZE)
    settings = RenderSettings(integrator="bdpt", light_sampling="power", max_depth=4)
    # The same random numbers, so that this is no question of noise.
    whole = Renderer(scene, settings).render_chunk(0, SPP).image
    np.testing.assert_allclose(np.sum(list(parts.values()), axis=0), whole, rtol=1e-3, atol=1e-4)
    assert sum(bool(part.any()) for part in parts.values()) == len(parts)
    assert pixels(picture).shape[2] == 3


def test_a_folder_gets_every_image(box: Path, tmp_path: Path) -> None:
    options = ("--spp", "2", "--max-depth", "2", "--size", "8x6", "--unweighted")
    done = elps("strategies", str(box), "-o", str(tmp_path / "out"), *options)
    assert done.returncode == 0, done.stderr
    names = {"pyramid.png", "s0t2.png", "s0t3.png", "s1t2.png", "s2t1.png"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    assert pixels(tmp_path / "out" / "s1t2.png").shape == (6, 8, 3)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--max-depth", "13"], "max_depth"),
        (["--max-depth", "0"], "max_depth"),
        (["--spp", "0"], "samples"),
        (["--set", "integrator=path"], "strategy of bdpt is shown"),
        (["--set", "bdpt.strategies=1,3"], "strategy of bdpt is shown"),
        (["--exr", "nowhere/all.exr"], "folder"),
    ],
)
def test_refusals_are_one_line(box: Path, tmp_path: Path, options: list[str], word: str) -> None:
    done = elps("strategies", str(box), "-o", str(tmp_path / "out.png"), *options)
    assert done.returncode == 2
    assert word in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_pairs_are_all_ways_to_make_a_path() -> None:
    pinhole, lens = (pairs(3, aperture=aperture) for aperture in (False, True))
    assert pinhole == [(0, 2), (0, 3), (1, 2), (2, 1), (0, 4), (1, 3), (2, 2), (3, 1)]
    assert set(lens) - set(pinhole) == {(3, 0), (4, 0)}


def flat(**images: float) -> dict[Pair, Linear]:
    """Images of one brightness each, by names such as ``s1t2``."""
    return {(int(k[1]), int(k[3])): np.full((96, 128, 3), value, np.float32) for k, value in images.items()}


def test_a_row_is_exposed_alike_and_in_order() -> None:
    rows = rows_of(flat(s0t2=0.0, s2t1=8.0, s0t3=1.0, s1t2=2.0))
    assert [row.segments for row in rows] == [1, 2]
    assert list(rows[1].images) == [(0, 3), (1, 2), (2, 1)]
    assert rows[0].is_dark
    assert not rows[1].is_dark
    assert rows[1].exposure == pytest.approx(-3.0)
    assert rows[1].shares() == pytest.approx({(0, 3): 1 / 11, (1, 2): 2 / 11, (2, 1): 8 / 11})
    picture = draw(rows, "title", "subtitle", weighted=True)
    # Along the middle of the last row of images the three come as they should.
    wanted = [int(encode(np.full((1, 1, 3), x), tone=TONE)[0, 0, 0]) for x in (1 / 8, 2 / 8, 1.0)]
    line = next(line for line in picture[::-1, :, 0] if np.count_nonzero(line == wanted[1]) == 128)
    assert [value for value in dict.fromkeys(line.tolist()) if value in wanted] == wanted
    assert picture[0, 0].tolist() == [int(BACKGROUND[i : i + 2], 16) for i in (1, 3, 5)]


def test_the_sum_stands_where_there_is_room() -> None:
    images = {pair: np.full((96, 128, 3), 0.5, np.float32) for pair in pairs(5, aperture=False)}
    weighted, unweighted = (draw(rows_of(images), "t", "s", weighted=way) for way in (True, False))
    assert weighted.shape == unweighted.shape
    corner = (slice(100, 200), slice(-300, -32))
    assert weighted[corner].mean() > 2 * unweighted[corner].mean()


def pixels(path: Path) -> np.ndarray:
    return np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.UINT8))
