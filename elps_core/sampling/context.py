"""What a render takes from the directional part of a global context."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.context.field import DirectionalField
from elps_core.context.lookup import RegionLookup
from elps_core.context.slits import Slits
from elps_core.context.store import DirectionalParts
from elps_core.paths.mis import Side
from elps_core.paths.scattering import Materials
from elps_core.sampling.aims import AimedDirections
from elps_core.sampling.direction import Guide, GuidedDirections, Share, Towards
from elps_core.sampling.slits import SlitDirections

CARE = 8.0
"""What a path is expected to find counts in units of its pixel's noise: the gain is this over the noise."""
GAINS = (1.0, 32.0)
"""Bounds of the gain."""
CARE_PAID = 1.0
"""The same where paths are paid when they end. On the door the product of variance and time is the same from 0.7 to 2,
to within a tenth, and a fifth greater with 0.5."""
DARKEST = 1e-3
"""Least estimate of a pixel relative to the mean: what no pilot sample has found is not nothing."""


def guided(
    materials: Materials, parts: DirectionalParts, *, eye: Share | None, light: Share | None
) -> GuidedDirections:
    """Directions by the tables of ``parts`` with a chance of ``eye`` and ``light``, one or by region [K].

    With a chance of 0 tables serve roulette only; without one they are not loaded.
    """
    lookup = RegionLookup(parts.regions)
    aims = AimedDirections(parts.aims, parts.radiance.irradiance) if parts.aims and eye is not None else None
    return GuidedDirections(
        materials,
        lookup,
        None
        if eye is None
        else Guide(DirectionalField(lookup, parts.radiance), eye, towards(aims, parts.slits, "eye")),
        None
        if light is None
        else Guide(DirectionalField(lookup, parts.importance), light, towards(None, parts.slits, "light")),
        prospects=parts.prospects,
    )


def towards(aims: AimedDirections | None, slits: Slits | None, side: Side) -> tuple[Towards, ...]:
    """What takes directions of tables: points and slits, where there are any."""
    through = SlitDirections(slits, side) if slits else None
    return tuple(each for each in (aims, through) if each)


class PixelWorth:
    """What a unit of luminance is worth at a film position: gain / the pilot's estimate there.

    To end a path adds noise in proportion to what it would have found, and saves its cost. So the gain is the
    greater the less ``noise`` there is otherwise: the standard deviation of one path over its pixel's value.
    """

    def __init__(
        self, pilot: NDArray[np.float32], noise: float, size: mi.ScalarVector2u, *, pays: bool = False
    ) -> None:
        """``pays``: eye paths are paid when they end; light paths never are."""
        self.gain = float(np.clip(CARE / max(noise, 1e-3), *GAINS))
        of_eye = CARE_PAID / max(noise, 1e-3) if pays else self.gain
        height, width = pilot.shape
        floor = DARKEST * float(pilot.mean()) or 1.0
        self._worth = on_device(mi.Float, of_eye / np.maximum(pilot, floor))
        self._width = dr.opaque(mi.UInt32, width)
        self._last = dr.opaque(mi.Point2u, [width - 1, height - 1])
        self._scale = dr.opaque(mi.Point2f, [width / int(size.x), height / int(size.y)])

    def __call__(self, position: mi.Point2f) -> mi.Float:
        """Of eye paths through film positions in pixels relative to the crop window."""
        pixel = dr.minimum(mi.Point2u(dr.maximum(position * self._scale, 0.0)), self._last)
        return dr.gather(mi.Float, self._worth, pixel.y * self._width + pixel.x)
