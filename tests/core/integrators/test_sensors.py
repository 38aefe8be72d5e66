"""Several cameras of one file, each with a film and a crop window of its own, against Mitsuba's paths.

They are held to their place: precision is what the zoo shows, with more samples.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elps_core.scene.loader import load_scene
from elps_core.settings import RenderSettings
from tests.agreement import compare

FILM = """<film type="hdrfilm"><integer name="width" value="{}"/><integer name="height" value="{}"/>
<integer name="crop_offset_x" value="{}"/><integer name="crop_offset_y" value="{}"/>
<integer name="crop_width" value="{}"/><integer name="crop_height" value="{}"/><rfilter type="{}"/></film>"""
LOOK = '<transform name="to_world">{}<lookat origin="{}" target="0, 0, 0" up="0, 1, 0"/></transform>'
WIDE = '<scale value="3"/>'
SCENE = f"""<scene version="3.0.0">
<sensor type="perspective"><float name="fov" value="40"/>{LOOK.format("", "0, 2, 6")}
{FILM.format(40, 30, 14, 9, 20, 16, "box")}</sensor>
<sensor type="orthographic">{LOOK.format(WIDE, "4, 3, 5")}
{FILM.format(24, 48, 3, 20, 18, 22, "gaussian")}</sensor>
<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/>
<translate y="-1"/></transform></shape>
<shape type="sphere"><bsdf type="roughplastic"/></shape>
<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="90"/>
<translate x="1.5" y="2.5" z="1"/></transform>
<emitter type="area"><rgb name="radiance" value="4, 3, 2"/></emitter></shape></scene>"""
SIZES = [(20, 16), (18, 22)]
IMAGES, SPP, DEPTH = 16, 96, 4
LEVEL = 1e-3
"""Chance of a false alarm of one comparison: eight of them are made."""
POWER = 0.06
"""Smallest difference of the means that is found in every case. A window that is off by one pixel is further away."""


OPTIONS: dict[str, dict[str, Any]] = {"pssmlt": {"pssmlt": {"bootstrap": 4096}}}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cameras") / "scene.xml"
    path.write_text(SCENE)
    return path


@cache
def images(scene: Path, sensor: int, algorithm: str) -> np.ndarray[Any, Any]:
    """Independent images [n, height, width, 3] of one of the cameras."""
    from elps_core.renderer import Renderer

    loaded = load_scene(scene, "llvm_ad_rgb", sensor=sensor)
    given = {"light_sampling": "uniform", "max_depth": DEPTH, "sensor": sensor, "roulette": "throughput"}
    settings = RenderSettings.model_validate({"integrator": algorithm, **given, **OPTIONS.get(algorithm, {})})
    renderer = Renderer(loaded, settings)
    assert renderer.size == SIZES[sensor]
    return np.stack([renderer.render_chunk(index, SPP).image for index in range(IMAGES)])


@pytest.mark.parametrize("algorithm", ["path", "light", "bdpt", "pssmlt"])
@pytest.mark.parametrize("sensor", [0, 1])
def test_every_camera_of_a_file_has_its_own_window(scene: Path, mi: Any, sensor: int, algorithm: str) -> None:
    del mi
    reference = images(scene, sensor, "mi_path")
    assert reference.shape[1:3] == SIZES[sensor][::-1]
    found = compare(images(scene, sensor, algorithm), reference, block=8, level=LEVEL)
    assert found.agrees, found
    assert found.detectable < POWER, found
