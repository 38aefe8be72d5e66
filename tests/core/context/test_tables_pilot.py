"""The pilot image: where paths count, how much, and how noisy they are."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

Array = np.ndarray[Any, Any]

SIZE = (48, 24)
PATHS = 1 << 18
ON = 0.2
"""Chance that a path finds anything."""


@pytest.fixture(autouse=True)
def _variant(mi: Any) -> None:
    """What is tested is a module of kernels."""


def entered(mi: Any, seed: int, *, image: Any = None, on: float = ON) -> Any:
    """Paths that find x + 0.5 on the average, all of it in a share ``on`` of them; x from 0 to 1 along the rows."""
    import drjit as dr

    from elps_core.context.pilot_image import PilotImage
    from elps_core.paths.stream import Stream

    pilot = image or PilotImage(mi.ScalarVector2u(SIZE))
    stream = Stream.of(PATHS, 1, seed)
    place = stream.next_2d()
    pilot.enter(place, dr.select(stream.next_1d() < on, (place.x + 0.5) / on, 0.0))
    return pilot


def test_the_image_is_the_mean(mi: Any) -> None:
    pilot = entered(mi, 1)
    assert pilot.shape == (48, 96)
    image = pilot.image()
    expected = (np.arange(96) + 0.5) / 96 + 0.5
    error = expected * np.sqrt((1.0 / ON - 1.0) / (PATHS / 96))
    inner = slice(1, -1)  # A blur draws the first and the last column inwards
    assert (np.abs(image.mean(axis=0) - expected) < 5.0 * error)[inner].all()
    assert image.std(axis=1).mean() < 0.5, "noise of single pixels is blurred"


def test_noise_is_that_of_one_path_of_the_last_step(mi: Any) -> None:
    pilot = entered(mi, 2)
    expected = np.sqrt(1.0 / ON - 1.0)
    assert pilot.noise() == pytest.approx(expected, rel=0.05)
    before = pilot.image().mean()
    pilot.begin_step()
    assert pilot.noise() == 0.0
    entered(mi, 3, image=pilot)
    assert pilot.noise() == pytest.approx(expected, rel=0.05)
    assert pilot.sums[1].sum() == 2 * PATHS
    assert pilot.image().mean() == pytest.approx(before, rel=0.02), "a mean, whatever the number of paths"


def test_it_tells_what_the_last_step_has_won(mi: Any) -> None:
    pilot = entered(mi, 1, on=0.5)
    assert pilot.won(0.0) == float("inf"), "there was no step before"
    pilot.begin_step()
    assert pilot.won(0.0) == float("inf"), "it has no paths yet"
    entered(mi, 2, image=pilot, on=0.5)
    assert abs(pilot.won(0.0)) < 0.02
    assert pilot.won(0.0) < pilot.won(2.0) < 0.05
    pilot.begin_step()
    entered(mi, 3, image=pilot, on=0.8)
    assert pilot.won(0.0) == pytest.approx(1.0 / 0.25 - 1.0, rel=0.05)
    pilot.begin_step()
    entered(mi, 4, image=pilot, on=0.5)
    assert pilot.won(0.0) == pytest.approx(0.25 - 1.0, rel=0.05)


def test_noisy_steps_are_not_compared(mi: Any) -> None:
    from elps_core.context.pilot_image import CLEAR

    pilot = entered(mi, 1, on=1.0 / (2.0 + CLEAR))
    pilot.begin_step()
    assert entered(mi, 2, image=pilot, on=1.0 / (2.0 + CLEAR)).won(0.0) == float("inf")


def test_what_is_no_number_counts_as_nothing(mi: Any) -> None:
    from elps_core.context.pilot_image import PilotImage

    pilot = PilotImage(mi.ScalarVector2u(SIZE))
    assert not pilot.image().any()
    pilot.enter(mi.Point2f([0.1, 0.6, 1.0], [0.1, 0.6, 1.0]), mi.Float([float("nan"), float("inf"), 2.0]))
    assert pilot.sums.sum(axis=(1, 2)) == pytest.approx([2.0, 3.0])
    assert pilot.sums[0, -1, -1] == 2.0
