"""The heuristics: partial sums against the definition, path by path, in numbers that a reader can check."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from elps_core.settings import HeuristicKind

N = 6
"""Vertices of the paths: strategies s = 0 .. N, of which those with t >= 1 count here."""
PATHS = 4096


def densities(rng: np.random.Generator) -> dict[str, Any]:
    """Random densities of every vertex from both sides, with geometry terms of one, and a Dirac vertex in some."""
    return {
        "from_light": np.exp(rng.normal(size=(N, PATHS))),  # solid angle = area measure: all distances, cosines are 1
        "from_eye": np.exp(rng.normal(size=(N, PATHS))),
        "delta": rng.random((N, PATHS)) < 0.15,
    }


def by_definition(kind: HeuristicKind, p: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Weights [strategies, paths] from the densities of all strategies."""
    from elps_core.paths.mis import CUTOFF, TIE

    if kind == "maximum":
        preferred = p * TIE ** np.arange(len(p))[:, None]
        return (preferred == preferred.max(axis=0)) & (p > 0)
    if kind == "cutoff":
        kept = np.where(p >= CUTOFF * p.max(axis=0), p, 0.0)
        return kept / kept.sum(axis=0)
    power = p**2 if kind == "power" else p
    return power / power.sum(axis=0)


@pytest.mark.parametrize("kind", ["balance", "power", "maximum", "cutoff"])
def test_weights_of_joins_are_those_of_the_definition(mi: Any, kind: HeuristicKind) -> None:
    import drjit as dr

    from elps_core.paths.mis import Heuristic, Partial

    rng = np.random.default_rng(5)
    d = densities(rng)
    for end in (0, 1, N - 1):
        d["delta"][end] = False
    heuristic = Heuristic(kind, N)
    light, eye, delta = d["from_light"], d["from_eye"], d["delta"]
    # A Dirac event's densities cancel, in whichever direction it is passed: the vertices beside it count once.
    for k in range(1, N - 1):
        eye[k - 1][delta[k]] = 1.0
        light[k + 1][delta[k]] = 1.0
    # Strategy s: vertices 0 .. s-1 from the light, the others from the eye; a join needs two smooth ends.
    p = np.stack(
        [
            light[:s].prod(axis=0) * eye[s:].prod(axis=0) * (~delta[max(s - 1, 0)] & ~delta[min(s, N - 1)])
            for s in range(N)
        ]
    )
    weights = by_definition(kind, p)
    number = lambda values: mi.Float(values.astype(np.float32))  # noqa: E731

    def walk(first: list[int], pdf: Any, pdf_rev: Any, side: str) -> Partial:
        """The partial sums at the last of the vertices ``first``, walked in that order."""
        one = dr.ones(mi.Float, PATHS)
        start = number(pdf[first[0]]) if side == "light" else mi.Float(dr.inf)
        partial = heuristic.start(start, one, number(pdf[first[1]]), side)
        for k in range(1, len(first) - 1):
            partial = heuristic.arrive(partial, one, one)
            at, to, back = first[k], first[k + 1], first[k - 1]
            partial = heuristic.scatter(partial, one, number(pdf[to]), number(pdf_rev[back]), mi.Bool(delta[at]), side)
        return heuristic.arrive(partial, one, one)

    for s in range(2, N - 1):
        from_light = walk(list(range(s)), light, eye, "light")
        from_eye = walk(list(range(N - 1, s - 1, -1)), eye, light, "eye")
        ratios_light = heuristic.others(from_light, number(eye[s - 1]), number(eye[s - 2]), "light")
        ratios_eye = heuristic.others(from_eye, number(light[s]), number(light[s + 1]), "eye")
        found = np.array(heuristic.weight(ratios_light, ratios_eye))
        joined = p[s] > 0
        assert joined.mean() > 0.5
        if kind in ("maximum", "cutoff"):  # A few paths lie on the edge to within rounding.
            assert np.isclose(found, weights[s], rtol=1e-3, atol=1e-6)[joined].mean() > 0.999
        else:
            assert np.allclose(found[joined], weights[s][joined], rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize("kind", ["balance", "power", "maximum", "cutoff"])
def test_weights_are_numbers_whatever_densities_are(mi: Any, kind: HeuristicKind) -> None:
    """Smooth hair has densities of 1e-20 beside 1e10: squared over a few bounces they leave single precision."""
    import drjit as dr

    from elps_core.paths.mis import Heuristic, Partial

    rng = np.random.default_rng(6)

    def extreme() -> Any:
        """From 1e-30 to 1e30, and 0 in some."""
        exponent = rng.uniform(-30.0, 30.0, PATHS)
        return mi.Float(np.where(rng.random(PATHS) < 0.2, 0.0, 10.0**exponent).astype(np.float32))

    def walk(side: Any) -> Partial:
        one = dr.ones(mi.Float, PATHS)
        partial = heuristic.start(one, one, one, side)
        for _ in range(N):
            partial = heuristic.arrive(partial, one, one)
            drawn = dr.maximum(extreme(), 1e-30)  # What has no density is not drawn
            partial = heuristic.scatter(partial, one, drawn, extreme(), mi.Bool(rng.random(PATHS) < 0.15), side)
        return heuristic.arrive(partial, one, one)

    heuristic = Heuristic(kind, N)
    light, eye = walk("light"), walk("eye")
    ratios = heuristic.others(light, extreme(), extreme(), "light"), heuristic.others(eye, extreme(), extreme(), "eye")
    weight = np.array(heuristic.weight(*ratios))
    assert np.isfinite(weight).all()
    assert weight.min() >= 0.0
    assert weight.max() <= 1.0
    assert np.isfinite(np.array([light.dvcm, *light.dvc, eye.dvcm, *eye.dvc])).all()
