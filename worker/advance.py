"""What a job needs next: pure decisions from its record to the work that it should start or its end.

Nothing here talks to Redis, the store or the renderer, and the time is an argument.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import count
from math import isfinite
from typing import NamedTuple

from elps_core.estimate.schedule import MEANTIME
from elps_core.estimate.stats import ends_by_error
from elps_core.settings import PREPARATION
from worker.models import FINAL_STATES, ContextState, Job
from worker.state import JobEntry

EAGER_SECONDS = 60.0
"""In a job's first minute of images new ones come every few seconds; later at each doubling of samples."""

ChunkSpp = Callable[[int], int]
"""Samples per pixel of the chunk with a given index."""


class Decision(NamedTuple):
    """What to do for a job now."""

    finish: bool = False
    """The stop criterion is met and nothing is left to wait for."""
    build_context: bool = False
    """The job needs a context that nobody builds yet."""
    start: tuple[int, ...] = ()
    """Chunks to offer."""


def decide(
    entry: JobEntry,
    context: ContextState | None,
    done: frozenset[int],
    in_flight: frozenset[int],
    window: int,
    now: float,
    chunk_spp: ChunkSpp,
    prepared: float = 0.0,
) -> Decision:
    """The next step of a job all of whose mergeable chunks are merged.

    Args:
        entry: the job.
        context: state of the context that it needs; None where it needs none.
        done: chunks of its render digest that the store holds.
        in_flight: chunks of its render digest that are offered or running, for whichever job.
        window: most chunks in flight for the job, so that ending it early wastes little.
        now: Unix time, seconds.
        chunk_spp: the schedule of its render digest.
        prepared: seconds that the context has taken so far.
    """
    job = entry.job
    if job.state in FINAL_STATES:
        return Decision()
    if entry.merged and (_reached(entry, now) or _planned(job, entry.merged, chunk_spp)):
        return Decision(finish=True)
    known = done | in_flight | frozenset(entry.merged)
    if context in ("missing", "failed", "building"):
        late = prepares_later(job, prepared, now)
        build = context != "building" and not late
        return Decision(build_context=build, start=_meantime(job, known, in_flight, window, late=late))
    room = window - len(in_flight)
    wanted: list[int] = []
    late = False
    spp = 0
    for index in count():
        if (job.stop.samples is not None and spp >= job.stop.samples) or len(wanted) >= room:
            break
        spp += chunk_spp(index)
        if index not in known:
            late = not worth_starting(entry, chunk_spp(index), now)
            if late:
                break
            wanted.append(index)
    # What is in flight was started in time and is waited for.
    return Decision(start=tuple(wanted), finish=late and not wanted and not in_flight)


def prepares_later(job: Job, prepared: float, now: float) -> bool:
    """Whether a job's context has to wait until more is rendered: of the time of a job that has no limit of time,
    preparing takes a quarter.

    ``prepared``: seconds that the context has taken so far.
    """
    free = job.settings.integrator == "auto" and job.stop.seconds is None
    begun = now if job.started is None else job.started
    return free and prepared > PREPARATION * (now - begun)


def _meantime(
    job: Job, known: frozenset[int], in_flight: frozenset[int], window: int, *, late: bool
) -> tuple[int, ...]:
    """Chunks to render while there is no context: the first at once, more where workers have nothing else to do.

    ``late``: whether nobody builds the context until more is rendered.
    """
    if job.settings.integrator != "auto":
        return ()
    early = [index for index in known if index >= MEANTIME]
    others = window - (1 if late else 2) - len(in_flight)  # Workers but the one that builds the context
    return tuple(MEANTIME + len(early) + k for k in range(max(others, 0 if early else 1)))


def worth_starting(entry: JobEntry, spp: int, now: float) -> bool:
    """Whether half of a chunk of ``spp`` samples or more fits into the job's time: jobs end on time on average.

    The first chunk always does: a job that ends has an image.
    """
    job = entry.job
    if not entry.merged or job.stop.seconds is None or job.started is None:
        return True
    return now + entry.sample_seconds * spp / 2 <= job.started + job.stop.seconds


def mergeable(entry: JobEntry, done: Iterable[int], chunk_spp: ChunkSpp) -> list[int]:
    """Chunks in the store that the job should still merge, ascending.

    A limit on samples takes the first chunks of the stream and no others, so that the image does
    not depend on which chunks another job with the same digest made.
    """
    new = sorted(set(done) - set(entry.merged))
    early = [index for index in new if index >= MEANTIME]
    candidates = new[: len(new) - len(early)]
    limit = entry.job.stop.samples
    if limit is None or not candidates:
        return new
    spp = 0
    for index in count():
        if spp >= limit:
            return [candidate for candidate in candidates if candidate < index] + early
        if index > candidates[-1]:
            return new
        spp += chunk_spp(index)
    raise AssertionError  # count never ends


def publish_due(entry: JobEntry, now: float, every: float) -> bool:
    """Whether the merged chunks are worth a new image: the first, then each ``every`` seconds, then each doubling."""
    job = entry.job
    if job.samples_done == entry.image_samples:
        return False
    if entry.image_samples == 0 or job.state in FINAL_STATES:
        return True
    if now - entry.image_time < every:
        return False
    early = job.started is not None and now - job.started < EAGER_SECONDS
    return early or job.samples_done >= 2 * entry.image_samples


def eta_seconds(entry: JobEntry, now: float) -> float | None:
    """Seconds until the first limit of the stop criterion is met, or None where nothing is known yet."""
    job, stop = entry.job, entry.job.stop
    if job.started is None or job.samples_done == 0:
        return None
    elapsed = now - job.started
    rendering = max(elapsed - job.seconds_context, 0.0)
    estimates = []
    if stop.seconds is not None:
        estimates.append(stop.seconds - elapsed)
    if stop.samples is not None:
        estimates.append(rendering * (stop.samples / job.samples_done - 1.0))
    if stop.error is not None and job.relative_error is not None:
        # The error falls with the square root of the samples. A product: a power out of a float's range raises.
        ratio = job.relative_error / stop.error
        estimates.append(rendering * (ratio * ratio - 1.0))
    known = [estimate for estimate in estimates if isfinite(estimate)]
    return max(min(known), 0.0) if known else None


def _reached(entry: JobEntry, now: float) -> bool:
    """Whether seconds or error are met; samples are a set of chunks, see :func:`_planned`."""
    job, stop = entry.job, entry.job.stop
    seconds = stop.seconds is not None and job.started is not None and now - job.started >= stop.seconds
    error = stop.error is not None and ends_by_error(job.relative_error, len(entry.merged), stop.error)
    return seconds or error


def _planned(job: Job, merged: tuple[int, ...], chunk_spp: ChunkSpp) -> bool:
    """Whether the merged chunks are all that the limit on samples asks for.

    Those by the context, or those that were there before it: together they are no fixed set.
    """
    if job.stop.samples is None:
        return False
    later = sum(chunk_spp(index) for index in merged if index < MEANTIME)
    return max(later, sum(chunk_spp(index) for index in merged if index >= MEANTIME)) >= job.stop.samples
