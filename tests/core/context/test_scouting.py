"""Which candidates are measured, and where training ends, by what scouts and pilots say."""

from __future__ import annotations

from dataclasses import asdict, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from elps_core.choice import (
    CANDIDATES,
    EYE_PATHS,
    JOINED,
    LIT_PATH,
    LIT_UNJOINED,
    PILOTS,
    SLOWEST,
    WITH_CAUSTICS,
    Pilot,
    choose,
    is_guided,
    together,
)
from elps_core.context.scouting import (
    CLEAR,
    DECIDED,
    FAR_AHEAD,
    FIRST_SCOUTS,
    HOPELESS,
    JOINS,
    LIGHT_COSTS,
    MOST_GAIN,
    OUTRIGHT,
    RIVALS_FALL,
    SCOUTS,
    SURE,
    TOLD_APART,
    WHOLE_TRAINING,
    brought_up,
    falls_short,
    far_ahead,
    next_scout,
    to_compare_again,
    unguided_wins,
    worth_measuring,
)
from tests.core.test_choice import AUTO, ENTRY, of, scouts, statistics


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
    assert worth_measuring(every, clear(pp=9.0), stopped=True) == []
    assert worth_measuring(every, clear(pp=9.0, bp=8.9 / DECIDED), stopped=True) == []
    assert worth_measuring(every, clear(pp=9.0, bp=9.1 / DECIDED), stopped=True) == ["path, plain", "bdpt, plain"]
    assert worth_measuring(every[1:], clear(pp=9.0, bp=9.1 / DECIDED), stopped=True) == []


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


def test_pilots_without_scouts_follow_in_turn() -> None:
    """What none before has made pointless; those that are done stay first, in their order."""
    every = list(CANDIDATES)
    assert worth_measuring(every, [])[:3] == ["bdpt, plain", LIT_PATH, EYE_PATHS]
    known = [of("bdpt, plain", 0.2), of(LIT_PATH, 1.0), of(EYE_PATHS, 8.0)]
    for done in range(4):
        planned = worth_measuring(every, [], known[:done])
        assert planned[:3] == [pilot.name for pilot in known]
    assert planned == planned[:3]


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
    stopped = unguided_wins(scouts)
    pilots: list[Pilot] = []
    while len(names := worth_measuring(order, scouts, pilots, stopped=stopped)) > len(pilots):
        assert names[: len(pilots)] == [pilot.name for pilot in pilots]
        pilots.append(replace(late[names[len(pilots)]], name=names[len(pilots)]))
    known = together(scouts, pilots)
    assert len({pilot.name for pilot in known}) == len(known)
    assert {pilot.name for pilot in known} <= candidates
    assert choose(AUTO, {PILOTS: [asdict(pilot) for pilot in known]}).name in candidates


def test_guided_scouts_are_compared_again_where_another_one_is_the_best() -> None:
    assert to_compare_again(clear(bp=2.0)) == ["bdpt, plain", EYE_PATHS, WITH_CAUSTICS]
    assert to_compare_again(clear(bp=2.0, pe=2.1)) == []
    assert to_compare_again([pilot for pilot in clear(bp=2.0) if not is_guided(pilot.name)]) == []
    assert to_compare_again([]) == []
    assert to_compare_again([of("bdpt, plain", 2.0, variance=CLEAR), of(EYE_PATHS, 1.0)]) == []


@pytest.mark.parametrize("image", [1.0, 0.25])
@pytest.mark.parametrize("doublings", [1.0, 2.0])
def test_what_a_step_has_won_tells_what_is_left_to_win(doublings: float, image: float) -> None:
    """The variance of guided paths falls to 0.8, whatever image it is relative to; they take the same time."""
    needed = 0.8**-doublings * (1.0 - WHOLE_TRAINING)
    for joined, short in ((1.01 * needed, True), (0.99 * needed, False)):
        before = [of(EYE_PATHS, 0.8), of("bdpt, plain", joined)]
        after = [replace(before[1], variance=image), replace(before[0], variance=0.8 * image)]
        assert falls_short(before, after, doublings) is short
        # What was lost by chance is not lost again and again.
        lost = [replace(before[0], variance=0.1), before[1]]
        assert falls_short(lost, after, doublings)
        hard = [replace(pilot, variance=CLEAR / image * pilot.variance) for pilot in after]
        assert not falls_short(before, hard, 0.0)
        found = [after[0], replace(after[1], variance=0.0)]
        assert not falls_short([replace(before[0], variance=1e30), before[1]], found, 8.0)


def test_scouts_that_are_not_asked_again_speak_of_the_same_image() -> None:
    before = [replace(pilot, mean=2.0, mean_error=0.2, error=0.4) for pilot in clear(bp=2.0)]
    after = [replace(pilot, variance=0.25 * pilot.variance, mean=1.0) for pilot in before if is_guided(pilot.name)]
    joined = next(pilot for pilot in before if pilot.name == "bdpt, plain")
    after.insert(0, replace(joined, variance=0.25 * joined.variance, mean=1.0))
    every = brought_up(before, after)
    assert every[: len(after)] == after
    assert {pilot.name for pilot in every} == {pilot.name for pilot in before}
    for pilot in every[len(after) :]:
        first = next(one for one in before if one.name == pilot.name)
        assert pilot.variance == pytest.approx(0.25 * first.variance)
        assert (pilot.error, pilot.mean, pilot.mean_error) == pytest.approx((0.1, 1.0, 0.1))
