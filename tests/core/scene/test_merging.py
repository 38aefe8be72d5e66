"""Meshes of one material become one mesh when a scene is loaded, and nobody sees it but the clock."""

from __future__ import annotations

import itertools
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elps_core import device
from elps_core.scene.canonical import canonicalize
from elps_core.scene.generate.mesh import box, lathe
from elps_core.scene.loader import LoadedScene, load_scene

from .conftest import SENSOR, folder_of, ply, scene_xml

VARIANT = "llvm_ad_rgb"
RAYS = 20_000
"""Some hundred on each of the shapes."""
OBJ = b"""
v -1 -1 0
v 1 -1 0.2
v 1 1 0
v -1 1 0.3
vt 0 0
vt 2 0
vt 2 3
vt 0 3
vn 0 0 1
vn 0.3 0 1
vn 0 0.3 1
vn -0.3 0 1
f 1/1/1 2/2/2 3/3/3
f 1/1/1 3/3/3 4/4/4
"""
VASE = lathe([(0.9, -0.5), (0.4, 0.0), (0.8, 0.6)], 12).to_ply()
FILES = {"a.obj": OBJ, "vase.ply": VASE}
KINDS = {
    "rectangle": '<shape type="rectangle">',
    "cube": '<shape type="cube">',
    "obj": '<shape type="obj"><string name="filename" value="a.obj"/>',
    "ply": '<shape type="ply"><string name="filename" value="vase.ply"/>',
}
CHECKED = """
    <bsdf type="twosided" id="checked"><bsdf type="diffuse">
        <texture type="checkerboard" name="reflectance">
            <transform name="to_uv"><scale x="4" y="6"/></transform>
            <rgb name="color0" value="0.7, 0.2, 0.1"/><rgb name="color1" value="0.1, 0.3, 0.8"/>
        </texture></bsdf></bsdf>"""
WHITE = '<bsdf type="diffuse" id="white"><rgb name="reflectance" value="0.7"/></bsdf>'
LAMP = """
    <shape type="rectangle">
        <transform name="to_world"><rotate x="1" angle="180"/><translate z="4"/></transform>
        <emitter type="area"><rgb name="radiance" value="5"/></emitter></shape>"""


def shape(kind: str, material: str, matrix: str, flags: tuple[str, ...] = ()) -> str:
    true = "".join(f'<boolean name="{flag}" value="true"/>' for flag in flags)
    place = f'<transform name="to_world">{matrix}</transform>'
    return f'{KINDS[kind]}{place}{true}<ref id="{material}"/></shape>'


def every_kind(material: str) -> tuple[str, int]:
    """One of each kind, as it is and mirrored, with and without each flag; and the number of different layouts."""
    shapes = []
    cases = itertools.product(KINDS, (1, -1), (False, True), (False, True))
    for number, (kind, side, flipped, faces) in enumerate(cases):
        flags = ("flip_normals",) * flipped + ("face_normals",) * faces
        turn = f'<rotate x="1" y="0.3" angle="{10 * number}"/>'
        row, column = divmod(number, 6)
        place = f'<translate x="{3 * column - 7.5}" y="{3 * row - 7.5}"/>'
        shapes.append(shape(kind, material, f'<scale x="{side}" y="0.8"/>{turn}{place}', flags))
    return "".join(shapes), len(shapes)


def both(tmp_path: Path, xml: bytes, files: dict[str, bytes] = FILES) -> tuple[LoadedScene, Any]:
    """A scene as we load it, and as Mitsuba does that merges nothing."""
    folder = folder_of(tmp_path / "folder", {"scene.xml": xml, **files})
    ours = load_scene(folder, VARIANT)
    return ours, device.use(VARIANT).load_file(str(folder / "scene.xml"), optimize=False)


def images(ours: LoadedScene, theirs: Any) -> list[Any]:
    mi = device.use(VARIANT)
    path = mi.load_dict({"type": "path", "max_depth": 5})
    return [np.array(mi.render(scene, integrator=path, spp=32, seed=3)) for scene in (ours.scene, theirs)]


