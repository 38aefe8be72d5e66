"""What changes: jobs and contexts as records in Redis, and the events that tell of each change.

A record is one JSON value. It changes by a pure function from the old record to the new one,
applied with optimistic locking (WATCH), so that a change and its events appear together or not at
all, whoever else is at work. Keys, all below ``elps:``:

=====================  ==================================================================
``job:{id}``           :class:`JobEntry`
``jobs``               sorted set of job ids by time of creation
``active``             set of ids of jobs that are not final
``events:{id}``        stream of a job's events, entry ``{n}-0`` is event n
``render:{digest}``    set of active jobs that want chunks of this render digest
``done:{digest}``      set of chunk indices that the store holds
``context:{digest}``   :class:`~worker.models.ContextRecord` that is not ready, or was not when last seen
``waiting:{digest}``   set of active jobs that need this context
``lock:{id}``          who merges a job now
``requests``           set of jobs that somebody asked to look at
``workers``            hash of worker name to :class:`~worker.models.WorkerInfo`
=====================  ==================================================================
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple, cast

from pydantic import BaseModel, ConfigDict, ValidationError
from redis import Redis
from redis.client import Pipeline
from redis.exceptions import WatchError

from worker.models import FINAL_STATES, ContextRecord, Event, Job, JobState, WorkerInfo

PREFIX = "elps:"
EVENTS_KEPT = 1000
"""Events kept per job for clients that reconnect: hours of a render, and a few hundred kilobytes."""
WORKER_SILENT_SECONDS = 10.0
"""A worker that was not heard of for this long is not counted as alive; three missed heartbeats."""
JOB_LOCK_SECONDS = 12
"""A lock whose holder died is free again after this. A merge that takes longer is done twice at worst:
what it found is written atomically."""
_UNLOCK = "if redis.call('GET', KEYS[1]) == ARGV[1] then redis.call('DEL', KEYS[1]) end"

_NEXT: dict[JobState, frozenset[str]] = {
    "queued": frozenset({"preparing", "rendering", *FINAL_STATES}),
    "preparing": frozenset({"rendering", *FINAL_STATES}),
    "rendering": FINAL_STATES,
    "paused": FINAL_STATES,
    "completed": frozenset(),
    "cancelled": frozenset(),
    "failed": frozenset(),
}


class JobEntry(BaseModel):
    """A job and what only the farm needs to know of it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    job: Job
    events: int = 0
    """Number of the last event."""
    merged: tuple[int, ...] = ()
    """Chunk indices that the numbers of the job count, ascending."""
    sample_seconds: float = 0.0
    """Seconds per sample per pixel that the last merged chunk took."""
    image_key: str | None = None
    image_samples: int = 0
    image_time: float = 0.0
    """Unix time of the last publication, seconds."""
    touched: float = 0.0
    """Unix time of the last change, seconds."""


class Change(NamedTuple):
    """A new record of a job and the events (type, data) that go with it."""

    entry: JobEntry
    events: tuple[tuple[str, dict[str, Any]], ...] = ()


def update(entry: JobEntry, **fields: Any) -> JobEntry:
    """A copy with fields of the public job replaced."""
    return entry.model_copy(update={"job": entry.job.model_copy(update=fields)})


def enter(entry: JobEntry, state: JobState, now: float, message: str | None = None) -> Change | None:
    """The job in another state, or None where it is there already or may not go there."""
    if state not in _NEXT[entry.job.state]:
        return None
    fields: dict[str, Any] = {"state": state, "message": message, "queue_position": None}
    if state in FINAL_STATES:
        fields |= {"finished": now, "eta_seconds": None, "chunks_running": 0}
    elif entry.job.started is None:
        fields["started"] = now
    return Change(update(entry, **fields), (("state", {"state": state, "message": message}),))


def missing_context(job: Job) -> ContextRecord:
    """The record of the context that a job needs, before anybody builds it."""
    return ContextRecord(
        digest=job.context_digest or "",
        state="missing",
        scene=job.scene,
        sensor=job.settings.sensor,
        settings=job.settings.measured,
    )


