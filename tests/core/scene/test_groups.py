"""Shapes in groups are shapes of the scene: their materials scatter, and their triangles count."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elps_core.scene.loader import load_scene
from elps_core.settings import RenderSettings

from .conftest import SENSOR, load, scene_xml

GROUP = """
    <shape type="shapegroup" id="g"><shape type="cube"/><shape type="sphere"><bsdf type="plastic"/></shape></shape>
    <shape type="instance"><ref id="g"/></shape><shape type="instance"><ref id="g"/></shape>
    <shape type="disk"/>"""


def test_every_shape_is_found_in_a_scene_with_instances(tmp_path: Path) -> None:
    loaded = load(tmp_path, scene_xml(GROUP))
    from elps_core.scene.groups import every_shape  # here: it needs a variant

    kinds = [shape.class_name() for shape in every_shape(loaded.scene)]
    assert {"Cube", "Sphere", "Disk", "Instance"} <= set(kinds)
    assert (kinds.count("Cube"), kinds.count("Sphere"), kinds.count("Instance")) == (1, 1, 2)
    assert loaded.summary.triangles == 12


def test_instances_reach_as_far_as_their_groups_stand_off(tmp_path: Path) -> None:
    moved = '<transform name="to_world"><scale value="2"/><translate x="-100"/></transform>'
    ball = '<shape type="sphere"><point name="center" x="50" y="0" z="0"/></shape>'
    away = GROUP.replace('<shape type="cube"/>', ball)
    loaded = load(tmp_path, scene_xml(away.replace('<ref id="g"/></shape><', f'<ref id="g"/>{moved}</shape><', 1)))
    from elps_core.scene.groups import local_reach

    assert local_reach(loaded.scene) / loaded.scale >= 99.0
    assert local_reach(load(tmp_path, scene_xml('<shape type="sphere"/>')).scene) == 0.0


ALONE = (
    '<shape type="cube"><transform name="to_world"><rotate y="1" angle="30"/><translate x="{0}"/></transform></shape>'
)
AGAIN = (
    f'<shape type="shapegroup" id="g">{ALONE}</shape><shape type="instance"><ref id="g"/>'
    '<transform name="to_world"><translate x="-{0}"/></transform></shape>'
)
LAMP = '<emitter type="point"><point name="position" value="1, 2, 4"/></emitter>'


def drawn(folder: Path, shapes: str, algorithm: str) -> float:
    """Mean of a small image in direct light, with the same random numbers for all."""
    from elps_core.renderer import Renderer

    (folder / "scene.xml").write_text(f'<scene version="3.0.0">{SENSOR}{shapes}{LAMP}</scene>')
    settings = RenderSettings(integrator=algorithm, max_depth=2, light_sampling="uniform", roulette="throughput")
    renderer = Renderer(load_scene(folder / "scene.xml", "llvm_ad_rgb", size=(8, 8)), settings)
    return float(np.mean(renderer.render_chunk(0, 64).image))


@pytest.mark.parametrize("algorithm", ["path", "bdpt"])
@pytest.mark.parametrize("far", [0, 2000])
def test_what_is_repeated_is_lit_as_what_stands_alone(tmp_path: Path, mi: Any, algorithm: str, far: int) -> None:
    """Also where a group's shapes stand far from its origin, where single precision rounds their surfaces."""
    del mi
    expected = drawn(tmp_path, ALONE.format(0), algorithm)
    assert expected > 0.001
    assert drawn(tmp_path, AGAIN.format(far), algorithm) == pytest.approx(expected, rel=0.002)
