"""Rooms far from the origin, tiny and huge ones, far cameras and far lamps: the image of a room at home."""

from __future__ import annotations

from math import atan, degrees
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elps_core.scene.loader import load_scene
from elps_core.settings import RenderSettings, with_overrides
from tests.agreement import compare

ALGORITHMS = ("path", "light", "bdpt")
IMAGES, SPP = 12, 64
USUAL_EYE, USUAL_LAMP = 4.0, 2.4


def room(
    size: float = 1.0,
    place: float = 0.0,
    *,
    eye: float = USUAL_EYE,
    lamp: float | None = None,
    light: str | None = None,
) -> str:
    """A floor, a wall, a ball and a lamp above, ``size`` times as large as at 1 and moved by ``place`` each way.

    The camera stands at the distance ``eye`` and sees as much of the room from everywhere. ``lamp`` is the distance of
    a lamp without extent, as bright on the floor from everywhere; without it there is an area light, or ``light``.
    """

    def at(*point: float) -> str:
        return ", ".join(repr(size * q + place) for q in point)

    def facing(rotate: str, scale: float, *point: float) -> str:
        return (
            f'<transform name="to_world">{rotate}<scale value="{size * scale!r}"/><translate value="{at(*point)}"/>'
            "</transform>"
        )

    def grey(value: float) -> str:
        return f'<bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="{value}"/></bsdf></bsdf>'

    down = facing('<rotate x="1" angle="90"/>', 0.5, 0, USUAL_LAMP, 0.5)
    above = f'<shape type="rectangle">{down}<emitter type="area"><rgb name="radiance" value="4"/></emitter></shape>'
    if lamp is not None:
        above = (
            f'<emitter type="spot"><transform name="to_world"><lookat origin="{at(0.2 * lamp, lamp, 0.3 * lamp)}" '
            f'target="{at(0, 0, 0)}" up="1, 0, 0"/></transform><float name="cutoff_angle" value="80"/>'
            f'<rgb name="intensity" value="{3 * (size * lamp) ** 2!r}"/></emitter>'
        )
    return f"""<scene version="3.0.0">
    <sensor type="perspective"><float name="fov" value="{degrees(2 * atan(1.4 / eye))!r}"/>
    <float name="near_clip" value="{0.01 * size!r}"/><float name="far_clip" value="{10 * eye * size!r}"/>
    <transform name="to_world"><lookat origin="{at(0, 0.7 + 0.2 * eye, eye)}" target="{at(0, 0.7, 0)}" up="0, 1, 0"/>
    </transform><film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/>
    <rfilter type="box"/></film></sensor>
    <shape type="rectangle">{facing('<rotate x="1" angle="-90"/>', 2.0, 0, 0, 0)}{grey(0.6)}</shape>
    <shape type="rectangle">{facing("", 2.0, 0, 1, -1.5)}{grey(0.5)}</shape>
    <shape type="sphere"><point name="center" value="{at(-0.5, 0.45, 0)}"/>
    <float name="radius" value="{0.45 * size!r}"/>{grey(0.4)}</shape>{above if light is None else light}</scene>"""


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
