"""What is chosen by trials, and from what."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from elps_core.errors import ContextMismatch
from elps_core.scene.summary import SceneSummary
from elps_core.selection.candidates import (
    BDPT,
    CANDIDATES,
    GUIDED_BDPT,
    GUIDED_PATH,
    LIT_PATH,
    MEANWHILE,
    OVER,
    PATH,
    SPARSE_BDPT,
    TRIALS,
    UNJOINED,
    Candidate,
    Choice,
    Trial,
    choose,
    fit_candidates,
    plain_of,
)
from elps_core.settings import ENDLESS, MAX_DEPTH, ContextSettings, RenderSettings, with_overrides

AUTO = RenderSettings(integrator="auto")
ENTRY: dict[str, Any] = {"error": 0.0, "mean": 1.0, "mean_error": 0.0, "microseconds": 1.0, "samples": 9}
CONTEXT: dict[str, Any] = {"direction_sampling": "context", "roulette": "context"}


def statistics(efficiencies: dict[Candidate, float], **facts: Any) -> dict[str, Any]:
    """Of a context with tables whose trials have these efficiencies."""
    entries = [ENTRY | {"name": each.name, "variance": 1e6 / value} for each, value in efficiencies.items()]
    return {TRIALS: entries, "table_paths": 9, MEANWHILE: PATH.name, **facts}


def all_but(best: Candidate, efficiency: float = 2.0) -> dict[str, Any]:
    """Statistics in which one candidate is the best of all."""
    return statistics(dict.fromkeys(CANDIDATES.values(), 1.0) | {best: efficiency})


@pytest.mark.parametrize("best", CANDIDATES.values(), ids=lambda each: each.name)
def test_auto_takes_the_most_efficient(best: Candidate) -> None:
    choice = choose(AUTO, all_but(best))
    assert (choice.name, choice.settings) == (best.name, best.settings(AUTO))
    assert not choice.settings.adaptive


def test_candidates_differ() -> None:
    every = CANDIDATES.values()
    assert len({each.settings(AUTO).model_dump_json() for each in every}) == len(every)


def test_auto_takes_over_what_every_candidate_has() -> None:
    asked = with_overrides(AUTO, {"max_depth": 7, "seed": 3, "width": 8, "height": 9})
    chosen = choose(asked, all_but(BDPT)).settings
    same = ("max_depth", "seed", "width", "height", "light_sampling", "rr_depth", "heuristic", "table_share")
    assert [getattr(chosen, field) for field in same] == [getattr(asked, field) for field in same]


@pytest.mark.parametrize("plain", [PATH, BDPT])
def test_auto_without_trials_goes_on_as_it_began(plain: Candidate) -> None:
    choice = choose(AUTO, {TRIALS: [], MEANWHILE: plain.name})
    assert choice.settings == plain.settings(AUTO)
    assert choice.weight_of_meantime == 1.0
    assert "no time" in choice.lines()[0]


@pytest.mark.parametrize(
    ("integrator", "changes", "plain", "guided"),
    [
        ("path", {}, PATH, GUIDED_PATH),
        ("bdpt", {}, BDPT, GUIDED_BDPT),
        ("bdpt", {"bdpt.eye_paths": 16}, BDPT, SPARSE_BDPT),
        ("light", {}, BDPT, GUIDED_BDPT),
        ("pssmlt", {"pssmlt.multiplexed": True}, BDPT, GUIDED_BDPT),
    ],
)
def test_a_named_integrator_keeps_its_name(
    integrator: str, changes: dict[str, Any], plain: Candidate, guided: Candidate
) -> None:
    asked = with_overrides(RenderSettings(integrator=integrator, **CONTEXT), changes)
    won = choose(asked, statistics({plain: 1.0, guided: 2.0}))
    assert (won.settings, won.name) == (asked, f"{integrator}, enlightened")
    lost = choose(asked, statistics({plain: 2.0, guided: 1.0}))
    assert lost.name == f"{integrator}, plain"
    assert lost.settings == with_overrides(
        asked, {"direction_sampling": "scattering", "roulette": "albedo", "context.adaptive": False}
    )


@pytest.mark.parametrize("integrator", ["path", "bdpt", "light"])
@pytest.mark.parametrize(("eye", "form"), [(PATH, "plain"), (LIT_PATH, "lit by context"), (GUIDED_PATH, "enlightened")])
def test_eye_paths_speak_for_what_was_not_tried(integrator: str, eye: Candidate, form: str) -> None:
    asked = RenderSettings(integrator=integrator, **CONTEXT)
    known = statistics({PATH: 1.0, LIT_PATH: 1.0, GUIDED_PATH: 1.0} | {eye: 2.0})
    assert choose(asked, known).name == f"{integrator}, {form}"


def test_lights_by_context_are_for_those_who_may_have_them() -> None:
    known = statistics({PATH: 1.0, LIT_PATH: 9.0, GUIDED_PATH: 2.0})
    asked = RenderSettings(integrator="path", light_sampling="power", **CONTEXT)
    assert choose(asked, known).name == "path, enlightened"


@pytest.mark.parametrize(
    ("best", "over"), [(PATH, "path"), (GUIDED_PATH, "path"), (BDPT, "bdpt"), (UNJOINED, "unjoined")]
)
@pytest.mark.parametrize("asked", [None, *OVER])
def test_chains_walk_over_the_better_samples_if_nothing_is_said(best: Candidate, over: str, asked: str | None) -> None:
    settings = with_overrides(RenderSettings(integrator="pssmlt", **CONTEXT), {"pssmlt.over": asked})
    choice = choose(settings, all_but(best))
    assert choice.settings.pssmlt.over == (asked or over)
    assert choice.name is not None
    assert choice.name.startswith(f"pssmlt over {asked or over}, ")


def test_a_plain_form_keeps_a_roulette_of_its_own() -> None:
    asked = RenderSettings(integrator="path", direction_sampling="context", roulette="none")
    assert choose(asked, statistics({PATH: 2.0, GUIDED_PATH: 1.0})).settings.roulette == "none"


def test_without_tables_nothing_is_guided() -> None:
    asked = RenderSettings(integrator="path", **CONTEXT)
    choice = choose(asked, {TRIALS: []})
    assert choice.name == "path, plain"
    assert not choice.settings.needs_tables


@pytest.mark.parametrize(
    "settings",
    [
        RenderSettings(integrator="path"),
        RenderSettings(integrator="mi_path"),
        RenderSettings(integrator="path", context=ContextSettings(adaptive=False), **CONTEXT),
        with_overrides(RenderSettings(integrator="bdpt", **CONTEXT), {"bdpt.strategies": "1,2"}),
        RenderSettings(integrator="bdpt", light_sampling="context"),
    ],
)
def test_nothing_to_choose(settings: RenderSettings) -> None:
    assert choose(settings, None) == Choice(settings, None)


@pytest.mark.parametrize(
    "broken",
    [
        {},
        {TRIALS: None},
        {TRIALS: [{"name": "path, plain"}]},
        {TRIALS: [ENTRY | {"name": "magic", "variance": 1.0}]},
        {TRIALS: [ENTRY | {"name": "path, plain", "variance": float("nan")}]},
    ],
)
def test_a_context_without_trials_leaves_no_choice(broken: dict[str, Any]) -> None:
    with pytest.raises(ContextMismatch, match="no trials"):
        choose(AUTO, broken)


def test_auto_needs_trials() -> None:
    with pytest.raises(ValidationError, match="chooses by trials"):
        RenderSettings(integrator="auto", context=ContextSettings(adaptive=False))


@pytest.mark.parametrize(
    "changes", [{"direction_sampling": "context"}, {"roulette": "none"}, {"bdpt": {"joins": False}}]
)
def test_what_auto_would_not_follow_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match="name an integrator"):
        RenderSettings(**changes)


def summary(**changes: Any) -> SceneSummary:
    sensor = {"type": "perspective", "width": 8, "height": 8}
    return SceneSummary.model_validate(
        {"sensors": [sensor], "emitters": [{"type": "area", "count": 1}], "bsdfs": ["diffuse"]}
        | {"shapes": 1, "triangles": 2}
        | changes
    )


@pytest.mark.parametrize(
    ("changes", "only", "plain"),
    [
        ({}, ("path", "bdpt"), PATH),
        ({"bsdfs": ["diffuse", "hair"]}, ("path",), PATH),
        # Light of a point behind glass comes to no eye path.
        ({"bsdfs": ["diffuse", "dielectric"], "emitters": [{"type": "point", "count": 1}]}, ("bdpt",), BDPT),
    ],
)
def test_candidates_find_all_light(changes: dict[str, Any], only: tuple[str, ...], plain: Candidate) -> None:
    fit = fit_candidates(summary(**changes), ContextSettings())
    assert [each.name for each in fit] == [name for name in CANDIDATES if name.startswith(only)]
    assert plain_of(fit) == plain


def test_efficiency_counts_variance_and_time() -> None:
    once = Trial("path, plain", 2.0, 0.5, 1.0, 0.1, 4.0, 9)
    assert once.efficiency == 1e6 / 8.0
    assert once.bound(2.0) == 1e6 / 12.0
    assert once.bound(-2.0) == 1e6 / 4.0


@pytest.mark.parametrize(("error", "best"), [(0.0, BDPT), (0.2, PATH)])
def test_what_trials_have_not_met_counts(error: float, best: Candidate) -> None:
    """Path tracing that has met half of the light has its samples' variance, and that of the other half."""
    known = all_but(PATH, 100.0)
    for entry in known[TRIALS]:
        entry |= {"samples": 1 << 20, "mean_error": error}
        if entry["name"].startswith("path"):
            entry["mean"] = 0.5
        if entry["name"] == BDPT.name:
            entry["variance"] = 1e5
    assert choose(AUTO, known).name == best.name


