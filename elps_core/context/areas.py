"""How much surface each region holds, by counting where random lines cross it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.context.lookup import RegionLookup
from elps_core.paths.stream import Stream
from elps_core.scene.meeting import Meeting

CROSSINGS = 256
"""Surfaces that a line is followed through."""


def region_areas(
    scene: mi.Scene | Meeting,
    regions: RegionLookup,
    count: int,
    lines: int,
    key: tuple[int, ...],
    *,
    facing: NDArray[np.float32] | None = None,
) -> NDArray[np.float64]:
    """Area of each region [count], unbiased, as seen from the regions' own sides.

    A line that is uniform in direction and place across the scene's bounding sphere of radius r crosses
    a surface of area A once in 2 pi r^2 / A times (Cauchy and Crofton), from either side alike. With the
    regions' normals, ``facing`` [count, 3], only sides count that face as their region does: the others, such as the
    outside of a room, are in the region that is nearest and are met by no path.
    """
    sphere = scene.bbox().bounding_sphere()
    radius = float(sphere.radius)
    stream = Stream.of(lines, *key)
    d = mi.warp.square_to_uniform_sphere(stream.next_2d())
    disk = mi.warp.square_to_uniform_disk_concentric(stream.next_2d())
    frame = mi.Frame3f(d)
    centre = mi.Point3f(sphere.center)
    dr.make_opaque(centre)
    far = dr.opaque(mi.Float, 1.01 * radius)
    origin = centre + frame.to_world(mi.Vector3f(disk.x, disk.y, 0.0)) * dr.opaque(mi.Float, radius) - d * far
    counts = dr.zeros(mi.UInt32, count)
    normals = None if facing is None else on_device(mi.Float, facing)

    def body(ray: mi.Ray3f, crossed: mi.UInt32, active: mi.Bool) -> tuple[mi.Ray3f, mi.UInt32, mi.Bool]:
        si = scene.ray_intersect(ray, active)
        active = active & si.is_valid()
        region, counted = regions.at(si, si.wi, active), active
        if normals is not None:
            side = dr.mulsign(mi.Vector3f(si.sh_frame.n), mi.Frame3f.cos_theta(si.wi))
            counted = active & (dr.dot(dr.gather(mi.Vector3f, normals, region, active), side) > 0.0)
        dr.scatter_reduce(dr.ReduceOp.Add, counts, mi.UInt32(1), region, counted)
        return si.spawn_ray(ray.d), crossed + 1, active & (crossed < CROSSINGS)

    start = (mi.Ray3f(origin, d), dr.zeros(mi.UInt32, lines), dr.full(mi.Bool, True, lines))
    dr.while_loop(start, lambda _r, _c, active: active, body, label="elps areas")
    dr.eval(counts)
    return np.asarray(np.array(counts, np.float64) * (4.0 * np.pi * radius * radius / lines))
