"""What eye paths are told to expect: as bright as records say, tinted as photons are, as uncertain as both tell."""

from __future__ import annotations

import numpy as np
import pytest

from elps_core.context.prospects import BLUE, BORROWED, GREEN, RED, prospects_of

LUMINANCE = np.array([RED, GREEN, BLUE])
PARENTS = np.array([0, 0, 1, 1])


def moments(count: float, mean: float, deviation: float) -> np.ndarray:
    """Of so many records of that mean and relative standard deviation."""
    return np.array([count, count * mean, count * mean**2 * (1.0 + deviation**2)])


def test_the_tint_is_that_of_photons_and_the_brightness_that_of_eye_paths() -> None:
    colours = np.array([[4.0, 1.0, 1.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0], [0.2, 0.9, 0.3]])
    bright = np.array([2.0, 0.5, 3.0, 0.0])
    found = prospects_of(bright, np.stack([moments(1000.0, 1.0, 1.0)] * 4, axis=1), PARENTS, colours)
    assert found[:, :3] @ LUMINANCE == pytest.approx(bright, rel=1e-5)
    assert found[0, :3] / found[0, 1] == pytest.approx(colours[0], rel=0.01)
    overall = colours.mean(axis=0)
    assert found[2, :3] / found[2, 1] == pytest.approx(overall / overall[1], rel=1e-5)
    grey = prospects_of(bright, np.stack([moments(1000.0, 1.0, 1.0)] * 4, axis=1), PARENTS, np.zeros((0, 3)))
    assert grey[:, :3] == pytest.approx(np.repeat(bright[:, None], 3, axis=1))


def test_few_records_borrow_the_deviation_of_their_group() -> None:
    ones = np.ones(4)
    parts = [moments(1e9, 1.0, 3.0), moments(1.0, 1.0, 0.0), moments(1e9, 2.0, 0.5), np.array([0.0, 0.0, 0.0])]
    found = prospects_of(ones, np.stack(parts, axis=1), PARENTS, np.ones((4, 3)))[:, 3]
    assert found[0] == pytest.approx(3.0, rel=1e-3)
    assert found[1] == pytest.approx(3.0 * np.sqrt(BORROWED / (BORROWED + 1.0)), rel=1e-3)
    assert found[2] == pytest.approx(0.5, rel=1e-3)
    assert found[3] == pytest.approx(0.5, rel=1e-3)
