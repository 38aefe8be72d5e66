"""Which Mitsuba variant runs here, on which LLVM library.

Dr.Jit compiles for the processor through a shared LLVM library. It takes the first one that it
finds when it is imported, and one that is too old aborts the whole process at its first kernel.
So the library is chosen, and asked for its version, before that import.
"""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Literal

from elps_core.errors import DeviceUnavailable

OLDEST_LLVM = 17
"""Dr.Jit 1.5 loads 15 and 16 without complaint and then aborts the process."""
TESTED_LLVM = 19
"""The version that the renderer is tested with; of several, the nearest is taken (17, 18 and 22 were seen to work)."""

LIBRARY_VARIABLE = "DRJIT_LIBLLVM_PATH"
"""Environment variable by which Dr.Jit is told its LLVM library, and the user's own choice."""
LIBRARY_PATTERNS = (
    "/usr/lib/*/libLLVM[-.]*so*",  # Debian, Ubuntu
    "/usr/lib/llvm-*/lib/libLLVM[-.]*so*",  # Debian and apt.llvm.org, development packages
    "/usr/lib64/libLLVM[-.]*so*",  # Fedora, RHEL, openSUSE
    "/usr/lib64/llvm*/lib*/libLLVM[-.]*so*",  # Fedora, older versions beside the current one
    "/usr/lib/libLLVM[-.]*so*",  # Arch
    "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",  # Homebrew on Apple silicon
    "/usr/local/opt/llvm*/lib/libLLVM*.dylib",  # Homebrew on Intel
    f"{sys.prefix}/lib/libLLVM[-.]*",  # conda
)
"""Where LLVM's shared library lies on the systems that Mitsuba has wheels for."""
_VERSION_IN_PATH = re.compile(r"llvm(?:\.so\.|[-@./])?(\d+)", re.IGNORECASE)


@dataclass(frozen=True)
class _PackageManager:
    program: str
    install: str
    llvm: str
    atomic: str
    """GCC's library of atomic operations: Mitsuba's wheels for Linux need it, minimal systems lack it."""


_PACKAGE_MANAGERS = (
    _PackageManager("brew", "brew install", f"llvm@{TESTED_LLVM}", ""),
    _PackageManager("apt-get", "sudo apt-get install", f"libllvm{TESTED_LLVM}", "libatomic1"),
    _PackageManager("dnf", "sudo dnf install", "llvm-libs", "libatomic"),
)
_OTHER_SYSTEM = _PackageManager("", "install with your package manager:", f"libLLVM-{TESTED_LLVM}", "libatomic")


@dataclass(frozen=True)
class DeviceInfo:
    """What this machine can render with."""

    device_class: Literal["cpu", "cuda"]
    """``cuda`` where a CUDA device answers, else ``cpu``."""
    variants: tuple[str, ...]
    """Mitsuba variants that :func:`use` accepts here."""
    llvm: str | None
    """Version of the LLVM library in use, such as ``19.1.7``; None without a usable one."""
    threads: int
    """Threads that the LLVM backend computes with."""


def use(variant: str) -> ModuleType:
    """The ``mitsuba`` module with ``variant`` set, on a library that is known to work.

    Raises:
        DeviceUnavailable: no LLVM of version 17 or later for an ``llvm_*`` variant, no CUDA device
            for a ``cuda_*`` variant, another system library missing, or a variant that this Mitsuba
            does not have.
    """
    problem = _choose_library()
    if problem and variant.startswith("llvm_"):
        raise DeviceUnavailable(problem)
    mitsuba = _import_mitsuba()
    if variant not in mitsuba.variants():
        raise DeviceUnavailable(f"unknown variant: choose one of {', '.join(describe().variants)}")
    if variant.startswith("llvm_"):
        _check_loaded()
    try:
        mitsuba.set_variant(variant)
    except ImportError:
        if variant.startswith("cuda_"):
            raise DeviceUnavailable("no CUDA device or driver here: choose an 'llvm_' variant") from None
        raise DeviceUnavailable("this processor lacks AVX and FMA (or NEON), which the LLVM variants need") from None
    return mitsuba


