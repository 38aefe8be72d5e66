"""A real Valkey, real stores and real workers for the tests of the queue."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from elps_core.estimate.schedule import chunk_spp
from elps_core.scene.generate import write
from elps_core.scene.generate.maze import maze
from elps_core.settings import RenderSettings
from worker.embedded import EmbeddedServer
from worker.farm import Farm
from worker.models import FINAL_STATES, Job, SceneRecord
from worker.parts import Parts
from worker.run import start_process
from worker.settings import FarmSettings

TINY = RenderSettings(integrator="mi_path", width=32, height=32, max_depth=4)
"""A small picture of a simple scene. Its chunks double in samples: the last ones take a second."""


@pytest.fixture(scope="session")
def server() -> Iterator[EmbeddedServer]:
    with EmbeddedServer() as running:
        yield running


@pytest.fixture
def settings(server: EmbeddedServer, tmp_path: Path) -> FarmSettings:
    """A farm of its own: an empty Redis and an empty store."""
    fresh = FarmSettings(
        redis_url=server.url, store_url=(tmp_path / "store").as_uri(), lease_seconds=2.0, sweep_seconds=0.5
    )
    parts = Parts(fresh)
    parts.redis.flushall()
    parts.close()
    return fresh


@pytest.fixture
def parts(settings: FarmSettings) -> Iterator[Parts]:
    opened = Parts(settings)
    yield opened
    opened.close()


@pytest.fixture
def farm(parts: Parts) -> Farm:
    return Farm(parts)


@pytest.fixture(scope="session")
def upload(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "rooms.zip"
    write(maze(1, 64, 64), path)
    return path


@pytest.fixture(scope="session")
def checked(server: EmbeddedServer, upload: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A store that has the scene, and the scene's digest: checking takes a second."""
    store = tmp_path_factory.mktemp("checked")
    farm = Farm.connect(FarmSettings(redis_url=server.url, store_url=store.as_uri()))
    record, _ = farm.add_scene(upload, "rooms.zip")
    farm.close()
    return store, record.digest


@pytest.fixture
def scene(farm: Farm, tmp_path: Path, checked: tuple[Path, str]) -> SceneRecord:
    store, digest = checked
    shutil.copytree(store, tmp_path / "store", dirs_exist_ok=True)
    record = farm.scene(digest)
    assert record is not None
    return record


@pytest.fixture
def temporary(tmp_path: Path) -> Path:
    """Where workers put their temporary files."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    return folder


@pytest.fixture
def hire(
    settings: FarmSettings, farm: Farm, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[], subprocess.Popen[bytes]]]:
    """Start workers; each call returns once the new one is on the farm's list."""
    hired: list[subprocess.Popen[bytes]] = []
    monkeypatch.setenv("TMPDIR", str(temporary))

    def one_more() -> subprocess.Popen[bytes]:
        known = {info.name for info in farm.workers()}
        hired.append(start_process(settings))
        wait_for(lambda: {info.name for info in farm.workers()} - known, 30)
        return hired[-1]

    yield one_more
    for worker in hired:
        worker.kill()  # what it leaves ends by itself, and the next test has a Redis of its own
        worker.wait()


def chunk_count(settings: RenderSettings, samples: int) -> int:
    """Chunks that a job with a limit on samples has."""
    assert settings.width is not None
    assert settings.height is not None
    spp, number = 0, 0
    while spp < samples:
        spp += chunk_spp(number, settings, (settings.width, settings.height))
        number += 1
    return number


def wait_for(condition: Callable[[], object], seconds: float) -> None:
    """Return once ``condition`` holds; fail after ``seconds``."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened in time"
        time.sleep(0.02)


def finished(farm: Farm, id: str, seconds: float = 60) -> Job:  # noqa: A002
    """The job once it is final."""
    wait_for(lambda: (job := farm.job(id)) is not None and job.state in FINAL_STATES, seconds)
    job = farm.job(id)
    assert job is not None
    return job


def children(pid: int) -> list[int]:
    """Process ids of a process's children."""
    listing = subprocess.run(["ps", "--ppid", str(pid), "-o", "pid="], capture_output=True, text=True, check=False)
    return [int(line) for line in listing.stdout.split()]
