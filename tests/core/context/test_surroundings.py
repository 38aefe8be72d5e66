"""A camera takes over what another one's context knows of the light around it, where it sees the same."""

from __future__ import annotations

import re
import zipfile
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elps_core.context.store import GlobalContext
from elps_core.scene.generate import door, write
from elps_core.scene.loader import LoadedScene, load_scene
from elps_core.settings import ContextSettings, RenderSettings

SETTINGS = ContextSettings(
    resolution=8,
    samples_per_cell=16,
    max_depth=6,
    regions=256,
    rows=8,
    columns=16,
    paths=1 << 19,
    tolerance=0.0,
    adaptive=False,
)


@pytest.fixture(autouse=True)
def _variant(mi: Any) -> None:
    """What is tested is a module of kernels."""


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "door.zip"
    write(door(angle=40.0), path)
    return path


def seen_from(room: Path, origin: tuple[float, ...], target: tuple[float, ...]) -> LoadedScene:
    """The room with its camera moved."""
    path = room.with_name(f"moved-{abs(hash((origin, target)))}.zip")
    with zipfile.ZipFile(room) as source, zipfile.ZipFile(path, "w") as moved:
        for name in source.namelist():
            data = source.read(name)
            if name == "scene.xml":
                place = "<lookat " + " ".join(
                    f'{word}="{" ".join(map(str, vector))}"'
                    for word, vector in (("origin", origin), ("target", target), ("up", (0.0, 0.0, 1.0)))
                )
                sensor = re.compile(r'(<sensor.*?<transform name="to_world">).*?(</transform>)', re.DOTALL)
                text, count = sensor.subn(rf"\g<1>{place} />\g<2>", data.decode())
                assert count == 1
                data = text.encode()
            moved.writestr(name, data)
    return load_scene(path, "llvm_ad_rgb", size=(32, 24))


HERE = ((1.5, 0.6, 1.4), (2.25, 3.2, 0.92))
NEAR = ((1.9, 0.7, 1.5), (2.0, 3.2, 0.9))


@cache
def built(room: Path) -> GlobalContext:
    from elps_core.context.build import ContextBuilder

    builder = ContextBuilder(seen_from(room, *HERE), SETTINGS)
    while builder.done < builder.steps:
        builder.step()
    return builder.result()


def test_cameras_are_no_part_of_the_surroundings(room: Path) -> None:
    here, near = seen_from(room, *HERE), seen_from(room, *NEAR)
    assert here.digest != near.digest
    assert here.surroundings == near.surroundings
    other = room.with_name("other.zip")
    write(door(angle=41.0), other)
    assert load_scene(other, "llvm_ad_rgb", size=(32, 24)).surroundings != here.surroundings


def test_a_camera_beside_needs_fewer_steps_and_has_the_same_light(room: Path) -> None:
    from elps_core.context.build import ContextBuilder
    from elps_core.renderer import Renderer

    known = built(room)
    assert known.directions is not None
    scene = seen_from(room, *NEAR)
    builder = ContextBuilder(scene, SETTINGS)
    whole = builder.steps
    assert builder.begin_from(known)
    assert builder.steps < whole
    while builder.done < builder.steps:
        saved = builder.to_bytes()  # What it began with outlives the process, too
        builder = ContextBuilder(scene, SETTINGS)
        builder.restore(saved)
        builder.step()
    found = builder.result()
    assert found.directions is not None
    np.testing.assert_array_equal(found.directions.radiance.values, known.directions.radiance.values)
    assert found.digest != known.digest
    # Fit to render with, though the two cameras' adjoint images may divide the lamp differently.
    by_context = {"direction_sampling": "context", "roulette": "context"}
    settings = RenderSettings(integrator="path", max_depth=SETTINGS.max_depth, context=SETTINGS, **by_context)
    Renderer(scene, settings, found).render_chunk(0)

    own = ContextBuilder(scene, SETTINGS)
    while own.done < own.steps:
        own.step()
    mine = own.result().directions
    assert mine is not None
    # The image is the camera's own, and not the other's.
    ours, theirs, other = (parts.pilot / parts.pilot.mean() for parts in (found.directions, mine, known.directions))
    difference = np.abs(ours - theirs).mean()
    assert difference < 0.15
    assert difference < np.abs(ours - other).mean() / 2


def test_a_camera_that_sees_the_unknown_begins_anew(room: Path) -> None:
    from elps_core.context.build import ContextBuilder

    known = built(room)
    assert known.directions is not None
    radiance = known.directions.radiance
    empty = replace(radiance, evidence=np.zeros_like(radiance.evidence))
    ignorant = replace(known, directions=replace(known.directions, radiance=empty))
    builder = ContextBuilder(seen_from(room, *NEAR), SETTINGS)
    steps = builder.steps
    given_up = replace(known, statistics=known.statistics | {"thorough": False})
    for other in (ignorant, given_up):
        assert not builder.begin_from(other)
        assert builder.steps == steps


def test_other_settings_and_other_scenes_do_not_fit(room: Path) -> None:
    from elps_core.context.build import ContextBuilder

    scene = seen_from(room, *NEAR)
    other = SETTINGS.model_copy(update={"rows": 16})
    assert not ContextBuilder(scene, other).begin_from(built(room))
    path = room.with_name("another.zip")
    write(door(angle=41.0), path)
    assert not ContextBuilder(load_scene(path, "llvm_ad_rgb", size=(32, 24)), SETTINGS).begin_from(built(room))


def test_only_before_the_first_step(room: Path) -> None:
    from elps_core.context.build import ContextBuilder

    builder = ContextBuilder(seen_from(room, *NEAR), SETTINGS)
    while not builder._tables.done:  # type: ignore[union-attr]
        builder.step()
    with pytest.raises(RuntimeError, match="begun"):
        builder.begin_from(built(room))
