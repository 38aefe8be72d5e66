"""Outgoing directions: by scattering alone, or mixed with what the context knows of light and sensor [thesis 5.3.3].

An eye path goes where radiance comes from, a light path where importance comes from: with a fixed chance
a direction is drawn from the table of the region, else from the material. Both paths evaluate the
densities of both mixtures, because each enters the other's weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.context.field import DirectionalField
from elps_core.context.lookup import RegionLookup
from elps_core.paths.mis import Side
from elps_core.paths.scattering import Materials, Scattered, Scattering
from elps_core.paths.stream import Stream
from elps_core.scene.spectrum import luminance

ENOUGH = 64
"""Records from which on a region's table is taken to know what a path can expect."""
NEVER = 0xFFFFFFFF
"""In their place: no table is taken to know."""


LIKELIER = 2.0
"""Times that a table's direction may be likelier by it than it was drawn, for what a path is paid: bounds that where
paths go by scattering alone, so that no payment is far from what the table expects of all directions."""


@dataclass(frozen=True)
class Outlook:
    """What a path can expect that goes on."""

    value: mi.Float
    """Luminance that it brings to its pixel, or importance: what comes from all sides at least, in any direction."""
    known: mi.Bool
    """Where a table tells that."""
    light: mi.Spectrum
    """What it brings to its pixel, on the average, by that direction."""
    deviation: mi.Float
    """Standard deviation of what it brings, over its mean."""


class Directions:
    """Directions by scattering alone."""

    def __init__(self, materials: Materials) -> None:
        self.materials = materials

    def seen(
        self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, cos_out: mi.Float, side: Side, active: mi.Bool
    ) -> Scattering:
        """Smooth scattering from ``si.wi`` into ``wo`` (local) at a vertex of the path on ``side``.

        ``cos_out`` is |wo n|, n the geometric normal. ``pdf`` is the density with which this path would
        draw ``wo``, ``pdf_rev`` that with which a path from the other side would draw ``si.wi``.
        """
        if side == "eye":
            return self.materials.seen_by_eye(si, wo, active)
        return self.materials.seen_by_light(si, wo, cos_out, active)

    def sample(self, si: mi.SurfaceInteraction3f, stream: Stream, side: Side, active: mi.Bool) -> Scattered:
        """Draw a direction by three numbers of ``stream``."""
        draw = self.materials.sample_from_eye if side == "eye" else self.materials.sample_from_light
        return draw(si, stream.next_1d(), stream.next_2d(), active)

    def expected(
        self,
        si: mi.SurfaceInteraction3f,  # noqa: ARG002
        event: Scattered,  # noqa: ARG002
        direction: mi.Vector3f,  # noqa: ARG002
        cos_out: mi.Float,  # noqa: ARG002
        beta: mi.Spectrum,  # noqa: ARG002
        side: Side,  # noqa: ARG002
        active: mi.Bool,  # noqa: ARG002
    ) -> Outlook:
        """What a path is expected to find that goes on by ``event`` in ``direction`` with throughput ``beta``."""
        return Outlook(mi.Float(1.0), mi.Bool(False), mi.Spectrum(0.0), mi.Float(1.0))

    def region(self, si: mi.SurfaceInteraction3f, wi: mi.Vector3f, active: mi.Bool) -> mi.UInt32:  # noqa: ARG002
        """Region of a surface point as a path sees it that comes from ``wi`` (local); 0 without regions."""
        return mi.UInt32(0)


class Towards(Protocol):
    """What takes some of the directions of a table: to where light comes from that is smaller than its cells."""

    def sample(
        self, origin: mi.Point3f, region: mi.UInt32, u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Bool, mi.Vector3f, mi.Point2f]:
        """Whether a direction is taken, and then which, as a unit vector in world space; else numbers left."""
        ...

    def mixed(
        self, otherwise: mi.Float, origin: mi.Point3f, region: mi.UInt32, direction: mi.Vector3f, active: mi.Bool
    ) -> mi.Float:
        """Density per solid angle of the unit vector ``direction``, ``otherwise`` that of those not taken."""
        ...


