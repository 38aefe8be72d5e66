"""The shapes of a scene, those of its groups as well."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device

FLAT = ("Disk", "Rectangle")
"""Shapes, beside meshes, whose distance from far away is as precise as single precision is."""
ROUND = 1 << 31
"""Flag of a surface that is not: none of Mitsuba's own."""
FRAME_MAPS = ("NormalMap", "BumpMap")
"""Materials that bend the shading frame, as their descriptions name them."""


class _Parts(mi.TraversalCallback):
    """Shapes that an object is made of."""

    def __init__(self) -> None:
        super().__init__()
        self.shapes: list[mi.Shape] = []

    def put(self, _name: str, value: Any, _flags: int, *_: Any) -> None:
        if isinstance(value, mi.Shape):
            self.shapes.append(value)


def every_shape(scene: mi.Scene) -> list[mi.Shape]:
    """All shapes that rays can meet: ``scene.shapes()`` holds instances in place of what these repeat."""
    shapes = scene.shapes()
    if all(shape.class_name() != "Instance" for shape in shapes):
        return list(shapes)
    # The scene tells of its groups, and an instance does not tell of its own.
    return list(dict.fromkeys([*shapes, *_parts(scene)]))


def with_parts(shapes: list[mi.Shape]) -> list[mi.Shape]:
    """Shapes, groups among them, and what the groups hold, each once."""
    return list(dict.fromkeys([*shapes, *(part for shape in shapes for part in _parts(shape))]))


def local_reach(scene: mi.Scene) -> float:
    """How far from the origins of their groups instances have their surfaces at most, in world units; 0 without any.

    Single precision rounds the coordinates of what they repeat there, before they are put in place. An instance does
    not tell which group it repeats: the largest of all scales counts for the farthest part of all groups.
    """
    placed = scene.shapes()
    matrices = [
        np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)[:3, :3]
        for shape in placed
        if shape.class_name() == "Instance"
    ]
    if not matrices:
        return 0.0
    parts = [part for part in _parts(scene) if part not in placed and part.class_name() != "ShapeGroup"]
    centres = [np.array(part.bbox().center(), np.float64).ravel() for part in parts]
    scale = max(float(np.linalg.norm(matrix, 2)) for matrix in matrices)
    return scale * max((float(np.linalg.norm(centre)) for centre in centres), default=0.0)


def numbers(shapes: list[mi.Shape]) -> NDArray[np.int64]:
    """By which pointers name shapes in kernels [n], from 1 on; 0 is none."""
    found = np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shapes)) if shapes else [], np.int64)
    return np.broadcast_to(found, len(shapes))


class MaterialFlags:
    """Flags of the material at surface points, from a table.

    Asked through pointers, each question is a table of all shapes that Mitsuba writes into the kernel, whose code then
    depends on their number.
    """

    def __init__(self, scene: mi.Scene) -> None:
        shapes = every_shape(scene)
        of = numbers(shapes)
        flags = np.zeros(int(of.max(initial=0)) + 1, np.uint32)
        carried = [shape.bsdf() for shape in shapes]
        known = {bsdf: int(bsdf.flags()) for bsdf in dict.fromkeys(carried) if bsdf}
        flags[of] = [known.get(bsdf, 0) for bsdf in carried]
        curved = [not shape.is_mesh() and shape.class_name() not in FLAT for shape in shapes]
        flags[of] |= np.where(curved, ROUND, 0).astype(np.uint32)
        descriptions = {str(bsdf) for bsdf in known}
        self.bends_frames = any(name in text for text in descriptions for name in FRAME_MAPS)
        """Whether a material bends the shading frame and so needs the surface's derivatives by u and v."""
        self._flags = on_device(mi.UInt32, flags)

    def __call__(self, si: mi.SurfaceInteraction3f, active: mi.Bool | bool = True) -> mi.UInt32:
        """Flags of the BSDF that ``si`` lies on; none where it lies on no surface."""
        return dr.gather(mi.UInt32, self._flags, dr.reinterpret_array(mi.UInt32, si.shape), active)

    def smooth(self, si: mi.SurfaceInteraction3f, active: mi.Bool | bool = True) -> mi.Bool:
        """Whether the surface scatters into more than single directions."""
        return mi.has_flag(self(si, active), mi.BSDFFlags.Smooth)

    def round(self, si: mi.SurfaceInteraction3f, active: mi.Bool | bool = True) -> mi.Bool:
        """Whether the distance to the surface from far away is imprecise."""
        return (self(si, active) & ROUND) != 0

    def transmits(self, si: mi.SurfaceInteraction3f, active: mi.Bool | bool = True) -> mi.Bool:
        """Whether light passes through the surface."""
        return mi.has_flag(self(si, active), mi.BSDFFlags.Transmission)


def _parts(whole: mi.Object) -> list[mi.Shape]:
    found = _Parts()
    whole.traverse(found)
    return [each for shape in found.shapes for each in (shape, *_parts(shape))]
