"""Scenes of many lamps: the image of Mitsuba's path tracer, by kernels that do not depend on how many there are."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from elps_core import device
from tests import adversaries
from tests.agreement import compare
from tests.lamps import KINDS, room
from tests.rendering import render

LAMPS = 120
DEPTH = 4


def camera(mi: Any, size: int = 24) -> dict[str, Any]:
    view = mi.ScalarTransform4f().look_at([-1.6, 0.4, -1.7], [0.4, 0.0, 0.3], [0, 1, 0])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    return {"sensor": {"type": "perspective", "fov": 75, "to_world": view, "film": film}}


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_spectral"])
def test_the_image_is_that_of_mitsuba(variant: str) -> None:
    mi = device.use(variant)
    try:
        scene = room(mi, LAMPS, **camera(mi))
        ours = render(scene, "bdpt", images=12, spp=128, max_depth=DEPTH)
        agreement = compare(ours, render(scene, "mi_path", images=12, spp=512, max_depth=DEPTH), block=8)
        assert agreement.agrees, agreement
        assert agreement.detectable < 0.03, agreement
    finally:
        device.use("llvm_ad_rgb")


@pytest.mark.parametrize(("algorithm", "kind"), [("path", "spiked"), ("bdpt", "random")])
def test_no_context_moves_the_image(mi: Any, algorithm: str, kind: adversaries.Kind) -> None:
    scene = room(mi, LAMPS, **camera(mi))
    parts = adversaries.parts(scene, kind)
    ours = render(scene, algorithm, images=12, spp=128, max_depth=DEPTH, seed=3, parts=parts)
    agreement = compare(ours, render(scene, "mi_path", images=12, spp=512, max_depth=DEPTH), block=8)
    assert agreement.agrees, agreement
    assert agreement.detectable < 0.04, agreement


def kernels(mi: Any, lamps: int, kinds: tuple[str, ...], algorithm: str) -> set[int]:
    """Hashes of the kernels of a render."""
    import drjit as dr

    scene = room(mi, lamps, kinds, **camera(mi, 8))
    parts = adversaries.parts(scene, "random")
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history()
        render(scene, algorithm, images=1, spp=4, max_depth=DEPTH, parts=parts)
        return {entry["hash"] for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT}


@pytest.mark.parametrize("algorithm", ["path", "bdpt"])
def test_kernels_do_not_depend_on_the_number_of_lamps(mi: Any, algorithm: str) -> None:
    alike = tuple(kind for kind in KINDS if kind not in ("spot", "picture", "cube"))
    fewer = kernels(mi, 70, alike, algorithm)
    assert fewer
    assert kernels(mi, 700, alike, algorithm) <= fewer


@pytest.mark.parametrize("kind", ["rectangle", "sphere", "point"])
def test_a_scene_of_one_kind_of_lamps_shares_kernels_too(mi: Any, kind: str) -> None:
    fewer = kernels(mi, 70, (kind,), "path")
    assert kernels(mi, 210, (kind,), "path") <= fewer


def test_lamps_are_as_bright_as_their_power_says(mi: Any) -> None:
    """The adjoint image of many lamps sums to the picture's flux, and keeps what each lamp gives."""
    from elps_core.context.adjoint import STEPS, AdjointMeasurement
    from elps_core.scene.emission import Emission
    from elps_core.scene.sensors import Camera
    from elps_core.settings import ContextSettings

    scene = room(mi, LAMPS, **camera(mi))
    settings = ContextSettings(resolution=16, samples_per_cell=256, max_depth=DEPTH)
    measured = AdjointMeasurement(scene, Camera(scene.sensors()[0]), Emission(scene), settings)
    for _ in range(STEPS):
        measured.step()
    weights = np.array([0.212671, 0.715160, 0.072169])
    picture = (render(scene, "mi_path", images=8, spp=256, max_depth=DEPTH) @ weights).mean(axis=(1, 2))
    flux = measured.batches.sum(axis=(1, 2))
    error = np.hypot(flux.std(ddof=1), picture.std(ddof=1)) / np.sqrt(8)
    assert abs(flux.mean() - picture.mean()) < 4.5 * error
    assert error < 0.02 * picture.mean()
    assert measured.image().sum() == pytest.approx(flux.mean(), rel=1e-6)
