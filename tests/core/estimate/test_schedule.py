"""Chunks start small, double, and end at a size that the settings alone decide."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from elps_core.estimate.schedule import BOOTSTRAP_RATIO, FULL_SAMPLES, chunk_spp
from elps_core.settings import BUILT_INTEGRATORS, PssmltSettings, RenderSettings

SIDES = st.integers(1, 16384)


def schedule(settings: RenderSettings, size: tuple[int, int]) -> list[int]:
    """Sizes of the first chunks; what they must be for any settings."""
    sizes = [chunk_spp(index, settings, size) for index in range(40)]
    assert all(sum(sizes[:count]) % sizes[count - 1] == 0 for count in range(1, 40))
    assert all(a <= b <= 2 * a for a, b in pairwise(sizes))
    return sizes


@given(st.sampled_from(["path", "light", "bdpt", "mi_path"]), SIDES, SIDES)
def test_chunks_grow_and_stay_bounded(integrator: str, width: int, height: int) -> None:
    sizes = schedule(RenderSettings(integrator=integrator), (width, height))
    assert sizes[0] == 1
    assert sizes[-1] * width * height <= max(1 << 22, width * height)


@given(SIDES, SIDES, st.integers(1024, 2**22), st.integers(1, 2**18))
def test_no_chunk_of_pssmlt_is_mostly_its_start(width: int, height: int, bootstrap: int, chains: int) -> None:
    settings = RenderSettings(integrator="pssmlt", pssmlt=PssmltSettings(bootstrap=bootstrap, chains=chains))
    sizes = schedule(settings, (width, height))
    mutations = sizes[0] * width * height
    worth = BOOTSTRAP_RATIO * bootstrap
    assert mutations >= worth
    assert sizes[0] == 1 or mutations < 2 * worth
    assert sizes[-1] * width * height <= max(FULL_SAMPLES["pssmlt"], mutations)


@pytest.mark.parametrize("integrator", BUILT_INTEGRATORS)
def test_the_first_picture_comes_within_a_second_or_two(integrator: str) -> None:
    size = (1280, 720)
    assert chunk_spp(0, RenderSettings(integrator=integrator), size) * size[0] * size[1] <= 1 << 20


def test_a_full_chunk_takes_each_algorithm_about_the_same_time() -> None:
    size = (256, 256)
    full = {name: chunk_spp(30, RenderSettings(integrator=name), size) for name in (*BUILT_INTEGRATORS, "mi_path")}
    assert full == {"path": 64, "light": 64, "bdpt": 32, "pssmlt": 32, "mi_path": 64}


def test_powers_of_two_are_met_exactly() -> None:
    sizes = [chunk_spp(index, RenderSettings(), (16, 12)) for index in range(12)]
    assert 64 in [sum(sizes[:count]) for count in range(12)]
