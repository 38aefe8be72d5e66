"""An image is unbiased wherever its preparation was cut off, and a job spends its time as it was told to."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from elps_core.estimate.schedule import MEANTIME
from elps_core.scene.generate import cornell, write
from elps_core.scene.loader import LoadedScene, load_scene
from elps_core.settings import ContextSettings, RenderSettings, StopCriterion, with_overrides
from tests.agreement import compare

SIZE, SPP, DEPTH = (16, 12), 256, 4
RUNS = int(os.environ.get("ELPS_TEST_CUTS", "16"))
"""Images by a context of their own each, of every phase."""
REFERENCES, REFERENCE_SPP = 64, 512
CONTEXT: dict[str, Any] = {
    "resolution": 8,
    "max_depth": DEPTH,
    "regions": 16,
    "rows": 4,
    "columns": 8,
    "tolerance": 0.0,
    "paths": (1 << 15) * 15,
}
CUTS = {
    "before the first step": 0,
    "before there are regions": 1,
    "before there are tables": 5,
    "with tables of one step": 6,
    "before the race": 8,
    "in the middle of the race": 9,
    "never": 1000,
}
"""Steps of the preparation after which the time is over."""
DETECTABLE = 0.05
"""Relative bias of the mean that the comparison finds at least."""


@pytest.fixture(autouse=True)
def _variant(mi: Any) -> None:
    """What is tested is a module of kernels."""


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> LoadedScene:
    path = tmp_path_factory.mktemp("scene") / "box.zip"
    write(cornell(), path)
    return load_scene(path, "llvm_ad_rgb", size=SIZE)


@pytest.fixture(scope="module")
def references(box: LoadedScene) -> np.ndarray[Any, Any]:
    from elps_core.renderer import Renderer

    settings = RenderSettings(integrator="mi_path", roulette="none", max_depth=DEPTH)
    renderer = Renderer(box, settings)
    return np.stack([renderer.render_chunk(index, REFERENCE_SPP).image for index in range(REFERENCES)])


def settings_of(seed: int) -> RenderSettings:
    return RenderSettings(seed=seed, max_depth=DEPTH, context=ContextSettings(seed=seed, **CONTEXT))


def cut_after(monkeypatch: pytest.MonkeyPatch, steps: int) -> Callable[[], None]:
    """Let the time for preparing be over after so many steps, by no clock; returns what begins another job."""
    from elps_core import progressive
    from elps_core.context.build import ContextBuilder
    from elps_core.selection.race import Allowance

    taken = [0]
    step = ContextBuilder.step

    def counted(builder: ContextBuilder, allowance: Allowance) -> None:
        step(builder, allowance)
        taken[0] += 1

    def left(_: Allowance, part: float = 1.0) -> float:
        return float("inf") if taken[0] < steps else -part

    monkeypatch.setattr(ContextBuilder, "step", counted)
    monkeypatch.setattr(Allowance, "left", left)
    monkeypatch.setattr(progressive, "PREPARATION", float("inf"))  # Of the samples, the first ones alone come before
    return lambda: taken.__setitem__(0, 0)


@pytest.mark.timeout(1200)
@pytest.mark.parametrize("cut", CUTS)
def test_a_preparation_that_is_cut_off_moves_no_image(
    box: LoadedScene, references: np.ndarray[Any, Any], cut: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from elps_core.progressive import ProgressiveRender

    again = cut_after(monkeypatch, CUTS[cut])
    images, ways = [], set()
    for seed in range(RUNS):
        again()
        stop = StopCriterion(samples=SPP)
        job = ProgressiveRender(box, settings_of(seed), stop, time.perf_counter(), lambda *_: None)
        rendered = job.run()
        assert rendered.merged.spp == SPP
        assert rendered.meantime is not None
        assert 0 < rendered.meantime.spp < SPP
        images.append(rendered.merged.mean())
        assert rendered.context is not None
        ways.add((rendered.renderer.choice.name, rendered.context.directions is not None))
    assert {tables for _, tables in ways} == {CUTS[cut] > 5}, ways
    agreement = compare(np.stack(images), references, block=4)
    assert agreement.agrees, agreement
    assert agreement.detectable < DETECTABLE, agreement


def test_samples_before_a_context_are_weighted_by_trials_alone(
    box: LoadedScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    from elps_core.progressive import ProgressiveRender
    from elps_core.selection import candidates

    cut_after(monkeypatch, CUTS["never"])
    monkeypatch.setattr(candidates.Choice, "weight_of_meantime", 0.25)
    stop = StopCriterion(samples=SPP)
    rendered = ProgressiveRender(box, settings_of(3), stop, time.perf_counter(), lambda *_: None).run()
    assert rendered.meantime is not None
    early = rendered.meantime
    later = [index for index in rendered.merged.chunks if index < MEANTIME]
    parts = [
        rendered.renderer.render_chunk(index, count)
        for index, count in zip(sorted(later), _counts(SPP - early.spp), strict=True)
    ]
    weights = [0.25 * early.spp, *(chunk.spp for chunk in parts)]
    expected = np.average([early.mean(), *(chunk.image for chunk in parts)], axis=0, weights=weights)
    # Filters weigh the samples of a pixel, so that means are close and not equal.
    assert np.abs(rendered.merged.mean() - expected).mean() < 0.05 * expected.mean()


def _counts(spp: int) -> list[int]:
    """Samples of the chunks of a job of that many."""
    counts: list[int] = []
    while spp:
        counts.append(min(1 << max(0, len(counts) - 1), spp, -(-SPP // 4)))
        spp -= counts[-1]
    return counts


@pytest.mark.parametrize("samples", [1, 9])
def test_a_job_that_is_shorter_than_any_preparation_has_none(box: LoadedScene, samples: int) -> None:
    from elps_core.progressive import ProgressiveRender

    stop = StopCriterion(samples=samples)
    told: list[str] = []
    begin = time.perf_counter() + 1e6  # No time has passed, however long it takes
    rendered = ProgressiveRender(box, settings_of(1), stop, begin, lambda what, *_: told.append(what)).run()
    assert (rendered.context, rendered.merged.spp, rendered.preparing) == (None, samples, 0.0)
    assert min(rendered.merged.chunks) >= MEANTIME
    assert all("rendering" in what for what in told)


def test_without_time_for_tables_plain_paths_go_on(box: LoadedScene) -> None:
    from elps_core.progressive import ProgressiveRender
    from elps_core.renderer import Renderer

    settings = with_overrides(settings_of(2), {"context.paths": None, "context.seconds": 1.0})
    Renderer(box, settings).render_chunk(MEANTIME)  # Compiled
    begin = time.perf_counter() - 1.0  # All of the time for preparing is over
    rendered = ProgressiveRender(box, settings, StopCriterion(seconds=2.0), begin, lambda *_: None).run()
    assert rendered.context is not None
    assert rendered.context.directions is None
    assert rendered.renderer.choice.name == "path, plain"
    assert rendered.merged.spp > 1
