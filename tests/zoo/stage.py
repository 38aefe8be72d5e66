"""What most scenes of the zoo share: a floor and a wall that fill the picture, a wide dim light above.

Noise is kept low on purpose: lights are large and hardly brighter than what they light, and none is in
view unless the scene is about that. About 13 million samples then find a bias of 0.2% of the mean.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.zoo.entry import Dict

SIZE = (24, 24)
"""Width and height in pixels: nine blocks of eight by eight."""
Array = np.ndarray[Any, Any]


def rgb(*value: float) -> Dict:
    """A colour; one number is a grey."""
    return {"type": "rgb", "value": list(value) if len(value) == 3 else value[0]}


def diffuse(*color: float) -> Dict:
    """A Lambertian surface, seen from both sides."""
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(*color)}}


def area(*radiance: float) -> Dict:
    """An area emitter."""
    return {"type": "area", "radiance": rgb(*radiance)}


def bitmap(mi: Any, pixels: Array, *, raw: bool = False) -> Dict:
    """A texture of ``pixels`` [height, width, channels]; ``raw`` numbers are not colours."""
    return {"type": "bitmap", "raw": raw, "bitmap": mi.Bitmap(np.ascontiguousarray(pixels, np.float32))}


def noise(seed: int, *shape: int, low: float = 0.1, high: float = 0.9) -> Array:
    """Uniform numbers in [low, high] of the given shape."""
    return np.random.default_rng(seed).uniform(low, high, shape)


def film(**options: Any) -> Dict:
    """A film of :data:`SIZE` with box-filtered pixels."""
    return {
        "type": "hdrfilm",
        "width": SIZE[0],
        "height": SIZE[1],
        "rfilter": {"type": "box"},
        **options,
    }


def camera(
    mi: Any,
    origin: tuple[float, float, float] = (0.0, 1.2, 3.4),
    target: tuple[float, float, float] = (0.0, 0.5, 0.0),
    *,
    fov: float = 40.0,
    of_film: Dict | None = None,
    **options: Any,
) -> Dict:
    """A perspective camera over the floor, looking at the middle; ``options`` are the sensor's."""
    sensor: Dict = {
        "type": "perspective",
        "fov": fov,
        "near_clip": 0.01,
        "to_world": mi.ScalarTransform4f().look_at(list(origin), list(target), [0, 1, 0]),
        "film": of_film or film(),
        **options,
    }
    if sensor["type"] == "orthographic":
        del sensor["fov"]
    return sensor


def room(*, floor: Dict | None = None, wall: Dict | None = None, mi: Any) -> Dict:
    """Floor and back wall."""
    place = mi.ScalarTransform4f
    return {
        "floor": {
            "type": "rectangle",
            "to_world": place().rotate([1, 0, 0], -90) @ place().scale(2.2),
            "bsdf": floor or diffuse(0.6, 0.5, 0.4),
        },
        "wall": {
            "type": "rectangle",
            "to_world": place().translate([0, 1.1, -1.2]) @ place().scale(2.2),
            "bsdf": wall or diffuse(0.4, 0.5, 0.6),
        },
    }


def ball(
    bsdf: Dict | None = None, *, center: tuple[float, float, float] = (0.0, 0.55, 0.0), radius: float = 0.55
) -> Dict:
    """The subject: a sphere on the floor."""
    return {"type": "sphere", "center": list(center), "radius": radius, "bsdf": bsdf or diffuse(0.7, 0.3, 0.3)}


def facing_down(mi: Any, x: float = 0.0, y: float = 2.6, z: float = 0.4, half: float = 1.2) -> Any:
    """To-world of a rectangle or disk of half side ``half`` that faces the floor."""
    place = mi.ScalarTransform4f
    return place().translate([x, y, z]) @ place().rotate([1, 0, 0], 90) @ place().scale(half)


def softbox(mi: Any) -> Dict:
    """The wide dim light above, out of view."""
    return {"type": "rectangle", "to_world": facing_down(mi), "bsdf": diffuse(0.3), "emitter": area(3.0, 2.7, 2.4)}


def scene(mi: Any, *, sensor: Dict | None = None, **parts: Any) -> Dict:
    """The stage with ``parts``, which replace what has the same name; None takes a part away."""
    whole: Dict = {"type": "scene", "sensor": sensor or camera(mi), **room(mi=mi), "ball": ball(), "light": softbox(mi)}
    whole.update(parts)
    return {name: part for name, part in whole.items() if part is not None}


def sphere_mesh(mi: Any, rows: int = 5, columns: int = 8, *, radius: float = 0.55, center: float = 0.55) -> Any:
    """A coarse sphere (pole caps included) with interpolated vertex normals, as a mesh with texture coordinates.

    Returns vertices [n, 3], normals [n, 3], texture coordinates [n, 2] and faces [m, 3].
    """
    theta = np.linspace(0.0, np.pi, rows + 1)
    phi = np.linspace(0.0, 2.0 * np.pi, columns + 1)
    t, p = (grid.ravel() for grid in np.meshgrid(theta, phi, indexing="ij"))
    normals = np.stack([np.sin(t) * np.cos(p), np.cos(t), -np.sin(t) * np.sin(p)], axis=1)
    uv = np.stack([p / (2.0 * np.pi), t / np.pi], axis=1)
    faces = []
    for row in range(rows):
        for column in range(columns):
            a, b = row * (columns + 1) + column, (row + 1) * (columns + 1) + column
            if row < rows - 1:
                faces.append((a, b, b + 1))
            if row > 0:
                faces.append((a, b + 1, a + 1))
    return normals * radius + [0.0, center, 0.0], normals, uv, np.array(faces)
