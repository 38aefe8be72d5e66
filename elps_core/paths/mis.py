"""Weights of multiple importance sampling by partial sums, O(1) per connection.

For a vertex x_i of a subpath, with p_i its forward area density from x_{i-1}, <-p_i the reverse
density and g the reverse geometry factor, the two sums

    dVCM_i = 1 / p_i
    dVC_i  = (<-g_{i-1} / p_i) (dVCM_{i-1} + <-p_{i-2} dVC_{i-1})

hold all that the weight of a connection needs of the subpath behind it (Georgiev 2012, technical
report on implementing vertex connection and merging; merging left out). The power heuristic with
exponent 2 [thesis 3.7.1] is the same recursion on squares: every factor passes through
:func:`power`. Cosines are those of geometric normals, because they convert densities from solid
angle to area. Survival probabilities of Russian roulette are left out of the weights, which keeps
the estimator unbiased and the sums smaller.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


def power(density: mi.Float) -> mi.Float:
    """A density or density ratio as the power heuristic (exponent 2) counts it."""
    return density * density


@dataclass
class Partial:
    """Partial sums of a subpath at its newest vertex; dimension as in the module's text."""

    dvcm: mi.Float
    dvc: mi.Float

    def arrive(self, distance: mi.Float, cos_in: mi.Float) -> Partial:
        """After a segment of length ``distance``, hitting a surface under ``cos_in`` (geometric)."""
        inv_cos = power(dr.rcp(cos_in))
        return Partial(self.dvcm * power(distance * distance) * inv_cos, self.dvc * inv_cos)

    def scatter(self, cos_out: mi.Float, pdf_fwd: mi.Float, pdf_rev: mi.Float, delta: mi.Bool) -> Partial:
        """After choosing an outgoing direction with solid-angle density ``pdf_fwd``.

        ``pdf_rev`` is the density of the reversed scattering event. At a Dirac event the two
        densities cancel, and no connection is possible there.
        """
        inv_fwd = dr.rcp(pdf_fwd)
        dvc_smooth = power(cos_out * inv_fwd) * dr.fma(power(pdf_rev), self.dvc, self.dvcm)
        return Partial(
            dr.select(delta, 0.0, power(inv_fwd)),
            dr.select(delta, power(cos_out) * self.dvc, dvc_smooth),
        )

    def other_strategies(self, pdf_from_other: mi.Float, pdf_rev: mi.Float) -> mi.Float:
        """Sum of the ratios (other strategy / this one) that lie on this subpath's side.

        ``pdf_from_other`` is the area density of this vertex as sampled from the other subpath's
        end, ``pdf_rev`` the solid-angle density of this vertex's predecessor given that direction.
        """
        return power(pdf_from_other) * dr.fma(power(pdf_rev), self.dvc, self.dvcm)


def weight(sum_light: mi.Float, sum_eye: mi.Float) -> mi.Float:
    """The weight of a strategy from the sums of both sides; in (0, 1]."""
    return dr.rcp(1.0 + sum_light + sum_eye)
