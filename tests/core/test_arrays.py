"""Arrays of numpy in kernels: the values that were given, and kernels that do not depend on where numpy put them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest
from numpy.typing import NDArray

from elps_core.arrays import ALIGNMENT, on_device


@pytest.mark.parametrize("kind", ["Float", "UInt32", "Bool", "UInt8", "Float16", "Float64", "Int32"])
@pytest.mark.parametrize("shape", [(0,), (1,), (7, 3)])
def test_it_holds_the_values_in_order(mi: Any, kind: str, shape: tuple[int, ...]) -> None:
    values = np.arange(np.prod(shape)).reshape(shape) % 2
    array = on_device(getattr(mi, kind), values)
    assert np.array_equal(np.array(array), values.ravel())


def test_it_keeps_a_copy(mi: Any) -> None:
    values = np.ones(5, np.float32)
    array = on_device(mi.Float, values)
    values[:] = 2.0
    assert np.array_equal(np.array(array), np.ones(5))


def placed(shift: int) -> NDArray[np.float32]:
    """The same eight numbers, ``shift`` bytes after an aligned address."""
    room = np.zeros(32 + 2 * ALIGNMENT, np.uint8)
    start = -room.ctypes.data % ALIGNMENT + shift
    values = room[start : start + 32].view(np.float32)
    values[:] = np.arange(8)
    return values


def kernel_of(mi: Any, table: Any) -> str:
    """The kernel that reads rows of four numbers from ``table``."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        rows = dr.gather(mi.Vector4f, table, dr.arange(mi.UInt32, 2))
        total = dr.sum(rows)
        dr.eval(total)
        assert np.allclose(total, [6.0, 22.0])
        return str(next(entry["hash"] for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT))


def test_kernels_are_the_same_wherever_numpy_put_the_values(mi: Any) -> None:
    # Dr.Jit's own conversion is not enough: if it were, this helper could go.
    assert len({kernel_of(mi, mi.Float(placed(shift))) for shift in (0, 4, 16)}) > 1
    assert len({kernel_of(mi, on_device(mi.Float, placed(shift))) for shift in (0, 4, 16)}) == 1
