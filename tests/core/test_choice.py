"""What is chosen by pilots, and from what."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from elps_core.choice import (
    CANDIDATES,
    CLEAR,
    DECIDED,
    ENLIGHTENED,
    EYE_PATHS,
    FAR_AHEAD,
    FIRST_SCOUTS,
    HOPELESS,
    JOINED,
    JOINS,
    LIGHT_COSTS,
    LIT_PATH,
    LIT_UNJOINED,
    MOST_GAIN,
    OUTRIGHT,
    PILOTS,
    RIVALS_FALL,
    SCOUTS,
    SLOWEST,
    SURE,
    TOLD_APART,
    WHOLE_TRAINING,
    WITH_CAUSTICS,
    Choice,
    Pilot,
    candidate,
    choose,
    far_ahead,
    fit_candidates,
    next_scout,
    together,
    unguided_wins,
    worth_measuring,
)
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


def clear(**efficiencies: float) -> list[Pilot]:
    """Scouts of a scene where light is easy to find."""
    return [replace(pilot, variance=1e-6 * pilot.variance) for pilot in scouts(**efficiencies)]


@pytest.mark.parametrize(
    ("efficiencies", "wins"),
    [
        ({}, True),
        ({"pe": 1.01}, False),  # It is better already
        ({"pe": 0.99}, True),
        ({"pp": 1.01}, True),
        ({"bp": 1.01}, True),
        ({"blbcu": 1.01}, True),
        ({"pp": 1.01, "beu": 1.14}, False),
        ({"pp": 0.1, "bp": 0.1}, True),  # One that is lit by context is still as good
        ({"pp": 0.1, "bp": 0.1, "plbc": 0.1}, False),
    ],
)
def test_training_stops_where_a_plain_one_is_ahead(efficiencies: dict[str, float], wins: bool) -> None:
    assert unguided_wins(clear(**efficiencies)) is wins


@pytest.mark.parametrize(
    ("efficiencies", "ahead"),
    [
        ({"bp": 1.01 * FAR_AHEAD}, True),
        ({"bp": 0.99 * FAR_AHEAD}, False),
        ({"bp": 9.0, "plbc": 9.0 / FAR_AHEAD + 0.1}, False),
        ({"bp": 9.0, "beu": 9.0 / FAR_AHEAD + 0.1}, False),
    ],
)
def test_tables_are_given_up_early_where_joined_subpaths_are_far_ahead(
    efficiencies: dict[str, float], ahead: bool
) -> None:
    first = [pilot for pilot in clear(**efficiencies) if pilot.name in FIRST_SCOUTS]
    assert far_ahead(first) is ahead
    joined, others = next(p for p in first if p.name == "bdpt, plain"), [p for p in first if p.name != "bdpt, plain"]
    assert far_ahead([joined])  # Of those that were asked so far
    assert not far_ahead(others)
    # One rare event of theirs is no reason to go on, and with many of them they are not sure of anything.
    rare = replace(joined, variance=3.0 * joined.variance, error=2.0 * joined.variance)
    assert far_ahead([rare, *others]) is ahead
    assert not far_ahead([replace(joined, variance=SURE), *(replace(p, variance=1e9) for p in others)])


@pytest.mark.parametrize("guided", ["pe", "beu"])
def test_tables_go_on_as_they_have_begun(guided: str) -> None:
    """Here their paths have half of the variance, and take twice the time and more."""
    names = {"pe": "path, enlightened", "beu": "bdpt, enlightened, unjoined"}
    for slower, wins in ((3.9 * (1.0 - WHOLE_TRAINING), False), (4.1 * (1.0 - WHOLE_TRAINING), True)):
        said = clear(**{"pe": 0.01, "beu": 0.01, guided: 2.0})
        slow = [replace(p, microseconds=slower) if p.name == names[guided] else p for p in said]
        assert unguided_wins(slow) is wins
        # What they have not won of their own kind is no sign
        own = (LIT_PATH, LIT_UNJOINED)
        worse = [replace(p, variance=0.5, microseconds=2.0) if p.name in own else p for p in slow]
        assert unguided_wins(worse)
    far = clear(**{"pe": 1e-3, "beu": 1e-3, guided: 100.0, "bp": 99.0 * MOST_GAIN * (1.0 - WHOLE_TRAINING)})
    assert not unguided_wins(far)
    assert unguided_wins([replace(p, variance=0.9 * p.variance) if p.name == "bdpt, plain" else p for p in far])


def test_training_goes_on_where_light_is_hard_to_find() -> None:
    said = clear(pp=2.0)
    assert unguided_wins(said)
    hard = [replace(pilot, variance=2.1 * CLEAR * pilot.variance) for pilot in said]
    assert not unguided_wins(hard)


@pytest.mark.parametrize(
    ("efficiencies", "rival", "wins"),
    [
        ({"pe": 2.0, "bp": 1.1}, 0.0, False),
        ({"pe": 2.0, "bp": 1.1}, RIVALS_FALL / 1.3, False),  # Eye paths will still be better than others
        ({"pe": 2.0, "bp": 1.0}, RIVALS_FALL / 0.9, True),
        ({"pp": 9.0, "pe": 2.0, "beu": 1.5}, 1e9, False),  # Those without tables are no better then
        ({"pp": 9.0, "pe": 2.0, "beu": 1.5}, 0.0, True),
    ],
)
def test_what_light_paths_tell_of_eye_paths_may_stop_training(
    efficiencies: dict[str, float], rival: float, wins: bool
) -> None:
    told = "bdpt, enlightened, unjoined"
    said = [replace(pilot, rival=rival * (pilot.name == told)) for pilot in clear(**efficiencies)]
    assert unguided_wins(said) is wins


def test_scouts_need_something_to_compare() -> None:
    assert not unguided_wins([])
    assert not unguided_wins(clear()[:1])


def test_plain_candidates_are_measured_again_where_several_are_close() -> None:
    every = list(CANDIDATES)
    assert worth_measuring(every, clear(pp=9.0)) == []
    assert worth_measuring(every, clear(pp=9.0, bp=8.9 / DECIDED)) == []
    assert worth_measuring(every, clear(pp=9.0, bp=9.1 / DECIDED)) == ["path, plain", "bdpt, plain"]
    assert worth_measuring(every[1:], clear(pp=9.0, bp=9.1 / DECIDED)) == []


def test_subpaths_are_joined_by_context_where_it_may_pay() -> None:
    every = list(CANDIDATES)
    assert set(worth_measuring(every, [])) == set(every)
    # What tables do for eye paths, they may do for joined subpaths, and a little more
    assert set(worth_measuring(every, scouts(pe=9.0, beu=8.0, bp=1.01 / JOINS))) == set(every)
    without = worth_measuring(every, scouts(pe=9.0, beu=8.0, bp=0.99 / JOINS))
    assert set(without) == set(every) - set(JOINED)
    assert set(worth_measuring(every, scouts(pp=0.9, bp=0.91 / JOINS, beu=0.8))) == set(every)
    # What is lit by context speaks for a plain path that no scout was asked of.
    for joined, pays in ((1.01, True), (0.99, False)):
        said = [of(EYE_PATHS, 9.0), of(LIT_PATH, 3.0), of("bdpt, plain", 3.0 * joined / JOINS)]
        assert set(JOINED).issubset(worth_measuring(every, said)) is pays


def test_what_tables_have_left_behind_is_not_measured_again() -> None:
    """Guided candidates come first, so that it is known how good they are when the others' turn comes."""
    every = list(CANDIDATES)
    said = scouts(pe=9.0, beu=8.0, bp=9.0, pp=9.0 / DECIDED)
    guided = [name for name in every if is_guided(name)]
    first = [name for name in guided if name != SLOWEST]
    planned = worth_measuring(every, said)
    assert planned[: len(guided)] == [*first, SLOWEST]

    def measured(**efficiencies: float) -> list[Pilot]:
        return [Pilot(**entry) for entry in statistics(**efficiencies)[PILOTS] if entry["name"] in first]

    near = measured(pe=0.97 * 9.0 * DECIDED)
    assert worth_measuring(every, said, near[:-1]) == planned
    assert worth_measuring(every, said, near) == [*first, "bdpt, plain"]
    more = [*near, Pilot(**ENTRY | {"name": "bdpt, plain", "variance": 1.0, "mean": 50.0})]
    assert worth_measuring(every, said, more) == [*first, "bdpt, plain"]
    assert worth_measuring(every, said, measured(pe=1.03 * 9.0 * DECIDED)) == first
    # The slowest follows where what is nearest to it is not hopeless.
    assert worth_measuring(every, said, measured(pe=20.0, be4ep=20.1 / HOPELESS)) == [*first, SLOWEST]
    assert worth_measuring(every, said, measured(pe=20.0, be4ep=19.9 / HOPELESS)) == first