def hits(scene: Any) -> dict[str, Any]:
    """What rays from all sides meet."""
    mi = device.use(VARIANT)
    random = np.random.default_rng(5)
    target, away = random.uniform(-9.0, 9.0, (3, RAYS)), random.normal(size=(3, RAYS))
    target[2] *= 0.1
    away /= np.linalg.norm(away, axis=0)
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(target + 30.0 * away), mi.Vector3f(-away)))
    found = {name: np.array(getattr(si, name)) for name in ("p", "n", "uv", "dp_du", "dp_dv", "wi")}
    return {**found, "shading": np.array(si.sh_frame.n), "valid": np.array(si.is_valid())}


def test_a_merged_mesh_is_met_like_its_parts(tmp_path: Path) -> None:
    """Mirrored and flipped ones too, of every kind: place, normals, texture coordinates, derivatives, sides."""
    shapes, count = every_kind("checked")
    ours, theirs = both(tmp_path, scene_xml(CHECKED + shapes))
    assert len(theirs.shapes()) == count
    # By normals flipped or not, of faces or not, and what the mesh has of normals and texture coordinates.
    assert len(ours.scene.shapes()) == 10
    one, other = hits(ours.scene), hits(theirs)
    assert other["valid"].sum() > RAYS / 10
    # Rays may pass by an edge on its other side.
    same = one["valid"] & other["valid"] & (np.abs(one["p"] - other["p"]).max(axis=0) < 1e-4)
    assert (same == other["valid"]).mean() > 0.999
    for name in ("n", "shading", "uv", "dp_du", "dp_dv", "wi"):
        np.testing.assert_allclose(one[name][:, same], other[name][:, same], atol=2e-3, err_msg=name)


def room(*more: str) -> bytes:
    """Every kind of mesh in two materials, a lamp, and a group that is repeated."""
    group = f"""
        <shape type="shapegroup" id="group">{shape("cube", "white", '<scale value="0.4"/>')}
            {shape("obj", "checked", '<scale value="0.5"/><translate z="0.6"/>')}</shape>
        <shape type="instance"><ref id="group"/>
            <transform name="to_world"><translate x="1" z="1"/></transform></shape>
        <shape type="instance"><ref id="group"/>
            <transform name="to_world"><rotate x="1" angle="50"/><translate x="-1" z="1"/></transform></shape>"""
    body = every_kind("checked")[0] + every_kind("white")[0].replace('y="0.3"', 'y="-0.7"')
    sensor = SENSOR.replace('origin="0, 0, 4"', 'origin="0, -9, 11"').replace('"16"', '"48"').replace('"12"', '"36"')
    return scene_xml(CHECKED + WHITE + body + LAMP + group + "".join(more), sensor=sensor)


def test_the_image_is_the_same(tmp_path: Path) -> None:
    ours, theirs = both(tmp_path, room())
    one, other = images(ours, theirs)
    assert other.mean() > 0.02
    # A path that passes by an edge on its other side is another path from there.
    changed = np.abs(one - other).max(axis=-1) > 1e-3 * (other.max(axis=-1) + 0.01)
    assert changed.mean() < 0.01
    assert one.mean() == pytest.approx(other.mean(), rel=2e-3)


def test_the_bounds_are_those_of_all_parts(tmp_path: Path) -> None:
    walls = "".join(shape("rectangle", "white", f'<translate x="{x}" z="{x}"/>') for x in (-7, 2, 5))
    ours, theirs = both(tmp_path, scene_xml(WHITE + walls))
    assert len(ours.scene.shapes()) == 1
    np.testing.assert_allclose(np.array(ours.scene.bbox().min), [-8.0, -1.0, -7.0], rtol=1e-6)
    for side in ("min", "max"):
        np.testing.assert_array_equal(getattr(ours.scene.bbox(), side), getattr(theirs.bbox(), side))
        np.testing.assert_array_equal(getattr(ours.scene.shapes()[0].bbox(), side), getattr(theirs.bbox(), side))


