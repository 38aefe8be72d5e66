"""Weights of multiple importance sampling by partial sums, O(1) per connection.

For a vertex x_i of a subpath, with p_i its forward area density from x_{i-1}, <-p_i the reverse
density and g the reverse geometry factor, the two sums

    dVCM_i = 1 / p_i
    dVC_i  = (<-g_{i-1} / p_i) (dVCM_{i-1} + <-p_{i-2} dVC_{i-1})

hold all that the weight of a connection needs of the subpath behind it (Georgiev 2012, technical
report on implementing vertex connection and merging; merging left out). Both are ratios of
densities, other strategy / this one. The heuristics of [thesis 3.7.1] differ in how they treat them:

- balance adds them; power (exponent 2) adds their squares, so that every factor is squared;
- maximum keeps the greatest in place of the sum;
- cutoff must know the greatest before it may add, so that it keeps each one: a list.

Cosines are those of geometric normals, because they convert densities from solid angle to area.
Survival probabilities of Russian roulette are left out of the weights, which keeps the estimator
unbiased and the sums smaller.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import Literal, TypeAlias

import drjit as dr
import mitsuba as mi

from elps_core.settings import HeuristicKind

Ratios: TypeAlias = "list[mi.Float]"
"""Density ratios of other strategies to this one: their sum, their greatest or all, by the heuristic."""
Side: TypeAlias = Literal["light", "eye"]
"""Which subpath: strategies on the light side have fewer light vertices than this one."""

CUTOFF = 0.1
"""Strategies less likely than this share of the likeliest are left out by the cutoff heuristic [Veach 1997, 9.2.3]."""
TIE = 1.5
"""Preference of the maximum heuristic for one light vertex more. Where densities are equal, as between diffuse
surfaces of one sphere, rounding would else decide, and decide differently for each strategy; rays that start off
the surface move densities by percents between points close together, so that 1.01 lost 1.4e-4 of the light."""
MOST_DENSITY = 1e18
"""Greatest density and density ratio that is told from greater ones: its square is a number in single precision."""
MOST_RATIO = 1e36
"""The same of sums and products of their powers. Smooth hair and nearly smooth metals have densities from 1e-20 to
1e10, whose powers would come to infinity after a few bounces, and infinity times a density of 0 is not a number. A
strategy so much likelier takes all of the light either way."""


@dataclass
class Partial:
    """Partial sums of a subpath at its newest vertex; dimension as in the module's text."""

    dvcm: mi.Float
    dvc: Ratios


