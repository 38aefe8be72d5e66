"""Where the time goes: how long kernels took to compile and to run."""

from __future__ import annotations

from typing import Any, ClassVar

import drjit as dr


class KernelClock:
    """Counts the seconds that kernels take inside a ``with`` block; such blocks may stand in each other."""

    _open: ClassVar[list[KernelClock]] = []
    """Those that count now. Dr.Jit's history can be read once, and tells all of them."""

    def __init__(self) -> None:
        self.compiling = 0.0
        """From tracing to machine code."""
        self.running = 0.0

    def __enter__(self) -> KernelClock:
        self._before = dr.flag(dr.JitFlag.KernelHistory)
        dr.set_flag(dr.JitFlag.KernelHistory, True)
        self._read()
        self._open.append(self)
        return self

    def __exit__(self, *_: object) -> None:
        self._read()
        self._open.remove(self)
        dr.set_flag(dr.JitFlag.KernelHistory, self._before)

    @classmethod
    def _read(cls) -> None:
        history: list[dict[str, Any]] = dr.kernel_history()
        for entry in history:
            for clock in cls._open:
                clock.compiling += (entry.get("codegen_time", 0.0) + entry.get("backend_time", 0.0)) / 1000.0
                clock.running += entry.get("execution_time", 0.0) / 1000.0
