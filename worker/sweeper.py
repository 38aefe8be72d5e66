"""What each worker's main process does beside Celery: tell that it lives, and find what others lost.

It holds no store and no renderer: the process forks, and their threads would not survive that.
"""

from __future__ import annotations

import threading
import time

import structlog
from redis.exceptions import RedisError

from worker.errors import FarmUnavailable
from worker.models import WorkerInfo
from worker.parts import Parts
from worker.queue import is_empty
from worker.state import PREFIX

log = structlog.get_logger()

HEARTBEAT_SECONDS = 2.0
FORGOTTEN_SECONDS = 10.0
"""An offer that lies this long while the queue is empty lost its message with a worker that died."""
STUCK_SECONDS = 5.0
"""A job that has nothing in flight and did not change for this long is looked at again."""
_LOCK = PREFIX + "sweeper"
_BORN = PREFIX + "born"


class Sweeper(threading.Thread):
    """A thread that keeps a worker's heartbeat, and sweeps where no other worker does."""

    def __init__(self, parts: Parts, info: WorkerInfo) -> None:
        super().__init__(name="sweeper", daemon=True)
        self._parts = parts
        self._info = info
        self._stop_asked = threading.Event()
        self._poked: dict[str, float] = {}

    def run(self) -> None:
        """Sweep until :meth:`stop`; an outage of Redis is waited out."""
        heard = 0.0
        while not self._stop_asked.wait(self._parts.settings.sweep_seconds):
            try:
                if time.monotonic() - heard > HEARTBEAT_SECONDS:
                    self._parts.state.heartbeat(self._info.model_copy(update={"last_seen": time.time()}))
                    heard = time.monotonic()
                milliseconds = int(1000 * self._parts.settings.sweep_seconds)
                if self._parts.redis.set(_LOCK, self._info.name, nx=True, px=milliseconds):
                    self.sweep()
            except (RedisError, FarmUnavailable) as error:
                log.warning("sweep interrupted", reason=type(error).__name__)
            except Exception:  # the thread must live as long as the worker: without it nothing is recovered
                log.exception("sweep failed")

    def stop(self) -> None:
        """End the thread and take the worker off the list."""
        self._stop_asked.set()
        self.join()
        try:
            self._parts.state.farewell(self._info.name)
        except RedisError:
            log.warning("farewell not delivered")

    def sweep(self) -> None:
        """Send again what was lost, and poke jobs that stand still though nothing is in flight for them."""
        parts = self._parts
        if parts.redis.set(_BORN, str(time.time()), nx=True):
            parts.queue.rebuild(parts.settings.device)
        empty = is_empty(parts.redis, parts.settings.device)
        for offer in parts.board.reclaim(FORGOTTEN_SECONDS if empty else None):
            log.warning("work offered again", work=offer.work.id)
            parts.queue.send(offer)
        at_work = {(work.kind, work.digest) for work in parts.board.in_flight()}
        now = time.time()
        poked = {}
        for entry in parts.state.active():
            job = entry.job
            moving = ("chunk", job.digest) in at_work or ("context", job.context_digest) in at_work
            last = max(entry.touched, self._poked.get(job.id, 0.0))
            poked[job.id] = last
            if not moving and now - last > STUCK_SECONDS:
                poked[job.id] = now
                parts.queue.settle(job)
        self._poked = poked
