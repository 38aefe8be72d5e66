"""Directions towards slits, in kernels."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from elps_core.arrays import on_device
from elps_core.context.slits import WIDER, Slits
from elps_core.paths.mis import Side

SHARPEST, BLUNTEST = 3e-4, 2.0
"""Bounds of a lobe's scale, radians: from what floats still tell to nearly all around."""
MARGIN = 0.01
"""Cosines that lobes reach beyond the ends of a slit."""
TINY = 1e-20
"""In place of nothing, where something is divided by it."""


@dataclass
class _Lobe:
    """A slit as it is seen from a point, the slit's direction being that of the poles."""

    frame: mi.Frame3f
    across: mi.Vector2f  # To the slit, in the plane across it, unit length
    low: mi.Float  # Cosines to the ends
    high: mi.Float
    narrow: mi.Float  # Hyperbolic tangent of half of the scale
    wide: mi.Float  # As well, of the wider scale


class SlitDirections:
    """Directions to a slit: evenly by their cosine to it between its ends, and around it as Cauchy has it, wrapped.

    From a point a segment is seen along a meridian of the sphere whose poles lie in the segment's direction. Light that
    is not quite where photons were is not lost: such a lobe falls with the square of the angle.

    Args:
        slits: where they are, and how likely.
        side: which paths go there; eye paths go to light, and light paths to importance.
    """

    def __init__(self, slits: Slits, side: Side) -> None:
        self._count = len(slits.spread)
        rows = [
            [*first, spread, *second, 0.0] for (first, second), spread in zip(slits.ends, slits.spread, strict=True)
        ]
        self._slits = on_device(mi.Float, rows)
        self._chances = on_device(mi.Float, slits.chances[0 if side == "eye" else 1])

    def sample(
        self, origin: mi.Point3f, region: mi.UInt32, u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Bool, mi.Vector3f, mi.Point2f]:
        """Whether a direction goes to a slit, and then which, as a unit vector in world space; else numbers left."""
        number, aimed, so_far, left = mi.UInt32(0), mi.Bool(False), mi.Float(0.0), mi.Float(u.x)
        for slit in range(self._count):
            chance = self._chance(region, slit, active)
            here = active & ~aimed & (u.x < so_far + chance)
            number, left = dr.select(here, slit, number), dr.select(here, (u.x - so_far) / chance, left)
            aimed, so_far = aimed | here, so_far + chance
        left = dr.select(aimed, left, (u.x - so_far) / (1.0 - so_far))
        left = dr.clip(left, 0.0, mi.Float(dr.one_minus_epsilon(mi.Float)))
        lobe = self._lobe(origin, number, aimed)
        # Of the angle off the meridian: tangent of its half, sine and cosine.
        wide = left < 0.5
        off = dr.select(wide, 2.0 * left, 2.0 * left - 1.0)
        tangent = dr.select(wide, lobe.wide, lobe.narrow) * dr.tan(dr.pi * (off - 0.5))
        squared = dr.square(tangent)
        sine, cosine = 2.0 * tangent / (1.0 + squared), (1.0 - squared) / (1.0 + squared)
        z = dr.lerp(lobe.low, lobe.high, u.y)
        radius = dr.safe_sqrt(1.0 - dr.square(z))
        x = radius * (cosine * lobe.across.x - sine * lobe.across.y)
        y = radius * (sine * lobe.across.x + cosine * lobe.across.y)
        return aimed, dr.normalize(lobe.frame.to_world(mi.Vector3f(x, y, z))), mi.Point2f(left, u.y)

    def mixed(
        self, otherwise: mi.Float, origin: mi.Point3f, region: mi.UInt32, direction: mi.Vector3f, active: mi.Bool
    ) -> mi.Float:
        """Density per solid angle of the unit vector ``direction`` where :meth:`sample` leaves it to another's."""
        total, so_far = mi.Float(0.0), mi.Float(0.0)
        for slit in range(self._count):
            chance = self._chance(region, slit, active)
            lobe = self._lobe(origin, mi.UInt32(slit), active)
            local = lobe.frame.to_local(direction)
            # 1 - cosine of the angle off the meridian: by the sine, where that has more digits.
            scale = dr.rsqrt(dr.maximum(dr.square(local.x) + dr.square(local.y), TINY))
            cosine = (local.x * lobe.across.x + local.y * lobe.across.y) * scale
            sine = (local.y * lobe.across.x - local.x * lobe.across.y) * scale
            off = dr.select(cosine > 0.0, dr.square(sine) / (1.0 + cosine), 1.0 - cosine)
            around = 0.5 * (_around(lobe.narrow, off) + _around(lobe.wide, off))
            within = (local.z >= lobe.low) & (local.z <= lobe.high)
            total = total + dr.select(within, chance * around / (lobe.high - lobe.low), 0.0)
            so_far = so_far + chance
        return dr.select(active, total + (1.0 - so_far) * otherwise, 0.0)

    def _chance(self, region: mi.UInt32, slit: int, active: mi.Bool) -> mi.Float:
        return dr.gather(mi.Float, self._chances, region * self._count + slit, active)

    def _lobe(self, origin: mi.Point3f, number: mi.UInt32, active: mi.Bool) -> _Lobe:
        one = dr.gather(mi.Vector4f, self._slits, 2 * number, active)
        other = dr.gather(mi.Vector4f, self._slits, 2 * number + 1, active)
        first, second = mi.Vector3f(one.x, one.y, one.z) - origin, mi.Vector3f(other.x, other.y, other.z) - origin
        along = second - first
        length = dr.norm(along)
        frame = mi.Frame3f(dr.select(length > 0.0, along / length, mi.Vector3f(0.0, 0.0, 1.0)))
        start = frame.to_local(first)
        squared = dr.square(start.x) + dr.square(start.y)
        distance = dr.sqrt(squared)
        across = dr.select(distance > 0.0, mi.Vector2f(start.x, start.y) / distance, mi.Vector2f(1.0, 0.0))
        low, high = (z * dr.rsqrt(dr.maximum(squared + dr.square(z), TINY)) for z in (start.z, start.z + length))
        scale = one.w / dr.maximum(distance, TINY)
        narrow, wide = (dr.tanh(0.5 * dr.clip(times * scale, SHARPEST, BLUNTEST)) for times in (1.0, WIDER))
        return _Lobe(frame, across, dr.maximum(low - MARGIN, -1.0), dr.minimum(high + MARGIN, 1.0), narrow, wide)


def _around(half: mi.Float, off: mi.Float) -> mi.Float:
    """Density per radian at an angle whose cosine is 1 - ``off``: sinh g / (cosh g - cosine) / 2 pi.

    ``half`` is the hyperbolic tangent of half of g.
    """
    squared = dr.square(half)
    return 2.0 * half / (2.0 * squared + (1.0 - squared) * off) * dr.inv_two_pi
