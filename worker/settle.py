"""Merging what a job's chunks have brought, publishing it, and starting what comes next.

Any worker does this for any job, one at a time per job. It may be asked to at any time and however
often: it looks at what is there, and changes nothing where nothing is new.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import structlog

from elps_core.errors import ContextMismatch
from elps_core.estimate.film import Accumulation, Chunk
from elps_core.estimate.schedule import MEANTIME, chunk_spp
from elps_core.selection.candidates import CANDIDATES, choose
from worker.advance import ChunkSpp, Decision, decide, eta_seconds, mergeable, publish_due
from worker.leases import Work
from worker.models import FINAL_STATES, ContextRecord, ContextState, Job, JobState, Statistic
from worker.parts import Parts
from worker.publish import publish
from worker.state import Change, JobEntry, enter, update
from worker.store import chunk_key, name
from worker.warm import Warm

log = structlog.get_logger()

_PROGRESS = ("samples_done", "chunks_done", "relative_error", "seconds_rendering", "eta_seconds")
"""Fields of a job that its progress events carry."""


def schedule(job: Job, choice: dict[str, Any] | None) -> ChunkSpp:
    """Samples per pixel of each chunk of a job, once it is known what renders."""
    by_trials = choice if job.settings.integrator == "auto" else None
    settings = CANDIDATES[by_trials["name"]].settings(job.settings) if by_trials else job.settings
    return lambda index: chunk_spp(index, settings, (job.width, job.height))


class _Merged(NamedTuple):
    """What is known of a merged image."""

    chunks: tuple[int, ...]
    samples: int
    seconds: float
    """Sum over its chunks."""
    sample_seconds: float
    """Per sample per pixel, of the chunk merged last."""
    error: float | None
    statistics: dict[str, Statistic]
    warnings: tuple[str, ...]


class Settler:
    """Merges and advances jobs on the connections of one rendering process."""

    def __init__(self, parts: Parts, warm: Warm, worker: str) -> None:
        self._parts = parts
        self._warm = warm
        self._worker = worker

    def settle(self, id: str) -> None:  # noqa: A002
        """Bring one job up to date, unless another process is at it: that one then looks once more."""
        state = self._parts.state
        state.request(id)
        while state.requested(id):
            with state.job_lock(id, self._worker) as held:
                if not held:
                    return  # the holder looks for requests after it has let go
                state.clear_request(id)
                self._settle(id)

    def _settle(self, id: str) -> None:  # noqa: A002
        entry = self._parts.state.entry(id)
        if entry is None or entry.job.state == "completed":
            return
        job, state = entry.job, self._parts.state
        context = self._context(job)
        choice = job.choice or (self._choice(job) if context == "ready" else None)
        spp = schedule(job, choice)
        # In this order: a chunk that is finished meanwhile is seen twice rather than not at all.
        in_flight = frozenset(
            work.number for work in self._parts.board.in_flight() if work[:2] == ("chunk", job.digest)
        )
        done = state.done(job.digest)
        image, facts = self._merge(entry, mergeable(entry, done, spp), choice)
        now = time.time()
        entry = _counted(entry, facts, now)
        window = sum(job.settings.variant in worker.variants for worker in state.workers()) + 1
        decision = decide(entry, context, done, in_flight, window, now, spp, self._prepared(job))
        key = None
        if facts.chunks and (decision.finish or publish_due(entry, now, self._parts.settings.publish_seconds)):
            key = publish(self._parts.store, job, image)
        seen = state.change(
            id, lambda entry: _changed(entry, facts, key, decision.finish, context, choice, time.time())
        )
        if seen is None:
            return
        if seen.job.state in FINAL_STATES:
            self._warm.forget_accumulation(job)
            self._parts.record(seen)
        else:
            self._start(seen.job, decision)

    def _merge(self, entry: JobEntry, new: list[int], choice: dict[str, Any] | None) -> tuple[Accumulation, _Merged]:
        """The merged image with ``new`` chunks in it.

        What was rendered before the ``choice`` counts by what trials say of it.
        """
        job = entry.job
        meantime = float(choice["meantime"]) if choice else 1.0
        merged = self._warm.accumulation(job, meantime)
        seconds = entry.sample_seconds
        for index in sorted({*entry.merged, *new} - merged.chunks):
            data = self._parts.store.get(chunk_key(job.digest, index))
            if data is None:
                log.warning("chunk is gone from the store", render=job.digest, chunk=index)
                self._parts.state.remove_done(job.digest, index)
                continue
            chunk = Chunk.from_bytes(data)
            merged.add(chunk, meantime if index >= MEANTIME else 1.0)
            seconds = chunk.seconds / chunk.spp
        error = entry.job.relative_error if merged.chunks == set(entry.merged) else merged.relative_error()
        statistics = {key: Statistic(**value._asdict()) for key, value in merged.statistics().items()}
        chunks, warnings = tuple(sorted(merged.chunks)), merged.warnings()
        return merged, _Merged(chunks, merged.spp, merged.seconds, seconds, error, statistics, warnings)

    def _context(self, job: Job) -> ContextState | None:
        """How far the context is that a job needs; *building* means that somebody is at it now."""
        digest = job.context_digest
        if digest is None:
            return None
        record = self._parts.state.context(digest)
        if record is not None and record.state in ("ready", "failed"):
            return record.state
        if any(work[:2] == ("context", digest) for work in self._parts.board.in_flight()):
            return "building"
        stored = self._parts.store.get(f"contexts/{name(digest)}.json")
        if stored is None:
            return "missing"
        self._parts.state.set_context(ContextRecord.model_validate_json(stored))
        return "ready"

    def _prepared(self, job: Job) -> float:
        """Seconds that the context of a job has taken so far."""
        record = self._parts.state.context(job.context_digest) if job.context_digest else None
        return (record.seconds or 0.0) if record else 0.0

    def _choice(self, job: Job) -> dict[str, Any] | None:
        """What the trials of a job's context say that should render."""
        record = self._parts.state.context(job.context_digest or "")
        if record is None or not job.settings.adaptive:
            return None
        try:
            return choose(job.settings, record.statistics).report()
        except ContextMismatch:
            return None  # the chunks fail, and say so

    def _start(self, job: Job, decision: Decision) -> None:
        for index in decision.start:
            self._parts.offer(job, Work("chunk", job.digest, index))
        # After the first picture, which takes a second.
        if decision.build_context and job.context_digest is not None:
            self._parts.offer(job, Work("context", job.context_digest, self._steps_saved(job.context_digest)))

    def _steps_saved(self, context: str) -> int:
        """Steps that an earlier, unfinished attempt at a context has left in the store."""
        saved = self._parts.store.keys(f"contexts/{name(context)}")
        return max((int(key.rpartition("/")[2]) for key in saved), default=0)


