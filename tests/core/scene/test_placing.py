"""Scenes far from the origin, tiny ones and huge ones are made where single precision is at home."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elps_core import device
from elps_core.scene.loader import LoadedScene

from .conftest import LIGHT, OBJ, SENSOR, VARIANT, load, scene_xml

FAR = (100000.0, -50000.0, 20000.0)
FILM = '<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/></film>'


def everything(size: float, place: tuple[float, float, float]) -> tuple[bytes, dict[str, bytes]]:
    """A scene that stands at ``place``, ``size`` times as large as it would be at 1: every kind of thing with a place
    or a length, and light that keeps radiance what it is."""

    def at(x: float, y: float, z: float) -> str:
        return ", ".join(repr(size * q + c) for q, c in zip((x, y, z), place, strict=True))

    def to_world(x: float, y: float, z: float, scale: float = 1.0) -> str:
        return (
            f'<transform name="to_world"><rotate y="1" angle="30"/><scale value="{size * scale!r}"/>'
            f'<translate value="{at(x, y, z)}"/></transform>'
        )

    def looking(x: float, y: float, z: float) -> str:
        return (
            f'<transform name="to_world"><lookat origin="{at(x, y, z)}" target="{at(0, 0.5, 0)}" up="0, 1, 0"/>'
            "</transform>"
        )

    def number(name: str, value: float) -> str:
        return f'<float name="{name}" value="{value!r}"/>'

    mesh = '<string name="filename" value="a.obj"/>'
    body = f"""<scene version="3.0.0">
    <sensor type="perspective">{number("near_clip", 0.1 * size)}{number("far_clip", 90 * size)}{looking(0, 1, 4)}{FILM}
    </sensor>
    <sensor type="thinlens">{number("near_clip", 0.01 * size)}{number("far_clip", 10000 * size)}
        {number("aperture_radius", 0.05 * size)}{number("focus_distance", 4 * size)}{looking(0, 1, 4)}{FILM}</sensor>
    <sensor type="orthographic">{number("near_clip", 0.1)}{number("far_clip", 0.1 + 20 * size)}{to_world(0, 1, 4)}{FILM}
    </sensor>
    <shape type="sphere"><point name="center" value="{at(0.5, 0.5, 0)}"/>{number("radius", 0.5 * size)}
        <bsdf type="bumpmap"><texture type="checkerboard"/>{number("scale", 0.3 * size)}<bsdf type="diffuse"/></bsdf>
    </shape>
    <shape type="cylinder"><point name="p0" value="{at(1, 0, 0)}"/><point name="p1" value="{at(1, 1, 0.5)}"/>
        {number("radius", 0.2 * size)}
        <bsdf type="diffuse"><texture type="volume" name="reflectance"><volume type="gridvolume" name="volume">
        <string name="filename" value="a.vol"/>{to_world(-2, -2, -2, 5)}</volume></texture></bsdf></shape>
    <shape type="disk">{to_world(-1, 0, 0)}</shape>
    <shape type="cube">{to_world(-1, 0, 1, 0.4)}
        <medium type="homogeneous" name="interior">{number("scale", 2 / size)}</medium></shape>
    <shape type="obj">{mesh}{to_world(0, 0, -1)}</shape>
    <shape type="rectangle">{to_world(0, 2, 0)}<emitter type="area"/></shape>
    <shape type="linearcurve"><string name="filename" value="a.txt"/>{to_world(1, 0, 1)}</shape>
    <shape type="shapegroup" id="group"><shape type="obj">{mesh}</shape></shape>
    <shape type="instance"><ref id="group"/>{to_world(2, 0, 0)}</shape>
    <emitter type="point"><point name="position" value="{at(0, 3, 1)}"/>
        <rgb name="intensity" value="{3 * size**2!r}, {2 * size**2!r}, {size**2!r}"/></emitter>
    <emitter type="spot">{looking(1, 3, 1)}<spectrum name="intensity" value="{5 * size**2!r}"/></emitter>
    <emitter type="projector">{looking(2, 3, 1)}<texture type="checkerboard" name="irradiance"/>
        {number("scale", 7 * size**2)}</emitter>
    </scene>"""
    curve = "".join(f"{k / 3} 0 0 {0.05 * size!r}\n" for k in range(4)).encode()
    volume = b"VOL\x03" + struct.pack("<5i6f8f", 1, 2, 2, 2, 1, 0, 0, 0, 1, 1, 1, *np.linspace(0.1, 0.9, 8))
    return body.encode(), {"a.obj": OBJ, "a.txt": curve, "a.vol": volume}


def numbers(scene: Any) -> dict[str, Any]:
    """All that an object's parameters say, and the boxes of the shapes."""
    mi = device.use(VARIANT)
    found = {}
    for k, part in enumerate([*scene.shapes(), *scene.emitters(), *scene.sensors(), *media(scene)]):
        for name, value in mi.traverse(part).items():
            value = value.matrix if hasattr(value, "matrix") else value
            if not isinstance(value, str):
                found[f"{k} {part.class_name()} {name}"] = np.array(value, np.float64).ravel()
        if hasattr(part, "bbox"):
            found[f"{k} {part.class_name()} box"] = np.array([part.bbox().min, part.bbox().max], np.float64).ravel()
    return found


