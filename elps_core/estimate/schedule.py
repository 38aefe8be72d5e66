"""How many samples each chunk of a render holds: fixed by what renders, never by a clock."""

from __future__ import annotations

from elps_core.settings import RenderSettings

FULL_SAMPLES = {"path": 1 << 22, "light": 1 << 22, "bdpt": 1 << 21, "pssmlt": 1 << 21}
"""Samples (of pssmlt: mutations) of a full chunk: on two cores one to three seconds in a Cornell box, and
three to eight in rooms with more to compute, or at greater depth. Samples are even within
a chunk."""
BASELINE_SAMPLES = 1 << 22
"""Of Mitsuba's own integrators."""
MEANTIME = 1 << 20
"""Index of the first chunk that is rendered by the plain way of ``auto`` before there is a context."""
BOOTSTRAP_RATIO = 4
"""Mutations for each path that a Metropolis chunk spends on finding where its chains start, at least."""


def chunk_spp(index: int, settings: RenderSettings, size: tuple[int, int]) -> int:
    """Samples per pixel of chunk ``index``: n, n, 2n, 4n, 8n ... up to a full chunk, powers of two.

    n is 1, so that the first picture comes at once, except where each chunk has a start of its own
    to pay for. The sums of the first chunks are powers of two as well, so that a render of 64 samples
    ends at 64. ``size`` is (width, height) in pixels. The same on every machine, because chunks of
    one render digest are interchangeable: ``settings`` are those that trials have chosen.
    """
    pixels = size[0] * size[1]
    full = max(1, FULL_SAMPLES.get(settings.integrator, BASELINE_SAMPLES) // pixels).bit_length() - 1
    if index >= MEANTIME:
        return 1 << min(max(0, index - MEANTIME - 1), max(1, BASELINE_SAMPLES // pixels).bit_length() - 1)
    first = 0
    if settings.integrator == "pssmlt":
        # Chains need no more: smaller chunks have fewer of them.
        worth = BOOTSTRAP_RATIO * settings.pssmlt.bootstrap
        first = (-(-worth // pixels) - 1).bit_length()
    return 1 << max(first, min(first + max(0, index - 1), full))
