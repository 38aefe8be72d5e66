"""Which piece of work comes first."""

from __future__ import annotations

from elps_core.estimate.schedule import MEANTIME
from elps_core.settings import StopCriterion
from tests.worker.test_advance import entry
from worker.leases import Work
from worker.queue import offer_for


def test_a_first_picture_waits_for_no_step_of_a_context() -> None:
    """One worker takes what was offered first of equal priority: the picture, which is offered before the context."""
    job = entry(StopCriterion(seconds=60.0)).job
    first, context, later = (
        offer_for(job, work).priority
        for work in (Work("chunk", "a", MEANTIME), Work("context", "b", 0), Work("chunk", "a", MEANTIME + 1))
    )
    assert first == context < later
