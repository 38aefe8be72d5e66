"""Error measures: what they weigh, and what they leave out."""

from __future__ import annotations

import numpy as np
import pytest

from elps_core.estimate.stats import rel_mse, relative_error


def test_relative_error_scales_with_neither_exposure_nor_size() -> None:
    rng = np.random.default_rng(4)
    mean, error = rng.random((16, 16, 3)) + 0.5, 0.1 * np.ones((16, 16, 3))
    assert relative_error(10 * mean, 10 * error) == pytest.approx(relative_error(mean, error))
    assert relative_error(mean, 2 * error) == pytest.approx(2 * relative_error(mean, error))


def test_trimming_leaves_out_the_worst_pixels() -> None:
    reference = np.ones((10, 10, 3))
    image = reference.copy()
    image[0, 0] = 100.0
    assert rel_mse(image, reference) > 10.0
    assert rel_mse(image, reference, trim=0.01) == 0.0
