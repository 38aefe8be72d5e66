"""Rules of survival: when a walk may end before its greatest depth."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from elps_core.settings import MAX_DEPTH, Roulette

MAX_SURVIVAL = 0.95
"""Mitsuba's upper limit of the survival probability: bounds walks in media that absorb nothing."""
MIN_SURVIVAL = 0.05
"""Lower limit, so that a survivor's weight stays bounded."""
MOST_RAISED = 1.5
"""Upper limit by context of what roulette makes of a path's weight, where nothing is paid; roulette by albedo keeps to
1. On the maze with tables of 2048 regions the variance was a third greater with 3 than with 1; on the door there was
no difference."""
LEAST_PAID = 0.2
"""Lower limit of the survival probability of paths that are paid where they end: what tables do not know of is
multiplied by its inverse."""
PAID_FROM = 2
"""Depth from which on paths may end that are paid, if no other is asked for that is smaller."""


@dataclass(frozen=True)
class RouletteRule:
    """Survival by ``kind`` from path depth ``start`` on; both are fixed when a kernel is built."""

    kind: Roulette
    start: int
    pays: bool = False
    """By context: whether a path that ends is paid what the table expects it to find, and one that goes on pays for it.
    Then it is what paths find beyond that alone that roulette makes noise of, and they may end early."""

    def __post_init__(self) -> None:
        """Refuse payment of what nothing tells.

        Raises:
            ValueError: paths would be paid without roulette by context.
        """
        if self.pays and self.kind != "context":
            raise ValueError("only roulette by context pays paths that end")

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

    def in_the_end(self, survival: mi.Float, depth: mi.UInt32) -> mi.Float:
        """``survival`` that ends every path, where nothing else does: what a path is worth may never fall."""
        return dr.select(depth < MAX_DEPTH, survival, dr.minimum(survival, MAX_SURVIVAL))

    def paid(self, spread: mi.Float, depth: mi.UInt32, known: mi.Bool, otherwise: mi.Float) -> tuple[mi.Float, mi.Bool]:
        """Probability to continue of paths that are paid where they end, and which are.

        In proportion to ``spread``, the standard deviation of what a path finds in units of its pixel's, which is where
        the product of variance and time is least if the rest of the path takes most of the time.
        """
        asked = known & (depth >= min(self.start, PAID_FROM))
        return dr.select(asked, dr.clip(spread, LEAST_PAID, 1.0), otherwise), asked