def of(name: str, efficiency: float, **known: float) -> Pilot:
    """What was said of a candidate whose samples take the time for that efficiency."""
    pilot = Pilot(**ENTRY | {"name": name, "variance": 1.0} | known)
    return replace(pilot, microseconds=1e6 / (efficiency * pilot.variance))


def in_turn(known: list[Pilot], candidates: tuple[str, ...] = SCOUTS) -> list[str]:
    """The scouts that go out where these are what they say."""
    said: list[Pilot] = []
    while (name := next_scout(candidates, said)) is not None:
        said.append(next(pilot for pilot in known if pilot.name == name))
    return [pilot.name for pilot in said]


def test_scouts_go_out_where_they_may_find_the_best() -> None:
    """Light paths, where joined ones have less variance; the power of lamps, where their regions are near the best."""
    three = ["bdpt, plain", LIT_PATH, EYE_PATHS]
    plain, unjoined, twin = (of(name, 1.0) for name in ("path, plain", LIT_UNJOINED, WITH_CAUSTICS))
    for lit, last in ((0.99, []), (1.01, ["path, plain"])):
        eye, joined = of(EYE_PATHS, 8.0), of("bdpt, plain", 1.0, variance=1.01 / LIGHT_COSTS)
        said = [of(LIT_PATH, 8.0 * lit / OUTRIGHT), eye, joined, plain, unjoined, twin]
        assert in_turn(said) == [*three, *last]
        assert in_turn(said, SCOUTS[:3]) == three
    joined = of("bdpt, plain", 1.0, variance=0.99 / LIGHT_COSTS)
    # What light paths have done for guided eye paths, they may do for others, and a little more.
    for gain, last in ((0.49, []), (0.51, [LIT_UNJOINED])):
        said = [of(LIT_PATH, 4.0), of(EYE_PATHS, 12.0), joined, of(WITH_CAUSTICS, 24.0 * gain), unjoined, plain]
        near = 4.0 * HOPELESS * gain * 2.0 / max(12.0, 24.0 * gain)
        assert in_turn(said) == [*three, WITH_CAUSTICS, *(last if near >= 1.0 else [])]
    # Where training stops anyway, nothing is asked that only tables would make better.
    ahead = of("bdpt, plain", 30.0, variance=0.1)
    assert in_turn([of(LIT_PATH, 4.0), of(EYE_PATHS, 8.0), ahead, unjoined, plain]) == [*three, LIT_UNJOINED]


