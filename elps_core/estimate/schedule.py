"""How many samples each chunk of a render holds: fixed by the settings alone, never by a clock."""

from __future__ import annotations

from elps_core.settings import RenderSettings

FIRST_SAMPLES = 1 << 18
"""Samples of the first chunk, about half a second of bidirectional path tracing on two cores: a
first picture at once."""
FULL_SAMPLES = 1 << 20
"""Samples of a full bidirectional chunk, about two seconds on two cores."""
BASELINE_FACTOR = 4
"""Mitsuba's own integrators make about this many times the samples a second."""


def chunk_spp(index: int, settings: RenderSettings, size: tuple[int, int]) -> int:
    """Samples per pixel of chunk ``index``: f, f, 2 f, 4 f ... up to a full chunk.

    ``size`` is (width, height) in pixels. The same on every machine, because chunks of one render
    digest are interchangeable.
    """
    factor = BASELINE_FACTOR if settings.integrator.startswith("mi_") else 1
    pixels = size[0] * size[1]
    first = max(1, FIRST_SAMPLES * factor // pixels)
    full = max(first, FULL_SAMPLES * factor // pixels)
    return min(full, first << min(max(0, index - 1), 30))
