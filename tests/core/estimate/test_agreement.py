"""The statistical tests themselves: they find what they claim to find, and do not cry wolf."""

from __future__ import annotations

import numpy as np

from tests.agreement import block_means, compare


def images(rng: np.random.Generator, n: int, bias: float = 0.0, noise: float = 0.3) -> np.ndarray:
    pattern = 1.0 + 0.5 * np.sin(np.arange(32))[None, :, None]
    return (pattern * (1.0 + bias) + noise * rng.standard_normal((n, 32, 32, 3))).astype(np.float32)


def test_false_alarms_are_as_rare_as_the_level_says() -> None:
    rng = np.random.default_rng(0)
    alarms = sum(not compare(images(rng, 8), images(rng, 12, noise=0.6), level=0.05).agrees for _ in range(300))
    # Binomial(300, 0.05): more than 28 has a chance below 0.1%.
    assert alarms <= 28


def test_a_bias_of_the_detectable_size_is_found() -> None:
    rng = np.random.default_rng(1)
    detectable = compare(images(rng, 24), images(rng, 24)).detectable
    assert 0.0005 < detectable < 0.02
    found = sum(not compare(images(rng, 24, bias=1.3 * detectable), images(rng, 24)).agrees for _ in range(40))
    assert found >= 36


def test_a_local_bias_is_found_in_its_block() -> None:
    rng = np.random.default_rng(2)
    first, second = images(rng, 16), images(rng, 16)
    first[:, :16, :16] *= 1.1
    first[:, 16:, 16:] *= 0.9
    assert not compare(first, second).agrees


def test_black_images_agree_and_a_constant_difference_does_not() -> None:
    black = np.zeros((4, 32, 32, 3), np.float32)
    assert compare(black, black).agrees
    assert not compare(black, black + 1.0).agrees


def test_blocks_cover_every_pixel_once() -> None:
    field = np.random.default_rng(3).random((2, 37, 50, 3))
    means = block_means(field, 16)
    assert means.shape == (2, 2 * 3, 3)
    ones = block_means(np.ones((1, 37, 50, 1)), 16)
    assert np.allclose(ones, 1.0)
