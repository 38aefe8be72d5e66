"""Generated scenes: deterministic, checked, tight where they claim to be."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elps_core import device
from elps_core.errors import SettingsRejected
from elps_core.scene.generate import GENERATORS, SceneDescription, cornell, door, lamps, maze, office, sphere, write
from elps_core.scene.generate.cornell import FLUX
from elps_core.scene.generate.maze import label
from elps_core.scene.generate.mesh import smooth
from elps_core.scene.loader import load_scene

LUMINANCE = (0.212671, 0.715160, 0.072169)
"""Weights of linear sRGB."""


def picture(
    folder: Path, scene: SceneDescription, *, spp: int = 64, depth: int = 12, size: tuple[int, int] = (24, 24)
) -> np.ndarray:
    """A render by Mitsuba's path tracer, [height, width, 3]."""
    mi = device.use("llvm_ad_rgb")
    path = folder / "scene.zip"
    write(scene, path)
    loaded = load_scene(path, "llvm_ad_rgb", size=size)
    integrator = mi.load_dict({"type": "path", "max_depth": depth})
    return np.array(mi.render(loaded.scene, sensor=loaded.sensor, integrator=integrator, spp=spp))


@pytest.mark.parametrize("name", sorted(GENERATORS))
def test_equal_parameters_give_equal_bytes(name: str, tmp_path: Path) -> None:
    for copy in ("a.zip", "b.zip"):
        write(GENERATORS[name](), tmp_path / copy)
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()


@pytest.mark.parametrize("name", sorted(GENERATORS))
def test_folder_and_zip_are_one_scene(name: str, tmp_path: Path) -> None:
    write(GENERATORS[name](), tmp_path / "scene.zip")
    write(GENERATORS[name](), tmp_path / "scene")
    digests = {load_scene(tmp_path / copy, "scalar_rgb", size=(8, 8)).digest for copy in ("scene.zip", "scene")}
    assert len(digests) == 1


@pytest.mark.parametrize("name", sorted(GENERATORS))
def test_the_film_has_the_size_asked_for(name: str, tmp_path: Path) -> None:
    write(GENERATORS[name](width=30, height=20), tmp_path / "scene.zip")
    loaded = load_scene(tmp_path / "scene.zip", "scalar_rgb")
    assert list(loaded.sensor.film().size()) == [30, 20]


def test_geometry_travels_as_ply_files(tmp_path: Path) -> None:
    write(door(), tmp_path / "new" / "door.zip")
    with zipfile.ZipFile(tmp_path / "new" / "door.zip") as archive:
        meshes = [name for name in archive.namelist() if name.endswith(".ply")]
        assert {"meshes/door_leaf.ply", "meshes/teapot.ply"} <= set(meshes)
        assert all(archive.read(name).startswith(b"ply\n") for name in meshes)


@pytest.mark.parametrize("rooms", [1, 2, 3, 4])
def test_a_maze_has_a_light_in_every_room(rooms: int, tmp_path: Path) -> None:
    write(maze(rooms=rooms), tmp_path / "maze.zip")
    loaded = load_scene(tmp_path / "maze.zip", "scalar_rgb", size=(8, 8))
    lights = {shape.id() for shape in loaded.scene.shapes() if shape.is_emitter()}
    assert lights == {f"light_{label(index)}" for index in range(rooms**2)}


def test_rooms_are_named_as_columns_of_a_spreadsheet() -> None:
    assert [label(index) for index in (0, 8, 25, 26, 51, 52, 255)] == ["a", "i", "z", "aa", "az", "ba", "iv"]


def test_far_lights_matter_little_in_a_maze_but_reach_the_camera(tmp_path: Path) -> None:
    def lit_by(lights: str) -> float:
        scene = maze(rooms=2)
        dark = r'(<shape type="rectangle" id="light_(?![LIGHTS]")\w+">.*?)<emitter.*?</emitter>'.replace(
            "LIGHTS", lights
        )
        return float(
            picture(tmp_path, SceneDescription(re.sub(dark, r"\1", scene.xml, flags=re.S), scene.files)).mean()
        )

    diagonal, neighbours, own = lit_by("a"), lit_by("bc"), lit_by("d")
    assert 0.0 < 5 * diagonal < neighbours < own / 2
    assert diagonal + neighbours + own == pytest.approx(lit_by("abcd"), rel=0.05)


