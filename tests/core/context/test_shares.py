"""Which chance of a direction from the tables is best: told by paths that were drawn with another one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from elps_core.context.shares import CHANCES, MOST, best_shares

DRAWN = 0.6
PATHS = 1 << 16


def trial(mi: Any, region: np.ndarray, found: np.ndarray, by_table: np.ndarray) -> np.ndarray:
    """Variances [2, chances] of two regions."""
    from elps_core.context.shares import ShareTrial

    made = ShareTrial(2, DRAWN)
    made.add(mi.UInt32(region), mi.Float(found), mi.Float(by_table), mi.Bool(True))
    return np.array(made.sums, float).reshape(2, -1)


def test_paths_tell_of_other_chances_what_these_would_have_told(mi: Any) -> None:
    """Two directions: light comes through one, which the table prefers, and the material does not."""
    table, material, light = np.array([0.9, 0.1]), np.array([0.2, 0.8]), np.array([1.0, 0.05])
    pdf = DRAWN * table + (1.0 - DRAWN) * material
    drawn = (np.random.default_rng(1).random(PATHS) < pdf[1]).astype(int)
    told = trial(mi, np.zeros(PATHS, np.uint32), light[drawn] / pdf[drawn], (table / pdf)[drawn])[0] / PATHS
    exact = [(light**2 / (chance * table + (1.0 - chance) * material)).sum() for chance in CHANCES]
    assert told == pytest.approx(exact, rel=0.03)


def test_no_single_event_decides(mi: Any) -> None:
    region = np.array([0, 1, 1], np.uint32)
    found = np.array([1e9, MOST, np.inf])
    sums = trial(mi, region, found, np.ones(3))
    assert sums[0] == pytest.approx(np.full(len(CHANCES), MOST**2), rel=1e-4)
    assert sums[1] == pytest.approx(2.0 * sums[0], rel=1e-4)
    assert not trial(mi, region, np.zeros(3), np.ones(3)).any()


def test_the_best_chance_is_that_of_least_variance_in_region_and_group() -> None:
    variance = np.ones((5, len(CHANCES)))
    variance[0, 2] = 0.5
    variance[1, 5] = 0.9  # Its group says the other one, with more weight
    variance[2:4, 6] = 0.2
    variance[4] = 0.0
    parents = np.array([0, 0, 1, 1, 2])
    chosen = best_shares(variance, parents)
    assert chosen[:4] == pytest.approx([CHANCES[2], CHANCES[2], CHANCES[6], CHANCES[6]])
    assert chosen[4] == pytest.approx(CHANCES[6]), "where nothing was found all regions together decide"