def _counted(entry: JobEntry, merged: _Merged, now: float) -> JobEntry:
    """The job with the numbers of its merged image; the same one where they are not news."""
    if not set(merged.chunks) > set(entry.merged):
        return entry
    entry = update(
        entry.model_copy(update={"merged": merged.chunks, "sample_seconds": merged.sample_seconds}),
        samples_done=merged.samples,
        chunks_done=len(merged.chunks),
        relative_error=merged.error,
        statistics=merged.statistics,
        image_warnings=merged.warnings,
        seconds_rendering=merged.seconds,
    )
    return update(entry, eta_seconds=None if entry.job.state in FINAL_STATES else eta_seconds(entry, now))


def _changed(
    entry: JobEntry,
    merged: _Merged,
    key: str | None,
    finish: bool,
    context: ContextState | None,
    choice: dict[str, Any] | None,
    now: float,
) -> Change | None:
    """The job with all that a merge has found, and the events that tell of it; None where nothing is new."""
    before = entry
    events: list[tuple[str, dict[str, Any]]] = []

    def go(state: JobState) -> None:
        nonlocal entry
        if change := enter(entry, state, now):
            entry = change.entry
            events.extend(change.events)

    # Chunks may come from another job with the same digest, so that this one never waited for a worker.
    if any(index < MEANTIME for index in merged.chunks) or (context == "ready" and entry.job.state == "preparing"):
        go("rendering")
    if choice is not None and entry.job.choice is None:
        entry = update(entry, choice=choice)
    counted = _counted(entry, merged, now)
    if counted is not entry:
        entry = counted
        events.append(("progress", {field: getattr(entry.job, field) for field in _PROGRESS}))
    if key is not None and key != entry.image_key and merged.samples > entry.image_samples:
        revision = entry.job.image_revision + 1
        facts = {"image_key": key, "image_samples": merged.samples, "image_time": now}
        entry = update(entry, image_revision=revision).model_copy(update=facts)
        events.append(("image", {"revision": revision, "samples": merged.samples}))
    if finish:
        go("completed")
    return None if entry is before else Change(entry, tuple(events))
