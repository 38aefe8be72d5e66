"""What rays meet: as Mitsuba tells it, and for many lamps by tables of our own.

Mitsuba traces the code that describes a hit once for each shape that there is, which for a thousand lamps takes a third
of a second, and that in every kernel. Lamps of one kind are rows of a table here.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from elps_core.arrays import on_device
from elps_core.scene.emitters import ANALYTIC, MANY, Light
from elps_core.scene.leaving import Leaving
from elps_core.scene.shapelight import Met, ShapeLights


class Meeting:
    """Intersections of rays with one scene, given as ``mi.Scene.ray_intersect`` gives them."""

    def __init__(
        self, scene: mi.Scene, lights: list[Light], on_shapes: ShapeLights, leaving: Leaving | None = None
    ) -> None:
        """``leaving`` is how rays leave the scene's surfaces; if not given, as of one of size 1."""
        self.scene = scene
        self.leaving = leaving or Leaving()
        self._on_shapes = on_shapes
        lamps = [k for k, light in enumerate(lights) if light.kind in ANALYTIC]
        self.by_tables = len(lights) > MANY and bool(lamps)
        """Whether lamps are met by tables."""
        if not self.by_tables:
            return
        of_lamp = np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr([lights[k].shape for k in lamps])))
        others = [shape for shape in scene.shapes() if not shape.is_emitter()]
        others += [light.shape for light in lights if light.shape is not None and light.kind not in ANALYTIC]
        of_other = np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(others)) if others else [], np.int64)
        self._others = others
        size = int(max(of_lamp.max(), of_other.max(initial=0))) + 1
        place, lamp = np.zeros(size, np.uint32), np.zeros(size, np.uint32)
        place[of_other] = 1 + np.arange(len(others))
        lamp[of_lamp] = lamps
        self._place, self._lamp = on_device(mi.UInt32, place), on_device(mi.UInt32, lamp)
        self._kind = on_device(mi.UInt32, [light.kind_index for light in lights])

    def ray_intersect(
        self, ray: mi.Ray3f, active: mi.Bool | bool = True, *, ray_flags: int | None = None, coherent: bool = False
    ) -> mi.SurfaceInteraction3f:
        """The first surface that ``ray`` meets; ``ray_flags`` ask for less than all."""
        flags = +mi.RayFlags.All if ray_flags is None else +ray_flags
        if not self.by_tables:
            return self.scene.ray_intersect(ray, ray_flags=flags, coherent=coherent, active=active)
        hit = self.scene.ray_intersect_preliminary(ray, coherent=coherent, active=active)
        active = mi.Bool(active) & hit.is_valid()
        target = dr.select(hit.instance == None, hit.shape, hit.instance)  # noqa: E711 (a comparison of arrays)
        number = dr.reinterpret_array(mi.UInt32, target)
        place = dr.gather(mi.UInt32, self._place, number, active)
        lamp = dr.gather(mi.UInt32, self._lamp, number, active)
        answers: list[Callable[..., Met]] = [self._lit, *(partial(_asked, shape, flags) for shape in self._others)]
        met: Met = dr.switch(place, answers, lamp, ray, hit, active)
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(number))
        si.t = dr.select(active, hit.t, dr.inf)
        si.time, si.wavelengths = ray.time, ray.wavelengths
        si.p, si.n, si.uv, si.dp_du, si.dp_dv = met.p, met.n, met.uv, met.dp_du, met.dp_dv
        si.sh_frame.n = met.shading
        si.shape = dr.reinterpret_array(mi.ShapePtr, dr.select(active, met.shape, 0))
        si.instance = dr.select(active, hit.instance, dr.zeros(mi.ShapePtr))
        si.prim_index = hit.prim_index
        si.initialize_sh_frame()
        si.wi = dr.select(active, si.to_local(-ray.d), -ray.d)
        return si

    def bbox(self) -> mi.BoundingBox3f:
        """The bounding box of the scene."""
        return self.scene.bbox()

    def _lit(self, lamp: mi.UInt32, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool) -> Met:
        kind = dr.gather(mi.UInt32, self._kind, lamp, active)
        return self._on_shapes.met(lamp, kind, ray, hit, active)


def _asked(
    shape: Any, flags: int, _lamp: mi.UInt32, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool
) -> Met:
    si = shape.compute_surface_interaction(ray, hit, flags, active)
    # What is told of an ordinary shape must not be its own number: its code would be another one than its neighbour's.
    which = si.shape if shape.class_name() == "Instance" else hit.shape
    return Met(si.p, si.n, si.sh_frame.n, si.uv, si.dp_du, si.dp_dv, dr.reinterpret_array(mi.UInt32, which))
