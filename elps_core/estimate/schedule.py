"""How many samples each chunk of a render holds: fixed by the settings alone, never by a clock."""

from __future__ import annotations

from elps_core.settings import RenderSettings

FULL_SAMPLES = 1 << 20
"""Samples of a full bidirectional chunk, about two seconds on two cores."""
BASELINE_FACTOR = 4
"""Mitsuba's own integrators make about this many times the samples a second."""


def chunk_spp(index: int, settings: RenderSettings, size: tuple[int, int]) -> int:
    """Samples per pixel of chunk ``index``: 1, 1, 2, 4, 8 ... up to a full chunk, a power of two.

    The first picture comes at once, and the sums of the first chunks are powers of two, so that a
    render of 64 samples ends at 64. ``size`` is (width, height) in pixels. The same on every
    machine, because chunks of one render digest are interchangeable.
    """
    factor = BASELINE_FACTOR if settings.integrator.startswith("mi_") else 1
    full = max(1, FULL_SAMPLES * factor // (size[0] * size[1]))
    return 1 << min(max(0, index - 1), full.bit_length() - 1)
