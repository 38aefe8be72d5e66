"""Small scenes and renders that the tests of the renderer share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from elps_core import device
from elps_core.settings import Roulette

Array = np.ndarray[Any, Any]


@pytest.fixture
def mi() -> Any:
    """Mitsuba in its default variant."""
    return device.use("llvm_ad_rgb")


@pytest.fixture
def camera_dict(mi: Any) -> Callable[..., dict[str, Any]]:
    """A small perspective camera; keyword arguments go to the film."""

    def make(origin: list[float], target: list[float], size: tuple[int, int] = (32, 32), **film: Any) -> dict[str, Any]:
        options = {"rfilter": {"type": "box"}, **film}
        return {
            "type": "perspective",
            "fov": 45,
            "to_world": mi.ScalarTransform4f().look_at(origin, target, [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": size[0], "height": size[1], **options},
        }

    return make


@pytest.fixture
def render_bdpt() -> Callable[..., Array]:
    """Independent images [n, height, width, 3] by our bidirectional path tracing."""

    def render(
        scene: Any,
        *,
        images: int,
        spp: int,
        max_depth: int,
        table: Callable[[Any], Array] | None = None,
        roulette: Roulette = "albedo",
        seed: int = 0,
    ) -> Array:
        from elps_core.integrators.bdpt import Bdpt
        from elps_core.integrators.frame import FrameRenderer
        from elps_core.paths.roulette import RouletteRule
        from elps_core.sampling.start import StartDensity, power_table
        from elps_core.scene.emission import Emission
        from elps_core.scene.sensors import Camera

        sensor = scene.sensors()[0]
        emission = Emission(scene)
        lights = StartDensity(emission, (table or power_table)(emission))
        bdpt = Bdpt(scene, Camera(sensor), lights, max_depth=max_depth, roulette=RouletteRule(roulette, 4))
        frames = FrameRenderer(bdpt, sensor.film())
        return np.stack([np.array(frames.render(spp, (seed, index)).image) for index in range(images)])

    return render


@pytest.fixture
def render_path() -> Callable[..., Array]:
    """Independent images [n, height, width, 3] by Mitsuba's path tracer without roulette."""

    def render(scene: Any, *, images: int, spp: int, max_depth: int) -> Array:
        import mitsuba

        integrator = mitsuba.load_dict({"type": "path", "max_depth": max_depth, "rr_depth": 1000})
        results = [
            np.array(mitsuba.render(scene, integrator=integrator, spp=spp, seed=1000 + index))
            for index in range(images)
        ]
        return np.stack(results)[..., :3]

    return render
