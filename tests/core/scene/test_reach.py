"""What is said to be lost is lost, and what is not is found: judged by rules, and by rendering."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elps_core.errors import SettingsRejected
from elps_core.scene import plugins, reach
from elps_core.scene.loader import load_scene
from elps_core.scene.summary import EmitterSummary, FilmSummary, SceneSummary, SensorSummary
from elps_core.settings import RenderSettings, with_overrides
from tests.tensors import material, written

from .conftest import load, scene_xml

VARIANT = "llvm_ad_rgb"


def described(emitters: str, bsdfs: str, sensor: str = "perspective") -> SceneSummary:
    return SceneSummary(
        sensors=(SensorSummary(type=sensor, width=8, height=8),),
        emitters=tuple(EmitterSummary(type=kind, count=1) for kind in emitters.split()),
        bsdfs=tuple(sorted(bsdfs.split())),
        shapes=1,
        triangles=0,
    )


def settings(integrator: str, **changes: Any) -> RenderSettings:
    return with_overrides(
        RenderSettings(integrator=integrator), {name.replace("__", "."): value for name, value in changes.items()}
    )


GLASS_AND_WALLS = "diffuse dielectric"


@pytest.mark.parametrize(
    ("integrator", "emitters", "bsdfs", "sensor", "changes", "words"),
    [
        ("bdpt", "point", GLASS_AND_WALLS, "perspective", {}, ["bdpt", "'point'", "'dielectric'", "before and after"]),
        ("bdpt", "spot directional", "diffuse mask", "orthographic", {}, ["'directional', 'spot'", "'mask'"]),
        ("pssmlt", "point", "plastic", "perspective", {}, ["pssmlt", "'plastic'", "before and after"]),
        ("bdpt", "point", "diffuse null twosided", "perspective", {}, ["'null'", "before and after"]),
        ("path", "point area", GLASS_AND_WALLS, "perspective", {}, ["path", "'point' that comes by way of"]),
        ("path", "projector", GLASS_AND_WALLS, "thinlens", {}, ["'projector' that comes by way of"]),
        ("path", "point area", "diffuse", "perspective", {"path__next_event": False}, ["finds no light of 'point',"]),
        (
            "light",
            "area",
            "diffuse conductor",
            "perspective",
            {},
            ["light", "'area'", "sees in or through 'conductor'"],
        ),
        ("light", "area", "conductor", "perspective", {"max_depth": 2}, ["sees in or through"]),
        ("light", "directional", "thindielectric plastic", "perspective", {}, ["'plastic', 'thindielectric'"]),
        ("mi_path", "directional", "roughplastic mask", "thinlens", {}, ["mi_path", "comes by way of 'mask'"]),
        ("mi_volpath", "point", "diffuse mask dielectric", "perspective", {}, ["comes by way of 'dielectric':"]),
        ("light", "area", "diffuse bumpmap roughdielectric", "perspective", {}, ["a part", "'roughdielectric'"]),
        ("mi_ptracer", "envmap", "diffuse conductor", "thinlens", {}, ["mi_ptracer", "sees in or through"]),
    ],
)
def test_lost_light_is_named(
    integrator: str, emitters: str, bsdfs: str, sensor: str, changes: dict[str, Any], words: list[str]
) -> None:
    lines = reach.unreachable(described(emitters, bsdfs, sensor), settings(integrator, **changes))
    assert len(lines) == 1
    assert all(word in lines[0] for word in words), lines
    assert "\n" not in lines[0]


@pytest.mark.parametrize(
    ("integrator", "emitters", "bsdfs", "sensor", "changes"),
    [
        ("bdpt", "area envmap sunsky constant", "diffuse dielectric conductor mask plastic", "perspective", {}),
        ("bdpt", "point", GLASS_AND_WALLS, "thinlens", {}),
        ("bdpt", "point", GLASS_AND_WALLS, "perspective", {"max_depth": 3}),
        ("bdpt", "point", "diffuse roughdielectric principled hair", "perspective", {}),
        ("bdpt", "point", "dielectric conductor", "perspective", {}),  # a point of light in mirrors: invisible
        ("bdpt", "point", GLASS_AND_WALLS, "perspective", {"bdpt__strategies": "1,3"}),
        ("path", "area", "diffuse dielectric mask", "perspective", {}),
        ("path", "point", GLASS_AND_WALLS, "perspective", {"max_depth": 2}),
        ("path", "area", GLASS_AND_WALLS, "perspective", {"path__next_event": False}),
        ("light", "area point", GLASS_AND_WALLS, "thinlens", {}),
        ("light", "area point", GLASS_AND_WALLS, "thinlens", {"light__connect": False}),
        ("light", "area point", "diffuse", "perspective", {}),
        ("light", "area", "bumpmap diffuse", "perspective", {}),
        ("bdpt", "area", "bumpmap roughdielectric", "perspective", {}),
        ("mi_volpath", "point", "diffuse mask", "perspective", {}),
        ("mi_depth", "point", GLASS_AND_WALLS, "perspective", {}),
    ],
)
def test_nothing_is_said_where_all_light_is_found(
    integrator: str, emitters: str, bsdfs: str, sensor: str, changes: dict[str, Any]
) -> None:
    assert reach.unreachable(described(emitters, bsdfs, sensor), settings(integrator, **changes)) == ()


def test_an_image_that_nothing_reaches_is_refused() -> None:
    pinhole, lens = (described("area", "diffuse", sensor) for sensor in ("perspective", "thinlens"))
    pure = settings("light", light__connect=False)
    aperture = settings("bdpt", bdpt__strategies="3,0 4,0")
    for asked in (pure, aperture):
        with pytest.raises(SettingsRejected, match="'thinlens'"):
            reach.check(pinhole, asked)
        reach.check(lens, asked)
    reach.check(pinhole, settings("bdpt", bdpt__strategies="3,0 2,1"))
    reach.check(pinhole, settings("mi_path"))


def test_kinds_of_materials_are_what_mitsuba_says_of_them(tmp_path: Path) -> None:
    from elps_core import device

    mi = device.use("scalar_rgb")
    inner = {"type": "diffuse"}
    (tmp_path / "a.bsdf").write_bytes(written(material()))
    parts = {
        "blendbsdf": {"a": inner, "b": inner, "weight": 0.5},
        "bumpmap": {"a": inner, "texture": {"type": "checkerboard"}},
        "mask": {"a": inner, "opacity": 0.5},
        "measured": {"filename": str(tmp_path / "a.bsdf")},
        "normalmap": {"a": inner, "normalmap": {"type": "checkerboard"}},
        "twosided": {"a": inner},
    }
    for kind in plugins.PLUGINS["bsdf"]:
        flags = mi.load_dict({"type": kind, **parts.get(kind, {})}).flags()
        mirrors = mi.has_flag(flags, mi.BSDFFlags.DeltaReflection) or mi.has_flag(flags, mi.BSDFFlags.DeltaTransmission)
        # Mitsuba's hair says Null of itself, and never lets light straight through.
        straight = mi.has_flag(flags, mi.BSDFFlags.Null) and kind != "hair"
        assert (kind in reach.MIRRORS) == mirrors, kind
        assert (kind in reach.STRAIGHT | {"thindielectric"}) == straight, kind
        assert (kind in reach.NEVER_SCATTER - reach.WRAPPERS) == (not mi.has_flag(flags, mi.BSDFFlags.Smooth)), kind


def test_materials_that_no_shape_has_do_not_count(tmp_path: Path) -> None:
    body = """
    <bsdf type="dielectric" id="unused"/>
    <bsdf type="conductor" id="mirror"/>
    <bsdf type="mask" id="leaf"><bsdf type="twosided"><bsdf type="plastic"/></bsdf></bsdf>
    <shape type="shapegroup" id="group"><shape type="sphere"><ref id="mirror"/></shape></shape>
    <shape type="instance"><ref id="group"/></shape>
    <shape type="rectangle"><ref id="leaf"/></shape>
    """
    assert load(tmp_path, scene_xml(body)).summary.bsdfs == ("conductor", "mask", "plastic", "twosided")
    assert load(tmp_path, scene_xml(body + '<shape type="cube"/>')).summary.bsdfs[1] == "diffuse"


# By rendering: a floor, a light above it, and something between or beside them that bends light.

CAMERAS = "".join(
    f"""<sensor type="{kind}"><float name="fov" value="40"/>{more}
    <transform name="to_world"><lookat origin="0, 2.2, 1.5" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="24"/>
    <rfilter type="box"/></film></sensor>"""
    for kind, more in (
        ("perspective", ""),
        ("thinlens", '<float name="aperture_radius" value="0.3"/><float name="focus_distance" value="2.7"/>'),
    )
)
PINHOLE, LENS = 0, 1
POINT = '<emitter type="point"><point name="position" value="0.3, 1.6, 0"/><rgb name="intensity" value="3"/></emitter>'
BALL = """<shape type="sphere"><point name="center" value="0.3, 1.6, 0"/><float name="radius" value="0.15"/>
<emitter type="area"><rgb name="radiance" value="40"/></emitter></shape>"""
FLOOR = """<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/>
<scale value="3"/></transform></shape>"""
PANE = """<shape type="rectangle"><bsdf type="thindielectric"/><transform name="to_world"><rotate x="1" angle="-90"/>
<scale value="3"/><translate y="1"/></transform></shape>"""
WALL = """<shape type="rectangle"><bsdf type="conductor"><string name="material" value="none"/></bsdf>
<transform name="to_world"><rotate y="1" angle="90"/><scale value="3"/><translate x="-0.6"/></transform></shape>"""
"""A mirror upright on the floor; it reflects from its other side as well."""


def rendered(tmp_path: Path, body: str, asked: RenderSettings) -> tuple[float, tuple[str, ...]]:
    """Mean of the image, and what is said of it."""
    from elps_core.renderer import Renderer

    path = tmp_path / "scene.xml"
    path.write_bytes(scene_xml(body, sensor=CAMERAS, light=""))
    scene = load_scene(path, VARIANT, sensor=asked.sensor)
    reach.check(scene.summary, asked)
    image = Renderer(scene, asked).render_chunk(0, 256).image
    return float(np.mean(image)), reach.unreachable(scene.summary, asked)


def asked_for(integrator: str, depth: int, sensor: int = PINHOLE, **changes: Any) -> RenderSettings:
    return settings(integrator, max_depth=depth, sensor=sensor, light_sampling="power", **changes)


@pytest.mark.parametrize(
    ("body", "losing", "finding", "lost"),
    [
        (POINT + FLOOR + PANE, asked_for("bdpt", 4), asked_for("bdpt", 4, LENS), 0.9),
        (POINT + FLOOR + WALL, asked_for("path", 3), asked_for("bdpt", 3), 0.1),
        (BALL + FLOOR + PANE, asked_for("light", 4), asked_for("path", 4), 0.9),
        (BALL + FLOOR + PANE, asked_for("light", 4), asked_for("light", 4, LENS), 0.9),
        (POINT + FLOOR, asked_for("path", 3, path__next_event=False), asked_for("path", 3), 1.0),
    ],
    ids=["both", "sent", "seen", "seen, lens", "all"],
)
def test_what_is_said_to_be_lost_is_lost(
    tmp_path: Path, body: str, losing: RenderSettings, finding: RenderSettings, lost: float
) -> None:
    """Where one algorithm warns and another does not, the first image lacks at least that share of the light."""
    poor, warned = rendered(tmp_path, body, losing)
    rich, silent = rendered(tmp_path, body, finding)
    assert len(warned) == 1
    assert not silent
    assert rich > 0.01
    assert poor <= (1.0 - lost) * rich


@pytest.mark.parametrize(
    ("body", "algorithms"),
    [
        (POINT + FLOOR, [asked_for(name, 3) for name in ("path", "light", "bdpt")]),
        (BALL + FLOOR + PANE, [asked_for(name, 4) for name in ("path", "bdpt")]),
        (BALL + FLOOR + WALL, [asked_for(name, 3, LENS) for name in ("path", "bdpt")]),
    ],
    ids=["point and floor", "lamp through a pane", "lamp and mirror"],
)
def test_where_nothing_is_said_all_light_is_found(tmp_path: Path, body: str, algorithms: list[RenderSettings]) -> None:
    means = []
    for asked in algorithms:
        mean, said = rendered(tmp_path, body, asked)
        assert not said
        means.append(mean)
    assert min(means) > 0.01
    # Means over 147,000 samples, within 1% of each other.
    assert max(means) / min(means) < 1.04


def test_hair_is_refused_where_light_paths_would_meet_it() -> None:
    """One sees out through a fibre and not into it: light paths would carry on from points that the eye never meets."""
    sensors = (SensorSummary(type="perspective", width=8, height=8),)
    emitters = (EmitterSummary(type="area", count=1),)
    summary = SceneSummary(
        sensors=sensors, emitters=emitters, bsdfs=("diffuse", "hair"), shapes=2, triangles=0, warnings=()
    )
    for integrator in ("light", "bdpt", "pssmlt"):
        with pytest.raises(SettingsRejected, match="hair"):
            reach.check(summary, RenderSettings(integrator=integrator))
    for integrator in ("path", "mi_path"):
        reach.check(summary, RenderSettings(integrator=integrator))


def test_depths_that_are_cut_are_told() -> None:
    scene = described("area", "diffuse")
    (line,) = reach.unreachable(scene, settings("bdpt", max_depth=-1))
    assert "256" in line
    for integrator in ("path", "light", "auto"):
        assert reach.unreachable(scene, settings(integrator, max_depth=-1)) == ()


def test_chains_keep_no_bands() -> None:
    scene = described("area", "diffuse")
    film = scene.sensors[0].model_copy(update={"film": FilmSummary(pixels="bands")})
    bands = scene.model_copy(update={"sensors": (film,)})
    reach.check(bands, settings("bdpt"))
    with pytest.raises(SettingsRejected, match="bands"):
        reach.check(bands, settings("pssmlt"))
