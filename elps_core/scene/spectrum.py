"""Spectra as the current variant represents them: one channel, three, or sampled wavelengths."""

from __future__ import annotations

import mitsuba as mi


def sample_wavelengths(u: mi.Float) -> tuple[mi.Spectrum, mi.UnpolarizedSpectrum]:
    """Hero wavelengths for ``u`` and their weights; nothing to sample outside spectral variants."""
    if mi.is_spectral:
        wavelengths, weight = mi.sample_rgb_spectrum(mi.sample_shifted(u))
        return wavelengths, weight
    return mi.Color0f(), mi.UnpolarizedSpectrum(1.0)


def luminance(value: mi.UnpolarizedSpectrum, wavelengths: mi.Spectrum) -> mi.Float:
    """Luminance of a spectrum, for ranking and adjoint measurements."""
    if mi.is_spectral:
        return mi.luminance(value, wavelengths)
    return value.x if mi.is_monochromatic else mi.luminance(value)
