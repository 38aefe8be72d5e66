"""One room wherever it stands, however large it is, and from however far it is seen or lit, as a scene file."""

from __future__ import annotations

from collections.abc import Callable
from math import atan, degrees
from pathlib import Path
from typing import Any

from elps_core.scene.loader import load_scene
from tests.zoo.entry import Entry, without_extent

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


def _read(xml: str) -> Callable[[Any, Path], Any]:
    """What has the room read by the loader, which moves and scales it."""

    def make(mi: Any, folder: Path) -> Any:
        (folder / "scene.xml").write_text(xml)
        return load_scene(folder / "scene.xml", mi.variant()).scene

    return make


ENTRIES = [
    Entry("room-far-away", _read(room(place=1000.0)), "room 1,000 units off the origin"),
    Entry("room-tiny", _read(room(1e-3, 1e5)), "room of a thousandth, 100,000 of its sizes off the origin"),
    Entry("room-camera-far", _read(room(eye=4e4)), "camera 10,000 rooms away"),
    Entry("room-lamp-far", _read(room(lamp=4e4)), "spot 10,000 rooms away", without_extent()),
]
