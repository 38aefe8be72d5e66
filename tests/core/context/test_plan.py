"""How the paths of a build are shared out among its steps."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest

from elps_core.settings import USUAL_PATHS


@pytest.fixture(autouse=True)
def _variant(mi: Any) -> None:
    """What is tested is in a module of kernels."""


@pytest.mark.parametrize("paths", [1024, 1 << 15, 100_000, 3 << 19, USUAL_PATHS, 10**8 + 7])
def test_steps_take_all_paths_and_no_more_than_a_few_seconds(paths: int) -> None:
    from elps_core.context.plan import FIRST_PATHS, MOST_PATHS, filling

    steps = list(filling(paths))
    assert sum(steps) == paths
    assert steps[0] <= 1.5 * FIRST_PATHS
    # At 0.4 million pairs of paths a second, on two cores, the longest takes four seconds.
    assert max(steps) <= 1.5 * MOST_PATHS
    assert all(after >= before for before, after in pairwise(steps[:-1]))
    assert steps[-1] >= 0.5 * steps[0]
