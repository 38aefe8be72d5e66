"""Artefacts on a local folder, in memory and on S3."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.request import Request, urlopen

import pytest
from moto.server import ThreadedMotoServer

from elps_core.errors import SettingsRejected
from worker.errors import StoreUnavailable
from worker.store import Store, chunk_key


@pytest.fixture(scope="module")
def s3_server() -> Iterator[ThreadedMotoServer]:
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    yield server
    server.stop()


def s3_url(server: ThreadedMotoServer, monkeypatch: pytest.MonkeyPatch, bucket: str) -> str:
    host, port = server.get_host_and_port()
    endpoint = f"http://{host}:{port}"
    for key, value in {
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_ALLOW_HTTP": "true",
        "AWS_ACCESS_KEY_ID": "key",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_REGION": "us-east-1",
    }.items():
        monkeypatch.setenv(key, value)
    with urlopen(Request(f"{endpoint}/{bucket}", method="PUT")):
        return f"s3://{bucket}/farm"


@pytest.fixture(params=["file", "memory", "s3"])
def store(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Store:
    if request.param == "file":
        return Store((tmp_path / "a folder").as_uri())
    if request.param == "memory":
        return Store("memory:///")
    server = request.getfixturevalue("s3_server")
    return Store(s3_url(server, monkeypatch, request.node.name.partition("[")[0].replace("_", "-")))


def test_what_was_put_is_got_and_never_overwritten(store: Store) -> None:
    assert store.get("chunks/a/0") is None
    assert not store.exists("chunks/a/0")
    assert store.put("chunks/a/0", b"first")
    assert not store.put("chunks/a/0", b"second")
    assert store.get("chunks/a/0") == b"first"
    assert store.exists("chunks/a/0")


def test_keys_lists_one_folder(store: Store) -> None:
    for key in ("chunks/a/0", "chunks/a/1", "chunks/ab/0", "jobs/a"):
        store.put(key, b"x")
    assert sorted(store.keys("chunks/a")) == ["chunks/a/0", "chunks/a/1"]
    assert store.keys("scenes") == []


def test_delete_forgets_and_is_idempotent(store: Store) -> None:
    store.put("key", b"x")
    store.delete("key")
    store.delete("key")
    assert store.get("key") is None


def test_fetch_gives_a_file_with_the_bytes(store: Store, tmp_path: Path) -> None:
    store.put("contexts/c.safetensors", b"tables")
    path = store.fetch("contexts/c.safetensors", tmp_path)
    assert path is not None
    assert path.read_bytes() == b"tables"
    assert store.fetch("contexts/d.safetensors", tmp_path) is None


def test_a_large_artefact_is_not_overwritten_either(store: Store) -> None:
    # Larger than a part of a multipart upload, which would ignore what is there.
    assert store.put("chunks/large", bytes(6_000_000))
    assert not store.put("chunks/large", b"x" * 6_000_000)
    assert store.get("chunks/large") == bytes(6_000_000)


@pytest.mark.parametrize("store", ["file", "memory"], indirect=True)  # moto itself is not atomic
def test_of_eight_writers_at_once_one_wins(store: Store) -> None:
    contents = [bytes([number]) * 6_000_000 for number in range(8)]
    with ThreadPoolExecutor(8) as pool:
        won = list(pool.map(lambda content: store.put("chunks/race", content), contents))
    assert won.count(True) == 1
    assert store.get("chunks/race") == contents[won.index(True)]


def test_chunk_keys_hold_no_colon() -> None:
    assert chunk_key("sha256:abc", 7) == "chunks/abc/7"


def test_a_url_that_names_no_store_is_refused() -> None:
    with pytest.raises(SettingsRejected, match="s3://bucket"):
        Store("nonsense")


def test_a_silent_s3_is_unavailable(monkeypatch: pytest.MonkeyPatch) -> None:
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    store = Store(s3_url(server, monkeypatch, "bucket"))
    server.stop()
    with pytest.raises(StoreUnavailable) as caught:
        store.get("key")
    assert "127.0.0.1" not in str(caught.value)


FULL = """
import sys
from worker.errors import StoreFull
from worker.store import Store
store = Store("file://" + sys.argv[1])
assert store.put("small", b"x")
try:
    store.put("large", bytes(4_000_000))
except StoreFull as error:
    assert sys.argv[1] not in str(error)
    assert store.get("large") is None
    assert store.keys("") == ["small"]
    print("full")
"""


def test_a_full_disk_is_told_and_leaves_nothing(tmp_path: Path) -> None:
    """On a file system of one megabyte, in a mount namespace of its own."""
    script = f'mount -t tmpfs -o size=1m none "{tmp_path}" && exec "{sys.executable}" -c "$1" "{tmp_path}"'
    command = ["unshare", "--map-root-user", "--mount", "sh", "-c", script, "sh", FULL]
    probe = subprocess.run([*command[:3], "true"], check=False, capture_output=True)
    if probe.returncode != 0:
        pytest.skip("no mount namespaces here")
    result = subprocess.run(command, check=False, capture_output=True, text=True)
    assert result.stdout == "full\n", result.stderr