@pytest.mark.parametrize(
    ("scene", "low", "high"),
    [
        (maze(rooms=3), (0.1, 0.1, 0.1), (3.9, 3.9, 2.7)),
        (maze(rooms=3), (8.5, 0.1, 2.0), (12.3, 3.9, 2.7)),
        (door(angle=0, crack=0), (0.1, 0.1, 1.5), (4.4, 3.4, 2.5)),
        (door(angle=9), (0.1, 0.1, 1.5), (4.4, 3.4, 2.5)),
        (door(angle=90), (0.1, 4.8, 0.1), (4.4, 8.4, 2.5)),
    ],
    ids=["maze, far room", "maze, camera's room", "door shut", "door ajar", "door open"],
)
def test_rooms_are_tight_and_show_their_front(
    scene: SceneDescription, low: tuple[float, ...], high: tuple[float, ...], tmp_path: Path
) -> None:
    mi = device.use("llvm_ad_rgb")
    write(scene, tmp_path / "scene.zip")
    loaded = load_scene(tmp_path / "scene.zip", "llvm_ad_rgb", size=(8, 8))
    rays = 2**20
    uniform = np.random.default_rng(1).random((5, rays), dtype=np.float32)
    corner, extent = np.array(low)[:, None], np.subtract(high, low)[:, None]
    directions = mi.warp.square_to_uniform_sphere(mi.Point2f(uniform[3:]))
    hit = loaded.scene.ray_intersect(mi.Ray3f(mi.Point3f(corner + extent * uniform[:3]), directions))
    inside = np.array(hit.is_valid())
    facing = np.einsum("ij,ij->j", np.array(hit.n), np.array(directions)) < 0
    # A ray may hit the hairline between two triangles: it is lost, and no more of them than one in 100,000.
    assert (~inside).sum() <= rays * 1e-5
    assert (inside & ~facing).sum() <= rays * 1e-5


@pytest.mark.parametrize("shape", ["rectangle", "sphere", "disk", "cylinder", "mesh"])
def test_every_light_of_the_cornell_box_has_the_same_flux(shape: Any, tmp_path: Path) -> None:
    from elps_core.scene.emission import Emission

    device.use("llvm_ad_rgb")
    write(cornell(light_shape=shape), tmp_path / "cornell.zip")
    emission = Emission(load_scene(tmp_path / "cornell.zip", "llvm_ad_rgb", size=(8, 8)).scene)
    assert emission.power == pytest.approx([np.dot(LUMINANCE, FLUX)], rel=2e-3)


@pytest.mark.parametrize("shapes", ["mixed", "sphere", "rectangle", "point"])
@pytest.mark.parametrize("count", [1, 7, 200])
def test_a_hall_has_as_many_lamps_as_asked_for_and_the_same_light(count: int, shapes: Any, tmp_path: Path) -> None:
    from elps_core.scene.emission import Emission

    device.use("llvm_ad_rgb")
    write(lamps(lamps=count, shapes=shapes), tmp_path / "lamps.zip")
    emission = Emission(load_scene(tmp_path / "lamps.zip", "llvm_ad_rgb", size=(8, 8)).scene)
    assert emission.count == count
    assert len(np.unique(emission.keys, axis=0)) == count
    assert emission.power.max() < 2.0 * emission.power.min()
    assert 0.5 * 2200 < emission.power.sum() < 2200 * 1.01


