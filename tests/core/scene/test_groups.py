"""Shapes in groups are shapes of the scene: their materials scatter, and their triangles count."""

from __future__ import annotations

from pathlib import Path

from .conftest import load, scene_xml

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
