"""Encodings of directional tables: how far off, how small, and what a damaged file is told."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from elps_core.context.encoding import HALF_TOP, LEVELS, OCTAVES, DirectionalTables, Encoding
from elps_core.errors import ContextMismatch

Array = np.ndarray[Any, Any]
ENCODINGS: list[Encoding] = ["float32", "float16", "log8"]
MIB = 2**20


def tables(values: Array) -> DirectionalTables:
    count = len(values)
    return DirectionalTables.of(values, np.linspace(0.0, 5.0, count), np.arange(count))


def floored(count: int = 20, rows: int = 32, columns: int = 64, power: float = 20.0, seed: int = 1) -> Array:
    """Tables of contrast ever so high above a floor of 0.5 %."""
    values = np.random.default_rng(seed).random((count, rows, columns)) ** power
    return 0.995 * values / values.sum(axis=(1, 2), keepdims=True) + 0.005 / (rows * columns)


def test_values_are_shares_and_a_region_without_any_is_even() -> None:
    values = floored()
    values[3] = 0.0
    made = tables(7.0 * values)
    assert np.abs(made.values.sum(axis=(1, 2), dtype=np.float64) - 1.0).max() < 1e-6
    assert (made.values[3] == np.float32(1.0 / 2048)).all()
    assert made.encoding == "float32"
    assert made.shape == (20, 32, 64)


@pytest.mark.parametrize(("encoding", "bound"), [("float32", 0.0), ("float16", 2.0**-11), ("log8", 0.0260)])
def test_error_keeps_the_stated_bound(encoding: Encoding, bound: float) -> None:
    values = floored()
    values[0] = 0.005 / 2048
    values[0, 5, 6] = 0.995  # 18.7 octaves between the floor and the one bright cell
    made = tables(values)
    error = np.abs(made.encoded(encoding).decoded() / made.values - 1.0)
    assert error.max() <= bound * (1 + 1e-3) + 1e-6
    if encoding != "float32":
        assert error.max() > bound / 8, "a bound that is never come near says nothing"


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.floats(0.0, 1e6, width=32), min_size=6, max_size=6),
    st.sampled_from(ENCODINGS),
)
def test_zero_stays_zero_and_the_largest_stays_itself(cells: list[float], encoding: Encoding) -> None:
    made = tables(np.array(cells).reshape(1, 2, 3))
    back = made.encoded(encoding).decoded()
    assert (back[made.values == 0.0] == 0.0).all()
    assert back.max() == pytest.approx(made.values.max(), rel=1e-3)
    lost = made.values < made.values.max() * 2.0**-OCTAVES  # Raised, or rounded to the next denormal
    step = {"float32": 0.0, "float16": 2.0**-11, "log8": 2.0 ** (OCTAVES / (LEVELS - 1) / 2) - 1.0}[encoding]
    kept = (made.values > 0.0) & ~lost
    assert (np.abs(back[kept] / made.values[kept] - 1.0) <= step + 1e-5).all()


def test_one_stray_value_does_not_coarsen_eight_bits() -> None:
    values = floored(1)
    values[0, 0, 0] = 1e-30
    made = tables(values)
    back = made.encoded("log8").decoded()
    assert np.abs(back / made.values - 1.0).ravel()[1:].max() < 2.0 ** (OCTAVES / (LEVELS - 1) / 2) - 1.0 + 1e-4
    assert 0.0 < back[0, 0, 0] < made.values.max() * 2.0 ** -(OCTAVES - 1)


def test_a_constant_and_an_empty_table_survive() -> None:
    values = np.zeros((2, 4, 4), np.float32)
    values[0] = 1.0 / 16
    made = DirectionalTables(values, np.ones((2, 2), np.float32), np.ones(2, np.float32), np.ones(2, np.uint32))
    for encoding in ENCODINGS:
        assert np.abs(made.encoded(encoding).decoded() - values).max() < 1e-7


def test_encoding_twice_changes_nothing_more() -> None:
    for encoding in ENCODINGS:
        once = tables(floored()).encoded(encoding)
        assert np.array_equal(once.encoded("float32").values, once.decoded())
        twice = once.encoded(encoding)
        assert np.abs(twice.decoded() / once.decoded() - 1.0).max() < 1e-5


def test_a_context_of_the_largest_size_stays_small() -> None:
    each = tables(floored(8, 16, 32)).encoded("log8").nbytes / 8
    assert 16384 * each <= 12 * MIB
    assert tables(floored(8)).encoded("float16").values.max() == HALF_TOP


def test_arrays_make_the_same_tables_again() -> None:
    made = tables(floored(5)).encoded("log8")
    back = DirectionalTables.from_arrays(made.arrays())
    assert back.encoding == "log8"
    assert all(np.array_equal(back.arrays()[name], array) for name, array in made.arrays().items())


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("values", lambda a: a[..., 0]),
        ("values", lambda a: a.astype(np.int32)),
        ("values", lambda a: a[:, :0]),
        ("values", lambda a: a[:-1]),
        ("scale", lambda a: a[:-1]),
        ("scale", lambda a: a.astype(np.float64)),
        ("irradiance", lambda a: a[:, None]),
        ("irradiance", lambda a: a * np.float32(np.nan)),
        ("evidence", lambda a: a.astype(np.int32)),
        ("evidence", None),
    ],
)
def test_damaged_arrays_are_refused(name: str, damage: Any) -> None:
    arrays = tables(floored(4)).encoded("log8").arrays()
    if damage is None:
        del arrays[name]
    else:
        arrays[name] = damage(arrays[name])
    with pytest.raises(ContextMismatch, match="build it again"):
        DirectionalTables.from_arrays(arrays)
