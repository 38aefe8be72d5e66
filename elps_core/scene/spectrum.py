"""Spectra as the current variant represents them: one channel, three, or sampled wavelengths."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

LUMINANCE_OF_ONE = 106.857
"""Integral of the eye's response over wavelengths in nanometres (CIE 1931), to which Mitsuba's spectra are scaled."""


def sample_wavelengths(u: mi.Float) -> tuple[mi.Spectrum, mi.UnpolarizedSpectrum]:
    """Hero wavelengths for ``u`` and their weights; nothing to sample outside spectral variants."""
    if mi.is_spectral:
        wavelengths, weight = mi.sample_rgb_spectrum(mi.sample_shifted(u))
        return wavelengths, weight
    return mi.Color0f(), mi.UnpolarizedSpectrum(1.0)


def white() -> float:
    """:func:`luminance` of what is 1 at all wavelengths."""
    return LUMINANCE_OF_ONE if mi.is_spectral else 1.0


def luminance(value: mi.UnpolarizedSpectrum, wavelengths: mi.Spectrum) -> mi.Float:
    """Luminance of a spectrum, for ranking and adjoint measurements."""
    if mi.is_spectral:
        return mi.luminance(value, wavelengths)
    return value.x if mi.is_monochromatic else mi.luminance(value)


def luminance_weights() -> NDArray[np.float64]:
    """Of linear red, green and blue in luminance, as Mitsuba weighs them."""
    return np.array([0.212671, 0.715160, 0.072169])
