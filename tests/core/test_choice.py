"""What is chosen by pilots, and from what."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import pytest
from pydantic import ValidationError

from elps_core.choice import (
    CANDIDATES,
    EYE_PATHS,
    JOINED,
    LIT_PATH,
    LIT_UNJOINED,
    PILOTS,
    WITH_CAUSTICS,
    Choice,
    Pilot,
    candidate,
    choose,
    fit_candidates,
    is_guided,
    together,
)
from elps_core.context.scouting import SCOUTS
from elps_core.errors import ContextMismatch
from elps_core.scene.summary import SceneSummary
from elps_core.settings import ContextSettings, RenderSettings, with_overrides

AUTO = RenderSettings(integrator="auto")
ENTRY: dict[str, Any] = {"error": 0.0, "mean": 1.0, "mean_error": 0.0, "microseconds": 1.0, "samples": 9}
LIT_ONES = ("plbc", "blbcu")
CONTEXT: dict[str, Any] = {"direction_sampling": "context", "roulette": "context"}


def statistics(**efficiencies: float) -> dict[str, Any]:
    """Of a context whose pilots have these efficiencies, by initials of the candidates; the others have 1."""
    entries = []
    for name in CANDIDATES:
        efficiency = efficiencies.get("".join(word[0] for word in name.replace(",", "").split()), 1.0)
        entries.append(ENTRY | {"name": name, "variance": 1e6 / efficiency})
    return {PILOTS: entries}


@pytest.mark.parametrize("name", CANDIDATES)
def test_auto_takes_the_most_efficient(name: str) -> None:
    initials = "".join(word[0] for word in name.replace(",", "").split())
    choice = choose(AUTO, statistics(**{initials: 2.0}))
    assert choice.name == name
    assert choice.settings == candidate(AUTO, name)
    assert not choice.settings.adaptive


def test_candidates_differ() -> None:
    assert len({candidate(AUTO, name).model_dump_json() for name in CANDIDATES}) == len(CANDIDATES)


def test_auto_takes_over_what_every_candidate_has() -> None:
    asked = with_overrides(AUTO, {"max_depth": 7, "seed": 3, "width": 8, "height": 9, "light_sampling": "power"})
    chosen = choose(asked, statistics(bp=2.0)).settings
    same = ("max_depth", "seed", "width", "height", "light_sampling", "rr_depth", "heuristic", "table_share")
    assert [getattr(chosen, field) for field in same] == [getattr(asked, field) for field in same]


@pytest.mark.parametrize(
    ("integrator", "changes", "plain", "enlightened"),
    [
        ("path", {}, "pp", "pe"),
        ("bdpt", {}, "bp", "be"),
        ("bdpt", {"bdpt.eye_paths": 4}, "bp", "be4ep"),
        ("bdpt", {"bdpt.eye_paths": 16}, "bp", "be4ep"),
        ("bdpt", {"bdpt.eye_paths": 16, "bdpt.joins": False}, "bp", "beu"),
        ("light", {}, "bp", "be"),
        ("pssmlt", {"pssmlt.multiplexed": True}, "bp", "be"),
    ],
)
def test_a_named_integrator_keeps_its_name(
    integrator: str, changes: dict[str, Any], plain: str, enlightened: str
) -> None:
    asked = with_overrides(RenderSettings(integrator=integrator, **CONTEXT), changes)
    names = {"".join(word[0] for word in name.replace(",", "").split()) for name in CANDIDATES}
    others = dict.fromkeys(names - {plain, enlightened, *LIT_ONES}, 100.0) | dict.fromkeys(LIT_ONES, 1.0)
    won = choose(asked, statistics(**others, **{enlightened: 2.0}))
    assert (won.settings, won.name) == (asked, f"{integrator}, enlightened")
    lost = choose(asked, statistics(**others, **{plain: 2.0}))
    assert lost.name == f"{integrator}, plain"
    assert lost.settings == with_overrides(
        asked, {"direction_sampling": "scattering", "roulette": "albedo", "context.adaptive": False}
    )


@pytest.mark.parametrize(
    ("integrator", "changes", "title", "roulette"),
    [
        ("path", {}, "path", "context"),
        ("bdpt", {"bdpt.eye_paths": 16, "bdpt.joins": False}, "bdpt", "context"),
        ("pssmlt", {"pssmlt.over": "unjoined"}, "pssmlt over unjoined", "albedo"),
        ("pssmlt", {}, "pssmlt over unjoined", "albedo"),
    ],
)
def test_lights_by_context_alone_may_be_the_best_form(
    integrator: str, changes: dict[str, Any], title: str, roulette: str
) -> None:
    asked = with_overrides(RenderSettings(integrator=integrator, **CONTEXT), changes)
    known = statistics(plbc=2.5, pe=2.0, blbcu=3.0, beu=2.0)
    choice = choose(asked, known)
    assert choice.name == f"{title}, lit by context"
    assert (choice.settings.light_sampling, choice.settings.direction_sampling) == ("context", "scattering")
    assert (choice.settings.roulette, choice.settings.bdpt) == (roulette, asked.bdpt)
    own = choose(with_overrides(asked, {"roulette": "none"}), known)
    assert own.settings.roulette == "none"
    over = {"pssmlt.over": "unjoined"} if integrator == "pssmlt" else {}
    other = with_overrides(asked, {"light_sampling": "power", **over})
    assert choose(other, known).name == f"{title}, enlightened"


@pytest.mark.parametrize(
    ("best", "over"), [("pp", "path"), ("pe", "path"), ("bp", "bdpt"), ("be", "bdpt"), ("beu", "unjoined")]
)
@pytest.mark.parametrize("asked", [None, "path", "bdpt", "unjoined"])
def test_chains_walk_over_the_better_samples_if_nothing_is_said(best: str, over: str, asked: str | None) -> None:
    settings = with_overrides(RenderSettings(integrator="pssmlt", **CONTEXT), {"pssmlt.over": asked})
    choice = choose(settings, statistics(**{best: 2.0}))
    assert choice.settings.pssmlt.over == (asked or over)
    plain = {"pp": {"path"}, "bp": {"bdpt", "unjoined"}}.get(best, set())
    enlightened = choice.settings.pssmlt.over not in plain  # What is alike is enlightened
    assert choice.name == f"pssmlt over {asked or over}, {'enlightened' if enlightened else 'plain'}"
    assert (choice.settings.direction_sampling == "context") is enlightened


def test_chains_do_not_walk_over_samples_that_were_left_out() -> None:
    found = statistics(pe=2.0)
    found[PILOTS] = [entry for entry in found[PILOTS] if entry["name"] not in JOINED]
    assert choose(RenderSettings(integrator="pssmlt", **CONTEXT), found).name == "pssmlt over path, enlightened"


def test_chains_walk_over_samples_of_bdpt_without_pilots() -> None:
    from elps_core.paths.strategies import chosen

    assert chosen(RenderSettings(integrator="pssmlt"), aperture=False).light_paths


def test_a_plain_form_keeps_a_roulette_of_its_own() -> None:
    asked = RenderSettings(integrator="path", direction_sampling="context", roulette="none")
    assert choose(asked, statistics(pp=2.0)).settings.roulette == "none"


@pytest.mark.parametrize(
    "settings",
    [
        RenderSettings(integrator="path"),
        RenderSettings(integrator="mi_path"),
        RenderSettings(integrator="path", context=ContextSettings(adaptive=False), **CONTEXT),
        with_overrides(RenderSettings(**CONTEXT), {"bdpt.strategies": "1,2"}),
        RenderSettings(integrator="bdpt", light_sampling="context"),
    ],
)
def test_nothing_to_choose(settings: RenderSettings) -> None:
    assert choose(settings, None) == Choice(settings, None)


BROKEN: list[dict[str, Any]] = [
    {},
    {PILOTS: []},
    {PILOTS: None},
    {PILOTS: [{"name": "path, plain"}]},
    {PILOTS: [ENTRY | {"name": "magic", "variance": 1.0}]},
    {PILOTS: [ENTRY | {"name": "path, plain", "variance": float("nan")}]},
]


@pytest.mark.parametrize("broken", BROKEN)
def test_without_pilots_there_is_no_choice(broken: dict[str, Any]) -> None:
    with pytest.raises(ContextMismatch, match="no pilots"):
        choose(AUTO, broken)


def scouts(**efficiencies: float) -> list[Pilot]:
    return [Pilot(**e) for e in statistics(**efficiencies)[PILOTS] if e["name"] in SCOUTS]


def of(name: str, efficiency: float, **known: float) -> Pilot:
    """What was said of a candidate whose samples take the time for that efficiency."""
    pilot = Pilot(**ENTRY | {"name": name, "variance": 1.0} | known)
    return replace(pilot, microseconds=1e6 / (efficiency * pilot.variance))


def test_what_tables_have_won_they_have_won_for_paths_that_are_alike() -> None:
    said = [of(EYE_PATHS, 9.0), of(WITH_CAUSTICS, 3.0, rival=5.0), of(LIT_PATH, 1.0)]
    found = {pilot.name: pilot for pilot in together(said, [replace(said[0], variance=0.25)])}
    assert found[WITH_CAUSTICS].efficiency == pytest.approx(12.0)
    assert found[WITH_CAUSTICS].rival == 0.0
    assert found[LIT_PATH].efficiency == pytest.approx(1.0)
    worse = {pilot.name: pilot for pilot in together(said, [replace(said[0], variance=4.0)])}
    assert worse[WITH_CAUSTICS].efficiency == pytest.approx(3.0)


def test_scouts_speak_in_terms_of_pilots() -> None:
    """Relative to an image that was too dark they had greater means and variances, and knew them worse."""
    said = [replace(pilot, mean=1.25, mean_error=0.01) for pilot in scouts(pp=1.0, bp=2.0)]
    pilots = [replace(pilot, mean=1.0, mean_error=0.02) for pilot in scouts(pe=50.0, beu=40.0)]
    guided = [pilot for pilot in pilots if is_guided(pilot.name)]
    every = together(said, guided)
    assert every[: len(guided)] == tuple(guided)
    assert {pilot.name for pilot in every} == {pilot.name for pilot in pilots}
    efficiency = {pilot.name: pilot.efficiency for pilot in every}
    assert efficiency["path, plain"] == pytest.approx(1.25**2)
    assert efficiency["bdpt, plain"] == pytest.approx(2.0 * 1.25**2)
    # Means of another image are no light that guided paths have missed.
    choice = choose(AUTO, {PILOTS: [asdict(pilot) for pilot in every]})
    assert choice.name == "path, enlightened"
    assert {p.name: p.efficiency for p in choice.pilots}["path, enlightened"] == pytest.approx(50.0)


def test_what_scouts_knew_to_be_missing_stays_missed() -> None:
    said = [replace(p, mean=0.5 if p.name == "path, plain" else 1.0, samples=1 << 20) for p in scouts(pp=9.0)]
    for guided in ([pilot for pilot in said if is_guided(pilot.name)], []):
        assert {p.name: p.efficiency for p in together(said, guided)}["path, plain"] < 5.0


@pytest.mark.parametrize(
    ("name", "scout", "expected"),
    [
        ("path, enlightened", 1.0, 1.8),  # By a rare event of the pilot
        ("path, enlightened", 9.0, 5.0),  # Tables have become better
        ("path, plain", 1.0, 1.8),
        ("path, plain", 9.0, 8.2),
    ],
)
def test_scouts_and_pilots_know_more_together(name: str, scout: float, expected: float) -> None:
    said = [replace(p, variance=scout, error=1.0) if p.name == name else p for p in scouts()]
    found = [replace(p, variance=5.0, error=2.0) if p.name == name else p for p in scouts()]
    (both,) = (pilot for pilot in together(said, found) if pilot.name == name)
    assert both.variance == pytest.approx(expected)
    assert both.error == pytest.approx(2.0 if expected == 5.0 else 2.0 / 5.0**0.5)


def test_what_was_left_out_is_judged_by_what_is_nearest() -> None:
    found = statistics(bp=2.0, beu=3.0)
    found[PILOTS] = [entry for entry in found[PILOTS] if entry["name"] not in JOINED]
    asked = RenderSettings(integrator="bdpt", **CONTEXT)
    assert choose(asked, found).name == "bdpt, enlightened"
    found = statistics(bp=2.0, be4ep=3.0)
    found[PILOTS] = [entry for entry in found[PILOTS] if entry["name"] != JOINED[0]]
    assert choose(asked, found).name == "bdpt, enlightened"
    found = statistics(bp=2.0, pe=3.0)
    found[PILOTS] = [entry for entry in found[PILOTS] if entry["name"] not in (*JOINED, WITH_CAUSTICS, LIT_UNJOINED)]
    assert choose(asked, found).name == "bdpt, enlightened"
    unjoined = with_overrides(asked, {"bdpt.eye_paths": 4, "bdpt.joins": False})
    assert choose(unjoined, found).name == "bdpt, enlightened"


def test_auto_needs_pilots() -> None:
    with pytest.raises(ValidationError, match="chooses by pilots"):
        RenderSettings(integrator="auto", context=ContextSettings(adaptive=False))


def summary(**changes: Any) -> SceneSummary:
    sensor = {"type": "perspective", "width": 8, "height": 8}
    return SceneSummary.model_validate(
        {"sensors": [sensor], "emitters": [{"type": "area", "count": 1}], "bsdfs": ["diffuse"]}
        | {"shapes": 1, "triangles": 2}
        | changes
    )


@pytest.mark.parametrize(
    ("changes", "only"),
    [
        ({}, ("path", "bdpt")),
        ({"bsdfs": ["diffuse", "hair"]}, ("path",)),
        # Light of a point behind glass comes to no eye path.
        ({"bsdfs": ["diffuse", "dielectric"], "emitters": [{"type": "point", "count": 1}]}, ("bdpt",)),
    ],
)
def test_candidates_find_all_light(changes: dict[str, Any], only: tuple[str, ...]) -> None:
    fit = fit_candidates(summary(**changes), ContextSettings())
    assert fit == [name for name in CANDIDATES if name.startswith(only)]


def test_efficiency_counts_variance_and_time() -> None:
    once = Pilot("path, plain", 2.0, 0.1, 1.0, 0.1, 4.0, 9)
    assert once.efficiency == 1e6 / 8.0


@pytest.mark.parametrize(("error", "name"), [(0.0, "bdpt, plain"), (0.2, "path, plain")])
def test_what_pilots_have_not_met_counts(error: float, name: str) -> None:
    """Path tracing that has met half of the light has its samples' variance, and that of the other half."""
    entries = statistics(pp=100.0)[PILOTS]
    for entry in entries:
        entry["samples"] = 1 << 20
        entry["mean_error"] = error
        if entry["name"].startswith("path"):
            entry["mean"] = 0.5
        if entry["name"] == "bdpt, plain":
            entry["variance"] = 1e5
    assert choose(AUTO, {PILOTS: entries}).name == name


def test_light_paths_tell_of_the_variance_of_eye_paths() -> None:
    """What eye paths have not met in a pilot, and would be far too bright: only that of the same eye paths."""
    found = statistics(pe=3.0, beu=2.0, pp=1.9)
    assert choose(AUTO, found).name == "path, enlightened"
    (told,) = (entry for entry in found[PILOTS] if entry["name"] == "bdpt, enlightened, unjoined")
    told["rival"] = 1e6 / 1.5
    choice = choose(AUTO, found)
    assert choice.name == "bdpt, enlightened, unjoined"
    assert {p.name: p.efficiency for p in choice.pilots}["path, enlightened"] == pytest.approx(1.5)
    assert {p.name: p.efficiency for p in choice.pilots}["path, plain"] == pytest.approx(1.9)


def test_a_choice_tells_its_evidence() -> None:
    choice = choose(AUTO, statistics(pe=4.0))
    report = choice.report()
    assert report is not None
    assert report["name"] == "path, enlightened"
    assert [entry["name"] for entry in report[PILOTS]] == list(CANDIDATES)
    (line,) = choice.lines()
    assert line.startswith("rendered by path, enlightened")
    assert "path, plain 0.25" in line
    assert choose(RenderSettings(integrator="path"), None).lines() == []
