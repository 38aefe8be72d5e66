"""Error measures: what they weigh, and what they leave out."""

from __future__ import annotations

import numpy as np
import pytest

from elps_core.estimate.stats import BLACK_CHUNKS, MIN_CHUNKS, ends_by_error, rel_mse, relative_error


def test_relative_error_scales_with_neither_exposure_nor_size() -> None:
    rng = np.random.default_rng(4)
    mean, error = rng.random((16, 16, 3)) + 0.5, 0.1 * np.ones((16, 16, 3))
    assert relative_error(10 * mean, 10 * error) == pytest.approx(relative_error(mean, error))
    assert relative_error(mean, 2 * error) == pytest.approx(2 * (relative_error(mean, error) or 0.0))


def test_trimming_leaves_out_the_worst_pixels() -> None:
    reference = np.ones((10, 10, 3))
    image = reference.copy()
    image[0, 0] = 100.0
    assert rel_mse(image, reference) > 10.0
    assert rel_mse(image, reference, trim=0.01) == 0.0


def test_a_black_image_has_no_relative_error_and_comes_to_an_end() -> None:
    black = np.zeros((4, 4, 3), np.float32)
    assert relative_error(black, black) is None
    assert rel_mse(black, black) == 0.0
    assert not ends_by_error(None, 1, 0.1)
    assert not ends_by_error(None, BLACK_CHUNKS - 1, 0.1)
    assert ends_by_error(None, BLACK_CHUNKS, 0.1)


def test_an_error_counts_once_there_are_chunks_enough_to_know_it() -> None:
    assert not ends_by_error(0.05, MIN_CHUNKS - 1, 0.1)
    assert ends_by_error(0.05, MIN_CHUNKS, 0.1)
    assert not ends_by_error(0.2, 100, 0.1)


def test_the_dimmest_image_has_a_relative_error() -> None:
    dim = np.full((4, 4, 3), 2.0**-149)
    found = relative_error(dim, dim)
    assert found is not None
    assert 0.5 < found < 1.0


def test_pixels_below_zero_do_not_take_the_floor_away() -> None:
    mean = np.ones((4, 4, 3))
    mean[:2] = -1.0
    assert relative_error(mean, 0.1 * np.ones((4, 4, 3))) == pytest.approx(0.1, rel=0.01)
