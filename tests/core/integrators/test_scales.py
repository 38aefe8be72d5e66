"""Rooms far from the origin, tiny and huge ones, far cameras and far lamps: the image of a room at home."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elps_core.scene.loader import load_scene
from elps_core.settings import RenderSettings, with_overrides
from tests.agreement import compare
from tests.zoo.rooms import room

ALGORITHMS = ("path", "light", "bdpt")
IMAGES, SPP = 12, 64


def images(xml: str, algorithm: str, tmp_path: Path) -> Any:
    from elps_core.renderer import Renderer

    path = tmp_path / "scene.xml"
    path.write_text(xml)
    loaded = load_scene(path, "llvm_ad_rgb")
    settings = {"integrator": algorithm, "max_depth": 4, "roulette": "none", "light_sampling": "power"}
    renderer = Renderer(loaded, with_overrides(RenderSettings(), settings))
    return np.stack([renderer.render_chunk(index, SPP).image for index in range(IMAGES)])


@pytest.mark.parametrize(
    ("xml", "usual"),
    [
        pytest.param(room(place=1000.0), room(), id="1000 units away"),
        pytest.param(room(1e-3), room(), id="a thousandth"),
        pytest.param(room(1e-3, 1e5), room(), id="a thousandth, far away"),
        pytest.param(room(1e5, 1e5), room(), id="huge, far away"),
        pytest.param(room(eye=4e4), room(eye=4e4), id="camera 10,000 rooms away"),
        pytest.param(room(lamp=4e4), room(lamp=4e4), id="lamp 10,000 rooms away"),
    ],
)
def test_all_algorithms_make_the_usual_image(xml: str, usual: str, mi: Any, tmp_path: Path) -> None:
    del mi
    wanted = images(usual, "mi_path", tmp_path)
    for algorithm in ALGORITHMS:
        outcome = compare(images(xml, algorithm, tmp_path), wanted, block=8)
        assert outcome.agrees, (algorithm, outcome)
        assert outcome.detectable < 0.03, (algorithm, outcome)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_no_light_leaks_through_walls_of_half_a_millimetre(algorithm: str, mi: Any, tmp_path: Path) -> None:
    """Between the room and its lamp, ten metres across: what stands close to either end is met."""
    del mi
    sides = "".join(
        f'<shape type="cube"><transform name="to_world"><scale value="{scale}"/><translate value="{move}"/></transform>'
        "</shape>"
        for scale, move in (
            ("5, 0.00025, 5", "0, 5, 0"),
            ("5, 0.00025, 5", "0, -5, 0"),
            ("0.00025, 5, 5", "5, 0, 0"),
            ("0.00025, 5, 5", "-5, 0, 0"),
            ("5, 5, 0.00025", "0, 0, 5"),
            ("5, 5, 0.00025", "0, 0, -5"),
        )
    )
    sun = (
        '<emitter type="directional"><vector name="direction" value="0.3, -1, -0.2"/><rgb name="irradiance" value="9"/>'
        '</emitter><shape type="disk"><transform name="to_world"><rotate x="1" angle="90"/>'
        '<translate value="0, 5.1, 0"/></transform><emitter type="area"/></shape>'
    )
    assert images(room(light=sides + sun), algorithm, tmp_path).max() == 0.0
