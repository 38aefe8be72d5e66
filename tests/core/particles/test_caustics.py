"""Photons that are aimed at mirrors and glass: against what eye paths find by chance on the same way back."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.core.particles.conftest import Array, check
from tests.rendering import uneven_table

PATHS = 1 << 16
DEPTH = 6
RADIANCE = 3.0
CELLS = 4
"""Of the floor, along each side."""


def room(mi: Any, light: str, shapes: tuple[str, ...]) -> Any:
    """A floor [-1, 1]^2 at z = 0 that absorbs, and over it a lamp and what turns its light."""
    place = mi.ScalarTransform4f
    lamp = place().translate([0.2, 0.1, 3.0]) @ place().rotate([1, 0, 0], 180.0) @ place().scale(0.5)
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    scene: dict[str, Any] = {
        "type": "scene",
        "floor": {"type": "rectangle", "bsdf": {"type": "twosided", "bsdf": black}},
        "sensor": {"type": "perspective", "to_world": place().look_at([0, -3, 2], [0, 0, 0], [0, 0, 1])},
    }
    if light == "area":
        emitter = {"type": "area", "radiance": {"type": "rgb", "value": RADIANCE}}
        scene["lamp"] = {"type": "rectangle", "to_world": lamp, "bsdf": black, "emitter": emitter}
    elif light == "constant":
        scene["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": RADIANCE}}
    else:
        intensity = {"type": "rgb", "value": RADIANCE}
        scene["point"] = {"type": "point", "position": [0.2, 0.1, 3.0], "intensity": intensity}
    half = {"type": "rgb", "value": 0.5}
    every = {
        "ball": {"type": "sphere", "center": [-0.2, 0.1, 0.6], "radius": 0.4, "bsdf": {"type": "dielectric"}},
        "mirror": {
            "type": "rectangle",
            "to_world": place().translate([0.9, 0.0, 0.7]) @ place().rotate([0, 1, 0], -75) @ place().scale(0.4),
            "bsdf": {"type": "twosided", "bsdf": {"type": "conductor", "specular_reflectance": half}},
        },
        "rough": {"type": "sphere", "center": [0.5, -0.6, 0.4], "radius": 0.2, "bsdf": {"type": "roughconductor"}},
    }
    return mi.load_dict(scene | {name: every[name] for name in shapes})


def sampler(mi: Any, scene: Any, paths: int = PATHS) -> Any:
    from elps_core.particles.caustics import CausticSampler
    from elps_core.sampling.start import StartDensity
    from elps_core.scene.emission import Emission

    emission = Emission(scene)
    return CausticSampler(scene, StartDensity(emission, uneven_table(emission)), max_depth=DEPTH, paths=paths)


def cells_of(position: Array, weight: Array, side: int = CELLS) -> Array:
    """Sums of weights by cell of the floor."""
    cell = np.clip(((position[:, :2] + 1.0) * (side / 2)).astype(int), 0, side - 1)
    return np.bincount(cell[:, 0] * side + cell[:, 1], weight, side * side)


def by_eye(mi: Any, scene: Any, count: int, seed: int) -> Array:
    """The same integral over the cells of the floor, from there: E[X^2] cos^2 over points and directions."""
    import drjit as dr

    random = mi.PCG32(size=count, initstate=seed)
    place = mi.Point2f(random.next_float32(), random.next_float32())
    start = mi.Point3f(2.0 * place.x - 1.0, 2.0 * place.y - 1.0, 0.0)
    direction = mi.warp.square_to_cosine_hemisphere(mi.Point2f(random.next_float32(), random.next_float32()))
    ray = mi.Ray3f(start + direction * 1e-4, direction)
    found, carried, active = mi.Float(0.0), mi.Float(1.0), mi.Bool(True)
    for depth in range(DEPTH):
        si = scene.ray_intersect(ray, active)
        emitter = si.emitter(scene, active)
        if depth:  # What comes straight from the lamp is no caustic
            found = found + dr.select(active, carried * mi.luminance(emitter.eval(si, active)), 0.0)
        active = active & si.is_valid() & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Delta)
        uv = mi.Point2f(random.next_float32(), random.next_float32())
        sample, weight = si.bsdf().sample(mi.BSDFContext(), si, random.next_float32(), uv, active)
        carried = carried * dr.select(active, mi.luminance(weight), 0.0)
        ray = si.spawn_ray(si.to_world(sample.wo))
    cos = mi.Frame3f.cos_theta(direction)
    value = dr.square(found) * cos * dr.pi * 4.0 / count  # cos^2 over a density of cos / pi, times the area
    return cells_of(np.array(start).T, np.array(value, np.float64))


@pytest.mark.parametrize(
    ("light", "shapes"), [("area", ("ball",)), ("constant", ("mirror", "rough")), ("constant", ("ball", "mirror"))]
)
def test_weights_are_those_that_eye_paths_find(mi: Any, light: str, shapes: tuple[str, ...]) -> None:
    scene = room(mi, light, shapes)
    aimed = sampler(mi, scene)
    assert aimed.count == len({*shapes} - {"rough"})
    expected = np.array([by_eye(mi, scene, 1 << 21, seed) for seed in range(16)])
    found = []
    for run in range(24):
        photons = [batch.arrays() for batch in aimed.run((7, run))]
        assert all((part.depth >= 2).all() for part in photons)
        on_floor = [(part.position[np.abs(part.position[:, 2]) < 1e-3], part) for part in photons]
        sums = [cells_of(at, part.weight[np.abs(part.position[:, 2]) < 1e-3]) for at, part in on_floor]
        found.append(np.sum(sums, axis=0, dtype=np.float64))
    # Cells that eye paths hardly ever find anything in say nothing.
    mean, error = expected.mean(axis=0), expected.std(axis=0, ddof=1) / 4.0
    known = (mean > 0.0) & (error < 0.03 * mean)
    assert known.sum() >= 3
    check(np.array(found)[:, known], mean[known], error[known], bound=0.2)


def test_runs_are_split_into_batches(mi: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from elps_core.particles import caustics

    monkeypatch.setattr(caustics, "BATCH", PATHS // 2)
    scene = room(mi, "area", ("ball",))
    batches = [batch.arrays() for batch in sampler(mi, scene).run((1,))]
    assert len(batches) == 2
    totals = [float(batch.weight.sum()) for batch in batches]
    assert totals[0] == pytest.approx(totals[1], rel=0.3)
    assert totals[0] != totals[1]


@pytest.mark.parametrize(("light", "shapes"), [("area", ("rough",)), ("area", ()), ("point", ("ball",))])
def test_nothing_to_aim_at_brings_nothing(mi: Any, light: str, shapes: tuple[str, ...]) -> None:
    """Light of a point that glass has bent is met by no eye path."""
    aimed = sampler(mi, room(mi, light, shapes))
    assert sum(len(batch) for batch in aimed.run((1,))) == 0