def test_one_that_is_surely_the_best_needs_no_pilot() -> None:
    every = list(CANDIDATES)
    said = [of(EYE_PATHS, 9.0, error=0.1), of(LIT_PATH, 6.0, error=0.1), of("bdpt, plain", 1.0)]
    assert worth_measuring(every, said) == []
    assert choose(AUTO, {PILOTS: [asdict(pilot) for pilot in together(said, [])]}).name == EYE_PATHS
    unsure = [replace(said[0], error=0.3), replace(said[1], error=0.2), said[2]]
    assert worth_measuring(every, unsure) == [EYE_PATHS, LIT_PATH, "bdpt, plain"]


def test_paths_that_are_alike_are_measured_again_where_they_are_close() -> None:
    every = list(CANDIDATES)
    for other, again in ((9.1 / TOLD_APART, True), (8.9 / TOLD_APART, False)):
        said = [of(EYE_PATHS, 9.0), of(WITH_CAUSTICS, other), of(LIT_PATH, 1.0), of("bdpt, plain", 1.0)]
        assert (WITH_CAUSTICS in worth_measuring(every, said)) is again
    told = [replace(said[0]), replace(said[1], rival=1.5), *said[2:]]
    assert WITH_CAUSTICS in worth_measuring(every, told)


def test_what_tables_have_won_they_have_won_for_paths_that_are_alike() -> None:
    said = [of(EYE_PATHS, 9.0), of(WITH_CAUSTICS, 3.0, rival=5.0), of(LIT_PATH, 1.0)]
    found = {pilot.name: pilot for pilot in together(said, [replace(said[0], variance=0.25)])}
    assert found[WITH_CAUSTICS].efficiency == pytest.approx(12.0)
    assert found[WITH_CAUSTICS].rival == 0.0
    assert found[LIT_PATH].efficiency == pytest.approx(1.0)
    worse = {pilot.name: pilot for pilot in together(said, [replace(said[0], variance=4.0)])}
    assert worse[WITH_CAUSTICS].efficiency == pytest.approx(3.0)


