"""Rules of survival: when a walk may end before its greatest depth."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from elps_core.settings import Roulette

MAX_SURVIVAL = 0.95
"""Mitsuba's upper limit of the survival probability: bounds walks in media that absorb nothing."""
MIN_SURVIVAL = 0.05
"""Lower limit, so that a survivor's weight stays bounded."""
MOST_RAISED = 1.5
"""Upper limit by context of what roulette makes of a path's weight; roulette by albedo keeps to 1. On the maze with
tables of 2048 regions the variance was a third greater with 3 than with 1; on the door there was no difference."""


@dataclass(frozen=True)
class RouletteRule:
    """Survival by ``kind`` from path depth ``start`` on; both are fixed when a kernel is built."""

    kind: Roulette
    start: int

    def survival(self, beta: mi.Spectrum, eta: mi.Float, albedo: mi.Spectrum, depth: mi.UInt32) -> mi.Float:
        """Probability to continue after a scattering event at ``depth``.

        ``throughput`` follows the path's weight times the squared index of refraction so far, as
        Mitsuba's ``path`` does; ``albedo`` follows the local weight f |cos| / p [thesis 5.1.1]; ``context``
        is as ``albedo`` where :meth:`by_worth` knows no better.
        """
        if self.kind == "none":
            return mi.Float(1.0)
        q = dr.max(beta * dr.square(eta)) if self.kind == "throughput" else dr.max(albedo)
        return dr.select(depth >= self.start, dr.clip(q, MIN_SURVIVAL, MAX_SURVIVAL), 1.0)

    def by_worth(self, worth: mi.Float, raised: mi.Float, known: mi.Bool, otherwise: mi.Float) -> mi.Float:
        """Probability to continue where it is ``known`` what a path is worth [thesis 5.3.4].

        In proportion to that; but ``raised``, by which all roulette so far would have raised the throughput over what a
        path has that loses nothing where it may end, is not to grow beyond :data:`MOST_RAISED`: tables may err by
        more than weights should grow. ``otherwise`` holds where nothing is known.
        """
        return dr.select(known, dr.clip(worth, dr.minimum(raised / MOST_RAISED, 1.0), 1.0), otherwise)
