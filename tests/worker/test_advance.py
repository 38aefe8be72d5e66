"""What a job needs next, decided without Redis and without a clock."""

from __future__ import annotations

from typing import Any

import pytest

from elps_core.estimate.schedule import MEANTIME, chunk_spp
from elps_core.selection.candidates import CANDIDATES
from elps_core.settings import RenderSettings, StopCriterion
from worker.advance import Decision, decide, eta_seconds, mergeable, publish_due, worth_starting
from worker.models import Job
from worker.settle import schedule
from worker.state import JobEntry

NONE: frozenset[int] = frozenset()


def entry(stop: StopCriterion, merged: tuple[int, ...] = (), sample_seconds: float = 0.0, **fields: Any) -> JobEntry:
    job = Job(
        id="j",
        revision=1,
        scene="sha256:0",
        stop=stop,
        created=0.0,
        width=8,
        height=8,
        digest="sha256:1",
        **{
            "settings": RenderSettings(integrator="bdpt"),
            "state": "rendering",
            "started": 0.0,
            "samples_done": sum(spp(i) for i in merged),
            **fields,
        },
    )
    return JobEntry(job=job, merged=merged, sample_seconds=sample_seconds)


def spp(index: int) -> int:
    return (1, 1, 2, 4)[min(index % MEANTIME, 3)]


def decided(
    job: JobEntry,
    context: Any = None,
    done: frozenset[int] = NONE,
    flying: frozenset[int] = NONE,
    window: int = 3,
    now: float = 1.0,
) -> Decision:
    return decide(job, context, done, flying, window, now, spp)


def test_a_job_without_a_limit_of_time_prepares_for_a_quarter_of_what_has_passed() -> None:
    auto = RenderSettings(integrator="auto")
    job = entry(StopCriterion(samples=64), merged=(MEANTIME,), settings=auto)
    there = frozenset({MEANTIME})

    def at(now: float, prepared: float, flying: frozenset[int] = NONE) -> Decision:
        return decide(job, "missing", there, flying, 2, now, spp, prepared)

    assert at(8.0, 2.0) == Decision(build_context=True)
    assert at(7.9, 2.0) == Decision(start=(MEANTIME + 1,))
    assert at(7.9, 2.0, frozenset({MEANTIME + 1})) == Decision()
    timed = entry(StopCriterion(samples=64, seconds=60.0), merged=(MEANTIME,), settings=auto)
    assert decide(timed, "missing", there, NONE, 2, 7.9, spp, 2.0).build_context
    enough = entry(StopCriterion(samples=2), merged=(MEANTIME, MEANTIME + 1), settings=auto)
    assert decide(enough, "missing", there, NONE, 2, 7.9, spp, 2.0).finish


@pytest.mark.parametrize("name", CANDIDATES)
def test_chunks_are_as_large_as_those_of_what_trials_have_chosen(name: str) -> None:
    named = CANDIDATES[name].settings(RenderSettings())
    auto = {"settings": RenderSettings(integrator="auto"), "width": 256, "height": 256}
    chosen = schedule(entry(StopCriterion(seconds=9.0)).job.model_copy(update=auto), {"name": name})
    assert [chosen(index) for index in range(20)] == [chunk_spp(index, named, (256, 256)) for index in range(20)]


def test_a_new_job_fills_its_window() -> None:
    assert decided(entry(StopCriterion(samples=100))) == Decision(start=(0, 1, 2))


def test_samples_bound_what_is_started() -> None:
    assert decided(entry(StopCriterion(samples=2)), window=9) == Decision(start=(0, 1))
    assert decided(entry(StopCriterion(samples=3)), window=9) == Decision(start=(0, 1, 2))


def test_each_commit_releases_the_next() -> None:
    job = entry(StopCriterion(samples=100), merged=(0,))
    assert decided(job, done=frozenset({0}), flying=frozenset({1, 2})) == Decision(start=(3,))
    assert decided(job, done=frozenset({0}), flying=frozenset({1, 2, 3})) == Decision()


def test_a_lost_chunk_is_started_before_later_ones() -> None:
    job = entry(StopCriterion(samples=100), merged=(0, 2))
    assert decided(job, done=frozenset({0, 2}), window=1) == Decision(start=(1,))


def test_a_context_comes_first() -> None:
    job = entry(StopCriterion(samples=4), state="queued")
    assert decided(job, "missing") == Decision(build_context=True)
    assert decided(job, "failed") == Decision(build_context=True)
    assert decided(job, "building") == Decision()
    assert decided(job, "ready").start == (0, 1, 2)


def test_there_is_a_picture_before_there_is_a_context() -> None:
    """By the plain way of auto; more of it only by workers that have nothing else to do."""
    job = entry(StopCriterion(seconds=60), state="queued", settings=RenderSettings())
    assert decided(job, "missing", window=2) == Decision(build_context=True, start=(MEANTIME,))
    assert decided(job, "building", window=2, flying=frozenset({MEANTIME})) == Decision()
    shown = job.model_copy(update={"merged": (MEANTIME,)})
    assert decided(shown, "building", window=2, done=frozenset({MEANTIME})) == Decision()
    assert decided(shown, "building", window=4, done=frozenset({MEANTIME})) == Decision(
        start=(MEANTIME + 1, MEANTIME + 2)
    )
    assert decided(shown, "ready", window=2, done=frozenset({MEANTIME})) == Decision(start=(0, 1))
    assert decided(shown, "building", window=2, done=frozenset({MEANTIME}), now=60.0).finish