def test_pilots_without_scouts_follow_in_turn() -> None:
    """What none before has made pointless; those that are done stay first, in their order."""
    every = list(CANDIDATES)
    assert worth_measuring(every, [])[:3] == ["bdpt, plain", LIT_PATH, EYE_PATHS]
    known = [of("bdpt, plain", 0.2), of(LIT_PATH, 1.0), of(EYE_PATHS, 8.0)]
    for done in range(4):
        planned = worth_measuring(every, [], known[:done])
        assert planned[:3] == [pilot.name for pilot in known]
    assert planned == planned[:3]


def is_guided(name: str) -> bool:
    return ENLIGHTENED.items() <= CANDIDATES[name].items()


NUMBERS = st.sampled_from([0.0, 0.02, 0.5, 1.0, 1.2, 2.0, 30.0, 1e4])
SAID = st.builds(Pilot, st.just(""), NUMBERS, NUMBERS, NUMBERS, NUMBERS, NUMBERS, st.just(9), NUMBERS)
ALL_SAY = st.fixed_dictionaries(dict.fromkeys(CANDIDATES, SAID))


@given(candidates=st.sets(st.sampled_from(sorted(CANDIDATES)), min_size=1), early=st.none() | ALL_SAY, late=ALL_SAY)
def test_whatever_they_say_there_is_a_choice(
    candidates: set[str], early: dict[str, Pilot] | None, late: dict[str, Pilot]
) -> None:
    """Scouts and pilots follow one another to an end, none twice, and none in the place of one that has been."""
    order = [name for name in CANDIDATES if name in candidates]
    scouts: list[Pilot] = []
    while early and (scout := next_scout(order, scouts)) is not None:
        scouts.append(replace(early[scout], name=scout))
    unguided_wins(scouts)
    pilots: list[Pilot] = []
    while len(names := worth_measuring(order, scouts, pilots)) > len(pilots):
        assert names[: len(pilots)] == [pilot.name for pilot in pilots]
        pilots.append(replace(late[names[len(pilots)]], name=names[len(pilots)]))
    known = together(scouts, pilots)
    assert len({pilot.name for pilot in known}) == len(known)
    assert {pilot.name for pilot in known} <= candidates
    assert choose(AUTO, {PILOTS: [asdict(pilot) for pilot in known]}).name in candidates


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
