"""Generated scenes: deterministic, checked, tight where they claim to be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elps_core import device
from elps_core.errors import SettingsRejected
from elps_core.scene.generate import GENERATORS, cornell, door, maze, sphere, write
from elps_core.scene.loader import load_scene


def picture(
    folder: Path, scene: Any, *, spp: int = 64, depth: int = 12, size: tuple[int, int] = (24, 24)
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


@pytest.mark.parametrize("rooms", [1, 2, 4])
def test_a_maze_has_a_light_in_every_room(rooms: int, tmp_path: Path) -> None:
    write(maze(rooms=rooms), tmp_path / "maze.zip")
    loaded = load_scene(tmp_path / "maze.zip", "scalar_rgb", size=(8, 8))
    assert len(loaded.scene.emitters()) == rooms**2


@pytest.mark.parametrize("shape", ["rectangle", "sphere", "disk", "cylinder", "mesh"])
def test_every_light_of_the_cornell_box_has_the_same_flux(shape: str, tmp_path: Path) -> None:
    from elps_core.scene.emission import Emission

    device.use("llvm_ad_rgb")
    write(cornell(light_shape=shape), tmp_path / "cornell.zip")
    emission = Emission(load_scene(tmp_path / "cornell.zip", "llvm_ad_rgb", size=(8, 8)).scene)
    # Luminance of the flux in all three channels.
    assert emission.power == pytest.approx([0.212671 * 17 + 0.715160 * 12 + 0.072169 * 6.8], rel=2e-3)


def test_a_shut_door_without_cracks_lets_nothing_through(tmp_path: Path) -> None:
    assert picture(tmp_path, door(angle=0, crack=0), spp=256).max() == 0.0


def test_a_wider_door_lets_more_through(tmp_path: Path) -> None:
    means = [float(picture(tmp_path, door(angle=angle)).mean()) for angle in (0, 20, 90)]
    assert 0.0 < means[0] < means[1] < means[2]


def test_the_sphere_is_a_furnace(tmp_path: Path) -> None:
    image = picture(tmp_path, sphere(albedo=0.6), depth=3)
    assert image.mean() == pytest.approx(1 + 0.6 + 0.36, rel=2e-3)


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
        ("sphere", {"albedo": 1.0}),
        ("sphere", {"width": 0}),
    ],
)
def test_parameters_out_of_range_are_refused_in_one_line(name: str, parameters: dict[str, Any]) -> None:
    with pytest.raises(SettingsRejected) as caught:
        GENERATORS[name](**parameters)
    assert "\n" not in str(caught.value)
