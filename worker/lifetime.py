"""Processes that must not outlive the one that started them."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import time
from pathlib import Path

LOOK_SECONDS = 0.5
"""How often a process looks whether its parent is still there."""
GRACE_SECONDS = 20.0
"""Time that an orphan gets to finish its chunk before it is killed; a chunk takes 2 to 10 seconds."""


def end_with_parent(parent: int, *, gently: bool = False, folder: Path | None = None) -> None:
    """End this process once ``parent`` is no longer its parent, by whatever signal that died.

    At once, for whoever would work on for nobody; or ``gently``: SIGTERM first, and SIGKILL after
    :data:`GRACE_SECONDS`. ``folder`` is removed before that.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(LOOK_SECONDS)
        if gently:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(GRACE_SECONDS)
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, name="parent", daemon=True).start()