def test_there_are_as_many_shapes_as_materials(tmp_path: Path) -> None:
    """Equal materials are one, those of shapes that name none are another; what is more than a mesh stays apart."""
    other = WHITE.replace('"white"', '"too"')
    grey = WHITE.replace('"white"', '"grey"').replace('"0.7"', '"0.5"')
    cubes = "".join(shape("cube", name, f'<translate x="{x}"/>') for x in range(3) for name in ("white", "too", "grey"))
    bare = '<shape type="cube"/><shape type="rectangle"/>'
    apart = (
        '<shape type="sphere"><ref id="white"/></shape>',
        '<shape type="cube"><ref id="white"/><emitter type="area"/></shape>',
        '<shape type="cube"><ref id="white"/><medium type="homogeneous" name="interior"/></shape>',
        '<shape type="ply"><string name="filename" value="colors.ply"/><ref id="white"/></shape>',
        '<shape type="cube"><ref id="white"/><texture type="checkerboard" name="vertex_paint"/></shape>',
    )
    coloured = ply().replace(b"property float z\n", b"property float z\nproperty float r\nproperty float g\n")
    points = np.array([[0, 0, 0, 1, 1], [1, 0, 0, 0, 1], [0, 1, 0, 1, 0]], "<f4").tobytes()
    coloured = coloured[: coloured.index(b"end_header\n") + 11] + points + coloured[-13:]
    ours, theirs = both(
        tmp_path, scene_xml(WHITE + other + grey + cubes + bare + "".join(apart)), {"colors.ply": coloured}
    )
    assert len(theirs.shapes()) == 9 + 2 + len(apart)
    assert len(ours.scene.shapes()) == 2 + 1 + len(apart)
    # Two of the cubes, the sphere, the lamp, the medium, the colours and the paint have but one material.
    assert len({str(shape.bsdf()) for shape in ours.scene.shapes()}) == 3
    assert ours.summary.shapes == 9 + 2 + len(apart)
    assert ours.summary.triangles == 12 * (9 + 1 + 3) + 2 + 1


def test_shapes_stand_where_the_first_of_them_stood(tmp_path: Path) -> None:
    body = "".join(
        f'<shape type="{kind}" id="{name}"><ref id="{material}"/></shape>'
        for name, kind, material in (
            ("a", "sphere", "white"),
            ("b", "cube", "checked"),
            ("c", "disk", "white"),
            ("d", "cube", "white"),
            ("e", "rectangle", "checked"),
            ("f", "sphere", "white"),
        )
    )
    ours, _ = both(tmp_path, scene_xml(WHITE + CHECKED + body))
    assert [shape.id() for shape in ours.scene.shapes()] == ["a", "b", "c", "d", "f"]


def test_neither_digest_nor_counts_tell_of_it(tmp_path: Path) -> None:
    """They are those of the upload: as many shapes and triangles as Mitsuba makes of it, those of groups once each."""
    ours, theirs = both(tmp_path, room())
    text = canonicalize(tmp_path / "folder" / "scene.xml")
    assert ours.digest == text.digest
    assert ours.summary.shapes == text.text.count("<shape ")
    outside = sum(shape.face_count() for shape in theirs.shapes() if shape.is_mesh())
    assert ours.summary.triangles == outside + 12 + 2  # The group has a cube and a file of two
    assert len(ours.scene.shapes()) < len(theirs.shapes()) / 2


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_spectral", "llvm_ad_mono"])
def test_every_variant_merges(variant: str, tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "folder", {"scene.xml": room(), **FILES})
    scene = load_scene(folder, variant).scene
    assert len(scene.shapes()) < 24
    assert np.isfinite(np.array(scene.bbox().max)).all()


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ('<boolean name="unheard" value="true"/>', "unheard"),
        ('<emitter type="constant"/><emitter type="constant"/>', "scene"),
        ('<shape type="cube"><float name="unheard" value="1"/></shape>', "unheard"),
    ],
)
def test_what_mitsuba_refuses_is_still_refused(wrong: str, named: str, tmp_path: Path, reject: Any) -> None:
    folder = folder_of(tmp_path / "folder", {"scene.xml": scene_xml(wrong)})
    message = reject(load_scene, folder, VARIANT)
    assert named in message
    assert re.search(r"\(line \d+\)", message)


