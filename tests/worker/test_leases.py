"""Work in flight on a real server."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from worker.leases import Board, Offer, Work, kept
from worker.parts import Parts

WORK = Work("chunk", "sha256:1", 3)
OFFER = Offer(WORK, "elps.llvm", 6)


@pytest.fixture
def board(parts: Parts) -> Board:
    return parts.board


def test_work_is_named_both_ways() -> None:
    assert Work.parse(WORK.id) == WORK
    assert Work.parse("context/sha256:2/0") == Work("context", "sha256:2", 0)


def test_work_is_offered_once(board: Board) -> None:
    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(lambda _: board.offer(OFFER), range(8))).count(True) == 1
    assert board.in_flight() == {WORK}


def test_one_of_many_starts_it(board: Board) -> None:
    board.offer(OFFER)
    with ThreadPoolExecutor(8) as pool:
        leases = list(pool.map(lambda number: board.start(WORK, f"worker {number}", 5.0), range(8)))
    assert sum(lease is not None for lease in leases) == 1
    assert list(board.running()) == [WORK]


def test_finished_work_cannot_be_started(board: Board) -> None:
    board.offer(OFFER)
    lease = board.start(WORK, "a", 5.0)
    assert lease is not None
    assert board.finish(lease)
    assert not board.finish(lease)
    assert board.start(WORK, "b", 5.0) is None
    assert board.in_flight() == frozenset()


def test_a_workers_new_child_takes_over_at_once_and_the_old_token_is_void(board: Board) -> None:
    board.offer(OFFER)
    old = board.start(WORK, "a", 60.0)
    new = board.start(WORK, "a", 60.0)
    assert old is not None
    assert new is not None
    assert (old.attempts, new.attempts) == (1, 2)
    assert int(new.token) > int(old.token)
    assert not board.renew(old, 60.0)
    assert not board.release(old)
    assert not board.finish(old)
    assert board.in_flight() == {WORK}
    assert board.finish(new)


def test_an_expired_lease_is_offered_again_with_its_attempts(board: Board) -> None:
    board.offer(OFFER)
    lease = board.start(WORK, "lost", 0.1)
    assert lease is not None
    assert board.reclaim(None) == []
    time.sleep(0.15)
    assert board.reclaim(None) == [OFFER]
    assert board.reclaim(None) == []
    assert not board.finish(lease)
    again = board.start(WORK, "b", 5.0)
    assert again is not None
    assert again.attempts == 2


def test_a_forgotten_offer_is_found_only_when_asked(board: Board) -> None:
    board.offer(OFFER)
    time.sleep(0.15)
    assert board.reclaim(None) == []
    assert board.reclaim(5.0) == []
    assert board.reclaim(0.1) == [OFFER]


def test_released_work_can_be_started_by_anyone(board: Board) -> None:
    board.offer(OFFER)
    lease = board.start(WORK, "a", 60.0)
    assert lease is not None
    assert board.release(lease)
    again = board.start(WORK, "b", 60.0)
    assert again is not None
    assert again.attempts == 2


def test_a_kept_lease_outlives_its_seconds(board: Board) -> None:
    board.offer(OFFER)
    lease = board.start(WORK, "a", 0.3)
    assert lease is not None
    with kept(board, lease, 0.3, 60.0):
        time.sleep(0.7)
        assert board.start(WORK, "b", 0.3) is None
        assert board.reclaim(None) == []
    assert board.finish(lease)


def test_a_body_without_progress_loses_its_lease(board: Board) -> None:
    board.offer(OFFER)
    lease = board.start(WORK, "hangs", 0.2)
    assert lease is not None
    with kept(board, lease, 0.2, 0.4):
        time.sleep(0.9)
        assert board.reclaim(None) == [OFFER]
