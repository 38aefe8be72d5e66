"""Which candidates are measured, and whether tables that are being filled will pay: what scouts and pilots say of it.

Early in training a few candidates are compared by scouts, to stop where a candidate without tables will be better.
Imports no Mitsuba.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

from elps_core.choice import (
    CANDIDATES,
    EYE_PATHS,
    JOINED,
    LEAST,
    LIT_PATH,
    LIT_UNJOINED,
    SLOWEST,
    TWINS,
    WITH_CAUSTICS,
    Pilot,
    is_guided,
    known_together,
    together,
)

SCOUTS = ("bdpt, plain", LIT_PATH, EYE_PATHS, WITH_CAUSTICS, LIT_UNJOINED, "path, plain")
"""Those that are compared early in training already, so that it can stop where tables will not pay; each only where it
can still be the best, by what those before it have said: to compile and to run one takes a second and more."""
FIRST_SCOUTS = ("bdpt, plain", LIT_PATH, WITH_CAUSTICS)
"""Those that are compared a step of filling before, as long as the first is far ahead of all others."""
FAR_AHEAD = 2.5
"""Times as efficient as all others joined subpaths have to be then, so that tables need not be filled any further. In
Veach's scene they are 3.5 times as efficient as the best guided ones, and 1.5 times in the end; without its glass 2.1
times and 0.8 times."""
SURE = 10.0
"""Relative variance of joined subpaths below which they are that sure of what there is to find."""
UNGUIDED = {EYE_PATHS: LIT_PATH, WITH_CAUSTICS: LIT_UNJOINED}
"""What the guided ones of them would be without directions by table."""
MOST_GAIN = 2.0
"""How many times smaller tables can still make their variance, at most."""
STILL = 1.5
"""Power of what tables have won by then that they are still to win. In a Cornell box they have won 1.7 times, and win
2.7 times more; on a staircase 1.06 times."""
RIVALS_FALL = 5.0
"""Times smaller that the variance becomes, which light paths tell of eye paths, as tables learn where light comes from:
with a bulb in glass from 560 to 1080 then to 190 to 250 in the end."""
CLEAR = 100.0
"""Relative variance above which nothing is decided then: where light is so hard to find, as at a door that is hardly
ajar, tables do not know it yet."""
WHOLE_TRAINING = 0.1
"""Part of a render's time that the rest of training takes, which guided ones have to win back."""
HOPELESS = 1.5
"""Times as efficient as a candidate another is, where that candidate is not measured."""
DECIDED = 1.15
"""The same of a candidate without directions by table that a scout has measured: a pilot would say the same again."""
TOLD_APART = 1.25
"""The same where a scout has measured it and one that makes the same eye paths: in six of seven scenes the ratio of the
two changed by a third at most until the end of training; in the seventh a mistimed scout had it the other way."""
OUTRIGHT = 1.25
"""Times that paths can be better by the power of lamps, and no roulette by context, than lit by context: 1.24 were
seen, in a Cornell box."""
LIGHT_COSTS = 1.5
"""Times that eye paths have to have more variance than joined subpaths, for light paths to be worth their time."""
JOINS = 1.5
"""Times that tables may do more for joined subpaths than for eye paths."""


def unguided_wins(scouts: Iterable[Pilot]) -> bool:
    """Whether training can stop: one without directions by table is better than those with it are and will be."""
    said = tuple(scouts)
    known = {pilot.name: pilot for pilot in known_together(replace(pilot, rival=0.0) for pilot in said)}
    rival = max((pilot.rival for pilot in said), default=0.0)
    guided = [pilot for pilot in known.values() if is_guided(pilot.name)]
    now, then = (
        [_at_least(rival / RIVALS_FALL, p) for p in ps] for ps in (guided, [_trained(p, known) for p in guided])
    )
    # Eye paths without tables find caustics no more easily.
    others = [_at_least(rival, pilot) for pilot in known.values() if not is_guided(pilot.name)]
    if not guided or not others:
        return False
    best = max(others, key=lambda pilot: pilot.efficiency)
    worth = max(*(p.efficiency for p in now), *((1.0 - WHOLE_TRAINING) * p.efficiency for p in then))
    return best.variance < CLEAR and best.efficiency >= worth


