"""``python -m worker.watcher PROGRAM FOLDER [keep]``: run a server for as long as standard input is open.

Standard input brings the server's configuration, ends it with a zero byte, and then stays open until the
process that started us closes it or dies. Without ``keep`` the data folder is removed at the end. Imports
the standard library only, to start at once.
"""

from __future__ import annotations

import fcntl
import os
import select
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import TextIO

STOP_SECONDS = 10.0
"""Time that the server may take to write its data and end."""
LOOK_SECONDS = 0.2
"""How often we look whether the server ended by itself."""


def watch(program: str, folder: Path) -> int:
    """Run the server; its exit status, or 0 where it was ended by us."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # a terminal signals the whole group: our end is the broken pipe
    source = sys.stdin.fileno()
    configuration = bytearray()
    while not configuration.endswith(b"\0"):
        piece = os.read(source, 4096)
        if not piece:
            return 0
        configuration += piece
    with (folder / "lock").open("w") as held:
        if not _locked(held, source):  # two servers on one folder would spoil each other's data
            return 0
        command = [program, "-"]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as server:  # noqa: S603
            assert server.stdin is not None  # noqa: S101
            server.stdin.write(configuration.removesuffix(b"\0"))
            server.stdin.close()
            while server.poll() is None:
                if _closed(source):
                    server.terminate()
                    try:
                        server.wait(STOP_SECONDS)
                    except subprocess.TimeoutExpired:
                        server.kill()
                    return 0
            return server.returncode


def _closed(source: int) -> bool:
    """Whether the pipe from the process that started us broke; waits a moment to see."""
    readable, _, _ = select.select([source], [], [], LOOK_SECONDS)
    return bool(readable) and not os.read(source, 1)


def _locked(held: TextIO, source: int) -> bool:
    """Wait for the lock of the data folder; False where the pipe breaks first."""
    while True:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if _closed(source):
                return False
        else:
            return True


if __name__ == "__main__":
    data = Path(sys.argv[2])
    status = watch(sys.argv[1], data)
    if "keep" not in sys.argv[3:]:
        shutil.rmtree(data, ignore_errors=True)
    sys.exit(status)
