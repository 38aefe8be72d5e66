"""What a surface is asked: values and both densities of a scattering event, in one call a vertex.

A dynamic call costs more than what most BSDFs compute in it, so that everything that is needed of
one BSDF is dispatched together. Directions are local; densities are per solid angle.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from elps_core.arrays import on_device
from elps_core.paths.mis import Side
from elps_core.scene.groups import MaterialFlags, every_shape, numbers

STRAIGHT = 1e-8
"""Square of |wi + eta wo| below which a ray passes without being refracted, and tells of no normal."""


@dataclass
class Scattering:
    """A smooth scattering event between two given directions."""

    value: mi.Spectrum  # f |cos|, for light paths the adjoint f*
    pdf: mi.Float  # Density of wo given wi
    pdf_rev: mi.Float  # Density of wi given wo


@dataclass
class Scattered:
    """A sampled scattering event."""

    wo: mi.Vector3f
    weight: mi.Spectrum  # f |cos| / pdf
    pdf: mi.Float
    pdf_rev: mi.Float  # Of a smooth event; at a Dirac event both densities cancel
    eta: mi.Float  # Relative index of refraction passed
    delta: mi.Bool  # Whether it is a Dirac event
    albedo: mi.Spectrum  # f |cos| / density of scattering alone, whatever else was drawn by
    by_table: mi.Float | None = None  # Density of the table that takes part in the mixture, where one does


Answer = TypeVar("Answer", Scattering, Scattered)


class Materials:
    """What the surfaces of one scene are made of.

    Mitsuba keeps one list of all BSDFs in the process: those that lie inside others, and those of other scenes. A call
    that may go to any of them compiles all; here it may go to those alone that a shape of the scene has, and to one of
    those that are alike: Mitsuba makes a material of its own for each shape that names none.
    """

    def __init__(self, scene: mi.Scene) -> None:
        shapes = every_shape(scene)
        carried = [bsdf for bsdf in dict.fromkeys(shape.bsdf() for shape in shapes) if bsdf is not None]
        kinds: dict[Hashable, int] = {}
        kind = [kinds.setdefault(_plain(bsdf) or bsdf, len(kinds)) for bsdf in carried]
        first = dict(zip(reversed(kind), reversed(carried), strict=True))
        self._carried = [first[k] for k in range(len(kinds))]
        self.flags = MaterialFlags(scene)
        of, kind_of = numbers(shapes), dict(zip(carried, kind, strict=True))
        places = np.zeros(int(of.max(initial=0)) + 1, np.uint32)
        places[of] = [kind_of.get(shape.bsdf(), 0) for shape in shapes]
        self._places = on_device(mi.UInt32, places)

    def _ask(self, question: Callable[..., Answer], si: mi.SurfaceInteraction3f, *rest: Any) -> Answer:
        """Put ``question`` to the BSDF of each surface point; the last argument tells where there is one to ask."""
        number = dr.reinterpret_array(mi.UInt32, si.shape)
        active = rest[-1] & (number != 0)
        place = dr.gather(mi.UInt32, self._places, number, active)
        answer: Answer = dr.switch(place, [partial(question, bsdf) for bsdf in self._carried], si, *rest[:-1], active)
        return _sound(answer)

    def seen_by_eye(self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool) -> Scattering:
        """Smooth scattering at a vertex of an eye path."""

        def ask(bsdf: mi.BSDF, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool) -> Scattering:
            context = mi.BSDFContext(mi.TransportMode.Radiance)
            value, pdf = bsdf.eval_pdf(context, si, wo, active)
            return Scattering(value, pdf, bsdf.pdf(context, _reversed(si, wo), si.wi, active))

        event: Scattering = self._ask(ask, si, wo, active)
        return event

    def seen_by_light(
        self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, cos_out: mi.Float, active: mi.Bool
    ) -> Scattering:
        """Smooth scattering at a vertex of a light path; ``cos_out`` is |wo n|, n the geometric normal.

        The adjoint BSDF [thesis 2.6.1, alg. 2.1; Veach 1997 5.3.2] is the BSDF as the sensor sees it:
        evaluated from ``wo``, so with the cosine of the direction to the light and whatever shading frame
        the material bends to, times the ratio of geometric cosines. All strategies thus estimate one
        integrand, bump maps and refraction included.
        """

        def ask(bsdf: mi.BSDF, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool) -> Scattering:
            value, pdf_rev = bsdf.eval_pdf(mi.BSDFContext(mi.TransportMode.Radiance), _reversed(si, wo), si.wi, active)
            pdf = bsdf.pdf(mi.BSDFContext(mi.TransportMode.Importance), si, wo, active)
            return Scattering(value, pdf, pdf_rev)

        found: Scattering = self._ask(ask, si, wo, active)
        found.value = found.value * _over_cos_in(cos_out, si)
        return found

    def sample_from_eye(
        self, si: mi.SurfaceInteraction3f, u_lobe: mi.Float, u: mi.Point2f, active: mi.Bool
    ) -> Scattered:
        """Draw the next direction of an eye path."""

        def ask(
            bsdf: mi.BSDF, si: mi.SurfaceInteraction3f, u_lobe: mi.Float, u: mi.Point2f, active: mi.Bool
        ) -> Scattered:
            context = mi.BSDFContext(mi.TransportMode.Radiance)
            sample, weight = bsdf.sample(context, si, u_lobe, u, active)
            delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
            pdf_rev = bsdf.pdf(context, _reversed(si, sample.wo), si.wi, active & ~delta)
            return Scattered(sample.wo, weight, sample.pdf, pdf_rev, sample.eta, delta, weight)

        event: Scattered = self._ask(ask, si, u_lobe, u, active)
        return event

    def sample_from_light(
        self, si: mi.SurfaceInteraction3f, u_lobe: mi.Float, u: mi.Point2f, active: mi.Bool
    ) -> Scattered:
        """Draw the next direction of a light path; its weight is that of the adjoint BSDF."""

        def ask(
            bsdf: mi.BSDF, si: mi.SurfaceInteraction3f, u_lobe: mi.Float, u: mi.Point2f, active: mi.Bool
        ) -> Scattered:
            sample, specular = bsdf.sample(mi.BSDFContext(mi.TransportMode.Importance), si, u_lobe, u, active)
            delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
            radiance = mi.BSDFContext(mi.TransportMode.Radiance)
            value, pdf_rev = bsdf.eval_pdf(radiance, _reversed(si, sample.wo), si.wi, active & ~delta)
            weight = dr.select(delta, specular * _exchange(si.wi, sample), value / sample.pdf)
            # Rough dielectrics reject a few of their samples, and leave a direction and a tiny density with them.
            weight = dr.select(dr.max(specular) > 0.0, weight, 0.0)
            return Scattered(sample.wo, weight, sample.pdf, pdf_rev, sample.eta, delta, weight)

        found: Scattered = self._ask(ask, si, u_lobe, u, active)
        found.weight = found.weight * _over_cos_in(dr.abs(dr.dot(si.to_world(found.wo), si.n)), si)
        found.albedo = found.weight
        return found

    def sample_mixed(
        self,
        si: mi.SurfaceInteraction3f,
        given: mi.Bool,
        wo: mi.Vector3f,
        u_lobe: mi.Float,
        u: mi.Point2f,
        side: Side,
        active: mi.Bool,
    ) -> Scattered:
        """The next direction: ``wo`` where ``given``, else drawn by scattering.

        Of a smooth event ``weight`` is f |cos| (for light paths the adjoint), not yet divided by whatever
        density the caller has drawn with, and ``pdf`` that of scattering alone.
        """
        mode = mi.TransportMode.Radiance if side == "eye" else mi.TransportMode.Importance

        def ask(
            bsdf: mi.BSDF,
            si: mi.SurfaceInteraction3f,
            given: mi.Bool,
            wo: mi.Vector3f,
            u_lobe: mi.Float,
            u: mi.Point2f,
            active: mi.Bool,
        ) -> Scattered:
            context, radiance = mi.BSDFContext(mode), mi.BSDFContext(mi.TransportMode.Radiance)
            sample, drawn = bsdf.sample(context, si, u_lobe, u, active & ~given)
            delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta) & ~given
            wo = dr.select(given, wo, sample.wo)
            smooth = active & ~delta
            if side == "eye":
                value, pdf = bsdf.eval_pdf(context, si, wo, smooth)
                pdf_rev = bsdf.pdf(context, _reversed(si, wo), si.wi, smooth)
            else:
                value, pdf_rev = bsdf.eval_pdf(radiance, _reversed(si, wo), si.wi, smooth)
                pdf = bsdf.pdf(context, si, wo, smooth)
                drawn = dr.select(delta, drawn * _exchange(si.wi, sample), drawn)
            weight = dr.select(delta, drawn, value)
            # Rough dielectrics reject a few of their samples, and leave a direction and a tiny density with them.
            weight = dr.select(given | (dr.max(drawn) > 0.0), weight, 0.0)
            return Scattered(wo, weight, dr.select(delta, sample.pdf, pdf), pdf_rev, sample.eta, delta, weight)

        event: Scattered = self._ask(ask, si, given, wo, u_lobe, u, active)
        # What a given direction passes through is not told; it matters for roulette by throughput only.
        event.eta = dr.select(given, 1.0, event.eta)
        if side == "light":
            event.weight = event.weight * _over_cos_in(dr.abs(dr.dot(si.to_world(event.wo), si.n)), si)
        return event


def _sound(answer: Answer) -> Answer:
    """An answer whose values and densities are numbers: Mitsuba's materials that reflect nothing divide 0 by 0."""
    answer.pdf = _number(answer.pdf)
    answer.pdf_rev = _number(answer.pdf_rev)
    if isinstance(answer, Scattering):
        answer.value = dr.select(dr.isfinite(dr.sum(answer.value)), answer.value, 0.0)
    else:
        answer.weight = dr.select(dr.isfinite(dr.sum(answer.weight)), answer.weight, 0.0)
    return answer


