"""Hidden emitters: the camera sees what is behind them, and they light the scene all the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from elps_core import device
from elps_core.scene.loader import load_scene
from elps_core.settings import RenderSettings, with_overrides
from tests.agreement import compare

SCENE = """<scene version="3.0.0"><sensor type="perspective"><float name="fov" value="40"/>
<transform name="to_world"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/><rfilter type="box"/></film>
</sensor>
<shape type="rectangle"><transform name="to_world"><scale value="0.8"/><translate z="-1"/></transform></shape>
<shape type="rectangle"><transform name="to_world"><scale value="0.3"/><translate z="1"/></transform>
<bsdf type="diffuse"/><emitter type="area"><rgb name="radiance" value="7"/></emitter></shape>
<shape type="sphere"><point name="center" x="1" y="0" z="2"/><float name="radius" value="0.2"/>
<emitter type="area"><rgb name="radiance" value="20, 5, 1"/></emitter></shape>
<emitter type="constant"><rgb name="radiance" value="0.5"/></emitter></scene>"""


def images(folder: Path, integrator: str, **overrides: object) -> np.ndarray:
    device.use("llvm_ad_rgb")
    from elps_core.renderer import Renderer

    (folder / "scene.xml").write_text(SCENE)
    plain = {"light_sampling": "uniform"} if integrator == "path" else {}
    settings = RenderSettings(integrator=integrator, hide_emitters=True, max_depth=4, **plain)
    renderer = Renderer(load_scene(folder, settings.variant), with_overrides(settings, overrides))
    return np.stack([renderer.render_chunk(index, 64).image for index in range(16)])


def test_paths_see_what_mitsuba_sees(tmp_path: Path) -> None:
    wanted = images(tmp_path, "mi_path")
    found = images(tmp_path, "path")
    assert found[:, 0, 0].max() == 0.0  # the environment
    assert 0.0 < found[:, 8, 8].mean() < 1.0  # behind the lamp
    outcome = compare(found, wanted, block=4)
    assert outcome.agrees, outcome
    assert outcome.detectable < 0.02, outcome


def test_auto_hides_before_it_has_a_context(tmp_path: Path) -> None:
    assert images(tmp_path, "auto")[:, 0, 0].max() == 0.0


@pytest.mark.parametrize("integrator", ["bdpt", "light", "pssmlt", "mi_ptracer"])
def test_what_would_show_them_is_refused(integrator: str) -> None:
    with pytest.raises(ValueError, match="hide_emitters"):
        RenderSettings(integrator=integrator, hide_emitters=True)
