"""Chunks start small, double, and end at a size that the settings alone decide."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from elps_core.estimate.schedule import chunk_spp
from elps_core.settings import RenderSettings


@given(st.integers(1, 16384), st.integers(1, 16384))
def test_chunks_grow_and_stay_bounded(width: int, height: int) -> None:
    settings = RenderSettings()
    sizes = [chunk_spp(index, settings, (width, height)) for index in range(40)]
    assert sizes[0] == 1
    assert all(sum(sizes[:count]) % sizes[count - 1] == 0 for count in range(1, 40))
    assert all(a <= b <= 2 * a for a, b in pairwise(sizes))
    assert sizes[-1] * width * height <= max(1 << 20, width * height)


def test_baselines_get_larger_chunks() -> None:
    size = (256, 256)
    assert chunk_spp(9, RenderSettings(integrator="mi_path"), size) == 4 * chunk_spp(9, RenderSettings(), size)


def test_powers_of_two_are_met_exactly() -> None:
    sizes = [chunk_spp(index, RenderSettings(), (16, 12)) for index in range(12)]
    assert 64 in [sum(sizes[:count]) for count in range(12)]
