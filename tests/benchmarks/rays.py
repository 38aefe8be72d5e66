"""The rays that a render traces, recorded and then traced alone: what a renderer that did nothing else would cost."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from elps_core.integrators.bdpt import Bdpt
from elps_core.paths.stream import Stream

FAR = 1e30
"""Length that stands for no end."""


class _Site:
    """Rays of one place in the code: up to ``slots`` for each of ``lanes`` lanes."""

    def __init__(self, lanes: int, slots: int) -> None:
        self.lanes = lanes
        self.count = dr.zeros(mi.UInt32, lanes)
        self.rays = dr.zeros(mi.Float, lanes * slots * 8)
        dr.eval(self.count, self.rays)

    def record(self, ray: Any, active: Any) -> None:
        lane = dr.arange(mi.UInt32, self.lanes)
        at = (dr.scatter_inc(self.count, lane, active) * self.lanes + lane) * 2
        dr.scatter(self.rays, mi.Vector4f(*ray.o, dr.minimum(ray.maxt, FAR)), at, active)
        dr.scatter(self.rays, mi.Vector4f(*ray.d, 0.0), at + 1, active)


class OwnRays:
    """The rays of one pass of ``lanes`` lanes of a :class:`Bdpt` with all strategies and a pinhole.

    Stands in for the scene where rays are traced, and notes which place in the code asks.
    """

    def __init__(self, bdpt: Bdpt, lanes: int) -> None:
        self.scene, self.lanes = bdpt.scene, lanes
        deep = bdpt.max_depth
        pairs = (deep - 2) * (deep - 1) // 2
        sizes = {"light walk": deep - 1, "t = 1": deep - 1, "eye walk": deep, "s = 1": deep - 1, "s, t >= 2": pairs}
        self.sites = {name: _Site(lanes, slots) for name, slots in sizes.items()}
        self._place = "eye walk"
        connector, surfaces = bdpt.connector, bdpt.connector.surfaces
        self._note(bdpt, "_light_walk", "light walk")
        self._note(connector, "connect_sensor", "t = 1")
        self._note(connector, "connect_light", "s = 1")
        self._note(connector, "connect_vertices", "s, t >= 2")
        bdpt.scene = surfaces.scene = self
        try:
            streams = (Stream.of(lanes, 1, 0), Stream.of(lanes, 1, 1))
            size = bdpt.camera.size
            position = streams[0].next_2d() * mi.Point2f(mi.Float(size.x), mi.Float(size.y))
            radiance, _ = bdpt.trace(position, streams, lambda *_: None)
            dr.eval(radiance)
        finally:
            bdpt.scene = surfaces.scene = self.scene
            del bdpt._light_walk, connector.connect_sensor, connector.connect_light, connector.connect_vertices  # type: ignore[method-assign]
        for site in self.sites.values():
            dr.eval(site.count, site.rays)
        dr.sync_thread()

    def _note(self, owner: Any, method: str, place: str) -> None:
        original = getattr(owner, method)

        def noted(*arguments: Any) -> Any:
            before, self._place = self._place, place
            try:
                return original(*arguments)
            finally:
                self._place = before

        setattr(owner, method, noted)

    def ray_intersect(self, ray: Any, **options: Any) -> Any:
        """As the scene's own, recorded."""
        self.sites[self._place].record(ray, options["active"])
        return self.scene.ray_intersect(ray, **options)

    def ray_test(self, ray: Any, active: Any) -> Any:
        """As the scene's own, recorded."""
        self.sites[self._place].record(ray, active)
        return self.scene.ray_test(ray, active)

    @property
    def per_sample(self) -> float:
        """Rays of one sample."""
        return float(sum(np.array(site.count, np.float64).mean() for site in self.sites.values()))

    def replay(self, *, trace: bool) -> None:
        """Trace all of them again and nothing else; without ``trace`` only read them, the overhead of doing so."""
        for name, site in self.sites.items():
            self._replay(site, name.endswith("walk"), trace)

    def _replay(self, site: _Site, surface: bool, trace: bool) -> None:
        lane = dr.arange(mi.UInt32, self.lanes)
        count = dr.gather(mi.UInt32, site.count, lane)

        def body(i: mi.UInt32, total: mi.Float) -> tuple[mi.UInt32, mi.Float]:
            active = i < count
            at = (i * self.lanes + lane) * 2
            start = dr.gather(mi.Vector4f, site.rays, at, active)
            way = dr.gather(mi.Vector4f, site.rays, at + 1, active)
            found = dr.sum(start) + dr.sum(way)
            if trace:
                ray = mi.Ray3f(mi.Point3f(start.x, start.y, start.z), mi.Vector3f(way.x, way.y, way.z))
                ray.maxt = start.w
                if surface:
                    si = self.scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=False, active=active)
                    found = found + si.t + si.uv.x + dr.sum(si.n) + dr.sum(si.sh_frame.n)
                else:
                    found = found + dr.select(self.scene.ray_test(ray, active), 1.0, 0.0)
            return i + 1, total + found

        start = (dr.zeros(mi.UInt32, self.lanes), dr.zeros(mi.Float, self.lanes))
        _, total = dr.while_loop(start, lambda i, _: i < count, body, label="replay")
        dr.eval(total)
        dr.sync_thread()
