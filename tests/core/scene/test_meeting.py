"""Rays meet lamps by our tables where they meet them by Mitsuba's shapes, and all that is told of it is the same."""

from __future__ import annotations

from typing import Any

import numpy as np

RAYS = 1 << 18
FIELDS = ("t", "p", "n", "uv", "dp_du", "dp_dv", "wi", "shape", "instance", "dn_du", "dn_dv", "time")
ROUNDING = 1e-4
"""Of coordinates of some metres, and of their derivatives, in single precision."""


def turned(mi: Any) -> dict[str, dict[str, Any]]:
    """Lamps of all shapes that have tables: turned, mirrored, squeezed, and with normals that point inwards."""
    place = mi.ScalarTransform4f
    turn = place().rotate([0.6, 0.0, 0.8], 33)

    def at(x: float, y: float, z: float, *scale: float) -> Any:
        return place().translate([x, y, z]) @ turn @ place().scale(list(scale))

    lamps: dict[str, dict[str, Any]] = {
        "rectangle": {"type": "rectangle", "to_world": at(0, 0, 0, 2, 0.5, 1)},
        "inwards rectangle": {"type": "rectangle", "to_world": at(0, 0, -6, 2, 0.5, 1), "flip_normals": True},
        "mirrored rectangle": {"type": "rectangle", "to_world": at(5, 5, -6, -2, 0.5, 1)},
        "sphere": {"type": "sphere", "center": [3, 1, 0], "radius": 0.7},
        "turned sphere": {"type": "sphere", "to_world": at(-4, 0, 0, 1.3, 1.3, 1.3)},
        "inwards sphere": {"type": "sphere", "to_world": at(-4, 5, 0, 1.3, 1.3, 1.3), "flip_normals": True},
        "disk": {"type": "disk", "to_world": at(0, 4, 0, 1.7, 1.7, 1.7)},
        "squeezed disk": {"type": "disk", "to_world": at(0, 4, 4, 1.7, 0.5, 1)},
        "cylinder": {"type": "cylinder", "p0": [0, -4, 0], "p1": [1, -5, 1], "radius": 0.3},
        "inwards cylinder": {
            "type": "cylinder",
            "p0": [4, -4, 0],
            "p1": [5, -5, 1],
            "radius": 0.5,
            "flip_normals": True,
        },
        "mirrored cylinder": {"type": "cylinder", "to_world": at(4, -4, 4, -1, 1, 1)},
        "mesh": {"type": "cube", "to_world": at(9, 0, 0, 1, 1, 1)},
    }
    return {name: {**lamp, "emitter": {"type": "area"}} for name, lamp in lamps.items()}


def test_what_rays_meet_is_what_mitsuba_tells(mi: Any) -> None:
    import drjit as dr

    from elps_core.scene.emission import Emission
    from elps_core.scene.emitters import MANY

    place = mi.ScalarTransform4f
    others: dict[str, Any] = {
        "box": {"type": "cube", "to_world": place().translate([9, 4, 0])},
        "ball": {"type": "sphere", "center": [9, 9, 0], "radius": 1},
        "group": {"type": "shapegroup", "part": {"type": "cube"}},
        "instance": {
            "type": "instance",
            "to_world": place().translate([-9, 0, 0]),
            "of": {"type": "ref", "id": "group"},
        },
    }
    small = {
        f"small {k}": {"type": "sphere", "center": [-3 + 0.1 * k, -2, 0], "radius": 0.04, "emitter": {"type": "area"}}
        for k in range(MANY)
    }
    lamps = turned(mi)
    scene = mi.load_dict({"type": "scene", **lamps, **others, **small})
    rays = Emission(scene).rays
    assert rays.by_tables
    rng = np.random.default_rng(1)
    low, high = (np.array(corner, np.float32).reshape(3, 1) for corner in (scene.bbox().min, scene.bbox().max))
    start, end = (low + (high - low) * rng.random((3, RAYS), dtype=np.float32) for _ in range(2))
    ray = mi.Ray3f(mi.Point3f(start), dr.normalize(mi.Vector3f(mi.Point3f(end) - mi.Point3f(start))))
    wanted, found = scene.ray_intersect(ray), rays.ray_intersect(ray)
    for name in FIELDS:
        a, b = getattr(wanted, name), getattr(found, name)
        if name in ("shape", "instance"):
            a, b = (dr.reinterpret_array(mi.UInt32, part) for part in (a, b))
        a, b = (np.atleast_2d(np.array(part, np.float64)) for part in (a, b))
        with np.errstate(invalid="ignore"):
            off = np.where(a == b, 0.0, np.abs(a - b)).max(axis=0)
        # Seams of spheres and cylinders, where 0 and 1 are one, and their poles, where a hair turns the tangent.
        assert np.quantile(off, 0.999) < ROUNDING, name
    assert np.abs(np.array(wanted.sh_frame.n) - np.array(found.sh_frame.n))[:, np.array(wanted.is_valid())].max() < 1e-3
    met = np.unique(np.array(dr.reinterpret_array(mi.UInt32, found.shape)))
    assert len(met) > len(lamps) + len(small)


def test_few_lamps_are_met_by_mitsuba(mi: Any) -> None:
    from elps_core.scene.emission import Emission

    assert not Emission(mi.load_dict({"type": "scene", **turned(mi)})).rays.by_tables
