"""A room of many lamps of every kind, more than kernels know by code."""

from __future__ import annotations

from typing import Any

import numpy as np

COLUMNS = 12
"""Lamps hang in rows of this many."""
KINDS = ("rectangle", "sphere", "disk", "cylinder", "cube", "point", "spot", "picture")


def room(mi: Any, lamps: int, kinds: tuple[str, ...] = KINDS, **sensor: Any) -> Any:
    """A box from -2 to 2 with ``lamps`` of these ``kinds`` in turn under its ceiling, each of another brightness."""
    place = mi.ScalarTransform4f
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.5, 0.4]}}
    box = {"type": "cube", "to_world": place().scale(2.0), "flip_normals": True, "bsdf": grey}
    pillar = {"type": "cube", "to_world": place().translate([0.3, -1.0, 0.2]) @ place().scale([0.2, 1.0, 0.2])}
    lights = {f"lamp{k}": _lamp(mi, kinds[k % len(kinds)], k, lamps) for k in range(lamps)}
    return mi.load_dict({"type": "scene", "box": box, "pillar": pillar, **lights, **sensor})


def _lamp(mi: Any, kind: str, number: int, lamps: int) -> dict[str, Any]:
    place = mi.ScalarTransform4f
    row, column = divmod(number, COLUMNS)
    rows = -(-lamps // COLUMNS)
    spot = [-1.7 + 3.4 * (column + 0.5) / COLUMNS, 1.2 + 0.4 * (number % 3) / 3, -1.7 + 3.4 * (row + 0.5) / rows]
    size = 0.35 * min(3.4 / COLUMNS, 3.4 / rows)
    colour = (0.3 + np.random.default_rng(number).random(3)).tolist()
    bright = {"type": "rgb", "value": [12.0 * c / (lamps * size * size) for c in colour]}
    area = {"type": "area", "radiance": bright}
    down = place().translate(spot) @ place().rotate([1, 0, 0], 90 + 7 * (number % 5)) @ place().scale(size)
    if kind == "picture":
        pixels = np.random.default_rng(number).random((4, 4, 3)).astype(np.float32)
        picture = {"type": "bitmap", "bitmap": mi.Bitmap(pixels)}
        return {"type": "rectangle", "to_world": down, "emitter": {"type": "area", "radiance": picture}}
    if kind == "point":
        return {
            "type": "point",
            "position": spot,
            "intensity": {"type": "rgb", "value": [3.0 * c / lamps for c in colour]},
        }
    if kind == "spot":
        aimed = place().look_at(spot, [spot[0] + 0.2, -2.0, spot[2]], [0, 0, 1])
        return {
            "type": "spot",
            "to_world": aimed,
            "cutoff_angle": 40.0,
            "intensity": {"type": "rgb", "value": 20.0 / lamps},
        }
    if kind == "sphere":
        return {"type": "sphere", "center": spot, "radius": 0.6 * size, "emitter": area}
    if kind == "cylinder":
        ends = [spot, [spot[0] + size, spot[1], spot[2] + 0.3 * size]]
        return {"type": "cylinder", "p0": ends[0], "p1": ends[1], "radius": 0.3 * size, "emitter": area}
    return {"type": kind, "to_world": down @ place().scale(0.6 if kind == "cube" else 1.0), "emitter": area}
