"""What a worker does when a message comes: render a chunk, take a step of a context, settle a job.

All of it runs in the child that Celery forks, one task at a time.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import structlog
from celery import Celery, signals
from pydantic import ValidationError

from elps_core.errors import DeviceUnavailable, ElpsError
from elps_core.estimate.schedule import MEANTIME
from elps_core.selection.race import Allowance
from worker.advance import prepares_later, worth_starting
from worker.errors import FarmUnavailable
from worker.leases import Lease, Work, kept
from worker.lifetime import end_with_parent
from worker.models import ContextRecord, Job
from worker.parts import Parts
from worker.queue import offer_for
from worker.settle import Settler, schedule
from worker.state import Change, JobEntry, missing_context, update
from worker.store import chunk_key, name
from worker.warm import Warm, checkpoint_key

log = structlog.get_logger()

MAX_ATTEMPTS = 3
"""How often a chunk or a step is started before its jobs fail: machines die, but not three times in a row."""
GIVEN_UP = "the renderer failed three times on this scene: simplify it, or give the job's id to the operator"
"""Shown where the cause is no message for users; the log has it."""


class Child:
    """The tasks of one rendering process."""

    def __init__(self, parts: Parts, worker: str) -> None:
        """``worker`` is the name of the worker."""
        self._parts = parts
        self._worker = worker
        self.warm = Warm(parts.store)
        self._settler = Settler(parts, self.warm, worker)

    def prepare(self) -> None:
        """Load Mitsuba before the first job asks for it."""
        try:
            self.warm.prepare(self._parts.settings.warm_variant)
        except DeviceUnavailable as error:  # the jobs that need it fail with the same line
            log.error("no device", reason=str(error))

    def settle(self, job: str) -> None:
        """Merge what there is of a job and start what comes next."""
        try:
            self._settler.settle(job)
        except ElpsError as error:  # a full disk, a lost connection: the sweeper has it tried again
            log.warning("job not settled", job=job, reason=str(error))

    def chunk(self, digest: str, index: int) -> None:
        """Render a chunk that jobs with this render digest wait for."""
        state, store = self._parts.state, self._parts.store

        def render(job: Job) -> None:
            for entry in state.of_render(digest):
                state.enter(entry.job.id, "preparing" if index >= MEANTIME else "rendering")
            key = chunk_key(digest, index)
            if not store.exists(key):
                store.put(key, self.warm.chunk(job, index).to_bytes())
                self._tell(state.of_render(digest))

        lease = self._attempt(Work("chunk", digest, index), render)
        if lease is None:
            return
        state.add_done(digest, [index])
        if self._parts.board.finish(lease):
            for entry in state.of_render(digest):
                self.settle(entry.job.id)

    def context(self, digest: str, done: int) -> None:
        """Take the step after ``done`` of a context that jobs wait for."""
        state = self._parts.state
        lease = self._attempt(Work("context", digest, done), lambda job: self._step(job, digest, done))
        if lease is None:
            return
        self._parts.board.finish(lease)
        record = state.context(digest)
        waiting = state.waiting(digest)
        self._tell(waiting)
        for entry in waiting:
            # Jobs without a limit of time may have to render before the next step is due.
            if record is not None and (record.state == "ready" or entry.job.stop.seconds is None):
                self.settle(entry.job.id)

    def _later(self, job: Job, record: ContextRecord) -> bool:
        return prepares_later(job, record.seconds or 0.0, time.time())

    def _tell(self, entries: list[JobEntry]) -> None:
        """Add what was spent to the records of the jobs that it was spent on."""
        if spent := self.warm.spent():

            def add(entry: JobEntry) -> Change:
                fields = {field: round(getattr(entry.job, field) + seconds, 3) for field, seconds in spent.items()}
                return Change(update(entry, **fields))

            for entry in entries:
                self._parts.state.change(entry.job.id, add)

    def rebuild(self) -> None:
        """Bring back the jobs that Redis does not know and the store does."""
        newest: dict[str, int] = {}
        for key in self._parts.store.keys("jobs"):
            _, id, revision = key.split("/")  # noqa: A001
            newest[id] = max(newest.get(id, 0), int(revision))
        for id, last in newest.items():  # noqa: A001
            if self._parts.state.entry(id) is not None:
                continue
            data = self._parts.store.get(f"jobs/{id}/{last}")
            if data is None:
                continue
            try:
                entry = JobEntry.model_validate_json(data).model_copy(update={"events": 0})
            except ValidationError:
                log.warning("job of another version left out", job=id)
                continue
            self._parts.list_chunks(entry.job.digest)
            self._parts.state.create(entry)
            self.settle(id)

    def _step(self, job: Job, digest: str, done: int) -> None:
        state, store = self._parts.state, self._parts.store
        for entry in state.waiting(digest):
            if entry.job.state == "queued":
                state.enter(entry.job.id, "preparing")
        record = state.context(digest) or missing_context(job)
        if record.state == "ready":
            return
        if store.exists(checkpoint_key(digest, done + 1)):  # by a process that died before it could say so
            self._parts.offer(job, Work("context", digest, done + 1))
            return
        if record.state != "building":
            record = record.model_copy(update={"state": "building", "seconds": 0.0, "error": None})
            state.set_context(record)
        begin = time.monotonic()
        with self.warm.timed():
            builder = self.warm.builder(job, done)
            builder.step(_time_for_preparing(job, self.warm.compiling))
        finished = builder.done == builder.steps
        if finished:
            context = builder.result()
            store.put(f"contexts/{name(digest)}.safetensors", context.to_bytes())
            if context.directions is not None:
                store.put(f"surroundings/{name(context.surroundings)}/{name(digest)}", b"")
            record = record.model_copy(update={"state": "ready", "statistics": context.statistics})
        else:
            store.put(checkpoint_key(digest, builder.done), builder.to_bytes())
        seconds = (record.seconds or 0.0) + time.monotonic() - begin
        record = record.model_copy(update={"progress": builder.progress, "seconds": seconds})
        if finished:
            store.put(f"contexts/{name(digest)}.json", record.model_dump_json().encode())
            for key in store.keys(f"contexts/{name(digest)}"):
                store.delete(key)
            self.warm.forget_builder(digest)
        elif not self._later(job, record):
            # Offered before this step is taken off the board, so that no job sees nobody at work.
            self._parts.offer(job, Work("context", digest, builder.done))
        state.set_context(record)

    def _attempt(self, work: Work, body: Callable[[Job], None]) -> Lease | None:
        """Run ``body`` for a job that waits for ``work``, under a lease; None unless it ran to its end."""
        lease = self._parts.board.start(work, self._worker, self._parts.settings.lease_seconds)
        if lease is None:
            return None  # done by now, or with another worker
        waiting = self._waiting(work)
        if not waiting or (work.kind == "chunk" and not any(_in_time(entry, work.number) for entry in waiting)):
            self._parts.board.finish(lease)
            for entry in waiting:
                self.settle(entry.job.id)
            return None
        if lease.attempts > MAX_ATTEMPTS:  # each time the process died, so that nothing was raised
            self._give_up(lease, GIVEN_UP)
            return None
        job = waiting[0].job
        if self._run(lease, job, body):
            return lease
        self.warm.forget_scenes()  # No error holds them any more
        return None

    def _run(self, lease: Lease, job: Job, body: Callable[[Job], None]) -> bool:
        """Whether ``body`` ran to its end; else its work is given up, offered again or left to others."""
        work, settings = lease.work, self._parts.settings
        try:
            with kept(self._parts.board, lease, settings.lease_seconds, settings.stall_seconds):
                body(job)
        except FarmUnavailable as error:
            # The lease runs out and the work is offered again: until then the farm may come back.
            log.warning("work interrupted", work=work.id, attempts=lease.attempts, reason=str(error))
            if lease.attempts == MAX_ATTEMPTS:
                self._give_up(lease, str(error))
        except ElpsError as error:
            self._give_up(lease, str(error))
        except Exception:
            log.exception("work failed", work=work.id, attempts=lease.attempts, job=job.id)
            if lease.attempts == MAX_ATTEMPTS:
                self._give_up(lease, GIVEN_UP)
            elif self._parts.board.release(lease):
                self._parts.queue.send(offer_for(job, work))
        else:
            return True
        return False

    def _waiting(self, work: Work) -> list[JobEntry]:
        state = self._parts.state
        return state.of_render(work.digest) if work.kind == "chunk" else state.waiting(work.digest)

    def _give_up(self, lease: Lease, message: str) -> None:
        """End the jobs that wait for a piece of work, unless another worker has taken it over."""
        work, state = lease.work, self._parts.state
        if not self._parts.board.finish(lease):
            return
        record = state.context(work.digest)
        if work.kind == "context" and record is not None:
            state.set_context(record.model_copy(update={"state": "failed", "error": message}))
        for entry in self._waiting(work):
            state.enter(entry.job.id, "failed", message)
            self.settle(entry.job.id)


def _time_for_preparing(job: Job, compiling: float) -> Allowance:
    """What a job gives to its context, where the kernel of plain paths took so many seconds to compile."""
    now = time.time()
    return Allowance.of(time.perf_counter() - (now - (job.started or now)), job.stop.seconds, compiling)


def _in_time(entry: JobEntry, index: int) -> bool:
    return worth_starting(entry, schedule(entry.job, entry.job.choice)(index), time.time())


def register(app: Celery, make_child: Callable[[], Child], folder: Path) -> None:
    """Add the tasks to ``app``, in the process that will fork.

    ``make_child`` is called once in each process that runs them; ``folder`` is for the files of that process.
    """
    child = cache(make_child)
    parent = os.getpid()

    def prepare(**_: object) -> None:
        end_with_parent(parent)
        own = folder / "child"
        shutil.rmtree(own, ignore_errors=True)  # of a process before us that was killed
        own.mkdir()
        tempfile.tempdir = str(own)
        child().prepare()

    signals.worker_process_init.connect(prepare, weak=False)

    @app.task(name="elps.settle")  # type: ignore[untyped-decorator]
    def settle(job: str) -> None:
        child().settle(job)

    @app.task(name="elps.chunk")  # type: ignore[untyped-decorator]
    def chunk(digest: str, index: int) -> None:
        child().chunk(digest, index)

    @app.task(name="elps.context")  # type: ignore[untyped-decorator]
    def context(digest: str, done: int) -> None:
        child().context(digest, done)

    @app.task(name="elps.rebuild")  # type: ignore[untyped-decorator]
    def rebuild() -> None:
        child().rebuild()