class State:
    """The records of one farm. ``redis`` must decode its responses."""

    def __init__(self, redis: Redis) -> None:
        self.redis = redis
        self._unlock = redis.register_script(_UNLOCK)

    # Jobs

    def create(self, entry: JobEntry) -> bool:
        """Write a new job with the event of its state; False where the id exists."""
        job = entry.job
        active = job.state not in FINAL_STATES

        def transact(pipe: Pipeline) -> bool:
            if pipe.get(_key("job", job.id)) is not None:
                return False
            pipe.multi()
            self._write(pipe, entry, (("state", {"state": job.state, "message": job.message}),))
            pipe.zadd(_key("jobs"), {job.id: job.created})
            if active:
                for members in _memberships(job):
                    pipe.sadd(members, job.id)
            return True

        return bool(self._transaction(transact, _key("job", job.id)))

    def entry(self, id: str) -> JobEntry | None:  # noqa: A002
        """One job, or None."""
        text = cast("str | None", self.redis.get(_key("job", id)))
        return _parsed(text)

    def entries(self, ids: Iterable[str]) -> list[JobEntry]:
        """The jobs among ``ids`` that exist, in their order."""
        keys = [_key("job", id) for id in ids]  # noqa: A001
        texts = cast("list[str | None]", self.redis.mget(keys)) if keys else []
        return [entry for text in texts if (entry := _parsed(text)) is not None]

    def change(self, id: str, step: Callable[[JobEntry], Change | None]) -> JobEntry | None:  # noqa: A002
        """Apply ``step`` to a job; it may run several times and must be pure.

        Returns the job as it is then (changed or, where ``step`` gave None, unchanged), or None
        where there is no such job.
        """
        outcome: list[JobEntry | None] = [None]

        def transact(pipe: Pipeline) -> None:
            text = cast("str | None", pipe.get(_key("job", id)))
            outcome[0] = before = _parsed(text)
            change = None if before is None else step(before)
            pipe.multi()
            if before is None or change is None:
                return
            job = change.entry.job
            numbered = change.entry.model_copy(
                update={"job": job.model_copy(update={"revision": before.job.revision + 1}), "touched": time.time()}
            )
            outcome[0] = self._write(pipe, numbered, change.events)
            if job.state in FINAL_STATES and before.job.state not in FINAL_STATES:
                for members in _memberships(job):
                    pipe.srem(members, id)

        self._transaction(transact, _key("job", id))
        return outcome[0]

    def enter(self, id: str, state: JobState, message: str | None = None) -> JobEntry | None:  # noqa: A002
        """:func:`enter` for a stored job; a transition that is not allowed changes nothing."""
        return self.change(id, lambda entry: enter(entry, state, time.time(), message))

    def newest(self, limit: int) -> list[JobEntry]:
        """The last ``limit`` jobs, newest first."""
        return self.entries(cast("list[str]", self.redis.zrevrange(_key("jobs"), 0, limit - 1)))

    def active(self) -> list[JobEntry]:
        """Jobs that are not final, in no order."""
        return self.entries(self._members("active"))

    def of_render(self, digest: str) -> list[JobEntry]:
        """Active jobs that want chunks of a render digest."""
        return self.entries(self._members("render", digest))

    def waiting(self, context: str) -> list[JobEntry]:
        """Active jobs that need a context."""
        return self.entries(self._members("waiting", context))

    @contextmanager
    def job_lock(self, id: str, holder: str) -> Iterator[bool]:  # noqa: A002
        """Try to be the only one that merges a job; yields whether this worked.

        ``holder`` does one thing at a time: a lock in its name was left by a process of its that died.
        """
        key = _key("lock", id)
        held = bool(self.redis.set(key, holder, nx=True, ex=JOB_LOCK_SECONDS)) or self.redis.get(key) == holder
        try:
            yield held
        finally:
            if held:
                self._unlock(keys=[key], args=[holder])

    def request(self, id: str) -> None:  # noqa: A002
        """Ask that a job be looked at."""
        self.redis.sadd(_key("requests"), id)

    def requested(self, id: str) -> bool:  # noqa: A002
        """Whether somebody asked since the last :meth:`clear_request`."""
        return bool(self.redis.sismember(_key("requests"), id))

    def clear_request(self, id: str) -> None:  # noqa: A002
        """Take note that the job is looked at now."""
        self.redis.srem(_key("requests"), id)

    # Chunks that exist

    def done(self, render: str) -> frozenset[int]:
        """Indices of the chunks that the store holds for a render digest."""
        return frozenset(int(index) for index in self._members("done", render))

    def add_done(self, render: str, indices: Iterable[int]) -> None:
        """Take note of chunks in the store."""
        if members := [str(index) for index in indices]:
            self.redis.sadd(_key("done", render), *members)

    def remove_done(self, render: str, index: int) -> None:
        """Take note that a chunk is gone from the store."""
        self.redis.srem(_key("done", render), str(index))

    # Contexts

    def context(self, digest: str) -> ContextRecord | None:
        """What Redis knows of a context."""
        text = cast("str | None", self.redis.get(_key("context", digest)))
        return None if text is None else ContextRecord.model_validate_json(text)

    def name_context(self, missing: ContextRecord) -> None:
        """Make a context known that the store does not have, unless it is known as being built or failed."""
        known = self.context(missing.digest)
        if known is not None and known.state == "ready":  # and is gone from the store since
            self.redis.delete(_key("context", missing.digest))
        self.redis.set(_key("context", missing.digest), missing.model_dump_json(), nx=True)

    def set_context(self, record: ContextRecord) -> None:
        """Write a context's record and tell every job that waits for it."""
        self.redis.set(_key("context", record.digest), record.model_dump_json())
        data = {"state": record.state, "progress": record.progress}

        def tell(entry: JobEntry) -> Change:
            seconds = 0.0 if entry.job.context_hit else record.seconds or 0.0
            fields = {"context_state": record.state, "context_progress": record.progress, "seconds_context": seconds}
            return Change(update(entry, **fields), (("context", data),))

        for entry in self.waiting(record.digest):
            self.change(entry.job.id, tell)

    # Events

    def events(self, id: str, after: int) -> list[Event]:  # noqa: A002
        """Kept events of a job numbered above ``after``, oldest first."""
        entries = cast("list[tuple[str, dict[str, str]]]", self.redis.xrange(_key("events", id), min=f"{after + 1}-0"))
        return [parse_event(number, fields) for number, fields in entries]

    # Workers

    def heartbeat(self, info: WorkerInfo) -> None:
        """Take note that a worker is alive, and forget those that went silent."""
        self.redis.hset(_key("workers"), info.name, info.model_dump_json())
        everyone = cast("dict[str, str]", self.redis.hgetall(_key("workers")))
        if silent := [name for name, text in everyone.items() if _silent(WorkerInfo.model_validate_json(text))]:
            self.redis.hdel(_key("workers"), *silent)

    def farewell(self, worker: str) -> None:
        """Forget a worker that ends."""
        self.redis.hdel(_key("workers"), worker)

    def workers(self) -> list[WorkerInfo]:
        """Workers that are alive."""
        texts = cast("list[str]", self.redis.hvals(_key("workers")))
        infos = [WorkerInfo.model_validate_json(text) for text in texts]
        return [info for info in infos if not _silent(info)]

    # Internals

    def _members(self, *parts: str) -> set[str]:
        return cast("set[str]", self.redis.smembers(_key(*parts)))

    def _write(self, pipe: Pipeline, entry: JobEntry, events: tuple[tuple[str, dict[str, Any]], ...]) -> JobEntry:
        for number, (kind, data) in enumerate(events, start=entry.events + 1):
            fields: Any = {"type": kind, "data": json.dumps(data)}
            pipe.xadd(_key("events", entry.job.id), fields, id=f"{number}-0", maxlen=EVENTS_KEPT, approximate=False)
        entry = entry.model_copy(update={"events": entry.events + len(events)})
        pipe.set(_key("job", entry.job.id), entry.model_dump_json())
        return entry

    def _transaction(self, body: Callable[[Pipeline], Any], key: str) -> Any:
        """Run ``body``, which reads, calls ``multi`` and writes, until nobody else touched ``key`` meanwhile."""
        while True:
            with self.redis.pipeline() as pipe:
                try:
                    pipe.watch(key)  # type: ignore[no-untyped-call]
                    result = body(pipe)
                    pipe.execute()
                except WatchError:
                    continue
                return result


def events_key(id: str) -> str:  # noqa: A002
    """Redis key of a job's event stream."""
    return _key("events", id)


def parse_event(number: str, fields: dict[str, str]) -> Event:
    """An event from a stream entry."""
    return Event.model_validate(
        {"id": int(number.partition("-")[0]), "type": fields["type"], "data": json.loads(fields["data"])}
    )


def _key(*parts: str) -> str:
    return PREFIX + ":".join(parts)


def _parsed(text: str | None) -> JobEntry | None:
    """A job's record; one that another version of the program wrote and this one cannot read is none."""
    try:
        return None if text is None else JobEntry.model_validate_json(text)
    except ValidationError:
        return None


def _memberships(job: Job) -> list[str]:
    """The sets that an active job belongs to."""
    sets = [_key("active"), _key("render", job.digest)]
    if job.context_digest is not None:
        sets.append(_key("waiting", job.context_digest))
    return sets


def _silent(info: WorkerInfo) -> bool:
    return time.time() - info.last_seen > WORKER_SILENT_SECONDS