def media(scene: Any) -> list[Any]:
    return [shape.interior_medium() for shape in scene.shapes() if shape.interior_medium()]


def placed(loaded: LoadedScene, size: float) -> tuple[float, tuple[float, float, float]]:
    """How large a scene of :func:`everything` is as it was made, and where its origin is, as its first camera says."""
    mi = device.use(VARIANT)
    sensor = mi.traverse(loaded.scene.sensors()[0])
    scale = np.log2(float(sensor["near_clip"]) / (0.1 * size))
    assert scale == pytest.approx(np.round(scale), abs=1e-5), "a power of two"
    now = size * 2.0 ** float(np.round(scale))
    x, y, z = np.array(sensor["to_world"].matrix, np.float64)[:3, 3] - now * np.array([0.0, 1.0, 4.0])
    return now, (float(x), float(y), float(z))


@pytest.mark.parametrize(
    ("size", "place"),
    [(1.0, FAR), (2.0**-10, (0.0, 0.0, 0.0)), (2.0**17, (0.0, 0.0, 0.0)), (2.0**-10, FAR), (2.0**14, FAR)],
)
def test_everything_is_as_if_it_had_been_made_there(
    size: float, place: tuple[float, float, float], tmp_path: Path
) -> None:
    loaded = load(tmp_path, *everything(size, place))
    now, centre = placed(loaded, size)
    assert (now, centre) != (size, place)
    assert 0.1 <= loaded.extent <= 1000.0
    assert max(map(abs, centre)) <= loaded.extent
    wanted = load(tmp_path, *everything(now, centre))
    found, expected = numbers(loaded.scene), numbers(wanted.scene)
    assert found.keys() == expected.keys()
    assert len(found) > 60
    for name, value in expected.items():
        size_of = max(np.abs(value[np.isfinite(value)]).max(initial=0.0), 1e-3 * now)
        np.testing.assert_allclose(found[name], value, rtol=0.0, atol=2e-6 * size_of, err_msg=name)


def test_usual_scenes_are_left_as_they_are_bit_for_bit(tmp_path: Path) -> None:
    body, files = everything(1.0, (3.0, -2.0, 5.0))
    loaded = load(tmp_path, body, files)
    mi = device.use(VARIANT)
    for name, content in {"scene.xml": body, **files}.items():
        (tmp_path / name).write_bytes(content)
    theirs = mi.load_file(str(tmp_path / "scene.xml"), optimize=False, parallel=False)
    found, expected = numbers(loaded.scene), numbers(theirs)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert np.array_equal(found[name], value, equal_nan=True), name


ROOM = """<shape type="rectangle"/><shape type="sphere"><float name="radius" value="0.5"/></shape>
<shape type="cube"><transform name="to_world"><scale value="0.3"/></transform></shape>"""


@pytest.mark.parametrize(
    "huge",
    [
        '<shape type="rectangle"><transform name="to_world"><scale value="1e6"/></transform></shape>',
        '<shape type="sphere"><point name="center" value="5e7, 1e8, 5e7"/><float name="radius" value="6e5"/></shape>',
    ],
)
def test_neither_an_endless_floor_nor_a_ball_for_a_sun_moves_a_room(huge: str, tmp_path: Path) -> None:
    loaded = load(tmp_path, scene_xml(ROOM + huge))
    mi = device.use(VARIANT)
    assert 1.0 < loaded.extent < 3.0
    assert np.array_equal(np.array(mi.traverse(loaded.scene.sensors()[0])["to_world"].matrix)[:3, 3], [0, 0, 4])


def test_cameras_do_not_move_a_scene(tmp_path: Path) -> None:
    """Contexts are shared between cameras, and with them the places of what they hold."""
    small = ROOM.replace('value="0.5"', 'value="0.0005"').replace('value="0.3"', 'value="0.0003"')
    extents = [
        load(tmp_path, scene_xml(small, sensor=SENSOR.replace("0, 0, 4", origin))).extent
        for origin in ("0, 0, 4", "0, 0, 4e6")
    ]
    assert extents[0] == extents[1]


