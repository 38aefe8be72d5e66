"""The context file: whole or refused, and mapped rather than read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from elps_core.context.store import GlobalContext, load, save
from elps_core.errors import ContextMismatch
from elps_core.settings import ContextSettings


@pytest.fixture
def context() -> GlobalContext:
    rng = np.random.default_rng(0)
    return GlobalContext(
        digest="sha256:" + "a" * 64,
        scene="sha256:" + "b" * 64,
        sensor=1,
        settings=ContextSettings(resolution=8),
        adjoint=rng.random((8, 9)).astype(np.float32),
        emitters=rng.random((3, 7)).astype(np.float32),
        statistics={"seconds": 1.5, "emitters": 3},
    )


def test_what_is_saved_is_loaded(context: GlobalContext, tmp_path: Path) -> None:
    path = tmp_path / "context.elps"
    save(context, path)
    again = load(path)
    assert np.array_equal(again.adjoint, context.adjoint)
    assert np.array_equal(again.emitters, context.emitters)
    assert (again.digest, again.scene, again.sensor) == (context.digest, context.scene, context.sensor)
    assert again.settings == context.settings
    assert again.statistics == context.statistics
    assert [entry.name for entry in tmp_path.iterdir()] == ["context.elps"]


def test_tables_are_mapped_into_memory(context: GlobalContext, tmp_path: Path) -> None:
    path = tmp_path / "context.elps"
    save(context, path)
    assert isinstance(load(path).adjoint, np.memmap)


@pytest.mark.parametrize(
    "content",
    [b"", b"x" * 7, b"\xff" * 64, b"\x02" + b"\0" * 7 + b"{}", b"\x10" + b"\0" * 7 + b'{"__metadata__":{'],
)
def test_other_files_are_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "context.elps"
    path.write_bytes(content)
    with pytest.raises(ContextMismatch):
        load(path)


def test_a_missing_file_is_refused_without_its_path(tmp_path: Path) -> None:
    with pytest.raises(ContextMismatch) as caught:
        load(tmp_path / "nowhere")
    assert str(tmp_path) not in str(caught.value)


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(position=st.integers(0, 2000), value=st.integers(0, 255), length=st.integers(0, 3000))
def test_damaged_files_are_refused_or_harmless(
    context: GlobalContext, tmp_path: Path, position: int, value: int, length: int
) -> None:
    data = bytearray(context.to_bytes())
    if position < len(data):
        data[position] = value
    path = tmp_path / "damaged.elps"
    path.write_bytes(bytes(data[: max(1, len(data) - length)]))
    try:
        loaded = load(path)
    except ContextMismatch:
        return
    np.asarray(loaded.adjoint).sum()
