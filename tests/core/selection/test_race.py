"""Who is tried next, and where training ends, by what trials say."""

from __future__ import annotations

import time
from dataclasses import replace

import hypothesis
import pytest
from hypothesis import strategies as st

from elps_core.selection.candidates import (
    BDPT,
    CANDIDATES,
    GUIDED_BDPT,
    GUIDED_PATH,
    LIT_PATH,
    PATH,
    SPARSE_BDPT,
    UNJOINED,
    Candidate,
    Trial,
)
from elps_core.selection.race import (
    BEST,
    COMPILING,
    COMPILING_GUIDED,
    ENDLESS,
    FAR,
    FARTHEST,
    GROWTH,
    GUIDED_COSTS,
    UNKNOWN,
    UNTRIED,
    Allowance,
    brought_up,
    contenders,
    next_trial,
    promise,
    training_pays,
)

EVERY = list(CANDIDATES.values())


def trial(candidate: Candidate, variance: float, microseconds: float = 1.0, **facts: float) -> Trial:
    known = {"error": 0.0, "mean": 1.0, "mean_error": 0.0, "samples": 1 << 16} | facts
    return Trial(name=candidate.name, variance=variance, microseconds=microseconds, **known)  # type: ignore[arg-type]


def given(preparing: float, rendering: float) -> Allowance:
    return Allowance(time.perf_counter() + preparing, rendering)


def test_plain_paths_are_tried_first_and_guided_ones_after_them() -> None:
    assert next_trial(EVERY, []) is PATH
    assert next_trial(EVERY, [trial(PATH, 5.0)]) is GUIDED_PATH


@pytest.mark.parametrize(("variance", "tried"), [(BEST, False), (20.0 * BEST, True)])
def test_joined_paths_are_tried_where_eye_paths_leave_something_to_win(variance: float, tried: bool) -> None:
    trials = [trial(PATH, variance), trial(GUIDED_PATH, variance)]
    assert (next_trial(EVERY, trials) is BDPT) is tried


@pytest.mark.parametrize("caustics", [False, True])
def test_light_paths_that_are_not_joined_are_for_caustics(caustics: bool) -> None:
    trials = [trial(PATH, 50.0), trial(GUIDED_PATH, 20.0), trial(BDPT, 50.0, 3.0)]
    assert next_trial([PATH, GUIDED_PATH, BDPT, UNJOINED], trials, caustics=caustics) is (
        UNJOINED if caustics else None
    )


def test_guided_joined_paths_follow_where_plain_ones_are_near_the_best() -> None:
    eyes = [trial(PATH, 40.0), trial(GUIDED_PATH, 20.0)]
    near, far = [*eyes, trial(BDPT, 10.0, 3.0)], [*eyes, trial(BDPT, 400.0, 3.0)]
    assert next_trial([*EVERY[:3], SPARSE_BDPT], near) is SPARSE_BDPT
    assert next_trial([*EVERY[:3], SPARSE_BDPT], far) is None


def test_what_guided_paths_have_bounds_those_with_lamps_alone() -> None:
    trials = [trial(PATH, 40.0), trial(GUIDED_PATH, 1.0)]
    assert promise(LIT_PATH, trials) < 1.5 * trials[1].efficiency
    assert next_trial([PATH, GUIDED_PATH, LIT_PATH], [*trials, trial(BDPT, 0.3, 1.0)]) is None


def test_what_takes_longer_to_compile_than_there_is_time_is_left_out() -> None:
    trials = [trial(PATH, 5.0, compiling=1.0), trial(GUIDED_PATH, 4.0, compiling=COMPILING_GUIDED)]
    needed = COMPILING["joined"]
    assert next_trial(EVERY, trials, given(2.0 * needed, 60.0)) is BDPT
    assert next_trial([PATH, GUIDED_PATH, BDPT], trials, given(0.9 * needed, 60.0)) is None
    assert next_trial([PATH, GUIDED_PATH, BDPT], trials, given(2.0 * needed, needed)) is None


