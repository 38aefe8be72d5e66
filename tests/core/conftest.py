"""Small scenes and renders that the tests of the renderer share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elps_core import device
from elps_core.settings import Roulette
from tests.core.tiers import is_thorough
from tests.rendering import Table, render

Array = np.ndarray[Any, Any]
HERE = Path(__file__).parent


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what `make test` leaves out."""
    for item in items:
        if item.path.is_relative_to(HERE) and is_thorough(item.path.relative_to(HERE).as_posix(), item.name):
            item.add_marker(pytest.mark.thorough)


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

    def draw(
        scene: Any,
        *,
        images: int,
        spp: int,
        max_depth: int,
        table: Table | None = None,
        roulette: Roulette = "albedo",
        seed: int = 0,
    ) -> Array:
        options: dict[str, Any] = {"roulette": roulette, "seed": seed}
        return render(scene, "bdpt", images=images, spp=spp, max_depth=max_depth, table=table, **options)

    return draw


@pytest.fixture
def render_path() -> Callable[..., Array]:
    """Independent images [n, height, width, 3] by Mitsuba's path tracer without roulette."""

    def draw(scene: Any, *, images: int, spp: int, max_depth: int) -> Array:
        return render(scene, "mi_path", images=images, spp=spp, max_depth=max_depth)

    return draw