def far_ahead(scouts: Iterable[Pilot]) -> bool:
    """Whether joined subpaths are so much better than all other scouts that tables will not bring these near them."""
    known = {pilot.name: pilot for pilot in known_together(scouts)}
    joined = known.pop("bdpt, plain", None)
    if joined is None or joined.variance >= SURE:
        return False
    # Even if it is better by a standard error: one rare event of its own is no reason to go on.
    joined = replace(joined, variance=max(joined.variance - joined.error, 0.0))
    return all(joined.efficiency >= FAR_AHEAD * other.efficiency for other in known.values())


def to_compare_again(scouts: Iterable[Pilot]) -> list[str]:
    """The best scout and the guided ones, where it is not one of these: a step later it is known how they get on."""
    known = known_together(scouts)
    guided = [pilot.name for pilot in known if is_guided(pilot.name)]
    best = max(known, key=lambda pilot: pilot.efficiency, default=None)
    if best is None or not guided or is_guided(best.name) or best.variance >= CLEAR:
        return []
    return [best.name, *guided]


def falls_short(before: Iterable[Pilot], after: Iterable[Pilot], doublings: float) -> bool:
    """Whether training can stop, by what a step has won for guided scouts.

    ``after`` are those of :func:`to_compare_again`. Each of the ``doublings`` of paths that are left is taken to win as
    much; for what the image is worth that variances are relative to, the one without tables speaks.
    """
    was = {pilot.name: max(pilot.variance, LEAST) for pilot in before}
    plain, *guided = known_together(replace(pilot, rival=0.0) for pilot in after)
    image = max(plain.variance, LEAST) / was[plain.name]
    for pilot in guided:
        won = image * was[pilot.name] / max(pilot.variance, LEAST)
        each = min(max(won, 1.0), CLEAR)  # Bounded, so that its powers are floats
        if (1.0 - WHOLE_TRAINING) * pilot.efficiency * each**doublings > plain.efficiency:
            return False
    return plain.variance < CLEAR


def brought_up(before: Iterable[Pilot], after: Iterable[Pilot]) -> list[Pilot]:
    """Scouts ``after`` a step, and those of ``before`` that were not asked again, in terms of the same image."""
    asked = list(after)
    names = {pilot.name for pilot in asked}
    scouts = list(before)
    first = next(pilot for pilot in scouts if pilot.name == asked[0].name)
    image = max(asked[0].variance, LEAST) / max(first.variance, LEAST)
    root = image**0.5
    left = (pilot for pilot in scouts if pilot.name not in names)
    return [
        *asked,
        *(
            replace(
                pilot,
                variance=image * pilot.variance,
                error=image * pilot.error,
                mean=root * pilot.mean,
                mean_error=root * pilot.mean_error,
            )
            for pilot in left
        ),
    ]


def _at_least(rival: float, pilot: Pilot) -> Pilot:
    """A pilot that knows what light paths have told, if its candidate has none."""
    alone = CANDIDATES[pilot.name]["integrator"] == "path"
    return replace(pilot, variance=max(pilot.variance, rival)) if alone else pilot


def _trained(guided: Pilot, known: Mapping[str, Pilot]) -> Pilot:
    """A scout as it will be in the end, if tables go on as they have begun."""
    plain = known.get(UNGUIDED.get(guided.name, ""))
    gain = plain.variance / max(guided.variance, LEAST) if plain else 1.0
    return replace(guided, variance=guided.variance / min(max(gain, 1.0) ** STILL, MOST_GAIN))


def _joining_may_pay(scouts: Iterable[Pilot]) -> bool:
    """Whether joined subpaths could be the best with tables, if these do for them what they do for eye paths."""
    known = {pilot.name: pilot.efficiency for pilot in known_together(scouts)}
    plain = known.get("path, plain", known.get(LIT_PATH, float("inf")))
    gain = max(1.0, known.get(EYE_PATHS, 0.0) / plain)
    return JOINS * gain * known.get("bdpt, plain", 0.0) >= max(known.values(), default=0.0)


def next_scout(candidates: Iterable[str], scouts: Iterable[Pilot]) -> str | None:
    """The candidate to compare next, early in training; None where no other can be the best."""
    said = tuple(scouts)
    names = {pilot.name for pilot in said}
    return next((n for n in SCOUTS if n in candidates and n not in names and _may_win(n, said)), None)