def test_light_paths_tell_of_the_variance_of_eye_paths() -> None:
    """What eye paths have not met in a trial, and would be far too bright."""
    known = statistics({GUIDED_PATH: 3.0, UNJOINED: 2.0, BDPT: 1.9})
    assert choose(AUTO, known).name == GUIDED_PATH.name
    (told,) = (entry for entry in known[TRIALS] if entry["name"] == UNJOINED.name)
    told["rival"] = 1e6 / 1.5
    choice = choose(AUTO, known)
    assert choice.name == UNJOINED.name
    assert {trial.name: trial.efficiency for trial in choice.trials}[GUIDED_PATH.name] == pytest.approx(1.5)
    assert {trial.name: trial.efficiency for trial in choice.trials}[BDPT.name] == pytest.approx(1.9)


@pytest.mark.parametrize(("plain", "weight"), [(0.5, 0.25), (2.0, 1.0), (8.0, 1.0)])
def test_what_was_rendered_before_counts_by_its_variance(plain: float, weight: float) -> None:
    """Never more than what was chosen, whose samples may be better in time and not in number."""
    choice = choose(AUTO, statistics({PATH: plain, GUIDED_PATH: 2.0}))
    assert choice.weight_of_meantime == pytest.approx(weight if choice.name == GUIDED_PATH.name else 1.0)


def test_a_choice_tells_its_evidence() -> None:
    choice = choose(AUTO, all_but(GUIDED_PATH, 4.0))
    report = choice.report()
    assert report is not None
    assert report["name"] == GUIDED_PATH.name
    assert [entry["name"] for entry in report[TRIALS]] == list(CANDIDATES)
    (line,) = choice.lines()
    assert line.startswith("rendered by path, enlightened")
    assert "path, plain 0.25" in line
    assert choose(RenderSettings(integrator="path"), None).lines() == []


def test_paths_without_a_greatest_depth_may_be_joined() -> None:
    best = choose(RenderSettings(max_depth=-1), all_but(GUIDED_BDPT))
    assert (best.name, best.settings.longest) == (GUIDED_BDPT.name, MAX_DEPTH)
    lone = choose(RenderSettings(max_depth=-1), all_but(GUIDED_PATH))
    assert (lone.name, lone.settings.longest) == (GUIDED_PATH.name, ENDLESS)
