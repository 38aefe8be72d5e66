"""``elps serve``: everything that one machine needs, in one command, and all of it gone at the end.

The API runs in this process. The coordination server and the workers are child processes that are
ended here, and that end by themselves where this process is killed.
"""

from __future__ import annotations

import contextlib
import ipaddress
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import uvicorn

from elps_core.errors import ElpsError, SettingsRejected
from service.app import create_app
from service.settings import ServiceSettings
from worker.embedded import EmbeddedServer
from worker.farm import Farm
from worker.run import start_process, stop_process
from worker.settings import FarmSettings

ELPS = [sys.executable, "-m", "elps_core.cli"]
"""The command ``elps`` of this installation, wherever its script lies."""
HANG_UP_SECONDS = 2
"""How long open event streams may hold up the end."""
LOOK_TICKS = 10
"""Ticks of the server, of 0.1 s each, between two looks whether the workers are alive."""


class ServeFailed(ElpsError):
    """The service could not start, or a part of it ended by itself."""


def check_host(host: str) -> str:
    """``host`` as a loopback address.

    Raises:
        SettingsRejected: any other address; without keys the service is for this machine only.
    """
    with contextlib.suppress(ValueError):
        if ipaddress.ip_address("127.0.0.1" if host == "localhost" else host).is_loopback:
            return "127.0.0.1" if host == "localhost" else host
    raise SettingsRejected("without keys the service listens on this machine only: use --host 127.0.0.1")


def serve(data: Path, host: str, port: int, workers: int, announce: Callable[[str], None]) -> None:
    """Runs the service until it is interrupted (SIGINT, SIGTERM).

    Args:
        data: folder for the artefacts and the coordination server's files; created where it is
            missing. Not used where ``ELPS_STORE_URL`` and ``REDIS_URL`` name others.
        host: loopback address.
        port: 0 takes a free one.
        workers: worker processes to start here; 0 where they run elsewhere.
        announce: called with the URL once requests are answered.

    Raises:
        SettingsRejected: not a loopback address, or settings that do not fit.
        ServeFailed: the port is taken, or a worker ended by itself.
    """
    listener = _bind(check_host(host), port)
    with listener, contextlib.ExitStack() as stack:
        stack.enter_context(interruptible(0))  # to be interrupted is how it ends
        settings = _settings(data, stack)
        farm = Farm.connect(settings)
        stack.callback(farm.close)
        children = stack.enter_context(_workers(settings, workers))
        config = uvicorn.Config(
            create_app(farm, ServiceSettings()),
            log_level="warning",
            timeout_graceful_shutdown=HANG_UP_SECONDS,
            server_header=False,
        )
        server = _Server(config, children, announce)
        server.run(sockets=[listener])
        if server.lost_worker:
            raise ServeFailed("a worker ended by itself: its last lines above say why")


class _Server(uvicorn.Server):
    """A server that says when it listens, and that ends with its workers."""

    def __init__(
        self, config: uvicorn.Config, workers: list[subprocess.Popen[bytes]], announce: Callable[[str], None]
    ) -> None:
        super().__init__(config)
        self._workers = workers
        self._announce = announce
        self.lost_worker = False

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        for listener in sockets or []:
            host, port = listener.getsockname()[:2]
            self._announce(f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}")

    async def on_tick(self, counter: int) -> bool:
        if counter % LOOK_TICKS == 0 and any(worker.poll() is not None for worker in self._workers):
            self.lost_worker = True
            return True
        return await super().on_tick(counter)


def _bind(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
    except OSError:
        listener.close()
        raise ServeFailed(f"port {port} is taken: choose another one, or 0 for any, with --port") from None
    return listener


@contextlib.contextmanager
def interruptible(status: int) -> Iterator[None]:
    """The first SIGINT or SIGTERM raises SystemExit(status) in the block; later ones cannot disturb the clean-up."""

    def stop(_number: int, _frame: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        raise SystemExit(status)

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _settings(data: Path, stack: contextlib.ExitStack) -> FarmSettings:
    """Where the farm lives: what the environment says, else below ``data``."""
    settings = FarmSettings()
    try:
        data.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError:
        raise ServeFailed("the data folder cannot be made: choose another one with --data") from None
    if settings.store_url is None:
        settings = settings.model_copy(update={"store_url": (data / "store").resolve().as_uri()})
    if settings.redis_url is None:
        embedded = stack.enter_context(EmbeddedServer(data / "valkey"))
        settings = settings.model_copy(update={"redis_url": embedded.url})
    return settings


@contextlib.contextmanager
def _workers(settings: FarmSettings, count: int) -> Iterator[list[subprocess.Popen[bytes]]]:
    workers: list[subprocess.Popen[bytes]] = []
    try:
        for _ in range(count):
            workers.append(start_process(settings))
        yield workers
    finally:
        for worker in workers:  # all at once, since each one finishes its chunk first
            worker.terminate()
        for worker in workers:
            stop_process(worker)