@dataclass(frozen=True)
class Heuristic:
    """How the strategies that can make one path share its light; fixed when a kernel is built."""

    kind: HeuristicKind
    length: int
    """Strategies that a list must hold: the greatest number of vertices of a path."""
    joins: bool = True
    """Whether there are strategies with two vertices or more on either side."""

    @property
    def width(self) -> int:
        """Numbers in :attr:`Partial.dvc`."""
        return self.length if self.kind == "cutoff" else 1

    def start(
        self, pdf_point: mi.Float, cosine: mi.Float, pdf: mi.Float, side: Side, fraction: mi.Float | float = 1.0
    ) -> Partial:
        """At a subpath's first vertex, when its first direction was drawn with density ``pdf``.

        ``pdf_point`` is the density of the first vertex itself where the other subpath could find it
        by chance, infinite where it cannot (a pinhole, a point light). Lengths do not matter where
        first segments are parallel: densities are then those of an area across the rays. ``fraction``
        is the number of paths from this side for one from the other.
        """
        before = Partial(self.power(dr.rcp(pdf_point * fraction)), [mi.Float(0.0)] * self.width)
        partial = self.scatter(before, cosine, pdf, mi.Float(0.0), mi.Bool(False), side)
        # A first vertex that is drawn alone, as next event estimation does, is drawn for every other path.
        partial.dvcm = partial.dvcm * self.power(mi.Float(1.0 / fraction))
        return partial

    def arrive(self, partial: Partial, distance2: mi.Float, cos_in: mi.Float) -> Partial:
        """After a segment of squared length ``distance2``, hitting a surface under ``cos_in`` (geometric)."""
        inv_cos = self.power(dr.rcp(cos_in))
        dvcm = partial.dvcm * self.power(distance2) * inv_cos
        return Partial(_bounded(dvcm), [_bounded(ratio * inv_cos) for ratio in partial.dvc])

    def scatter(
        self,
        partial: Partial,
        cos_out: mi.Float,
        pdf_fwd: mi.Float,
        pdf_rev: mi.Float,
        delta: mi.Bool,
        side: Side,
        first: mi.Bool | None = None,
    ) -> Partial:
        """After choosing an outgoing direction with solid-angle density ``pdf_fwd``.

        ``pdf_rev`` is the density of the reversed scattering event. At a Dirac event the two
        densities cancel, and no connection is possible there. ``first``: where the subpath's other end is the vertex
        before, which the other subpath can do without being joined in the middle; None: everywhere.
        """
        inv_fwd = dr.rcp(pdf_fwd)
        head = self.power(cos_out * inv_fwd)
        tail = dr.select(delta, self.power(cos_out), head * self.power(pdf_rev))
        return Partial(
            dr.select(delta, 0.0, self.power(inv_fwd)),
            self._gather(self._joined(dr.select(delta, 0.0, head * partial.dvcm), first), tail, partial.dvc, side),
        )

    def others(
        self,
        partial: Partial,
        pdf_from_other: mi.Float,
        pdf_rev: mi.Float,
        side: Side,
        *,
        nearest: bool = False,
        first: mi.Bool | None = None,
    ) -> Ratios:
        """Ratios (other strategy / this one) that lie on this subpath's side.

        ``pdf_from_other`` is the area density of this vertex as sampled from the other subpath's
        end, ``pdf_rev`` the solid-angle density of this vertex's predecessor given that direction.
        ``nearest``: only the strategy with one vertex less on this side exists; ``first``: where that one exists
        though nothing is joined in the middle, None for everywhere.
        """
        scale = self.power(pdf_from_other)
        if nearest:
            return self._gather(scale * partial.dvcm, mi.Float(0.0), [], side)
        return self._gather(self._joined(scale * partial.dvcm, first), scale * self.power(pdf_rev), partial.dvc, side)

    def single(self, pdf_other: mi.Float, pdf_this: mi.Float, side: Side) -> Ratios:
        """The ratio of the one strategy on a side whose subpath is a single vertex."""
        return self._gather(self.power(pdf_other / pdf_this), mi.Float(0.0), [], side)

    def weight(self, light: Ratios, eye: Ratios) -> mi.Float:
        """The weight of a strategy from the ratios of both sides, in [0, 1]."""
        ratios = light + eye
        if self.kind == "maximum":
            return dr.select(reduce(dr.maximum, ratios, mi.Float(0.0)) < 1.0, mi.Float(1.0), 0.0)
        if self.kind == "cutoff":
            least = CUTOFF * reduce(dr.maximum, ratios, mi.Float(1.0))
            total = sum((dr.select(ratio >= least, ratio, 0.0) for ratio in ratios), mi.Float(1.0))
            return dr.select(least <= 1.0, dr.rcp(total), 0.0)
        return dr.rcp(sum(ratios, mi.Float(1.0)))

    def power(self, density: mi.Float) -> mi.Float:
        """A density or density ratio as this heuristic counts it."""
        density = dr.minimum(density, MOST_DENSITY)
        return density * density if self.kind == "power" else density

    def _joined(self, head: mi.Float, first: mi.Bool | None) -> mi.Float:
        return head if self.joins or first is None else dr.select(first, head, 0.0)

    def _gather(self, head: mi.Float, scale: mi.Float, tail: Ratios, side: Side) -> Ratios:
        """One more strategy ``head`` before the scaled ``tail``."""
        scale = _bounded(scale)
        if self.kind == "cutoff":
            return [_bounded(head), *(_bounded(scale * ratio) for ratio in tail[: self.length - 1])]
        if not tail:
            return [head * self._tie(side)]
        if self.kind == "maximum":
            return [_bounded(dr.maximum(head, scale * tail[0]) * self._tie(side))]
        return [_bounded(dr.fma(scale, tail[0], head))]

    def _tie(self, side: Side) -> float:
        if self.kind != "maximum":
            return 1.0
        return 1.0 / TIE if side == "light" else TIE


def _bounded(ratio: mi.Float) -> mi.Float:
    return dr.minimum(ratio, MOST_RATIO)
