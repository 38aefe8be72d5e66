"""Records of jobs and contexts on a real server."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from redis.exceptions import RedisError

from elps_core.settings import RenderSettings, StopCriterion
from worker import state as records
from worker.models import ContextRecord, Job, WorkerInfo
from worker.parts import Parts
from worker.state import Change, JobEntry, State, missing_context, update


def make(id: str = "a", created: float = 1.0) -> JobEntry:  # noqa: A002
    job = Job(
        id=id,
        revision=1,
        state="queued",
        scene="sha256:0",
        settings=RenderSettings(),
        stop=StopCriterion(samples=1),
        created=created,
        width=8,
        height=8,
        digest="sha256:1",
        context_digest="sha256:2",
    )
    return JobEntry(job=job)


@pytest.fixture
def state(parts: Parts) -> State:
    return parts.state


def test_a_new_job_is_there_once_with_its_first_event(state: State) -> None:
    assert state.create(make())
    assert not state.create(make())
    assert [(event.id, event.type, event.data["state"]) for event in state.events("a", 0)] == [(1, "state", "queued")]
    assert [entry.job.id for entry in state.active()] == ["a"]
    assert [entry.job.id for entry in state.of_render("sha256:1")] == ["a"]
    assert [entry.job.id for entry in state.waiting("sha256:2")] == ["a"]


def test_newest_first(state: State) -> None:
    for number, id in enumerate("abc"):  # noqa: A001
        state.create(make(id, created=float(number)))
    assert [entry.job.id for entry in state.newest(2)] == ["c", "b"]


def test_states_follow_one_another_and_count_revisions(state: State) -> None:
    state.create(make())
    entry = state.enter("a", "preparing")
    assert entry is not None
    assert entry.job.revision == 2
    assert entry.job.started is not None
    rendering = state.enter("a", "rendering")
    assert rendering is not None
    assert rendering.job.started == entry.job.started
    assert state.enter("a", "preparing") == rendering  # no way back
    ended = state.enter("a", "failed", "why")
    assert ended is not None
    assert (ended.job.state, ended.job.message) == ("failed", "why")
    assert ended.job.finished is not None
    assert [event.id for event in state.events("a", 0)] == [1, 2, 3, 4]


@pytest.mark.parametrize("final", ["completed", "cancelled", "failed"])
def test_a_final_state_stays(state: State, final: records.JobState) -> None:
    state.create(make())
    ended = state.enter("a", final)
    for other in ("queued", "preparing", "rendering", "completed", "cancelled", "failed"):
        assert state.enter("a", other) == ended
    assert state.active() == []
    assert state.of_render("sha256:1") == []
    assert state.waiting("sha256:2") == []


def test_changes_at_once_are_all_counted(state: State) -> None:
    state.create(make())

    def count(_: int) -> None:
        state.change(
            "a", lambda entry: Change(update(entry, samples_done=entry.job.samples_done + 1), (("progress", {}),))
        )

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(count, range(80)))
    entry = state.entry("a")
    assert entry is not None
    assert entry.job.samples_done == 80
    assert entry.job.revision == 81
    assert [event.id for event in state.events("a", 0)] == list(range(1, 82))
    assert [event.id for event in state.events("a", 79)] == [80, 81]


def test_old_events_are_trimmed(state: State, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(records, "EVENTS_KEPT", 5)
    state.create(make())
    for _ in range(9):
        state.change("a", lambda entry: Change(entry, (("progress", {}),)))
    assert [event.id for event in state.events("a", 0)] == [6, 7, 8, 9, 10]


def test_an_unknown_job_is_none(state: State) -> None:
    assert state.entry("nobody") is None
    assert state.enter("nobody", "cancelled") is None
    assert state.entry("nobody") is None
    assert state.events("nobody", 0) == []


def test_a_context_tells_those_that_wait(state: State) -> None:
    entry = make()
    state.create(entry)
    state.set_context(missing_context(entry.job))
    record = state.context("sha256:2")
    assert isinstance(record, ContextRecord)
    state.set_context(record.model_copy(update={"state": "ready", "progress": 1.0, "seconds": 2.5}))
    seen = state.entry("a")
    assert seen is not None
    assert (seen.job.context_state, seen.job.context_progress, seen.job.seconds_context) == ("ready", 1.0, 2.5)
    assert state.events("a", 0)[-1].data == {"state": "ready", "progress": 1.0}


def test_a_job_is_merged_by_one_at_a_time(state: State) -> None:
    with state.job_lock("a", "first") as first:
        with state.job_lock("a", "second") as second:
            assert (first, second) == (True, False)
        with state.job_lock("a", "first") as successor:  # the worker's new child, after the old one died
            assert successor
    with state.job_lock("a", "second") as later:
        assert later


def test_workers_that_fall_silent_are_forgotten(state: State) -> None:
    def info(name: str, last_seen: float) -> WorkerInfo:
        return WorkerInfo(name=name, device="llvm", variants=[], busy=False, last_seen=last_seen)

    now = time.time()
    state.heartbeat(info("old", now - records.WORKER_SILENT_SECONDS - 1))
    state.heartbeat(info("new", now))
    assert [worker.name for worker in state.workers()] == ["new"]
    state.farewell("new")
    assert state.workers() == []


def test_a_broken_change_leaves_no_trace(state: State) -> None:
    state.create(make())

    def broken(entry: JobEntry) -> Change:
        raise RedisError

    with pytest.raises(RedisError):
        state.change("a", broken)
    entry = state.entry("a")
    assert entry is not None
    assert entry.job.revision == 1


def test_a_record_of_another_version_is_left_out(state: State, parts: Parts) -> None:
    state.create(make("a"))
    state.create(make("b"))
    parts.redis.set("elps:job:a", '{"job": {"id": "a", "a field that is gone": 1}}')
    assert [entry.job.id for entry in state.newest(9)] == ["b"]
    assert state.entry("a") is None
    assert state.enter("a", "cancelled") is None
