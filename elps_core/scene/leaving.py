"""Rays that leave surfaces: from as close to them as rounding allows.

A ray that starts on a surface, as far as single precision tells it, may meet the surface itself. It starts off it by a
distance that follows the rounding of coordinates. Mitsuba's own distance is fifty times as long: light paths that
start displaced by it are some percents off in a scene of size 4 that stands 1000 units from the origin, and rays to
the sensor meet the edges of cracks that the sensor sees past.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

OFF = 16.0 * 2.0**-24
"""Distance from the surface, over the size of the coordinates there: 16 times the rounding of one number. With 8 times
0.05% of the rays that leave a cylinder meet it, with 4 times 0.1% of those that leave a disk."""
FLATTEST = 1e-3
"""Least cosine with which a line leaves a surface high enough: below it the surface may shadow itself, a millionth of
the light that it scatters."""
SHORT = 1.0 - 16.0 * 2.0**-24
"""Share of a segment that is tested: its length is rounded as well, and ends may stand on a surface."""


class Leaving:
    """Rays that leave the surfaces of one scene.

    Args:
        extent: how large the scene is. Surfaces that pass the origin have coordinates of this size elsewhere.
    """

    def __init__(self, extent: float = 1.0) -> None:
        self._extent = dr.opaque(mi.Float, extent)  # Data, not code: scenes share kernels.

    def off(self, p: mi.Point3f, n: mi.Normal3f, d: mi.Vector3f) -> mi.Point3f:
        """``p`` on a surface with the geometric normal ``n``, moved off it to the side that ``d`` points to."""
        return dr.fma(dr.mulsign(self._height(p), dr.dot(n, d)), n, p)

    def along(self, p: mi.Point3f, n: mi.Normal3f, d: mi.Vector3f) -> mi.Point3f:
        """As :meth:`off`, but moved along the unit vector ``d``: where a line that grazes edges must be met exactly."""
        return dr.fma(self._height(p) / dr.maximum(dr.abs(dr.dot(n, d)), FLATTEST), d, p)

    def _height(self, p: mi.Point3f) -> mi.Float:
        return (self._extent + dr.max(dr.abs(p))) * OFF

    def ray(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Ray3f:
        """From a surface into the unit vector ``d``."""
        return mi.Ray3f(self.off(si.p, si.n, d), d, si.time, si.wavelengths)

    def to(self, si: mi.SurfaceInteraction3f, target: mi.Point3f) -> mi.Ray3f:
        """From a surface to ``target``, a point that is on no surface or has been moved off it."""
        return self.between(self.off(si.p, si.n, target - si.p), target)

    @staticmethod
    def between(start: mi.Point3f, end: mi.Point3f) -> mi.Ray3f:
        """From one point to another, both on no surface: for a question that asks for no wavelengths."""
        delta = end - start
        distance = dr.norm(delta)
        ray = mi.Ray3f(start, delta / distance)
        ray.maxt = distance * SHORT
        return ray
