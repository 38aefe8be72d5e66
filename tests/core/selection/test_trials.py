"""Trials say what renders of the same settings show: their variance, their mean, and how long they take."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from elps_core.context.store import GlobalContext
from elps_core.scene.generate import cornell, write
from elps_core.scene.loader import LoadedScene, load_scene
from elps_core.selection.candidates import BDPT, CANDIDATES, GUIDED_PATH, PATH, TRIALS, UNJOINED, Trial, choose
from elps_core.settings import ContextSettings, RenderSettings

SETTINGS = ContextSettings(
    resolution=8, samples_per_cell=16, max_depth=5, regions=32, rows=8, columns=16, paths=1 << 16, tolerance=0.0
)
SIDE, SPP, IMAGES = 96, 16, 8
"""Of the film, as large as the pilot image; and of the renders that pilots are held against: in sets of samples
as large as theirs, and as evenly spread."""
BLOCKS = 8
"""Of each pilot, at least, however busy the machine is."""


@pytest.fixture(autouse=True)
def _variant(mi: Any) -> None:
    """What is tested is a module of kernels."""


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> LoadedScene:
    path = tmp_path_factory.mktemp("scene") / "box.zip"
    write(cornell(), path)
    return load_scene(path, "llvm_ad_rgb", size=(SIDE, SIDE))


@cache
def context_of(box: LoadedScene) -> GlobalContext:
    from elps_core.context import build
    from elps_core.context.build import ContextBuilder
    from elps_core.selection import trials

    builder = ContextBuilder(box, SETTINGS)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trials, "LEAST", BLOCKS)
        # What a trial says is to be true of every candidate, also of those that need none.
        patch.setattr(build, "next_trial", lambda fit, done, *_, **__: next((c for c in fit if not _in(c, done)), None))
        patch.setattr(build, "COMPARED_AFTER", 1000)
        while builder.done < builder.steps:
            saved = builder.to_bytes()
            builder = ContextBuilder(box, SETTINGS)
            builder.restore(saved)  # Trials, too, outlive the process that ran them
            builder.step()
    return builder.result()


def _in(candidate: Any, trials: list[Trial]) -> bool:
    return candidate.name in {trial.name for trial in trials}


def test_every_candidate_has_a_trial(box: LoadedScene) -> None:
    from elps_core.selection.trials import BLOCK

    trials = context_of(box).statistics[TRIALS]
    assert sorted(entry["name"] for entry in trials) == sorted(CANDIDATES)
    assert all(entry["microseconds"] > 0.0 and entry["samples"] >= BLOCKS * BLOCK for entry in trials)


@pytest.mark.parametrize("pays", [True, False])
def test_training_ends_where_trials_say_that_tables_do_not_pay(
    box: LoadedScene, pays: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    from elps_core.context import build
    from elps_core.context.build import COMPARED_AFTER, ContextBuilder
    from elps_core.context.plan import FIRST_PATHS

    monkeypatch.setattr(build, "training_pays", lambda trials, gain: pays)
    settings = SETTINGS.model_copy(update={"paths": 1 << 19})
    builder, most = ContextBuilder(box, settings), 0
    while builder.done < builder.steps:
        saved, done, most = builder.to_bytes(), builder.done, max(most, builder.steps)
        builder = ContextBuilder(box, settings)
        builder.restore(saved)  # What trials said holds in the next process, too
        assert builder.done == done
        builder.step()
    statistics = builder.result().statistics
    trials = {entry["name"] for entry in statistics[TRIALS]}
    assert statistics["thorough"] is pays
    assert PATH.name in trials
    if pays:
        assert statistics["table_paths"] == 1 << 19
    else:
        assert statistics["table_paths"] == sum(FIRST_PATHS << step for step in range(COMPARED_AFTER))
        assert builder.steps < most
    assert choose(RenderSettings(integrator="auto"), statistics).name in trials


def test_tables_that_are_filled_to_the_end_are_compared_at_the_end(
    box: LoadedScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    from elps_core.context import build
    from elps_core.context.build import ContextBuilder

    monkeypatch.setattr(build, "training_pays", lambda trials, gain: False)
    settings = SETTINGS.model_copy(update={"paths": 1 << 18, "thorough": True})
    builder = ContextBuilder(box, settings)
    while builder.done < builder.steps:
        builder.step()
    statistics = builder.result().statistics
    assert (statistics["table_paths"], statistics["thorough"]) == (1 << 18, True)
    assert statistics[TRIALS]


@pytest.mark.parametrize(
    ("parts", "left"),
    [
        ([[1.0, 2.0], [3.0, 1.0]], 7.0),
        ([[1.0, 2.0], [3.0, 7.0]], 6.0),
        ([[900.0, 2.0], [80.0, 2.0]], 4.0),
        ([[0.0, 0.0], [0.0, 0.0]], 0.0),
        ([[0.0, 5.0], [0.0, 0.0]], 0.0),
    ],
)
def test_one_event_does_not_decide_a_variance(parts: list[list[float]], left: float) -> None:
    from elps_core.selection.trials import without_singular

    variance = np.array(parts)
    assert variance[without_singular(variance)].sum() == left


@pytest.mark.parametrize("name", CANDIDATES)
def test_variance_and_mean_are_those_of_renders(box: LoadedScene, name: str) -> None:
    from elps_core.context.pilot_image import blurred
    from elps_core.renderer import Renderer
    from elps_core.selection.trials import BLURS

    context = context_of(box)
    assert context.directions is not None
    (trial,) = (entry for entry in context.statistics[TRIALS] if entry["name"] == name)
    settings = RenderSettings(integrator="auto", max_depth=SETTINGS.max_depth, context=SETTINGS)
    renderer = Renderer(box, CANDIDATES[name].settings(settings), context)
    weights = np.array([0.212671, 0.715160, 0.072169])
    images = np.stack([renderer.render_chunk(k, SPP).image @ weights for k in range(IMAGES)])
    image = np.asarray(context.directions.pilot, np.float64)
    assert image.shape == images.shape[1:]
    for _ in range(BLURS):
        image = blurred(image)
    inverse = 1.0 / np.sqrt(np.square(image) + (0.01 * image.mean()) ** 2)
    variance = float((images.var(axis=0, ddof=1) * SPP * np.square(inverse)).mean())
    mean = float((images.mean(axis=0) * inverse).mean())
    assert trial["mean"] == pytest.approx(mean, rel=0.05)
    assert trial["variance"] == pytest.approx(variance, rel=0.25)


def test_auto_renders_what_trials_chose(box: LoadedScene) -> None:
    from elps_core.renderer import Renderer

    settings = RenderSettings(integrator="auto", max_depth=SETTINGS.max_depth, context=SETTINGS)
    renderer = Renderer(box, settings, context_of(box))
    assert renderer.choice.name in CANDIDATES
    forced = Renderer(box, CANDIDATES[renderer.choice.name].settings(settings), context_of(box))
    assert np.allclose(renderer.render_chunk(0, 4).image, forced.render_chunk(0, 4).image, rtol=1e-4, atol=1e-5)
    assert [renderer.chunk_spp(index) for index in range(20)] == [forced.chunk_spp(index) for index in range(20)]


def test_light_paths_tell_no_more_than_the_variance_of_eye_paths(box: LoadedScene) -> None:
    trials = {entry["name"]: entry for entry in context_of(box).statistics[TRIALS]}
    rival = trials[UNJOINED.name]["rival"]
    assert 0.0 <= rival < 1.3 * trials[GUIDED_PATH.name]["variance"]
    assert all(entry["rival"] == 0.0 for name, entry in trials.items() if name != UNJOINED.name)


def test_what_one_path_says_is_not_sure() -> None:
    from elps_core.selection.trials import at_least

    assert at_least(np.full(64, 3.0)) == 3.0
    lone = np.zeros(64)
    lone[5] = 640.0
    assert at_least(lone) < 0.0
    some = np.random.default_rng(1).exponential(4.0, 1 << 12)
    assert 3.5 < at_least(some) < some.mean()


def test_a_candidate_that_is_far_behind_says_little_more(box: LoadedScene, monkeypatch: pytest.MonkeyPatch) -> None:
    from elps_core.selection import trials
    from elps_core.selection.trials import BEHIND, BLOCK

    runner = runner_of(box)
    monkeypatch.setattr(trials, "SECONDS", 1e9)
    monkeypatch.setattr(trials, "MOST", 5)
    alone = runner.run(PATH)
    assert alone.samples == 5 * BLOCK
    # Times jitter, and few blocks know little of a variance: far from the limit on both sides.
    near, far = (replace(alone, name=BDPT.name, variance=alone.variance / (times * BEHIND)) for times in (0.25, 100.0))
    assert runner.run(PATH, [near]).samples == 5 * BLOCK
    assert runner.run(PATH, [near, far]).samples == 2 * BLOCK


def runner_of(box: LoadedScene) -> Any:
    from elps_core.scene.sensors import Camera
    from elps_core.selection.trials import TrialRunner

    context = context_of(box)
    assert context.directions is not None
    camera = Camera(box.sensor)
    return TrialRunner(box.scene, camera, box.emission, context.adjoint, context.directions, SETTINGS)


def test_the_same_eye_paths_are_compared(box: LoadedScene) -> None:
    """What chance has brought one of two candidates, it brings the other."""
    from elps_core.context.adjoint import density_of
    from elps_core.integrators.make import paths_of

    runner, context = runner_of(box), context_of(box)
    settings = RenderSettings(integrator="auto", max_depth=SETTINGS.max_depth, context=SETTINGS)
    lights = density_of("adjoint", box.emission, context.adjoint, SETTINGS)
    paths = [
        paths_of(box.scene, runner._camera, lights, each.settings(settings), runner._parts)
        for each in (UNJOINED, GUIDED_PATH)
    ]
    noises = [runner._block(bdpt, (key,)).by_eye[0] for bdpt, key in zip((*paths, paths[1]), (7, 7, 8), strict=True)]
    # Where the lamp is seen, its light can leave no digit for any other.
    noisy = np.all(np.array(noises) > 0.0, axis=0)
    assert noisy.mean() > 0.9
    unjoined, same, others = (np.log(noise[noisy]) for noise in noises)
    assert np.corrcoef(unjoined, same)[0, 1] > 0.6
    assert abs(np.corrcoef(others, same)[0, 1]) < 0.2
