"""Directions towards slits: what is drawn is what is evaluated, wherever the slit lies and however wide it is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

DRAWS = 1 << 16
LEVEL = 1e-4
"""Probability with which a test of a correct density fails; seeds are fixed, so it fails never or always."""
ENDS = np.array([[1.0, 2.0, -0.5], [1.4, 2.3, 0.9]])
AXIS = (ENDS[1] - ENDS[0]) / np.linalg.norm(ENDS[1] - ENDS[0])
ORIGINS = {
    "beside it": [0.3, -0.2, 0.1],
    "close to it": (ENDS.mean(axis=0) + np.array([1e-3, 0.0, 0.0])).tolist(),
    "beyond its end": (ENDS[1] + 0.7 * AXIS + np.array([0.02, 0.0, 0.0])).tolist(),
    "in line with it": (ENDS[0] - 0.4 * AXIS).tolist(),
    "on it": ENDS[0].tolist(),
    "far away": [300.0, -50.0, 20.0],
}


def slit(spread: float, chance: float) -> Any:
    from elps_core.context.slits import Slits
    from elps_core.sampling.slits import SlitDirections

    # Another one that no path of this side aims at.
    ends = np.stack([ENDS[:, ::-1], ENDS]).astype(np.float32)
    chances = np.array([[[0.1, 0.2]], [[0.0, chance]]], np.float32)
    return SlitDirections(Slits(ends, np.array([0.1, spread], np.float32), chances), "light")


def draw(mi: Any, towards: Any, origin: list[float]) -> tuple[Any, Any, Any]:
    import drjit as dr

    from elps_core.paths.stream import Stream

    every, region = dr.full(mi.Bool, True, DRAWS), dr.zeros(mi.UInt32, DRAWS)
    which, direction, left = towards.sample(mi.Point3f(*origin), region, Stream.of(DRAWS, 5).next_2d(), every)
    return np.array(which), direction, left


def around(direction: Any, origin: list[float]) -> tuple[Any, Any]:
    """Cosine to the slit, and angle off the meridian that it lies on."""
    unit = np.array(direction, np.float64).T
    z = unit @ AXIS
    towards = ENDS[0] - np.asarray(origin)
    across = towards - (towards @ AXIS) * AXIS
    across /= np.linalg.norm(across)
    return z, np.arctan2(unit @ np.cross(AXIS, across), unit @ across)


@pytest.mark.parametrize("spread", [1e-6, 0.003, 0.1, 5.0])
@pytest.mark.parametrize("name", ["beside it", "beyond its end", "far away"])
def test_directions_are_drawn_by_the_density_that_is_told(mi: Any, name: str, spread: float) -> None:
    import drjit as dr

    from elps_core.context.slits import WIDER
    from elps_core.sampling.slits import BLUNTEST, MARGIN, SHARPEST

    origin, towards = ORIGINS[name], slit(spread, 0.5)
    which, direction, _ = draw(mi, towards, origin)
    assert abs(which.mean() - 0.5) < 5.0 * 0.5 / np.sqrt(DRAWS)
    told = towards.mixed(mi.Float(0.0), mi.Point3f(*origin), dr.zeros(mi.UInt32, DRAWS), direction, mi.Bool(True))
    unit = np.array(direction, np.float64)
    assert np.abs(np.linalg.norm(unit, axis=0) - 1.0).max() < 1e-6
    z, phi = (part[which] for part in around(direction, origin))
    ends = (ENDS - origin) / np.linalg.norm(ENDS - origin, axis=1, keepdims=True) @ AXIS
    low, high = max(ends.min() - MARGIN, -1.0), min(ends.max() + MARGIN, 1.0)
    assert stats.kstest(z, stats.uniform(low, high - low).cdf).pvalue > LEVEL
    off = ENDS[0] - origin
    scale, wide = np.clip(
        np.array([1.0, WIDER]) * spread / np.linalg.norm(off - (off @ AXIS) * AXIS), SHARPEST, BLUNTEST
    )
    laws = [stats.wrapcauchy(np.exp(-width)) for width in (scale, wide)]
    if scale > 2.0 * SHARPEST:  # Of less, single precision tells the density, and not the place of every draw
        both = stats.kstest(np.mod(phi, 2.0 * np.pi), lambda angle: np.mean([law.cdf(angle) for law in laws], axis=0))
        assert both.pvalue > LEVEL
    density = 0.5 * np.mean([law.pdf(np.mod(phi, 2.0 * np.pi)) for law in laws], axis=0) / (high - low)
    sure = (np.abs(phi) < 100.0 * scale) & (z > low + 1e-5) & (z < high - 1e-5)
    error = np.abs(np.array(told)[which][sure] / density[sure] - 1.0)
    # Around an axis single precision tells angles the worse, the nearer to it.
    told_to = 1e-3 + 2e-6 / (scale * np.sqrt(1.0 - np.square(z[sure])))
    assert np.quantile(error / told_to, 0.99) < 1.0


@pytest.mark.parametrize("origin", ORIGINS.values(), ids=list(ORIGINS))
@pytest.mark.parametrize("spread", [0.02, 0.5])
def test_densities_integrate_to_one_and_are_positive_where_directions_go(
    mi: Any, origin: list[float], spread: float
) -> None:
    import drjit as dr

    towards = slit(spread, 0.5)
    which, direction, _ = draw(mi, towards, origin)
    nowhere = dr.zeros(mi.UInt32, DRAWS)
    told = np.array(towards.mixed(mi.Float(0.0), mi.Point3f(*origin), nowhere, direction, mi.Bool(True)))
    assert (told[which] > 0.0).mean() > 0.999
    assert np.isfinite(told).all()
    # By directions that are spread as an even half and the slit's are: E[p / (p + even)] = the integral over all.
    even = mi.warp.square_to_uniform_sphere(mi.Point2f(*np.random.default_rng(1).random((2, DRAWS)).astype(np.float32)))
    mixed = dr.select(mi.Bool(which), direction, even)
    told = np.array(towards.mixed(mi.Float(0.0), mi.Point3f(*origin), nowhere, mixed, mi.Bool(True)), np.float64)
    ratio = 2.0 * told / (told + 0.5 / (4.0 * np.pi))
    assert ratio.mean() == pytest.approx(1.0, abs=5.0 * ratio.std() / np.sqrt(DRAWS))


def test_what_is_not_aimed_is_left_even_and_is_the_others(mi: Any) -> None:
    import drjit as dr

    which, _, left = draw(mi, slit(0.02, 0.2), ORIGINS["beside it"])
    assert abs(which.mean() - 0.2) < 5.0 * 0.4 / np.sqrt(DRAWS)
    assert stats.kstest(np.array(left.x)[~which], "uniform").pvalue > LEVEL
    away = dr.normalize(mi.Vector3f(*(np.array(ORIGINS["beside it"]) - ENDS[0]).tolist()))
    for chance, expected in ((0.2, 0.8 * 0.7), (0.0, 0.7)):
        told = slit(1e-4, chance).mixed(
            mi.Float(0.7), mi.Point3f(*ORIGINS["beside it"]), mi.UInt32(0), away, mi.Bool(True)
        )
        assert float(told[0]) == pytest.approx(expected, rel=1e-3)
