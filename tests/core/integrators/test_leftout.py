"""Samples that are not finite: every algorithm leaves them out, counts them, and says what is seen there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elps_core.settings import RenderSettings

SCENE = """<scene version="3.0.0">
<sensor type="perspective">
    <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="12"/>
        <rfilter type="box"/></film>
</sensor>
<emitter type="constant"/>
<shape type="sphere" id="ball">{}</shape></scene>"""
TOO_BRIGHT = '<emitter type="area"><rgb name="radiance" value="3e38"/></emitter>'
"""A number in single precision, whose sum over three channels is none."""
NO_INDEX = '<bsdf type="dielectric" id="glass"><float name="int_ior" value="0"/></bsdf>'
"""Mitsuba divides by it."""
SPP = 8


def chunk(mi: Any, folder: Path, ball: str, integrator: str) -> Any:
    from elps_core.renderer import Renderer
    from elps_core.scene.loader import load_scene

    (folder / "scene.xml").write_text(SCENE.format(ball))
    scene = load_scene(folder / "scene.xml", "llvm_ad_rgb")
    settings = RenderSettings(integrator=integrator, max_depth=2, light_sampling="power")
    return Renderer(scene, settings).render_chunk(0, SPP)


@pytest.mark.parametrize("integrator", ["path", "light", "bdpt", "pssmlt", "mi_path"])
def test_what_is_not_finite_is_left_out_and_named(integrator: str, mi: Any, tmp_path: Path) -> None:
    found = chunk(mi, tmp_path, TOO_BRIGHT, integrator)
    # The corners show the sky alone; the ball is a disk of half of the image or more.
    assert np.isfinite(found.image).all()
    assert found.image[0, 0] == pytest.approx(1.0)
    assert set(found.left_out) <= {"'ball' of SmoothDiffuse", "the surroundings"}
    disk = found.left_out["'ball' of SmoothDiffuse"] / (16 * 12)
    assert disk > (0.2 if integrator == "pssmlt" else 0.2 * SPP)  # It looks at what is seen with fewer samples
    assert not found.image[6, 8].any()


def test_a_pixel_that_mitsuba_says_is_no_number_counts_nowhere(mi: Any, tmp_path: Path) -> None:
    found = chunk(mi, tmp_path, NO_INDEX, "mi_path")
    odd = found.weight == 0.0
    assert found.left_out["'ball' of 'glass'"] > 0
    assert sum(found.left_out.values()) == SPP * odd.sum()
    assert 0.2 < odd.mean() < 0.8
    assert not found.image[odd].any()
    assert found.image[~odd] == pytest.approx(1.0)


def test_where_all_is_finite_nothing_is_said(mi: Any, tmp_path: Path) -> None:
    assert not chunk(mi, tmp_path, "", "path").left_out


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_contributions_are_counted_by_the_pixel_where_they_fall(bad: float, mi: Any) -> None:
    from elps_core.integrators.leftout import LeftOut

    left_out = LeftOut(mi.ScalarVector2u(3, 2))
    where = mi.Point2f([0.5, 2.9, 2.9, 1.0, np.nan, 9.0], [0.5, 1.5, 1.5, 0.2, 0.5, 9.0])
    amount = mi.Float([1.0, bad, bad, bad, bad, bad])
    kept = left_out.keep(where, amount, mi.Bool([True, True, True, False, True, True]))
    assert np.array(kept).tolist() == [True, False, False, False, False, False]
    # Whatever has no place, or none on the film, is counted at its edge.
    assert left_out.counts.tolist() == [[1, 0, 0], [0, 0, 3]]
    left_out.begin()
    assert not left_out.counts.any()
