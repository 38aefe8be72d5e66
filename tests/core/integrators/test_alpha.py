"""The alpha channel: that of Mitsuba's path tracer, filtered as the colour is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest


def scene(mi: Any, filter_name: str, *, sky: bool = False, opacity: float | None = None) -> Any:
    """A ball that covers a part of the film, behind a veil where there is an ``opacity``."""
    film = {"type": "hdrfilm", "width": 16, "height": 12, "pixel_format": "rgba", "rfilter": {"type": filter_name}}
    look = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    parts: dict[str, Any] = {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 45, "to_world": look, "film": film},
        "ball": {"type": "sphere", "center": [-0.6, 0.3, 0.0]},
        "lamp": {"type": "point", "position": [0.0, 3.0, 3.0], "intensity": {"type": "rgb", "value": 20.0}},
    }
    if opacity is not None:
        veil = mi.ScalarTransform4f().translate([0.5, 0, 1.5]).scale([0.7, 0.4, 1])
        parts["veil"] = {
            "type": "rectangle",
            "to_world": veil,
            "bsdf": {"type": "mask", "opacity": opacity, "nested": {"type": "diffuse"}},
        }
    if sky:
        parts["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": 0.5}}
    return mi.load_dict(parts)


def alphas(mi: Any, scene: Any, spp: int) -> tuple[Any, Any]:
    """Ours and Mitsuba's, [height, width]."""
    from elps_core.integrators.alpha import AlphaFrames
    from elps_core.integrators.canvas import Canvas
    from elps_core.scene.sensors import Camera

    sensor = scene.sensors()[0]
    frames = AlphaFrames(scene, Camera(sensor), Canvas(sensor.film()), 16)
    integrator = mi.load_dict({"type": "path", "max_depth": 6})
    return np.array(frames.render(spp, (0, 0))), np.array(mi.render(scene, integrator=integrator, spp=spp))[..., 3]


@pytest.mark.parametrize("filter_name", ["box", "gaussian", "mitchell"])
def test_it_is_that_of_mitsuba(mi: Any, filter_name: str) -> None:
    ours, theirs = alphas(mi, scene(mi, filter_name), 1024)
    assert ours == pytest.approx(theirs, abs=0.06)
    assert ours.mean() == pytest.approx(theirs.mean(), abs=2e-3)
    assert 0.1 < ours.mean() < 0.6
    assert ours.max() > 0.999
    assert not ours[-1, 10:].any()


def test_veils_cover_as_much_as_they_hold_back(mi: Any) -> None:
    ours, theirs = alphas(mi, scene(mi, "box", opacity=0.3), 4096)
    assert ours == pytest.approx(theirs, abs=0.04)
    assert ours.mean() == pytest.approx(theirs.mean(), abs=2e-3)
    assert ours[6, 12] == pytest.approx(0.3, abs=0.04)


def test_a_sky_covers_all(mi: Any) -> None:
    ours, theirs = alphas(mi, scene(mi, "gaussian", sky=True), 4)
    assert ours == pytest.approx(theirs, abs=1e-6)
    assert (ours == 1.0).all()
