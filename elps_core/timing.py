"""Where the time goes: how long kernels took to compile."""

from __future__ import annotations

from typing import Any

import drjit as dr


class CompileClock:
    """Counts the seconds that Dr.Jit spends on tracing to machine code inside a ``with`` block."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __enter__(self) -> CompileClock:
        self._before = dr.flag(dr.JitFlag.KernelHistory)
        dr.set_flag(dr.JitFlag.KernelHistory, True)
        dr.kernel_history()
        return self

    def __exit__(self, *_: object) -> None:
        history: list[dict[str, Any]] = dr.kernel_history()
        milliseconds = (entry.get("codegen_time", 0.0) + entry.get("backend_time", 0.0) for entry in history)
        self.seconds = sum(milliseconds) / 1000.0
        dr.set_flag(dr.JitFlag.KernelHistory, self._before)