def test_lamps_of_a_hall_stand_free(tmp_path: Path) -> None:
    """What leaves a lamp goes some way before it meets anything."""
    import drjit as dr

    from elps_core.scene.emission import Emission

    mi = device.use("llvm_ad_rgb")
    write(lamps(lamps=300), tmp_path / "lamps.zip")
    scene = load_scene(tmp_path / "lamps.zip", "llvm_ad_rgb", size=(8, 8)).scene
    emission = Emission(scene)
    index = dr.arange(mi.UInt32, emission.count * 64)
    u = np.random.default_rng(3).random((2, emission.count * 64), dtype=np.float32)
    point = emission.point(index // 64, mi.Point2f(u), mi.Color0f(), mi.Bool(True))
    met = scene.ray_intersect(mi.Ray3f(point.si.p + 1e-3 * point.si.n, mi.Vector3f(point.si.n)))
    assert bool(dr.all(met.is_valid()))
    near = np.array(met.t).reshape(-1, 64)
    assert (np.quantile(near, 0.75, axis=1) > 0.05).all(), "half of a sphere is near the board that it stands on"


def test_a_shut_door_without_cracks_lets_nothing_through(tmp_path: Path) -> None:
    assert picture(tmp_path, door(angle=0, crack=0), spp=256).max() == 0.0


def test_a_wider_door_lets_more_through(tmp_path: Path) -> None:
    means = [float(picture(tmp_path, door(angle=angle)).mean()) for angle in (0, 20, 90)]
    assert 0.0 < means[0] < means[1] < means[2]


@pytest.mark.parametrize(("light", "expected"), [("emission", 1 + 0.6 + 0.36), ("point", 0.6 + 0.36)])
def test_the_sphere_is_a_furnace(light: Any, expected: float, tmp_path: Path) -> None:
    image = picture(tmp_path, sphere(albedo=0.6, light=light, radiance=2.0), depth=3)
    assert image.mean() == pytest.approx(2.0 * expected, rel=2e-3)


def test_a_curve_meets_its_points_and_makes_no_loop() -> None:
    points = [(0.0, 0.0), (0.16, 0.0), (0.17, 0.02), (0.25, 0.22)]
    curve = smooth(points, 8)
    assert np.array(curve)[::8] == pytest.approx(np.array(points))
    assert (np.diff(np.array(curve)[:, 0]) > 0).all()


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("maze", {"rooms": 0}),
        ("maze", {"rooms": 1000}),
        ("door", {"angle": -1}),
        ("door", {"angle": float("nan")}),
        ("door", {"crack": 1.0}),
        ("cornell", {"light_shape": "torus"}),
        ("cornell", {"objects": "teapots"}),
        ("lamps", {"lamps": 0}),
        ("lamps", {"shapes": "candle"}),
        ("sphere", {"albedo": 1.0}),
        ("sphere", {"width": 0}),
    ],
)
def test_parameters_out_of_range_are_refused_in_one_line(name: str, parameters: dict[str, Any]) -> None:
    with pytest.raises(SettingsRejected) as caught:
        GENERATORS[name](**parameters)
    assert "\n" not in str(caught.value)


def test_a_place_that_cannot_be_written_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for output in (tmp_path / "file" / "scene.zip", tmp_path / "file" / "scene"):
        with pytest.raises(SettingsRejected, match=r"^the scene cannot be written there \([^/]*\): choose") as caught:
            write(sphere(), output)
        assert str(tmp_path) not in str(caught.value)


def test_an_office_has_a_thousand_meshes_or_one_for_each_material(tmp_path: Path) -> None:
    summaries = []
    for name, scene in (("many", office()), ("one", office(merged=True))):
        write(scene, tmp_path / name)
        summaries.append(load_scene(tmp_path / name, "scalar_rgb", size=(8, 8)).summary)
    many, one = summaries
    panels = sum(emitter.count for emitter in many.emitters if emitter.type == "area")
    materials = office().xml.count("<bsdf ")
    assert materials == 25
    assert 900 < many.shapes - panels < 1200
    # The carpet has a rectangle of its own.
    assert one.shapes - panels == materials
    assert one.triangles == many.triangles
    assert one.emitters == many.emitters


def test_an_office_shows_the_same_either_way(tmp_path: Path) -> None:
    images = [picture(tmp_path, office(desks=4, merged=merged), spp=16) for merged in (False, True)]
    assert images[0].mean() > 0.1
    np.testing.assert_allclose(images[0], images[1], rtol=1e-3, atol=1e-4)


def test_an_office_is_lit_by_its_windows_too(tmp_path: Path) -> None:
    scene = office(desks=4)
    dark = re.sub(r'<emitter type="area">.*?</emitter>', "", scene.xml, flags=re.S)
    by_sky, by_all = (picture(tmp_path, SceneDescription(xml, scene.files)).mean() for xml in (dark, scene.xml))
    assert 0.02 < by_sky / by_all < 0.6