def describe() -> DeviceInfo:
    """What :func:`use` would accept on this machine; sets no variant.

    Raises:
        DeviceUnavailable: Mitsuba does not load at all, because a system library is missing.
    """
    _choose_library()
    mitsuba, drjit = _import_mitsuba(), import_module("drjit")
    version = drjit.detail.llvm_version()
    prefixes = ["scalar_"]
    llvm = None
    if drjit.has_backend(drjit.JitBackend.LLVM) and version[0] >= OLDEST_LLVM:
        llvm = ".".join(str(part) for part in version)
        prefixes.append("llvm_")
    cuda = bool(drjit.has_backend(drjit.JitBackend.CUDA))
    if cuda:
        prefixes.append("cuda_")
    return DeviceInfo(
        device_class="cuda" if cuda else "cpu",
        variants=tuple(name for name in mitsuba.variants() if name.startswith(tuple(prefixes))),
        llvm=llvm,
        threads=drjit.thread_count(),
    )


def missing_packages() -> list[str]:
    """System packages to install before :func:`use` can work, as this machine's package manager calls them.

    Needs neither Mitsuba nor any other package, so that the set-up can ask before it has installed them.
    """
    missing = []
    if sys.platform == "linux" and _open("libatomic.so.1") is None:
        missing.append(_package_manager().atomic)
    if LIBRARY_VARIABLE not in os.environ and _choose_library():
        missing.append(_package_manager().llvm)
    return missing


def install_command(packages: list[str]) -> str:
    """The command to type that installs ``packages`` on this machine."""
    command = _package_manager().install
    if os.geteuid() == 0:
        command = command.removeprefix("sudo ")
    return " ".join([command, *packages])


def _package_manager() -> _PackageManager:
    return next((manager for manager in _PACKAGE_MANAGERS if shutil.which(manager.program)), _OTHER_SYSTEM)


def _import_mitsuba() -> ModuleType:
    try:
        return import_module("mitsuba")
    except (ImportError, NameError) as error:  # Dr.Jit trips over its own name where a system library is missing
        packages = missing_packages()
        if not packages:
            raise
        raise DeviceUnavailable(f"Mitsuba does not load: type '{install_command(packages)}'") from error


def _choose_library() -> str | None:
    """Point Dr.Jit at a usable library; returns what is wrong where there is none."""
    if "drjit" in sys.modules:
        return None  # it loaded its library on import: _check_loaded() tells
    chosen = os.environ.get(LIBRARY_VARIABLE)
    if chosen:
        version = _version(chosen)
        if version is not None and version >= OLDEST_LLVM:
            return None
        found = "no LLVM library" if version is None else f"an LLVM older than {OLDEST_LLVM}"
        return f"{LIBRARY_VARIABLE} names {found}: unset it, or let it name libLLVM {TESTED_LLVM}"
    for path in _candidates():
        if (_version(path) or 0) >= OLDEST_LLVM:
            os.environ[LIBRARY_VARIABLE] = path
            return None
    command = install_command([_package_manager().llvm])
    return f"no LLVM library of version {OLDEST_LLVM} or later found: type '{command}'"


def _check_loaded() -> None:
    """Refuse to go on with the library that Dr.Jit itself found where it is too old."""
    major = import_module("drjit").detail.llvm_version()[0]
    if 0 <= major < OLDEST_LLVM:
        raise DeviceUnavailable(f"LLVM {major} was loaded with drjit: call elps_core.device.use() before importing it")


def _candidates() -> Iterator[str]:
    """Libraries that may fit, the nearest to the tested version first, one path for each file.

    What calls itself too old is left out unopened: two LLVMs in one process are best avoided.
    """
    found: dict[Path, int] = {}
    for pattern in LIBRARY_PATTERNS:
        for name in Path("/").glob(pattern.removeprefix("/")):
            path = name.resolve()
            versions = _VERSION_IN_PATH.findall(str(path))
            found[path] = int(versions[-1]) if versions else OLDEST_LLVM
    for path, version in sorted(found.items(), key=lambda item: (abs(item[1] - TESTED_LLVM), item[1], item[0])):
        if version >= OLDEST_LLVM:
            yield str(path)


def _version(library: str) -> int | None:
    """Major version of an LLVM library: 0 where it is too old to tell (before 16), None for anything else.

    The library stays loaded; Dr.Jit then opens the same one, so that asking costs no time.
    """
    handle = _open(library)
    if handle is None:
        return None
    if not hasattr(handle, "LLVMGetVersion"):
        return 0 if hasattr(handle, "LLVMContextCreate") else None
    major = ctypes.c_uint()
    handle.LLVMGetVersion(ctypes.byref(major), None, None)  # null pointers are allowed and skipped
    return major.value


def _open(library: str) -> ctypes.CDLL | None:
    try:
        return ctypes.CDLL(library)
    except OSError:
        return None