def _may_win(name: str, others: tuple[Pilot, ...]) -> bool:
    """Whether a candidate can be the best, by what is known of others."""
    known = {pilot.name: pilot for pilot in known_together(others)}
    best = max((pilot.efficiency for pilot in known.values()), default=0.0)
    lit, joined = known.get(LIT_PATH), known.get("bdpt, plain")
    if name in (WITH_CAUSTICS, LIT_UNJOINED) and lit and joined and lit.variance < LIGHT_COSTS * joined.variance:
        return False
    if name == WITH_CAUSTICS:
        return not unguided_wins(others)
    if name == LIT_UNJOINED and lit and EYE_PATHS in known and WITH_CAUSTICS in known:
        gain = known[WITH_CAUSTICS].efficiency / known[EYE_PATHS].efficiency
        return HOPELESS * gain * lit.efficiency >= best
    if name == "path, plain" and lit:
        return OUTRIGHT * lit.efficiency >= best
    if name in JOINED:
        near = known.get(JOINED[-1])
        return _joining_may_pay(others) and (near is None or HOPELESS * near.efficiency >= best)
    return True


def worth_measuring(
    candidates: list[str], scouts: Iterable[Pilot], pilots: Iterable[Pilot] = (), *, stopped: bool = False
) -> list[str]:
    """Those that ``pilots`` have measured, and the candidates to measure after them, as far as is known.

    Without scouts all that can be the best. Where training has ``stopped`` because of scouts, those without directions
    by table, if several are close. Else the guided ones, but those that join subpaths only where it pays without
    tables; and after them, once pilots of these are known, the slowest of them and the others, if they are not hopeless
    against them. None if the only guided one was surely better than all others before its tables were finished.
    """
    said, measured = tuple(scouts), tuple(pilots)
    if not said:
        done = [pilot.name for pilot in measured]
        order = (*SCOUTS, *reversed(JOINED))
        return [*done, *(n for n in order if n in candidates and n not in done and _may_win(n, measured))]
    if stopped:
        close = _within(
            DECIDED, tuple(pilot for pilot in known_together(said) if not is_guided(pilot.name)), candidates
        )
        return close if len(close) > 1 else []
    guided = [name for name in candidates if is_guided(name) and _may_win_trained(name, said)]
    if guided == [EYE_PATHS] and _surely_best(EYE_PATHS, said):
        return []
    others = [name for name in candidates if not is_guided(name) and name in {pilot.name for pilot in said}]
    # By the first guided ones alone, so that the list stays as it is while the others are measured.
    slowest = [name for name in guided if name == SLOWEST]
    first = [name for name in guided if name != SLOWEST]
    early = [pilot for pilot in measured if pilot.name in first]
    if first and len(early) == len(first):
        known = known_together(together(said, early))
        others, near = _within(DECIDED, known, others), _within(HOPELESS, known, list(JOINED))
        slowest = slowest if near else []
    return [*first, *slowest, *others]


def _may_win_trained(name: str, scouts: tuple[Pilot, ...]) -> bool:
    """Whether a guided candidate can be the best in the end."""
    if name in JOINED:
        return _joining_may_pay(scouts)
    known = {pilot.name: pilot.efficiency for pilot in known_together(scouts)}
    return name in known and TOLD_APART * known[name] >= known.get(TWINS.get(name, ""), 0.0)


def _surely_best(name: str, scouts: tuple[Pilot, ...]) -> bool:
    """Whether a scout was the best, even if it is worse and the others are better by their standard errors."""
    known = {pilot.name: pilot for pilot in known_together(scouts)}
    if name not in known:
        return False
    own = known.pop(name)
    low = replace(own, variance=own.variance + own.error).efficiency
    return all(low > replace(p, variance=max(p.variance - p.error, LEAST)).efficiency for p in known.values())


def _within(times: float, pilots: tuple[Pilot, ...], names: list[str]) -> list[str]:
    """Those of ``names`` that the best of all pilots is not more than some ``times`` as efficient as."""
    best = max((pilot.efficiency for pilot in pilots), default=0.0)
    near = {pilot.name for pilot in pilots if times * pilot.efficiency >= best}
    return [name for name in names if name in near]
