"""Run a Python module of this package as a child that can do little: files, memory, time, network.

Bubblewrap is used where it works; elsewhere resource limits, an empty folder and a clean environment
remain. Imports no Mitsuba.
"""

from __future__ import annotations

import functools
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
"""The folder of ``elps_core``: with Python and the system's libraries all that the child has to see."""
SYSTEM_FOLDERS = ("/usr", "/lib", "/lib64", "/bin", "/opt", "/etc/alternatives", "/etc/ld.so.cache")
"""Read-only inside bubblewrap where they exist: shared libraries, LLVM's among them."""
KEPT_VARIABLES = ("PATH", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "DRJIT_LIBLLVM_PATH", "SYSTEMROOT")
PROBE_SECONDS = 10.0
MAX_OUTPUT_BYTES = 2**20


class ChildDiedError(Exception):
    """The child ended without an answer; :attr:`reason` says why: ``time``, ``memory``, ``crash``."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


@dataclass(frozen=True)
class ChildLimits:
    """Resources of one child process."""

    cpu_seconds: int = 60
    wall_seconds: float = 120.0
    memory_bytes: int = 8 * 2**30
    """Of address space, not only of memory in use: libraries and threads reserve about 2 GiB unused."""
    file_bytes: int = 2**30
    """Largest file that it may write: what it unpacks."""
    open_files: int = 512


def run(module: str, readable: Path, limits: ChildLimits, extra: Sequence[str] = ()) -> bytes:
    """Standard output of ``python -m module READABLE LIMITS... EXTRA...`` in a child, at most a mebibyte.

    The child's working directory is new, empty and gone afterwards, as are its temporary files. It sets
    the limits of its own resources first (:func:`restrict`); time is watched from here as well.

    Args:
        module: a module of this package.
        readable: the file or folder that the child is given.
        limits: what it may use.
        extra: further arguments.

    Raises:
        ChildDiedError: it took too long, was killed, crashed, or failed.
    """
    with tempfile.TemporaryDirectory(prefix="elps-child-") as folder, tempfile.TemporaryFile() as output:
        # -P and the package on the path: nothing of the working directory is ever imported.
        command = [sys.executable, "-P", "-m", module, str(readable.resolve())]
        command += [*(f"{name}={value}" for name, value in sorted(vars(limits).items())), *extra]
        child = subprocess.Popen(  # noqa: S603  # no shell, and nothing of the upload but its path
            [*_isolation(folder, readable.resolve()), *command],
            cwd=folder,
            env=_environment(folder),
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            status = child.wait(limits.wall_seconds)
        except BaseException as error:
            os.killpg(child.pid, signal.SIGKILL)  # it is not reaped yet, so the number is still its own
            child.wait()
            if isinstance(error, subprocess.TimeoutExpired):
                raise ChildDiedError("time") from None
            raise
        _raise_for(status)
        output.seek(0)
        return output.read(MAX_OUTPUT_BYTES)


def restrict(limits: ChildLimits) -> None:
    """Limit this process's own resources for good. Does nothing where the system has no such limits."""
    try:
        import resource
    except ImportError:  # Windows
        return
    wanted = {
        resource.RLIMIT_CPU: limits.cpu_seconds,
        resource.RLIMIT_AS: limits.memory_bytes,
        resource.RLIMIT_FSIZE: limits.file_bytes,
        resource.RLIMIT_NOFILE: limits.open_files,
        resource.RLIMIT_CORE: 0,
    }
    for kind, value in wanted.items():
        hard = resource.getrlimit(kind)[1]
        most = value if hard == resource.RLIM_INFINITY else min(value, hard)
        # At the soft limit of processor time comes a signal that tells the reason, at the hard one a kill.
        soft = max(most - 1, 1) if kind == resource.RLIMIT_CPU else most
        resource.setrlimit(kind, (soft, most))


def _environment(folder: str) -> dict[str, str]:
    kept = {name: os.environ[name] for name in KEPT_VARIABLES if name in os.environ}
    # Threads reserve address space each; one upload is not worth more than two of them.
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    places = dict.fromkeys(("HOME", "TMPDIR", "TEMP", "TMP", "XDG_CACHE_HOME"), folder)
    return {**kept, **threads, **places, "PYTHONPATH": str(PACKAGE.parent), "PYTHONDONTWRITEBYTECODE": "1"}


def _isolation(folder: str, readable: Path) -> list[str]:
    """The command that shuts the child in, or nothing where there is none that works."""
    if not _bubblewrap_works():
        return []
    shown = [*SYSTEM_FOLDERS, sys.prefix, sys.base_prefix, str(PACKAGE), str(readable)]
    library = os.environ.get("DRJIT_LIBLLVM_PATH")
    if library:
        shown.append(library)
    return [*_bubblewrap(), *_read_only(shown), "--bind", folder, folder, "--chdir", folder, "--"]


def _read_only(paths: list[str]) -> list[str]:
    return [part for path in paths if Path(path).exists() for part in ("--ro-bind", path, path)]


def _bubblewrap() -> list[str]:
    alone = ["--unshare-all", "--die-with-parent", "--new-session", "--cap-drop", "ALL"]
    return [shutil.which("bwrap") or "bwrap", *alone, "--proc", "/proc", "--dev", "/dev"]


@functools.cache
def _bubblewrap_works() -> bool:
    """Whether bubblewrap is there and this system lets it make namespaces. Asked once."""
    if shutil.which("bwrap") is None:
        return False
    binds = _read_only([*SYSTEM_FOLDERS, sys.prefix, sys.base_prefix])
    try:
        done = subprocess.run(  # noqa: S603
            [*_bubblewrap(), *binds, "--", sys.executable, "-I", "-S", "-c", ""],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=PROBE_SECONDS,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0


def _raise_for(status: int) -> None:
    """Bubblewrap passes a signal on as 128 + its number, as shells do."""
    number = -status if status < 0 else status - 128 if status > 128 else 0
    if number in (signal.SIGXCPU, signal.SIGALRM):
        raise ChildDiedError("time")
    if number == signal.SIGKILL:
        raise ChildDiedError("memory")
    if status:
        raise ChildDiedError("crash")
