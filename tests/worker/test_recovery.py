"""What a farm survives: killed children, killed workers, scenes that kill every renderer."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from elps_core.estimate.film import Accumulation
from elps_core.settings import RenderSettings, StopCriterion
from tests.worker.conftest import TINY, children, chunk_count, finished, wait_for
from tests.worker.test_jobs import GUIDED
from worker.farm import Farm
from worker.leases import Work
from worker.models import Job, SceneRecord
from worker.parts import Parts
from worker.run import start_process, stop_process
from worker.settings import FarmSettings
from worker.tasks import GIVEN_UP

Hire = Callable[[], subprocess.Popen[bytes]]

LONG = TINY.model_copy(update={"max_depth": 32})
STOP = StopCriterion(samples=8192)
CHUNKS = chunk_count(LONG, 8192)
LAST = CHUNKS - 1
"""A chunk of four million samples: long enough to be hit in the middle."""


def kill_child(worker: subprocess.Popen[bytes]) -> int:
    (child,) = children(worker.pid)
    os.kill(child, signal.SIGKILL)
    return child


def running(parts: Parts, kind: str, number: int) -> bool:
    return any(work.kind == kind and work.number == number for work in parts.board.running())


@cache
def undisturbed(upload: Path, settings: RenderSettings, chunks: int) -> Accumulation:
    """The same image, rendered here without any farm."""
    from elps_core import device

    device.use(settings.variant)
    from elps_core.renderer import Renderer
    from elps_core.scene.loader import load_scene

    assert settings.width is not None
    assert settings.height is not None
    renderer = Renderer(load_scene(upload, settings.variant, size=(settings.width, settings.height)), settings)
    image = Accumulation.empty(settings.width, settings.height)
    image.add_all(renderer.render_chunk(index) for index in range(chunks))
    return image


def check_image(farm: Farm, job: Job, expected: Accumulation) -> None:
    pixels = farm.pixels(job.id)
    assert pixels is not None
    assert job.samples_done == expected.spp
    np.testing.assert_allclose(pixels[1], expected.mean(), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(pixels[2], expected.standard_error(), rtol=1e-2, atol=1e-5)


def test_a_child_killed_in_the_middle_of_a_chunk(
    farm: Farm, parts: Parts, scene: SceneRecord, upload: Path, hire: Hire
) -> None:
    worker = hire()
    job = farm.submit(scene.digest, LONG, STOP)
    wait_for(lambda: running(parts, "chunk", LAST), 60)
    killed = kill_child(worker)
    ended = finished(farm, job.id)
    assert ended.state == "completed"
    assert children(worker.pid) != [killed]
    check_image(farm, ended, undisturbed(upload, LONG, CHUNKS))


def test_a_whole_worker_killed_in_the_middle_of_a_chunk(
    farm: Farm, parts: Parts, scene: SceneRecord, upload: Path, hire: Hire, temporary: Path
) -> None:
    workers = [hire(), hire()]
    names = {info.name: worker for info in farm.workers() for worker in workers if f"-{worker.pid}-" in info.name}
    job = farm.submit(scene.digest, LONG, STOP)
    wait_for(lambda: running(parts, "chunk", LAST), 60)
    held = [name for work, name in parts.board.running().items() if work.number == LAST]
    victim = names[held[0]]
    orphans = children(victim.pid)
    victim.kill()
    begin = time.monotonic()
    ended = finished(farm, job.id, 20)
    assert time.monotonic() - begin < 20
    assert ended.state == "completed"
    wait_for(lambda: not any(Path(f"/proc/{child}").exists() for child in orphans), 5)
    hire()
    assert len(list(temporary.glob("elps-*"))) == 2  # the next worker removes what the killed one left
    check_image(farm, ended, undisturbed(upload, LONG, CHUNKS))


def test_a_scene_that_kills_every_renderer_ends_in_failed(
    farm: Farm, parts: Parts, scene: SceneRecord, hire: Hire
) -> None:
    worker = hire()
    job = farm.submit(scene.digest, LONG, StopCriterion(samples=1))  # one chunk only
    record = f"elps:work:{Work('chunk', job.digest, 0).id}"
    for attempt in ("1", "2", "3"):
        wait_for(lambda attempt=attempt: parts.redis.hget(record, "attempts") == attempt, 30)  # type: ignore[misc]
        kill_child(worker)
    seen = finished(farm, job.id, 30)
    assert (seen.state, seen.message) == ("failed", GIVEN_UP)
    wait_for(lambda: not parts.board.in_flight(), 5)
    after = finished(farm, farm.submit(scene.digest, TINY, StopCriterion(samples=1)).id)
    assert after.state == "completed"


def test_a_context_goes_on_where_its_builder_was_killed(
    farm: Farm, parts: Parts, scene: SceneRecord, hire: Hire
) -> None:
    worker = hire()
    job = farm.submit(scene.digest, GUIDED, StopCriterion(samples=256))
    wait_for(lambda: any(work.kind == "context" and work.number >= 3 for work in parts.board.in_flight()), 60)
    kill_child(worker)
    ended = finished(farm, job.id)
    assert ended.state == "completed"
    progress = [event.data["progress"] for event in farm.events(job.id) if event.type == "context"]
    assert progress == sorted(progress)
    record = farm.context(job.context_digest or "")
    assert record is not None
    assert record.state == "ready"


def test_a_late_duplicate_of_a_chunk_changes_nothing(farm: Farm, parts: Parts, scene: SceneRecord, hire: Hire) -> None:
    hire()
    job = finished(farm, farm.submit(scene.digest, TINY, StopCriterion(samples=1024)).id)
    stored = parts.store.get(parts.store.keys("chunks")[0])
    for _ in range(3):  # messages that come again, for work that is done
        parts.queue.app.send_task("elps.chunk", args=[job.digest, 0], queue="elps.llvm")
        parts.queue.settle(job)
    time.sleep(1.5)
    assert farm.job(job.id) == job
    assert parts.store.get(parts.store.keys("chunks")[0]) == stored
    assert parts.board.in_flight() == frozenset()


def test_work_whose_message_was_lost_is_sent_again(farm: Farm, parts: Parts, scene: SceneRecord, hire: Hire) -> None:
    job = farm.submit(scene.digest, TINY, StopCriterion(samples=1))
    parts.redis.delete(*parts.redis.keys("elps.llvm*"))  # type: ignore[union-attr]
    hire()
    assert finished(farm, job.id, 30).state == "completed"


def test_sigterm_finishes_the_chunk_and_leaves_nothing(
    farm: Farm, parts: Parts, scene: SceneRecord, hire: Hire, temporary: Path
) -> None:
    worker = hire()
    job = farm.submit(scene.digest, LONG, StopCriterion(samples=2**20))
    wait_for(lambda: running(parts, "chunk", LAST), 60)
    family = children(worker.pid)
    stop_process(worker)
    assert worker.returncode == 0
    assert not any(Path(f"/proc/{child}").exists() for child in family)
    assert Work("chunk", job.digest, LAST) not in parts.board.in_flight()
    assert parts.board.running() == {}
    assert farm.workers() == []
    assert list(temporary.iterdir()) == []
    seen = farm.job(job.id)
    assert seen is not None
    assert seen.chunks_done >= CHUNKS
    farm.cancel(job.id)


def test_a_renderer_that_hangs_is_given_up(farm: Farm, scene: SceneRecord, settings: FarmSettings) -> None:
    """A chunk that takes longer than a worker's patience looks the same."""
    worker = start_process(settings.model_copy(update={"stall_seconds": 0.5, "lease_seconds": 1.0}))
    large = RenderSettings(integrator="mi_path", width=2560, height=2560, max_depth=64)
    ended = finished(farm, farm.submit(scene.digest, large, StopCriterion(samples=1)).id, 40)
    stop_process(worker)
    assert (ended.state, ended.message) == ("failed", GIVEN_UP)
