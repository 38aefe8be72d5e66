"""A live service for the tests: real server, real Valkey, real store; no worker, so that jobs stay queued."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from service.settings import ServiceSettings
from tests.service.live import ROOM, UPLOAD_LIMIT, serving
from worker.embedded import EmbeddedServer
from worker.farm import Farm
from worker.settings import FarmSettings


@pytest.fixture(scope="session")
def temporary(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder that everything below the service makes its temporary files in."""
    folder = tmp_path_factory.mktemp("temporary")
    before, tempfile.tempdir = tempfile.tempdir, str(folder)
    yield folder
    tempfile.tempdir = before


@pytest.fixture(scope="session")
def farm(tmp_path_factory: pytest.TempPathFactory, temporary: Path) -> Iterator[Farm]:
    with EmbeddedServer(tmp_path_factory.mktemp("valkey")) as valkey:
        store = tmp_path_factory.mktemp("store")
        farm = Farm.connect(FarmSettings(redis_url=valkey.url, store_url=store.as_uri()))
        yield farm
        farm.close()


@pytest.fixture(scope="session")
def client(farm: Farm) -> Iterator[httpx.Client]:
    with serving(farm, ServiceSettings(max_upload_bytes=UPLOAD_LIMIT)) as client:
        yield client


@pytest.fixture(scope="session")
def scene(client: httpx.Client) -> str:
    """Digest of a scene that the service has."""
    answer = client.post("/v1/scenes", content=ROOM, headers={"Content-Type": "application/xml"})
    assert answer.is_success, answer.text
    return str(answer.json()["digest"])
