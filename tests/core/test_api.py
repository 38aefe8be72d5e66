"""The public door: what is in it, what it costs, and what comes out."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import elps_core as elps
from elps_core.scene.generate import cornell, write

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> elps.LoadedScene:
    path = tmp_path_factory.mktemp("scene") / "box.zip"
    write(cornell(), path)
    return elps.load_scene(path, size=(16, 12))


def run(code: str) -> None:
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr


def test_every_name_is_there_before_a_variant_is_set() -> None:
    run("import elps_core as elps; [getattr(elps, name) for name in elps.__all__]; assert elps.__version__")
    assert sorted(elps.__all__) == sorted({*elps._MODULES, "__version__"})


def test_importing_it_costs_nothing() -> None:
    run("import sys, elps_core; sys.exit('mitsuba' in sys.modules or 'drjit' in sys.modules or 'numpy' in sys.modules)")


def test_a_name_that_is_not_there_is_an_error() -> None:
    with pytest.raises(AttributeError, match="nonsense"):
        _ = elps.nonsense


def test_an_image_is_an_array_and_grows_before_the_eyes(box: elps.LoadedScene) -> None:
    seen: list[elps.Progress] = []
    image = elps.render(box, samples=8, integrator="path", light_sampling="power", progress=seen.append)
    assert image.pixels.shape == (12, 16, 3)
    assert image.pixels.dtype == np.float32
    assert image.pixels.mean() > 0.0
    assert (image.channels, image.spp, image.settings.integrator) == (("R", "G", "B"), 8, "path")
    assert image.context is None
    assert seen[-1].share == 1.0
    assert np.array_equal(seen[-1].image, image.pixels)  # type: ignore[arg-type]


def test_a_context_serves_the_next_render(box: elps.LoadedScene) -> None:
    steps: list[elps.Progress] = []
    settings = elps.ContextSettings(resolution=8, samples_per_cell=16, regions=0)
    context = elps.build_context(box, settings, progress=steps.append)
    assert steps[-1].share == pytest.approx(1.0)
    plain = elps.RenderSettings(integrator="bdpt", direction_sampling="scattering", roulette="albedo", context=settings)
    image = elps.render(box, plain, samples=2, context=context)
    assert image.context is context
    assert image.pixels.mean() > 0.0


def test_what_does_not_fit_is_an_error_of_ours(box: elps.LoadedScene, tmp_path: Path) -> None:
    with pytest.raises(elps.ElpsError, match="integrator"):
        elps.render(box, samples=1, integrator="magic")
    with pytest.raises(elps.ElpsError, match="there is no scene"):
        elps.render(tmp_path / "nothing.xml", samples=1)


def test_mitsuba_can_name_our_integrators(box: elps.LoadedScene) -> None:
    import mitsuba as mi

    elps.register()
    pixels = np.array(mi.render(box.scene, integrator=mi.load_dict({"type": "elps_path"}), spp=4))
    assert pixels.shape == (12, 16, 3)
    assert pixels.mean() > 0.0