def _number(value: mi.Float) -> mi.Float:
    return dr.select(dr.isfinite(value), value, 0.0)


def _plain(bsdf: mi.BSDF) -> Hashable:
    """What tells a diffuse material of one reflectance from others, to the last digit; None of all other materials."""
    if bsdf.class_name() != "SmoothDiffuse":
        return None
    params = mi.traverse(bsdf)
    if [name for name, *_ in params] != ["reflectance.value"]:
        return None
    value = params["reflectance.value"]
    channels = [value] if isinstance(value, mi.Float) else list(value)
    return type(value).__name__, *(float(channel[0]) for channel in channels)


def _exchange(wi: mi.Vector3f, sample: mi.BSDFSample3f) -> mi.Float:
    """Ratio of the cosines of a Dirac event, whose weight is given for wi to wo.

    They are those with the normal that the material bends to. It lies along wi + eta wo where light is refracted; else
    they are equal.
    """
    bent = wi + sample.wo * sample.eta
    refracted = mi.has_flag(sample.sampled_type, mi.BSDFFlags.DeltaTransmission)
    refracted = refracted & (dr.squared_norm(bent) > STRAIGHT)
    return dr.select(refracted, dr.abs(dr.dot(bent, wi) / dr.dot(bent, sample.wo)), 1.0)


def _reversed(si: mi.SurfaceInteraction3f, wo: mi.Vector3f) -> mi.SurfaceInteraction3f:
    """The interaction as a walk meets it that arrives from ``wo``."""
    other = mi.SurfaceInteraction3f(si)
    other.wi = wo
    return other


def _over_cos_in(cos_out: mi.Float, si: mi.SurfaceInteraction3f) -> mi.Float:
    """``cos_out`` over the cosine of the direction that the path comes from; 0 where it comes along the surface."""
    cos_in = dr.abs(dr.dot(si.to_world(si.wi), si.n))
    return dr.select(cos_in > 0.0, cos_out / cos_in, 0.0)
