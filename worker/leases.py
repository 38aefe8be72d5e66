"""Work in flight: who holds which piece, for how long, and how often it was tried.

A piece of work is a chunk to render or a step of a context to build. A message in the queue is
only a hint that a piece is on offer; the truth is one hash per piece in Redis, changed by Lua
scripts on the server's clock. A piece is *offered* until a worker starts it, then *running* under
a lease. Each start draws a higher token; finishing needs the token of the latest start, so whoever
lost the lease changes nothing. Attempts are counted at the start: a scene that kills its renderer
cannot forget them.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, NamedTuple, cast

from redis import Redis
from redis.exceptions import RedisError

from worker.state import PREFIX

_ALL = PREFIX + "work"
_TOKEN = PREFIX + "token"
_CLOCK = "local t = redis.call('TIME'); local now = t[1] + t[2] / 1e6; "

_OFFER = (
    _CLOCK
    + """
if redis.call('EXISTS', KEYS[1]) == 1 then return 0 end
redis.call('HSET', KEYS[1], 'state', 'offered', 'at', now, 'attempts', 0, 'queue', ARGV[2], 'priority', ARGV[3])
redis.call('SADD', KEYS[2], ARGV[1])
return 1"""
)
_START = (
    _CLOCK
    + """
local w = redis.call('HMGET', KEYS[1], 'state', 'until', 'worker', 'attempts')
if not w[1] then return nil end
if w[1] == 'running' and tonumber(w[2]) > now and w[3] ~= ARGV[1] then return nil end
local token = redis.call('INCR', KEYS[2])
local attempts = tonumber(w[4]) + 1
redis.call('HSET', KEYS[1], 'state', 'running', 'at', now, 'until', now + ARGV[2], 'worker', ARGV[1],
           'token', token, 'attempts', attempts)
return {token, attempts}"""
)
_RENEW = (
    _CLOCK
    + """
if redis.call('HGET', KEYS[1], 'token') ~= ARGV[1] then return 0 end
if redis.call('HGET', KEYS[1], 'state') ~= 'running' then return 0 end
redis.call('HSET', KEYS[1], 'until', now + ARGV[2])
return 1"""
)
_FINISH = """
if redis.call('HGET', KEYS[1], 'token') ~= ARGV[1] then return 0 end
redis.call('DEL', KEYS[1])
redis.call('SREM', KEYS[2], ARGV[2])
return 1"""
_RELEASE = (
    _CLOCK
    + """
if redis.call('HGET', KEYS[1], 'token') ~= ARGV[1] then return 0 end
redis.call('HSET', KEYS[1], 'state', 'offered', 'at', now, 'token', '')
return 1"""
)
_RECLAIM = (
    _CLOCK
    + """
local w = redis.call('HMGET', KEYS[1], 'state', 'until', 'at')
local expired = w[1] == 'running' and tonumber(w[2]) < now
local forgotten = w[1] == 'offered' and ARGV[1] ~= '' and tonumber(w[3]) + ARGV[1] < now
if not (expired or forgotten) then return 0 end
redis.call('HSET', KEYS[1], 'state', 'offered', 'at', now, 'token', '')
return 1"""
)


class Work(NamedTuple):
    """A piece of work: chunk ``number`` of a render digest, or the step after ``number`` of a context digest."""

    kind: Literal["chunk", "context"]
    digest: str
    number: int

    @property
    def id(self) -> str:
        """The piece as one word."""
        return f"{self.kind}/{self.digest}/{self.number}"

    @classmethod
    def parse(cls, id: str) -> Work:  # noqa: A002
        """The piece that :attr:`id` names."""
        kind, digest, number = id.split("/")
        return cls("chunk" if kind == "chunk" else "context", digest, int(number))


class Lease(NamedTuple):
    """The right to finish a piece of work."""

    work: Work
    token: str
    attempts: int
    """How often the piece was started, this time included."""


class Offer(NamedTuple):
    """How a piece of work is sent: the queue of its device class, and the priority there."""

    work: Work
    queue: str
    priority: int


class Board:
    """All work in flight on one farm. ``redis`` must decode its responses."""

    def __init__(self, redis: Redis) -> None:
        self._redis = redis
        self._offer, self._start, self._renew, self._finish, self._release, self._reclaim = (
            redis.register_script(script) for script in (_OFFER, _START, _RENEW, _FINISH, _RELEASE, _RECLAIM)
        )

    def offer(self, offer: Offer) -> bool:
        """Put a piece on the board; False where it is there already, offered or running."""
        work = offer.work
        return bool(self._offer(keys=[_key(work), _ALL], args=[work.id, offer.queue, offer.priority]))

    def start(self, work: Work, worker: str, seconds: float) -> Lease | None:
        """Take a piece for ``seconds``; None where it is gone or another worker holds it.

        A worker does one piece at a time, so a lease in its own name belongs to a child of it that
        died: it is taken over at once.
        """
        reply = self._start(keys=[_key(work), _TOKEN], args=[worker, seconds])
        return None if reply is None else Lease(work, str(reply[0]), int(reply[1]))

    def renew(self, lease: Lease, seconds: float) -> bool:
        """Hold on for ``seconds`` from now; False where the lease is lost."""
        return bool(self._renew(keys=[_key(lease.work)], args=[lease.token, seconds]))

    def finish(self, lease: Lease) -> bool:
        """Take the piece off the board; False, and nothing happens, where the lease is lost."""
        return bool(self._finish(keys=[_key(lease.work), _ALL], args=[lease.token, lease.work.id]))

    def release(self, lease: Lease) -> bool:
        """Offer the piece again, its attempts kept; False where the lease is lost. Send it again then."""
        return bool(self._release(keys=[_key(lease.work)], args=[lease.token]))

    def in_flight(self) -> frozenset[Work]:
        """Every piece on the board."""
        return frozenset(Work.parse(id) for id in cast("set[str]", self._redis.smembers(_ALL)))  # noqa: A001

    def running(self) -> dict[Work, str]:
        """Pieces that a worker holds, and the worker's name."""
        found = {work: self._redis.hmget(_key(work), ["state", "worker"]) for work in self.in_flight()}
        return {work: str(worker) for work, (state, worker) in found.items() if state == "running"}

    def reclaim(self, forgotten_after: float | None) -> list[Offer]:
        """Offer anew what a lost worker held; the caller sends the result.

        ``forgotten_after``: seconds after which an offer that nobody took counts as lost too; give
        it only where the queue is empty, else None.
        """
        lost = []
        for work in self.in_flight():
            if self._reclaim(keys=[_key(work)], args=["" if forgotten_after is None else forgotten_after]):
                queue, priority = self._redis.hmget(_key(work), ["queue", "priority"])
                lost.append(Offer(work, str(queue), int(str(priority))))
        return lost


@contextmanager
def kept(board: Board, lease: Lease, seconds: float, stall_seconds: float) -> Iterator[None]:
    """Renew ``lease`` from a thread while the body runs, for ``stall_seconds`` at most.

    The bound ties the lease to progress: the body is one chunk or one step, and one that hangs
    must not hold its piece for ever.
    """
    stop = threading.Event()

    def renew() -> None:
        for _ in range(int(3 * stall_seconds / seconds)):
            if stop.wait(seconds / 3):
                return
            try:
                if not board.renew(lease, seconds):
                    return
            except RedisError:  # an outage shorter than the lease costs nothing
                continue

    thread = threading.Thread(target=renew, name="lease", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def _key(work: Work) -> str:
    return f"{_ALL}:{work.id}"
