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
ROUND_SHORT = 1.0 - 15000.0 * 2.0**-24
"""The same, Mitsuba's own, of a segment that ends at a sphere, cylinder or curve: Mitsuba's distance to a sphere is
wrong by its square over the radius, so that of the light of a bulb of 4 cm at 4 m 40% would be its own shadow."""


class Leaving:
    """Rays that leave the surfaces of one scene.

    Args:
        extent: how large the scene is. Surfaces that pass the origin have coordinates of this size elsewhere.
    """

    def __init__(self, extent: float = 1.0) -> None:
        self._extent = dr.opaque(mi.Float, extent)  # Data, not code: scenes share kernels.

    def off(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Point3f:
        """A point on a surface, moved off it along its geometric normal to the side that ``d`` points to."""
        return dr.fma(dr.mulsign(self._height(si), dr.dot(si.n, d)), si.n, si.p)

    def along(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Point3f:
        """As :meth:`off`, but moved along the unit vector ``d``: where a line that grazes edges must be met exactly."""
        return dr.fma(self._height(si) / dr.maximum(dr.abs(dr.dot(si.n, d)), FLATTEST), d, si.p)

    def _height(self, si: mi.SurfaceInteraction3f) -> mi.Float:
        # A point at the end of a long ray is rounded as its length is; points that no ray has met have none.
        length = dr.select(si.is_valid(), si.t, 0.0)
        return (self._extent + dr.max(dr.abs(si.p)) + length) * OFF

    def ray(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Ray3f:
        """From a surface into the unit vector ``d``."""
        return mi.Ray3f(self.off(si, d), d, si.time, si.wavelengths)

    def to(self, si: mi.SurfaceInteraction3f, target: mi.Point3f, at_round: mi.Bool | bool = False) -> mi.Ray3f:
        """From a surface to ``target``, a point that is on no surface or has been moved off it, ``at_round`` off one
        that is neither a mesh nor flat."""
        return self.between(self.off(si, target - si.p), target, at_round)

    @staticmethod
    def between(start: mi.Point3f, end: mi.Point3f, at_round: mi.Bool | bool = False) -> mi.Ray3f:
        """From one point to another, both on no surface: for a question that asks for no wavelengths."""
        delta = end - start
        distance = dr.norm(delta)
        ray = mi.Ray3f(start, delta / distance)
        ray.maxt = distance * dr.select(at_round, ROUND_SHORT, SHORT)
        return ray
