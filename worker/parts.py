"""The connections that every part of a farm needs: Redis, the store, the queue."""

from __future__ import annotations

from functools import cached_property

from redis import Redis
from redis.backoff import ExponentialBackoff
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import TimeoutError as RedisTimeoutError
from redis.retry import Retry

from elps_core.errors import SettingsRejected
from worker.leases import Board, Work
from worker.models import Job
from worker.queue import Queue, offer_for
from worker.settings import FarmSettings
from worker.state import JobEntry, State
from worker.store import Store, name

REDIS_TIMEOUT_SECONDS = 5.0
"""An answer that takes longer is none."""
REDIS_RETRIES = 2


class Parts:
    """Connections of one process to one farm, opened when first used; not to be taken through a fork."""

    def __init__(self, settings: FarmSettings) -> None:
        if not settings.redis_url:
            raise SettingsRejected("no Redis given: set REDIS_URL, or use 'elps serve', which brings its own")
        if not settings.store_url:
            raise SettingsRejected("no artefact store given: set ELPS_STORE_URL to file:///folder or s3://bucket")
        self.settings = settings
        self.redis_url: str = settings.redis_url
        self.store_url: str = settings.store_url

    @cached_property
    def redis(self) -> Redis:
        """The client of the coordination server."""
        try:
            return Redis.from_url(
                self.redis_url,
                decode_responses=True,
                socket_timeout=REDIS_TIMEOUT_SECONDS,
                socket_connect_timeout=REDIS_TIMEOUT_SECONDS,
                retry=Retry(ExponentialBackoff(), REDIS_RETRIES, (RedisConnectionError, RedisTimeoutError)),
            )
        except ValueError:
            raise SettingsRejected("Redis URL: use redis://[:password@]host:port/db") from None

    @cached_property
    def store(self) -> Store:
        """The artefact store."""
        return Store(self.store_url)

    @cached_property
    def state(self) -> State:
        """Jobs and contexts."""
        return State(self.redis)

    @cached_property
    def board(self) -> Board:
        """Work in flight."""
        return Board(self.redis)

    @cached_property
    def queue(self) -> Queue:
        """The way to the workers."""
        return Queue(self.redis_url)

    def offer(self, job: Job, work: Work) -> bool:
        """Put a piece of work that ``job`` needs on the board and tell the workers; False where it was there."""
        offer = offer_for(job, work)
        if not self.board.offer(offer):
            return False
        self.queue.send(offer)
        return True

    def record(self, entry: JobEntry) -> None:
        """Keep a job's record in the store, from where it comes back if Redis loses it."""
        self.store.put(f"jobs/{entry.job.id}/{entry.job.revision}", entry.model_dump_json().encode())

    def list_chunks(self, render: str) -> None:
        """Take note of the chunks of a render digest that the store holds already."""
        self.state.add_done(render, [int(key.rpartition("/")[2]) for key in self.store.keys(f"chunks/{name(render)}")])

    def close(self) -> None:
        """Give the connections back."""
        if "redis" in self.__dict__:
            self.redis.close()
        if "queue" in self.__dict__:
            self.queue.close()
