"""Directions towards the points where mirrors and glass show a lamp, in kernels."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.context.aims import POINTS, Aims

BLUNTEST, SHARPEST = 1e-2, 2.5e4
"""Bounds of k: from nearly all directions to a fifth of a degree, which floats still tell."""

TINY = 1e-20
"""In place of nothing, where something is divided by it."""


class AimedDirections:
    """Mixtures of lobes around directions to points, in proportion to (1 + k (1 - cos))^-4.

    Near the middle a lobe is like that of von Mises and Fisher, of concentration 4 k, and falls slower: light that is
    not quite where photons were is not lost. Its density takes no exponential.

    Args:
        aims: the points.
        irradiance: of each region [K], from all directions: points have the chance of their roots' part of both, a
            half at most.
    """

    def __init__(self, aims: Aims, irradiance: NDArray[np.float32]) -> None:
        total = aims.roots.sum(axis=1)
        least = np.minimum(total, irradiance) / np.maximum(total, TINY)
        chances = aims.roots * (least / np.maximum(irradiance + least * total, TINY))[:, None]
        self._points = on_device(mi.Float, aims.points)
        self._chances = on_device(mi.Float, chances)

    def sample(
        self, origin: mi.Point3f, region: mi.UInt32, u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Bool, mi.Vector3f, mi.Point2f]:
        """Whether a direction goes to a point, and then which, as a unit vector in world space; else numbers left."""
        number, aimed, so_far = mi.UInt32(0), mi.Bool(False), mi.Float(0.0)
        left = mi.Float(u.x)
        for lobe in range(POINTS):
            chance = dr.gather(mi.Float, self._chances, region * POINTS + lobe, active)
            here = active & ~aimed & (u.x < so_far + chance)
            number, left = dr.select(here, lobe, number), dr.select(here, (u.x - so_far) / chance, left)
            aimed, so_far = aimed | here, so_far + chance
        left = dr.select(aimed, left, (u.x - so_far) / (1.0 - so_far))
        left = dr.clip(left, 0.0, mi.Float(dr.one_minus_epsilon(mi.Float)))
        middle, sharp = self._lobe(origin, region * POINTS + number, aimed)
        # 1 - cosine, by inversion.
        height = dr.clip((dr.rcp(dr.cbrt(1.0 - left * _within(sharp))) - 1.0) / sharp, 0.0, 2.0)
        sine = dr.safe_sqrt(height * (2.0 - height))
        sin_phi, cos_phi = dr.sincos(dr.two_pi * u.y)
        local = mi.Vector3f(sine * cos_phi, sine * sin_phi, 1.0 - height)
        return aimed, dr.normalize(mi.Frame3f(middle).to_world(local)), mi.Point2f(left, u.y)

    def mixed(
        self, by_table: mi.Float, origin: mi.Point3f, region: mi.UInt32, direction: mi.Vector3f, active: mi.Bool
    ) -> mi.Float:
        """Density per solid angle of the unit vector ``direction`` where :meth:`sample` leaves it to a table's."""
        total, so_far = mi.Float(0.0), mi.Float(0.0)
        for lobe in range(POINTS):
            chance = dr.gather(mi.Float, self._chances, region * POINTS + lobe, active)
            middle, sharp = self._lobe(origin, region * POINTS + lobe, active)
            height = 0.5 * dr.squared_norm(direction - middle)
            total = total + chance * sharp / (_within(sharp) * dr.square(dr.square(1.0 + sharp * height)))
            so_far = so_far + chance
        return dr.select(active, total * (1.5 / dr.pi) + (1.0 - so_far) * by_table, 0.0)

    def _lobe(self, origin: mi.Point3f, number: mi.UInt32, active: mi.Bool) -> tuple[mi.Vector3f, mi.Float]:
        """Direction to a point, and k."""
        point = dr.gather(mi.Vector4f, self._points, number, active)
        away = mi.Point3f(point.x, point.y, point.z) - origin
        squared = dr.squared_norm(away)
        middle = dr.select(squared > 0.0, dr.normalize(away), mi.Vector3f(0.0, 0.0, 1.0))
        return middle, dr.clip(0.25 * squared / dr.maximum(point.w, TINY), BLUNTEST, SHARPEST)


def _within(sharp: mi.Float) -> mi.Float:
    """1 - (1 + 2 k)^-3: what the integral of (1 + k h)^-4 over h in [0, 2] is of that over all h."""
    return 1.0 - dr.rcp(dr.square(1.0 + 2.0 * sharp) * (1.0 + 2.0 * sharp))