Share: TypeAlias = "float | NDArray[np.float32]"
"""One chance, or that of each region [K]."""


@dataclass(frozen=True)
class Guide:
    """What one kind of path is guided by."""

    field: DirectionalField
    share: Share
    """Chance of a direction from the table, where the material scatters at all; 0: the table serves roulette."""
    towards: tuple[Towards, ...] = ()
    """What takes directions of the table, the last one first."""

    def sample(self, origin: mi.Point3f, region: mi.UInt32, u: mi.Point2f, active: mi.Bool) -> mi.Vector3f:
        """A direction from ``origin`` in a region, as a unit vector in world space."""
        taken, chosen = mi.Bool(False), mi.Vector3f(0.0, 0.0, 1.0)
        for towards in reversed(self.towards):
            aimed, direction, u = towards.sample(origin, region, u, active & ~taken)
            taken, chosen = taken | aimed, dr.select(aimed, direction, chosen)
        by_table, _ = self.field.sample(region, u, active & ~taken)
        return dr.select(taken, chosen, by_table)

    def pdf(self, origin: mi.Point3f, region: mi.UInt32, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Density per solid angle with which :meth:`sample` draws the unit vector ``direction``."""
        density = self.field.pdf(region, direction, active)
        for towards in self.towards:
            density = towards.mixed(density, origin, region, direction, active)
        return density


class GuidedDirections(Directions):
    """Mixtures of scattering and tables; a kind of path without a guide keeps to scattering."""

    def __init__(
        self,
        materials: Materials,
        lookup: RegionLookup,
        eye: Guide | None,
        light: Guide | None,
        *,
        enough: int = ENOUGH,
        prospects: NDArray[np.float32] | None = None,
    ) -> None:
        """``enough`` records, as of :data:`ENOUGH`; one kernel for any number of them.

        ``prospects`` [K, 4] tell what eye paths find, see :class:`elps_core.context.store.DirectionalParts`.
        """
        super().__init__(materials)
        self.lookup = lookup
        self._prospects = None if prospects is None else on_device(mi.Float, prospects)
        self._enough = dr.opaque(mi.UInt32, enough)
        self.guides: dict[Side, Guide | None] = {"eye": eye, "light": light}
        # By region in any case: one kernel for both.
        self._shares: dict[Side, mi.Float] = {
            side: on_device(mi.Float, np.broadcast_to(np.float32(guide.share), lookup.count))
            for side, guide in self.guides.items()
            if guide and np.any(np.asarray(guide.share) > 0.0)
        }

    def seen(
        self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, cos_out: mi.Float, side: Side, active: mi.Bool
    ) -> Scattering:
        """As of :class:`Directions`, with the densities of the mixtures."""
        event = super().seen(si, wo, cos_out, side, active)
        # Only asked where the material scatters: every vertex that is joined does.
        event.pdf = self._mixed(event.pdf, si, si.wi, wo, side, mi.Bool(True), active)
        event.pdf_rev = self._mixed(event.pdf_rev, si, wo, si.wi, _other(side), mi.Bool(True), active)
        return event

    def sample(self, si: mi.SurfaceInteraction3f, stream: Stream, side: Side, active: mi.Bool) -> Scattered:
        """As of :class:`Directions`: by table or by scattering, and weighted by the density of both together."""
        smooth = self.materials.flags.smooth(si)
        guide = self.guides[side]
        if guide is None or side not in self._shares:
            event = super().sample(si, stream, side, active)
        else:
            u_lobe, u = stream.next_1d(), stream.next_2d()
            here = active & smooth
            region = self.region(si, si.wi, here)
            share = dr.gather(mi.Float, self._shares[side], region, here)
            by_table = active & (u.x < share)
            # What is left of the number chooses the direction.
            left = dr.select(by_table, u.x / share, (u.x - share) / (1.0 - share))
            u.x = dr.clip(left, 0.0, mi.Float(dr.one_minus_epsilon(mi.Float)))
            direction = guide.sample(si.p, region, u, by_table)
            event = self.materials.sample_mixed(si, by_table, si.to_local(direction), u_lobe, u, side, active)
            event.by_table = guide.pdf(si.p, region, si.to_world(event.wo), here & ~event.delta)
            pdf = dr.lerp(event.pdf, event.by_table, share)
            # Roulette asks what the material keeps, not how well the table has chosen.
            albedo = dr.select(event.pdf > 0.0, event.weight / event.pdf, 1.0)
            event.albedo = dr.select(event.delta, event.weight, albedo)
            event.weight = dr.select(event.delta, event.weight / (1.0 - share), event.weight / pdf)
            event.weight = dr.select(event.delta | (pdf > 0.0), event.weight, 0.0)
            event.pdf = dr.select(event.delta, event.pdf, pdf)
        reverse = active & ~event.delta
        event.pdf_rev = self._mixed(event.pdf_rev, si, event.wo, si.wi, _other(side), smooth, reverse)
        return event

    def expected(
        self,
        si: mi.SurfaceInteraction3f,
        event: Scattered,
        direction: mi.Vector3f,
        cos_out: mi.Float,
        beta: mi.Spectrum,
        side: Side,
        active: mi.Bool,
    ) -> Outlook:
        """By the region's table, where it rests on enough records, and the surface is one that regions are made for."""
        guide = self.guides[side]
        if guide is None:
            return super().expected(si, event, direction, cos_out, beta, side, active)
        active = active & ~event.delta
        region = self.region(si, si.wi, active)
        drawn = side in self._shares and event.by_table is not None
        by_table = event.by_table if drawn else guide.pdf(si.p, region, direction, active)
        # The mean radiance at least, whatever the direction: tables do not know of every caustic, and paths that
        # are thinned out before they find one become fireflies.
        incident = guide.field.irradiance(region, active) * dr.maximum(by_table / cos_out, dr.inv_pi)
        value = luminance(mi.UnpolarizedSpectrum(beta), si.wavelengths) * incident
        known = active & (guide.field.evidence(region, active) >= self._enough)
        light, deviation = mi.Spectrum(0.0), mi.Float(1.0)
        if self._prospects is not None and side == "eye":
            red, green, blue, deviation = dr.gather(mi.Vector4f, self._prospects, region, known)
            mean = mi.Color3f(red, green, blue)
            mean = mi.Spectrum(mean) if mi.is_rgb else mi.Spectrum(mi.luminance(mean))
            light = beta * mean * (dr.minimum(by_table, LIKELIER * event.pdf) / cos_out)
        return Outlook(value, known, light, deviation)

    def region(self, si: mi.SurfaceInteraction3f, wi: mi.Vector3f, active: mi.Bool) -> mi.UInt32:
        """As of :class:`Directions`, by the surface's side that ``wi`` is on."""
        return self.lookup.at(si, wi, active)

    def _mixed(
        self,
        pdf: mi.Float,
        si: mi.SurfaceInteraction3f,
        wi: mi.Vector3f,
        wo: mi.Vector3f,
        side: Side,
        smooth: mi.Bool,
        active: mi.Bool,
    ) -> mi.Float:
        """Density with which a path on ``side`` that comes from ``wi`` draws ``wo``, ``pdf`` that of scattering."""
        guide = self.guides[side]
        if guide is None or side not in self._shares:
            return pdf
        region = self.region(si, wi, active)
        by_table = guide.pdf(si.p, region, si.to_world(wo), active)
        return dr.select(smooth, dr.lerp(pdf, by_table, dr.gather(mi.Float, self._shares[side], region, active)), pdf)


def _other(side: Side) -> Side:
    return "light" if side == "eye" else "eye"
