"""What emitters send out: by tables where a number says it all, by Mitsuba's plugins where none does.

Mitsuba traces a call through a pointer once for each emitter that there is. Lamps whose radiance is the same
everywhere, and point lights, are rows of one table instead: the time to trace a kernel, and its code, do not depend on
how many there are.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.scene.emitters import POINTS, SURFACES, Light, intensity_of

FEW = 32
"""Emitters that are asked for their radiance one by one: Python takes longer for each, and asks no others."""

Question = Callable[..., mi.Spectrum]


class Radiance:
    """Emission of all emitters of a scene, in their order."""

    def __init__(self, lights: list[Light]) -> None:
        self._kinds = [light.kind for light in lights]
        emitters = [light.emitter for light in lights]
        self._emitters = mi.EmitterPtr(emitters)
        known, values = _constants(lights, self._emitters)
        self.known: NDArray[np.bool_] = known
        """[count]: whether an emitter's radiance or intensity is one number for each channel."""
        self.values: NDArray[np.float64] = values
        """These numbers [count, channels]; zeros where they are not known."""
        self._has_known = bool(known.any())
        self._table = on_device(mi.Float, np.pad(values, ((0, 0), (0, _stride() - values.shape[1]))))
        on_surface = np.array([kind in SURFACES for kind in self._kinds])
        delta = np.array([kind in (*POINTS, "directional") for kind in self._kinds])
        self._shining = _Asked(emitters, ~known & ~delta, pointers=self._emitters)
        self._sending = _Asked(emitters, ~known & delta)
        self._known_shine = bool((known & on_surface).any())
        self._known_send = bool((known & delta).any())

    def seen(self, index: mi.UInt32, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Spectrum:
        """Radiance from a point of a surface, or of an environment, into the direction ``si.wi``."""
        value = dr.zeros(mi.Spectrum)
        if self._known_shine:
            value = self._constant(index, active & (mi.Frame3f.cos_theta(si.wi) > 0.0))
        if self._shining.any:
            asked = self._shining(lambda emitter, si, active: emitter.eval(si, active), index, si, active)
            value = dr.select(self._shining.of(index, active), asked, value) if self._known_shine else asked
        return value

    def sent(self, index: mi.UInt32, near: mi.Interaction3f, away: mi.Float, active: mi.Bool) -> mi.Spectrum:
        """Intensity of an emitter without extent towards ``near``, at the distance ``away`` from it; irradiance of one
        at infinity, where ``away`` is to be 1."""
        value = dr.zeros(mi.Spectrum)
        if self._known_send:
            value = self._constant(index, active)
        if self._sending.any:

            def ask(emitter: Any, near: mi.Interaction3f, active: mi.Bool) -> mi.Spectrum:
                return emitter.sample_direction(near, mi.Point2f(0.5), active)[1]

            asked = self._sending(ask, index, near, active) * dr.square(away)
            value = dr.select(self._sending.of(index, active), asked, value) if self._known_send else asked
        return value

    def _constant(self, index: mi.UInt32, active: mi.Bool) -> mi.Spectrum:
        if mi.is_monochromatic:
            return mi.Spectrum(dr.gather(mi.Float, self._table, index, active))
        row = dr.gather(mi.Vector4f, self._table, index, active)
        return mi.Spectrum(row.x, row.y, row.z)


class _Asked:
    """The emitters among all that Mitsuba is asked about.

    ``pointers``, where given, ask all of them when these are many. They must not for what Mitsuba draws on lamps: it
    has the numbers of each in its code, so that a hundred lamps are a hundred times the code.
    """

    def __init__(self, emitters: list[Any], which: NDArray[np.bool_], pointers: mi.EmitterPtr | None = None) -> None:
        self._chosen = [emitter for emitter, asked in zip(emitters, which, strict=True) if asked]
        self.any = bool(self._chosen)
        self._all = len(self._chosen) == len(emitters)
        self._pointers = pointers
        places = np.full(len(emitters), len(self._chosen))
        places[which] = np.arange(len(self._chosen))
        self._places = on_device(mi.UInt32, places)
        self._count = dr.opaque(mi.UInt32, len(self._chosen))

    def of(self, index: mi.UInt32, active: mi.Bool) -> mi.Bool:
        """Whether an emitter is one of these."""
        return mi.Bool(True) if self._all else dr.gather(mi.UInt32, self._places, index, active) < self._count

    def __call__(self, question: Question, index: mi.UInt32, near: Any, active: mi.Bool) -> mi.Spectrum:
        """The answers of those emitters that are among these."""
        place = dr.gather(mi.UInt32, self._places, index, active)
        active = active & (place < self._count)
        if self._pointers is not None and len(self._chosen) > FEW:
            return question(dr.gather(mi.EmitterPtr, self._pointers, index, active), near, active)
        answer: mi.Spectrum = dr.switch(place, [partial(question, each) for each in self._chosen], near, active)
        return answer


def _stride() -> int:
    """Numbers of a row of the table: a packet of four where there are three channels."""
    return 1 if mi.is_monochromatic else 4


def _constants(lights: list[Light], emitters: mi.EmitterPtr) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Which emitters have one value for each channel, and the values [count, channels]."""
    count, channels = len(lights), 1 if mi.is_monochromatic else 3
    known, values = np.zeros(count, bool), np.zeros((count, channels))
    if mi.is_spectral or mi.is_polarized:  # A spectrum is more than a number, and what Mitsuba draws from it too.
        return known, values
    surfaces = np.array([light.kind in SURFACES for light in lights])
    if surfaces.any():
        varying = np.array(mi.has_flag(emitters.flags(), mi.EmitterFlags.SpatiallyVarying))
        known = surfaces & ~np.broadcast_to(varying, count)
        si = dr.zeros(mi.SurfaceInteraction3f, count)
        si.wi = mi.Vector3f(0.0, 0.0, 1.0)
        shone = emitters.eval(si, on_device(mi.Bool, known))
        for channel in range(channels):
            values[known, channel] = np.broadcast_to(np.array(shone[channel], np.float64), count)[known]
    for k, light in enumerate(lights):
        intensity = intensity_of(light.emitter) if light.kind == "point" else None
        if intensity is not None:
            known[k], values[k] = True, intensity
    return known, values