def test_a_shape_of_a_group_that_also_stands_alone_is_moved_there_and_not_in_the_group(tmp_path: Path) -> None:
    """Its group is moved by its instances."""
    body = """<shape type="sphere" id="ball"/><shape type="shapegroup" id="group"><ref id="ball"/></shape>
    <shape type="instance"><ref id="group"/><transform name="to_world"><translate x="50000"/></transform></shape>
    <shape type="instance"><ref id="group"/><transform name="to_world"><translate x="50004"/></transform></shape>
    <shape type="instance"><ref id="group"/><transform name="to_world"><translate x="50008"/></transform></shape>"""
    scene = load(tmp_path, scene_xml(body)).scene
    middles = sorted(float(shape.bbox().center().x) for shape in scene.shapes())
    assert np.diff(middles) == pytest.approx([50000, 4, 4])
    assert abs(middles[1]) < 10


def test_a_lamp_whose_light_cannot_be_scaled_leaves_the_size_as_it_is(tmp_path: Path) -> None:
    tiny = '<transform name="to_world"><scale value="1e-4"/><translate x="2"/></transform>'
    lamp = (
        '<emitter type="point"><point name="position" value="1, 2, 3"/><spectrum type="blackbody" name="intensity">'
        '<float name="temperature" value="3000"/></spectrum></emitter>'
    )
    body = f'<shape type="rectangle">{tiny}</shape>'
    scenes = [load(tmp_path, scene_xml(body, light=light)) for light in (lamp, LIGHT)]
    sizes = [float(scene.scene.bbox().extents().x) for scene in scenes]
    assert sizes[0] == pytest.approx(2e-4)
    assert sizes[1] > 1.0
    assert abs(float(scenes[0].scene.bbox().center().x)) < 1e-3


def test_a_shared_spectrum_is_scaled_once_for_each_lamp(tmp_path: Path) -> None:
    body = '<shape type="rectangle"><transform name="to_world"><scale value="0.001"/></transform></shape>'
    light = (
        '<spectrum type="uniform" id="white"><float name="value" value="3"/></spectrum>'
        '<emitter type="point"><ref name="intensity" id="white"/></emitter>'
        '<emitter type="point"><ref name="intensity" id="white"/></emitter>'
    )
    mi = device.use(VARIANT)
    loaded = load(tmp_path, scene_xml(body, light=light))
    scale = loaded.extent / (0.001 * np.sqrt(8.0))
    for lamp in loaded.scene.emitters():
        assert float(mi.traverse(lamp)["intensity.value"]) == pytest.approx(3.0 * scale**2, rel=1e-5)


# What is said


def test_what_single_precision_cannot_hold_is_said(tmp_path: Path) -> None:
    far = OBJ.replace(b"v 0 0 0\nv 1 0 0\nv 0 1 0", b"v 90000 0 0\nv 90001 0 0\nv 90000 1 0")
    shape = '<shape type="obj" id="house"><string name="filename" value="a.obj"/></shape>'
    line = load(tmp_path, scene_xml(shape), {"a.obj": far}).summary.warnings[0]
    assert line.startswith("1 meshes, such as 'house', lie so far")
    lamp = LIGHT.replace("1, 2, 3", "1, 2, 30000")
    (line,) = load(tmp_path, scene_xml(light=lamp)).summary.warnings
    assert line.startswith("a lamp is more than 10,000 times the scene's size away")
    sensor = SENSOR.replace("0, 0, 4", "0, 0, 40000")
    (line,) = load(tmp_path, scene_xml(sensor=sensor)).summary.warnings
    assert line.startswith("a camera is more than 10,000 times the scene's size away")


def test_a_mesh_whose_place_is_in_to_world_is_exact(tmp_path: Path) -> None:
    shape = (
        '<shape type="obj"><string name="filename" value="a.obj"/>'
        '<transform name="to_world"><translate x="90000.123456" y="0" z="0"/></transform></shape>'
    )
    body = shape + shape.replace("90000.123456", "90001.654321")
    loaded = load(tmp_path, scene_xml(body), {"a.obj": OBJ})
    vertices = np.array(device.use(VARIANT).traverse(loaded.scene.shapes()[0])["vertex_positions"]).reshape(-1, 3)
    assert not any("meshes" in line for line in loaded.summary.warnings)
    assert np.diff(vertices[[0, 3], 0]) == pytest.approx([1.530865], abs=1e-6)