@pytest.mark.parametrize(
    ("plain", "guided", "pays"),
    [(1.0, 0.5, True), (1.0, 1.05, True), (1.0, 1.1 * GROWTH, False), (2.0 * UNKNOWN, 9.0 * UNKNOWN, True)],
)
def test_training_ends_where_tables_will_not_pay(plain: float, guided: float, pays: bool) -> None:
    assert training_pays([trial(PATH, plain), trial(GUIDED_PATH, guided)], 0.1) is pays


@pytest.mark.parametrize(("times", "pays"), [(0.9, False), (1.1, True)])
def test_paths_of_training_speak_for_guided_ones_that_were_not_tried(times: float, pays: bool) -> None:
    gain = times * GUIDED_COSTS / UNTRIED
    assert training_pays([trial(PATH, 1.0)], gain) is pays
    assert training_pays([trial(PATH, 4.0), trial(BDPT, 0.5, 2.0)], 4.0 * gain) is pays
    assert training_pays([trial(PATH, 2.0 * UNKNOWN)], gain)
    assert training_pays([], gain)


def test_in_the_middle_nothing_is_compiled_for_long() -> None:
    known, allowance = [trial(PATH, 5.0, compiling=1.0)], given(5.0, 60.0)
    assert next_trial([PATH, GUIDED_PATH], known, allowance) is GUIDED_PATH
    assert next_trial([PATH, GUIDED_PATH], known, allowance.hasty()) is None
    assert next_trial([PATH, GUIDED_PATH], known, allowance.hasty(), compiled=[GUIDED_PATH.name]) is GUIDED_PATH
    assert next_trial([PATH, GUIDED_PATH], known, ENDLESS.hasty()) is GUIDED_PATH


def test_where_eye_paths_hardly_find_light_joined_ones_are_tried_at_once() -> None:
    dark = [trial(PATH, 5.0 * FAR * BEST, compiling=1.0)]
    assert next_trial([PATH, BDPT], dark, given(5.0, 60.0).hasty()) is BDPT
    assert next_trial([PATH, BDPT], dark, given(2.0, 60.0).hasty()) is None


def test_hopeless_candidates_are_not_tried_again() -> None:
    middle = [trial(PATH, 1.0), trial(GUIDED_PATH, 2.0 * FARTHEST), trial(BDPT, 0.9 * FARTHEST)]
    left = contenders(EVERY, middle)
    assert GUIDED_PATH not in left
    assert {PATH, BDPT, GUIDED_BDPT} <= set(left)
    unknown = [trial(PATH, 1.0), trial(GUIDED_PATH, 2.0 * UNKNOWN)]
    assert GUIDED_PATH in contenders(EVERY, unknown)


def test_what_was_not_tried_again_is_not_forgotten() -> None:
    middle = [trial(PATH, 2.0, mean=3.0), trial(GUIDED_PATH, 9.0), trial(BDPT, 4.0)]
    end = [trial(GUIDED_PATH, 1.0, mean=0.5, mean_error=0.25), trial(BDPT, 3.0, mean=0.5)]
    every = brought_up(end, middle)
    assert every[:2] == tuple(end)
    assert [each.name for each in every[2:]] == [PATH.name]
    assert (every[2].variance, every[2].mean, every[2].mean_error) == (2.0, 0.5, 0.25)
    assert brought_up([], middle) == (middle[0], middle[2])


@hypothesis.given(
    st.dictionaries(st.sampled_from(list(CANDIDATES)), st.tuples(*[st.floats(1e-3, 1e4)] * 2, st.floats(0.0, 1.0))),
    st.floats(0.0, 100.0),
)
def test_a_race_ends_and_asks_everybody_once(known: dict[str, tuple[float, float, float]], left: float) -> None:
    trials: list[Trial] = []
    allowance = given(left, 60.0)
    while (candidate := next_trial(EVERY, trials, allowance)) is not None:
        assert candidate.name not in {each.name for each in trials}
        variance, microseconds, error = known.get(candidate.name, (1.0, 1.0, 0.1))
        trials.append(replace(trial(candidate, variance, microseconds), error=error * variance))
    if left > 10.0:
        assert trials[0].candidate is PATH
    assert training_pays(trials, 1.0) in (True, False)
    assert set(contenders(EVERY, trials)) <= set(EVERY)
