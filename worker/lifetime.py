"""Processes that must not outlive the one that started them, and files that must not outlive their process."""

from __future__ import annotations

import fcntl
import os
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LOOK_SECONDS = 0.5
"""How often a process looks whether its parent is still there."""
GRACE_SECONDS = 20.0
"""Time that an orphan gets to finish its chunk before it is killed; a chunk takes 2 to 10 seconds."""


def end_with_parent(parent: int, *, gently: bool = False) -> None:
    """End this process once ``parent`` is no longer its parent, by whatever signal that died.

    At once, for whoever would work on for nobody; or ``gently``: SIGTERM first, and SIGKILL after
    :data:`GRACE_SECONDS`.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(LOOK_SECONDS)
        if gently:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(GRACE_SECONDS)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, name="parent", daemon=True).start()


@contextmanager
def own_folder(prefix: str) -> Iterator[Path]:
    """A temporary folder of this process; those of processes that were killed are removed on the way.

    Its lock tells who is alive: the system lets go of it with the process, however that ends.
    """
    parent = Path(tempfile.gettempdir())
    for left in parent.glob(f"{prefix}*"):
        if _abandoned(left / "lock"):
            shutil.rmtree(left, ignore_errors=True)
    with (
        tempfile.TemporaryDirectory(prefix=prefix, ignore_cleanup_errors=True) as folder,
        Path(folder, "lock.new").open("w") as lock,
    ):
        fcntl.flock(lock, fcntl.LOCK_EX)
        Path(folder, "lock.new").rename(Path(folder, "lock"))  # nobody ever finds it unlocked
        yield Path(folder)


def _abandoned(lock: Path) -> bool:
    try:
        with lock.open() as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # held, just being made, or another user's
        return False
    return True
