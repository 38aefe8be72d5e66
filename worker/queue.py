"""The queue: Celery on Redis, set so that what a worker dies with comes back.

Messages carry digests, numbers and ids as JSON, never objects, and are hints only: what there is to
do stands in Redis (:mod:`worker.leases`), so a message that comes twice or late does no harm.
"""

from __future__ import annotations

from celery import Celery
from kombu.exceptions import OperationalError
from redis import Redis

from elps_core.estimate.schedule import MEANTIME
from worker.errors import FarmUnavailable
from worker.leases import Offer, Work
from worker.models import Job
from worker.settings import DeviceClass

PRIORITIES = [0, 3, 6, 9]
"""The lists that one queue has in Redis, the first served first."""
SETTLE, FIRST, NORMAL, LOW = PRIORITIES
"""Merging takes no time and frees work; first images come before later ones; then by the job's priority."""
VISIBILITY_SECONDS = 1200
"""When Celery itself sends an unacknowledged message again; four times the longest task (``stall_seconds``)."""
PUBLISH_RETRIES = {"max_retries": 3, "interval_start": 0.0, "interval_step": 0.2, "interval_max": 0.5}
"""A request waits for a lost connection for about a second."""


def queue_name(device: DeviceClass) -> str:
    """The queue that workers with this kind of device take from."""
    return f"elps.{device}"


def queue_of(job: Job) -> str:
    """The queue of the device class that a job's variant needs."""
    return queue_name("cuda" if job.settings.variant.startswith("cuda") else "llvm")


def offer_for(job: Job, work: Work) -> Offer:
    """How a piece of work that ``job`` asks for is to be sent."""
    if work.number in (0, MEANTIME) or work.kind == "context" or job.priority > 0:
        return Offer(work, queue_of(job), FIRST)
    return Offer(work, queue_of(job), NORMAL if job.priority == 0 else LOW)


def make_app(redis_url: str) -> Celery:
    """The Celery application of a farm; workers add the tasks (:mod:`worker.tasks`)."""
    app = Celery("elps", broker=redis_url, set_as_current=False)
    app.conf.update(
        accept_content=["json"],
        task_serializer="json",
        result_backend=None,
        task_ignore_result=True,
        task_acks_late=True,
        task_reject_on_worker_lost=True,
        worker_prefetch_multiplier=1,
        worker_concurrency=1,
        broker_transport_options={
            "visibility_timeout": VISIBILITY_SECONDS,
            "priority_steps": PRIORITIES,
            "queue_order_strategy": "priority",
        },
        broker_connection_retry_on_startup=True,
        task_default_queue=queue_name("llvm"),
        worker_enable_remote_control=False,
        worker_hijack_root_logger=False,
    )
    return app


class Queue:
    """Sends messages; raises FarmUnavailable where Redis does not take them."""

    def __init__(self, redis_url: str) -> None:
        self.app = make_app(redis_url)

    def send(self, offer: Offer) -> None:
        """Tell the workers of a piece of work that is on offer."""
        self._send(f"elps.{offer.work.kind}", [offer.work.digest, offer.work.number], offer.queue, offer.priority)

    def settle(self, job: Job) -> None:
        """Have some worker merge what there is of a job, and decide what comes next."""
        self._send("elps.settle", [job.id], queue_of(job), SETTLE)

    def rebuild(self, device: DeviceClass) -> None:
        """Have some worker bring back from the store what Redis lost."""
        self._send("elps.rebuild", [], queue_name(device), SETTLE)

    def close(self) -> None:
        """Give the connections back."""
        self.app.close()

    def _send(self, task: str, args: list[str | int], queue: str, priority: int) -> None:
        try:
            self.app.send_task(task, args=args, queue=queue, priority=priority, retry_policy=PUBLISH_RETRIES)
        except OperationalError:
            raise FarmUnavailable("the queue does not answer: try again later") from None


def is_empty(redis: Redis, device: DeviceClass) -> bool:
    """Whether no message waits for workers with this kind of device."""
    names = [queue_name(device) + (f"\x06\x16{step}" if step else "") for step in PRIORITIES]
    return not any(redis.llen(name) for name in names)
