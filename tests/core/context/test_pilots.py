"""Pilots say what renders of the same settings show: their variance, their mean, and how long they take."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from elps_core.choice import CANDIDATES, PILOTS, TWINS, WITH_CAUSTICS, Pilot, candidate, choose
from elps_core.context.scouting import FIRST_SCOUTS, SCOUTS
from elps_core.context.store import GlobalContext
from elps_core.scene.generate import cornell, write
from elps_core.scene.loader import LoadedScene, load_scene
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
    from elps_core.context import build, pilots
    from elps_core.context.build import ContextBuilder

    builder = ContextBuilder(box, SETTINGS)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pilots, "LEAST", BLOCKS)
        # What a pilot says is to be true of every candidate, also of those that need none.
        patch.setattr(build, "worth_measuring", lambda candidates, *_, **__: candidates)
        while builder.done < builder.steps:
            saved = builder.to_bytes()
            builder = ContextBuilder(box, SETTINGS)
            builder.restore(saved)  # Pilots, too, outlive the process that ran them
            builder.step()
    return builder.result()


def test_every_candidate_has_a_pilot(box: LoadedScene) -> None:
    from elps_core.context.pilots import BLOCK

    pilots = context_of(box).statistics[PILOTS]
    assert sorted(entry["name"] for entry in pilots) == sorted(CANDIDATES)
    assert all(entry["microseconds"] > 0.0 and entry["samples"] >= BLOCKS * BLOCK for entry in pilots)


@pytest.mark.parametrize("clear", [1e9, 0.0], ids=["plain wins", "plain loses"])
def test_training_stops_where_scouts_see_that_tables_do_not_pay(
    box: LoadedScene, clear: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    from elps_core.context import scouting
    from elps_core.context.build import SCOUTED_AFTER, ContextBuilder
    from elps_core.context.pilots import PilotRunner
    from elps_core.context.plan import FIRST_PATHS

    run = PilotRunner.run

    def timed(runner: PilotRunner, name: str, *others: Any, **how: Any) -> Pilot:
        """As long as tables cost, whatever else the machine does at that moment."""
        return replace(run(runner, name, *others, **how), microseconds=0.4 if "enlightened" in name else 0.2)

    monkeypatch.setattr(PilotRunner, "run", timed)
    # Whatever tables have won, they win nothing again; or nothing is clear.
    monkeypatch.setattr(scouting, "MOST_GAIN", 1e-9)
    monkeypatch.setattr(scouting, "CLEAR", clear)
    settings = SETTINGS.model_copy(update={"paths": 1 << 19})
    builder, most = ContextBuilder(box, settings), 0
    while builder.done < builder.steps:
        saved, done, most = builder.to_bytes(), builder.done, max(most, builder.steps)
        builder = ContextBuilder(box, settings)
        builder.restore(saved)  # What scouts said holds in the next process, too
        assert builder.done == done
        builder.step()
    statistics = builder.result().statistics
    pilots = [Pilot(**entry) for entry in statistics[PILOTS]]
    if not clear:
        assert statistics["table_paths"] == 1 << 19
        assert {pilot.name for pilot in pilots} >= set(SCOUTS[:3])  # Others where they may pay, by the clock
    else:
        assert statistics["table_paths"] == sum(FIRST_PATHS << step for step in range(SCOUTED_AFTER))
        assert builder.steps < most
        assert set(SCOUTS[:3]) <= {pilot.name for pilot in pilots} <= set(SCOUTS) - {WITH_CAUSTICS}
    best = choose(RenderSettings(integrator="auto"), statistics).name
    assert best in {pilot.name for pilot in pilots}


@pytest.mark.parametrize(
    ("noisy", "ahead", "short", "thorough", "steps"),
    [
        (True, True, True, False, 2),
        (False, True, True, False, 4),
        (True, False, True, False, 4),
        (True, False, False, False, 5),
        (True, True, True, True, 5),
    ],
    ids=["far ahead", "little noise", "little won", "much won", "to the end all the same"],
)
def test_training_may_stop_before_and_after_its_scouts(
    box: LoadedScene, noisy: bool, ahead: bool, short: bool, thorough: bool, steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    from elps_core.context import build, pilots
    from elps_core.context.build import ContextBuilder
    from elps_core.context.plan import FIRST_PATHS
    from elps_core.context.tables import TableBuilder

    monkeypatch.setattr(pilots, "MOST", pilots.LEAST)
    monkeypatch.setattr(TableBuilder, "finds_noise", noisy)
    monkeypatch.setattr(build, "far_ahead", lambda scouts: ahead)
    monkeypatch.setattr(build, "unguided_wins", lambda scouts: False)
    monkeypatch.setattr(build, "to_compare_again", lambda scouts: ["bdpt, plain", "path, enlightened"])
    monkeypatch.setattr(build, "falls_short", lambda before, after, doublings: short and 1.0 < doublings < 1.1)
    monkeypatch.setattr(build, "worth_measuring", lambda candidates, scouts, pilots, stopped: [p.name for p in pilots])
    settings = SETTINGS.model_copy(update={"paths": FIRST_PATHS * 31, "thorough": thorough})
    builder = ContextBuilder(box, settings)
    while builder.done < builder.steps:
        saved, done = builder.to_bytes(), builder.done
        builder = ContextBuilder(box, settings)
        builder.restore(saved)
        assert builder.done == done
        builder.step()
    statistics = builder.result().statistics
    assert statistics["table_paths"] == FIRST_PATHS * (2**steps - 1)
    assert statistics["thorough"] is (steps == 5)
    known = [entry["name"] for entry in statistics[PILOTS]]
    if steps == 2:
        assert known == list(FIRST_SCOUTS)
    elif steps == 4:
        assert known[:2] == ["bdpt, plain", "path, enlightened"]
        assert len(set(known)) == len(known) > 2
    else:
        assert bool(known) is not thorough


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
    from elps_core.context.pilots import without_singular

    variance = np.array(parts)
    assert variance[without_singular(variance)].sum() == left


@pytest.mark.parametrize("name", CANDIDATES)
def test_variance_and_mean_are_those_of_renders(box: LoadedScene, name: str) -> None:
    from elps_core.context.pilot_image import blurred
    from elps_core.context.pilots import BLURS
    from elps_core.renderer import Renderer

    context = context_of(box)
    assert context.directions is not None
    (pilot,) = (entry for entry in context.statistics[PILOTS] if entry["name"] == name)
    settings = RenderSettings(integrator="auto", max_depth=SETTINGS.max_depth, context=SETTINGS)
    renderer = Renderer(box, candidate(settings, name), context)
    weights = np.array([0.212671, 0.715160, 0.072169])
    images = np.stack([renderer.render_chunk(k, SPP).image @ weights for k in range(IMAGES)])
    image = np.asarray(context.directions.pilot, np.float64)
    assert image.shape == images.shape[1:]
    for _ in range(BLURS):
        image = blurred(image)
    inverse = 1.0 / np.sqrt(np.square(image) + (0.01 * image.mean()) ** 2)
    variance = float((images.var(axis=0, ddof=1) * SPP * np.square(inverse)).mean())
    mean = float((images.mean(axis=0) * inverse).mean())
    assert pilot["mean"] == pytest.approx(mean, rel=0.05)
    assert pilot["variance"] == pytest.approx(variance, rel=0.25)


def test_auto_renders_what_pilots_chose(box: LoadedScene) -> None:
    from elps_core.renderer import Renderer

    settings = RenderSettings(integrator="auto", max_depth=SETTINGS.max_depth, context=SETTINGS)
    renderer = Renderer(box, settings, context_of(box))
    assert renderer.choice.name in CANDIDATES
    forced = Renderer(box, candidate(settings, renderer.choice.name), context_of(box))
    assert np.allclose(renderer.render_chunk(0, 4).image, forced.render_chunk(0, 4).image, rtol=1e-4, atol=1e-5)
    assert [renderer.chunk_spp(index) for index in range(20)] == [forced.chunk_spp(index) for index in range(20)]


def test_light_paths_tell_no_more_than_the_variance_of_eye_paths(box: LoadedScene) -> None:
    pilots = {entry["name"]: entry for entry in context_of(box).statistics[PILOTS]}
    rival = pilots["bdpt, enlightened, unjoined"]["rival"]
    assert 0.0 <= rival < 1.3 * pilots["path, enlightened"]["variance"]
    assert all(entry["rival"] == 0.0 for name, entry in pilots.items() if name != "bdpt, enlightened, unjoined")


def test_what_one_path_says_is_not_sure() -> None:
    from elps_core.context.pilots import at_least

    assert at_least(np.full(64, 3.0)) == 3.0
    lone = np.zeros(64)
    lone[5] = 640.0
    assert at_least(lone) < 0.0
    some = np.random.default_rng(1).exponential(4.0, 1 << 12)
    assert 3.5 < at_least(some) < some.mean()


def test_a_scout_that_is_far_behind_says_little_more(box: LoadedScene, monkeypatch: pytest.MonkeyPatch) -> None:
    from elps_core.context import pilots
    from elps_core.context.pilots import BEHIND, BLOCK

    runner = runner_of(box)
    monkeypatch.setattr(pilots, "SCOUTING", 1e9)
    monkeypatch.setattr(pilots, "MOST", 5)
    alone = runner.run("path, plain", scout=True)
    assert alone.samples == 5 * BLOCK
    # Times jitter, and few blocks know little of a variance: far from the limit on both sides.
    near, far = (
        replace(alone, name="bdpt, plain", variance=alone.variance / (times * BEHIND)) for times in (0.25, 100.0)
    )
    assert runner.run("path, plain", [near], scout=True).samples == 5 * BLOCK
    assert runner.run("path, plain", [near, far], scout=True).samples == 2 * BLOCK
    monkeypatch.setattr(pilots, "SECONDS", 1e9)
    assert runner.run("path, plain", [near, far]).samples == 5 * BLOCK  # A pilot, which renders are chosen by


def runner_of(box: LoadedScene) -> Any:
    from elps_core.context.build import start_density
    from elps_core.context.pilots import PilotRunner
    from elps_core.scene.emission import Emission
    from elps_core.scene.sensors import Camera

    context = context_of(box)
    assert context.directions is not None
    lights = start_density(context, Emission(box.scene))
    return PilotRunner(box.scene, Camera(box.sensor), lights, context.directions, SETTINGS)


def test_the_same_eye_paths_are_compared(box: LoadedScene) -> None:
    """What chance has brought one of two candidates, it brings the other: both have as many of the same samples."""
    from elps_core.context.pilots import BLOCK
    from elps_core.integrators.make import paths_of

    runner = runner_of(box)
    for name, twin in TWINS.items():
        fewer = replace(runner.run(twin), samples=2 * BLOCK)
        assert runner.run(name, [fewer]).samples == 2 * BLOCK
        settings = RenderSettings(integrator="auto", max_depth=SETTINGS.max_depth, context=SETTINGS)
        paths = [
            paths_of(box.scene, runner._camera, runner._lights, candidate(settings, each), runner._parts)
            for each in (name, twin)
        ]
        every = zip((*paths, paths[1]), (7, 7, 8), strict=True)
        noises = [runner._block(bdpt, (key,)).by_eye[0] for bdpt, key in every]
        # Where the lamp is seen, its light can leave no digit for any other.
        noisy = np.all(np.array(noises) > 0.0, axis=0)
        assert noisy.mean() > 0.9
        unjoined, same, others = (np.log(noise[noisy]) for noise in noises)
        assert np.corrcoef(unjoined, same)[0, 1] > 0.6
        assert abs(np.corrcoef(others, same)[0, 1]) < 0.2
