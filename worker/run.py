"""A worker: Celery with one warm rendering process. ``python -m worker.run`` starts one on ``ELPS_...`` settings."""

from __future__ import annotations

import os
import secrets
import socket
import subprocess
import sys
import time
import warnings
from typing import get_args

import structlog
from celery import signals
from celery.exceptions import SecurityWarning

from elps_core.errors import ElpsError
from elps_core.settings import Variant
from worker.lifetime import end_with_parent, own_folder
from worker.models import WorkerInfo
from worker.parts import Parts
from worker.queue import make_app, queue_name
from worker.settings import FarmSettings
from worker.sweeper import Sweeper
from worker.tasks import Child, register

START_SECONDS = 60.0
"""Time that a rendering process may take to load Mitsuba on a slow disk before Celery replaces it."""
STOP_SECONDS = 30.0
"""Time that a worker gets to finish its chunk; a chunk takes 2 to 10 seconds."""
PARENT = "--parent"
"""Argument before the id of the process to end with: asked of the system, it would be wrong if that died at once."""


def run(settings: FarmSettings) -> int:
    """Work until SIGTERM or SIGINT; then take nothing new, finish the task in hand, and return the exit status.

    Raises:
        SettingsRejected: a URL is absent or malformed.
    """
    # Celery warns that a worker of root's could be made to unpickle things: ours takes JSON only.
    warnings.filterwarnings("ignore", category=SecurityWarning)
    structlog.configure(logger_factory=structlog.PrintLoggerFactory(sys.stderr))
    parts = Parts(settings)
    name = f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(3)}"
    app = make_app(parts.redis_url)
    app.conf.update(task_time_limit=settings.stall_seconds, worker_proc_alive_timeout=START_SECONDS)
    variants = [variant for variant in get_args(Variant) if variant.startswith(settings.device)]
    info = WorkerInfo(name=name, device=settings.device, variants=variants, busy=False, last_seen=time.time())
    sweeper = Sweeper(parts, info)
    signals.setup_logging.connect(_leave_logging, weak=False)
    worker = app.Worker(
        hostname=name,
        pool="prefork",
        concurrency=1,
        queues=[queue_name(settings.device)],
        without_gossip=True,
        without_mingle=True,
        without_heartbeat=True,
        quiet=True,
    )
    with own_folder("elps-worker-") as folder:
        register(app, lambda: Child(Parts(settings), name), folder)
        sweeper.start()
        try:
            worker.start()
        finally:
            sweeper.stop()
            parts.close()
    return int(worker.exitcode or 0)


def start_process(settings: FarmSettings) -> subprocess.Popen[bytes]:
    """Start a worker of its own on ``settings``; it ends by itself when this process does.

    A fresh process, not a fork: what this one has open stays closed there.
    """
    given = {f"ELPS_{key.upper()}": str(value) for key, value in settings.model_dump(exclude_none=True).items()}
    command = [sys.executable, "-m", "worker.run", PARENT, str(os.getpid())]
    return subprocess.Popen(command, env={**os.environ, **given})  # noqa: S603


def stop_process(worker: subprocess.Popen[bytes]) -> None:
    """Let a worker finish its chunk and end it; kill it where it takes too long."""
    worker.terminate()
    try:
        worker.wait(STOP_SECONDS)
    except subprocess.TimeoutExpired:
        worker.kill()
        worker.wait()


def _leave_logging(**_: object) -> None:
    """Celery sets up logging by itself unless somebody listens."""


if __name__ == "__main__":
    if sys.argv[1:2] == [PARENT]:
        end_with_parent(int(sys.argv[2]), gently=True)
    try:
        sys.exit(run(FarmSettings()))
    except ElpsError as error:
        sys.exit(str(error))