RENDER = """
import json, sys
from pathlib import Path
from elps_core import device
from elps_core.scene.loader import load_scene
from elps_core.settings import RenderSettings
mi = device.use("llvm_ad_rgb")
import drjit as dr
from elps_core.renderer import Renderer
dr.set_flag(dr.JitFlag.KernelHistory, True)
scene = load_scene(Path(sys.argv[1]), "llvm_ad_rgb")
for integrator in ("path", "mi_path"):
    Renderer(scene, RenderSettings(integrator=integrator, light_sampling="power"), None).render_chunk(0, 1)
kernels = [entry for entry in dr.kernel_history() if "hash" in entry]
order = [shape.face_count() if shape.is_mesh() else 0 for shape in scene.scene.shapes()]
print(json.dumps([order, *[[entry["hash"], entry["cache_hit"] or entry["cache_disk"]] for entry in kernels]]))
"""


def test_another_process_finds_every_kernel_on_disk(tmp_path: Path) -> None:
    """Nothing of chance is in a merged scene: neither the order of its shapes nor the layout of their memory."""
    folder = folder_of(tmp_path / "folder", {"scene.xml": room(), **FILES})
    command = [sys.executable, "-c", RENDER, str(folder)]
    (order, *first), (same, *second) = (
        json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1])
        for _ in range(2)
    )
    assert order == same
    assert len(first) > 2
    assert [kernel for kernel, _ in first] == [kernel for kernel, _ in second]
    assert all(found for _, found in second)


GLASS = '<bsdf type="dielectric" id="glass"/>'
PANES = "".join(
    f'''<shape type="ply"><string name="filename" value="pane.ply"/><boolean name="face_normals" value="true"/>
        <ref id="glass"/><transform name="to_world"><translate x="{x}" z="1.5"/></transform></shape>'''
    for x in (-9, 0, 0.55)
)
PANE = {"pane.ply": box((-0.2, -0.1, 0.0), (0.3, 0.1, 0.4)).to_ply()}
FLOOR = '<shape type="rectangle"><transform name="to_world"><scale value="12"/></transform><ref id="white"/></shape>'
PATHS = 1 << 14


def test_the_panes_of_a_mesh_are_known(tmp_path: Path) -> None:
    """Panes of one glass are one mesh, in whose sphere there is mostly air."""
    from elps_core.scene.pieces import pieces_of

    ours, theirs = both(tmp_path, scene_xml(GLASS + PANES + '<shape type="sphere"><ref id="glass"/></shape>'), PANE)
    assert len(ours.scene.shapes()) == 2
    pieces = [piece for shape in ours.scene.shapes() for piece in pieces_of(shape)]
    assert [(piece.first, piece.end) for piece in pieces] == [(0, 12), (12, 24), (24, 36), (0, 1)]
    for piece, shape in zip(pieces, theirs.shapes(), strict=True):
        ball = shape.bbox().bounding_sphere()
        np.testing.assert_allclose(piece.centre, np.array(ball.center).ravel(), atol=1e-6)
        assert piece.radius == pytest.approx(float(ball.radius), rel=1e-6)


def test_light_is_aimed_at_each_pane_by_itself(tmp_path: Path) -> None:
    """The same random numbers make the same photons, whether or not the panes are one mesh."""
    from elps_core.particles.caustics import CausticSampler
    from elps_core.sampling.start import StartDensity, power_table
    from elps_core.scene.emission import Emission

    ours, theirs = both(tmp_path, scene_xml(GLASS + WHITE + FLOOR + PANES + LAMP, light=""), PANE)
    weights = []
    for scene in (ours.scene, theirs):
        emission = Emission(scene)
        lights = StartDensity(emission, power_table(emission))
        sampler = CausticSampler(scene, lights, max_depth=6, paths=PATHS)
        assert sampler.count == 3
        weights.append(np.sort(np.concatenate([batch.arrays().weight.ravel() for batch in sampler.run((1, 2))])))
    assert len(weights[1]) > PATHS / 20
    assert len(weights[0]) == pytest.approx(len(weights[1]), rel=1e-3)
    assert weights[0].sum() == pytest.approx(weights[1].sum(), rel=1e-3)