def test_samples_before_the_context_are_merged_and_not_counted() -> None:
    auto = RenderSettings()
    job = entry(StopCriterion(samples=4), merged=(MEANTIME, 0, 1), settings=auto)
    assert mergeable(entry(StopCriterion(samples=4), settings=auto), {MEANTIME, 0, 5}, spp) == [0, MEANTIME]
    assert decided(job, "ready", done=frozenset({MEANTIME, 0, 1})) == Decision(start=(2,))
    assert decided(
        job.model_copy(update={"merged": (MEANTIME, 0, 1, 2)}), "ready", done=frozenset({MEANTIME, 0, 1, 2})
    ).finish


def test_enough_samples_finish() -> None:
    stop = StopCriterion(samples=4)
    assert decided(entry(stop, merged=(0, 1, 2)), done=frozenset({0, 1, 2})) == Decision(finish=True)
    assert not decided(entry(stop, merged=(0, 1)), done=frozenset({0, 1})).finish


def test_a_small_error_finishes() -> None:
    stop = StopCriterion(error=0.1)
    assert decided(entry(stop, merged=(0, 1, 2, 3), relative_error=0.1)).finish
    assert not decided(entry(stop, merged=(0, 1, 2, 3), relative_error=0.11)).finish
    assert not decided(entry(stop, merged=(0,), relative_error=None)).finish


def test_an_error_that_few_chunks_claim_is_not_believed() -> None:
    stop = StopCriterion(error=0.1)
    assert not decided(entry(stop, merged=(0, 1), relative_error=0.01)).finish


def test_time_finishes_but_never_without_an_image() -> None:
    stop = StopCriterion(seconds=10)
    assert decided(entry(stop, merged=(0,)), now=10.0).finish
    assert decided(entry(stop), now=99.0) == Decision(start=(0, 1, 2))


def test_no_chunk_starts_that_would_mostly_be_late() -> None:
    job = entry(StopCriterion(seconds=10), merged=(0, 1), sample_seconds=1.0)
    assert worth_starting(job, 4, 7.9)
    assert not worth_starting(job, 4, 8.1)
    done = frozenset({0, 1})
    # Chunk 2 has two samples: it fits until 9.0, chunk 3 with four until 8.0.
    assert decided(job, done=done, now=8.5) == Decision(start=(2,))
    assert decided(job, done=done, now=9.5) == Decision(finish=True)
    assert decided(job, done=done, now=9.5, flying=frozenset({2})) == Decision()


@pytest.mark.parametrize("state", ["completed", "cancelled", "failed"])
def test_a_final_job_needs_nothing(state: Any) -> None:
    assert decided(entry(StopCriterion(samples=4), state=state)) == Decision()


def test_samples_merge_the_first_chunks_and_no_others() -> None:
    job = entry(StopCriterion(samples=4), merged=(0,))
    assert mergeable(job, {0, 2, 3, 7}, spp) == [2]
    assert mergeable(job, {0, 1, 2}, spp) == [1, 2]
    assert mergeable(entry(StopCriterion(seconds=4)), {3, 0, 7}, spp) == [0, 3, 7]


def test_publishing_first_then_every_few_seconds_then_each_doubling() -> None:
    def due(samples: int, shown: int, at: float, now: float, **fields: Any) -> bool:
        job = entry(StopCriterion(samples=9999), samples_done=samples, **fields)
        return publish_due(job.model_copy(update={"image_samples": shown, "image_time": at}), now, 3.0)

    assert due(1, 0, 0.0, 0.1)
    assert not due(2, 1, 1.0, 3.9)
    assert due(2, 1, 1.0, 4.1)
    assert not due(150, 100, 90.0, 100.0)
    assert due(200, 100, 90.0, 100.0)
    assert due(101, 100, 99.9, 100.0, state="cancelled")
    assert not due(100, 100, 0.0, 100.0, state="cancelled")


def test_eta_is_that_of_the_first_limit() -> None:
    assert eta_seconds(entry(StopCriterion(samples=8), merged=(0, 1, 2)), 6.0) == pytest.approx(6.0)
    assert eta_seconds(entry(StopCriterion(samples=8, seconds=7), merged=(0, 1, 2)), 6.0) == pytest.approx(1.0)
    quarter = entry(StopCriterion(error=0.1), merged=(0, 1), relative_error=0.2)
    assert eta_seconds(quarter, 5.0) == pytest.approx(15.0)
    assert eta_seconds(entry(StopCriterion(samples=8)), 6.0) is None
    hopeless = StopCriterion(error=5e-324)
    assert eta_seconds(entry(hopeless, merged=(0, 1, 2), relative_error=0.2), 5.0) is None


def test_a_black_image_ends_though_it_has_no_error() -> None:
    stop = StopCriterion(error=0.1)
    assert not decided(entry(stop, merged=tuple(range(4)), relative_error=None)).finish
    assert decided(entry(stop, merged=tuple(range(8)), relative_error=None)).finish
