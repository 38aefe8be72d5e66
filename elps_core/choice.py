"""Which algorithm renders: as asked for, or the one that pilots have shown to be the best [no regret].

Pilots are measured with a scene's context and kept in it, so that all its renders choose alike, on
whatever machine. Their samples enter no image: a choice by the samples themselves would be biased.
Imports no Mitsuba.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from math import hypot, isfinite
from typing import Any

from elps_core.errors import ContextMismatch, SettingsRejected
from elps_core.scene import reach
from elps_core.scene.summary import SceneSummary
from elps_core.settings import BdptSettings, ContextSettings, PathSettings, RenderSettings, with_overrides

PLAIN = {"direction_sampling": "scattering", "roulette": "albedo"}
"""What an algorithm does without the context's tables."""
LIT = {"light_sampling": "context", "direction_sampling": "scattering", "roulette": "context"}
"""What it does with all but their directions: regions know their lamps, and how much light there is, long before they
know where it comes from."""
ENLIGHTENED = {"direction_sampling": "context", "roulette": "context"}
"""What it does with them."""
UNJOINED = {"bdpt.eye_paths": 4, "bdpt.joins": False}
"""Light paths that only bring to the sensor what they meet, one for four eye paths."""
CANDIDATES: dict[str, dict[str, Any]] = {
    "path, plain": {"integrator": "path", **PLAIN},
    "path, lit by context": {"integrator": "path", **LIT},
    "path, enlightened": {"integrator": "path", **ENLIGHTENED},
    "bdpt, plain": {"integrator": "bdpt", **PLAIN},
    "bdpt, enlightened": {"integrator": "bdpt", **ENLIGHTENED, "bdpt.guided_light": True},
    "bdpt, enlightened, 4 eye paths": {"integrator": "bdpt", **ENLIGHTENED, "bdpt.eye_paths": 4},
    "bdpt, enlightened, unjoined": {"integrator": "bdpt", **ENLIGHTENED, **UNJOINED},
    "bdpt, lit by context, unjoined": {"integrator": "bdpt", **LIT, **UNJOINED},
}
"""What pilots compare, and ``auto`` chooses from."""
SLOWEST = "bdpt, enlightened"
"""Takes longest to measure, and is not far from the other one of those that follow: not measured where that is
hopeless."""
JOINED = (SLOWEST, "bdpt, enlightened, 4 eye paths")
"""Those that may win where joining subpaths pays, and cost the more where it does not."""
LIT_PATH, LIT_UNJOINED = "path, lit by context", "bdpt, lit by context, unjoined"
EYE_PATHS, WITH_CAUSTICS = "path, enlightened", "bdpt, enlightened, unjoined"
"""The same eye paths, alone and with the light paths that can tell of their variance."""
TWINS = {LIT_UNJOINED: LIT_PATH, WITH_CAUSTICS: EYE_PATHS}
"""Candidates that make the eye paths of another one, and are told apart from it by the same samples."""
FORMS = {
    "bdpt": ("bdpt, plain", "bdpt, enlightened"),
    "unjoined": ("bdpt, plain", LIT_UNJOINED, WITH_CAUSTICS),
    "path": ("path, plain", LIT_PATH, EYE_PATHS),
}
"""Whose samples chains may walk over, and the candidates that speak for each: a plain one first, enlightened last."""
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
ALIKE = 0.01
"""Relative error that nobody knows a variance better than."""
SIGMAS = 3.0
"""Standard errors by which a mean may be off."""
LEAST = 1e-12
"""Of variance times microseconds: a black image has none."""
PILOTS = "pilots"
"""Their name among a context's statistics."""


@dataclass(frozen=True)
class Pilot:
    """What some samples said of a candidate."""

    name: str
    variance: float
    """Of one sample per pixel, over the square of a blurred image fixed beforehand; mean over the film."""
    error: float
    """Standard error of the variance."""
    mean: float
    """Of the samples, over the same image."""
    mean_error: float
    """Its standard error."""
    microseconds: float
    """Of one sample."""
    samples: int
    rival: float = 0.0
    """Variance, in the same measure, that eye paths alone have at least, by what light paths have met."""

    @property
    def efficiency(self) -> float:
        """1 / (variance time), time in seconds."""
        return 1e6 / max(self.variance * self.microseconds, LEAST)

    def against(self, pilots: Iterable[Pilot]) -> Pilot:
        """This pilot with the variance that it is known to have: with that of light that it has not met.

        What others certainly find, and this one has not in n samples, it finds with less than about one in n: the
        variance is then n times the square of the light that is missing, at least. Of caustics that eye paths seldom
        meet, and which are then too bright by far, light paths can tell.
        """
        every = tuple(pilots)
        certain = max(pilot.mean - SIGMAS * pilot.mean_error for pilot in every)
        missing = max(0.0, certain - self.mean - SIGMAS * self.mean_error)
        rival = max(pilot.rival for pilot in every) if self.name == EYE_PATHS else 0.0
        return replace(self, variance=max(self.variance + missing**2 * self.samples, rival))


@dataclass(frozen=True)
class Choice:
    """What renders, and why."""

    settings: RenderSettings
    name: str | None
    """The candidate that was chosen; None where there was nothing to choose."""
    pilots: tuple[Pilot, ...] = ()

    def report(self) -> dict[str, Any] | None:
        """The choice and its evidence, for JSON; None where there was nothing to choose."""
        if self.name is None:
            return None
        pilots = [asdict(pilot) | {"efficiency": pilot.efficiency} for pilot in self.pilots]
        return {"name": self.name, PILOTS: pilots}

    def lines(self) -> list[str]:
        """The same for people: one line, with the efficiencies relative to the best one."""
        if self.name is None:
            return []
        most = max(pilot.efficiency for pilot in self.pilots)
        shares = ", ".join(f"{pilot.name} {pilot.efficiency / most:.2f}" for pilot in self.pilots)
        return [f"rendered by {self.name} (efficiency in pilots: {shares})"]


def unguided_wins(scouts: Iterable[Pilot]) -> bool:
    """Whether training can stop: one without directions by table is better than those with it are and will be."""
    said = tuple(scouts)
    known = {pilot.name: pilot for pilot in _known(replace(pilot, rival=0.0) for pilot in said)}
    rival = max((pilot.rival for pilot in said), default=0.0)
    guided = [pilot for pilot in known.values() if _is_guided(pilot.name)]
    now, then = (
        [_at_least(rival / RIVALS_FALL, p) for p in ps] for ps in (guided, [_trained(p, known) for p in guided])
    )
    # Eye paths without tables find caustics no more easily.
    others = [_at_least(rival, pilot) for pilot in known.values() if not _is_guided(pilot.name)]
    if not guided or not others:
        return False
    best = max(others, key=lambda pilot: pilot.efficiency)
    worth = max(*(p.efficiency for p in now), *((1.0 - WHOLE_TRAINING) * p.efficiency for p in then))
    return best.variance < CLEAR and best.efficiency >= worth


def far_ahead(scouts: Iterable[Pilot]) -> bool:
    """Whether joined subpaths are so much better than all other scouts that tables will not bring these near them."""
    known = {pilot.name: pilot for pilot in _known(scouts)}
    joined = known.pop("bdpt, plain", None)
    if joined is None or joined.variance >= SURE:
        return False
    # Even if it is better by a standard error: one rare event of its own is no reason to go on.
    joined = replace(joined, variance=max(joined.variance - joined.error, 0.0))
    return all(joined.efficiency >= FAR_AHEAD * other.efficiency for other in known.values())


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
    known = {pilot.name: pilot.efficiency for pilot in _known(scouts)}
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
    known = {pilot.name: pilot for pilot in _known(others)}
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


def worth_measuring(candidates: list[str], scouts: Iterable[Pilot], pilots: Iterable[Pilot] = ()) -> list[str]:
    """Those that ``pilots`` have measured, and the candidates to measure after them, as far as is known.

    Without scouts all that can be the best. Where training has stopped, those without directions by table, if several
    are close. Else the guided ones, but those that join subpaths only where it pays without tables; and after them,
    once pilots of these are known, the slowest of them and the others, if they are not hopeless against them. None if
    the only guided one was surely better than all others before its tables were finished.
    """
    said, measured = tuple(scouts), tuple(pilots)
    if not said:
        done = [pilot.name for pilot in measured]
        order = (*SCOUTS, *reversed(JOINED))
        return [*done, *(n for n in order if n in candidates and n not in done and _may_win(n, measured))]
    if unguided_wins(said):
        close = _within(DECIDED, tuple(pilot for pilot in _known(said) if not _is_guided(pilot.name)), candidates)
        return close if len(close) > 1 else []
    guided = [name for name in candidates if _is_guided(name) and _may_win_trained(name, said)]
    if guided == [EYE_PATHS] and _surely_best(EYE_PATHS, said):
        return []
    others = [name for name in candidates if not _is_guided(name) and name in {pilot.name for pilot in said}]
    # By the first guided ones alone, so that the list stays as it is while the others are measured.
    slowest = [name for name in guided if name == SLOWEST]
    first = [name for name in guided if name != SLOWEST]
    early = [pilot for pilot in measured if pilot.name in first]
    if first and len(early) == len(first):
        known = _known(together(said, early))
        others, near = _within(DECIDED, known, others), _within(HOPELESS, known, list(JOINED))
        slowest = slowest if near else []
    return [*first, *slowest, *others]


def _may_win_trained(name: str, scouts: tuple[Pilot, ...]) -> bool:
    """Whether a guided candidate can be the best in the end."""
    if name in JOINED:
        return _joining_may_pay(scouts)
    known = {pilot.name: pilot.efficiency for pilot in _known(scouts)}
    return name in known and TOLD_APART * known[name] >= known.get(TWINS.get(name, ""), 0.0)


def _surely_best(name: str, scouts: tuple[Pilot, ...]) -> bool:
    """Whether a scout was the best, even if it is worse and the others are better by their standard errors."""
    known = {pilot.name: pilot for pilot in _known(scouts)}
    if name not in known:
        return False
    own = known.pop(name)
    low = replace(own, variance=own.variance + own.error).efficiency
    return all(low > replace(p, variance=max(p.variance - p.error, LEAST)).efficiency for p in known.values())


def together(scouts: Iterable[Pilot], pilots: Iterable[Pilot]) -> tuple[Pilot, ...]:
    """What is known of every candidate: by its pilot, its scout, or by both.

    Both are relative to an image of the tables' paths, and that of the scouts was darker where little light had been
    found. By how much follows from the candidate that both know best. A scout may lower a pilot's variance, because
    tables have only become better since and one rare event must not decide, and may raise it where there are no tables.
    Scouts do not testify to light that pilots have not met: what they said of each other is part of their variance.
    What tables have won since for some eye paths they have won for all that are alike.
    """
    said, measured = tuple(scouts), tuple(pilots)
    again = {pilot.name: pilot for pilot in measured}
    twice = [(pilot, again[pilot.name]) for pilot in said if pilot.name in again and pilot.mean > 0.0]
    if not twice:
        return (*measured, *(pilot for pilot in _known(said) if pilot.name not in again))
    before, after = min(twice, key=lambda pair: pair[0].mean_error / pair[0].mean)
    scale, level = (after.mean / before.mean) ** 2, (after.mean, after.mean_error)
    early = {p.name: replace(p, variance=scale * p.variance, error=scale * p.error) for p in said}
    known = {p.name: replace(p, variance=scale * p.variance, error=scale * p.error) for p in _known(said)}
    left = [replace(p, mean=level[0], mean_error=level[1], rival=0.0) for n, p in known.items() if n not in again]
    return (
        *(_averaged(pilot, early.get(pilot.name)) for pilot in measured),
        *(_like_its_twin(pilot, early, again) for pilot in left),
    )


def _like_its_twin(scout: Pilot, early: Mapping[str, Pilot], again: Mapping[str, Pilot]) -> Pilot:
    """A guided scout with what tables have won since for the one that makes the same eye paths."""
    twin = TWINS.get(scout.name, "")
    if not _is_guided(scout.name) or twin not in again or twin not in early:
        return scout
    return replace(scout, variance=scout.variance * min(1.0, again[twin].variance / max(early[twin].variance, LEAST)))


def _averaged(pilot: Pilot, scout: Pilot | None) -> Pilot:
    """The variance of both, by how well each knows it."""
    if scout is None or (_is_guided(pilot.name) and scout.variance >= pilot.variance):
        return pilot
    least = LEAST + ALIKE * pilot.variance
    weight = max(pilot.error, least) ** 2 / (max(pilot.error, least) ** 2 + max(scout.error, least) ** 2)
    variance = pilot.variance + weight * (scout.variance - pilot.variance)
    return replace(pilot, variance=variance, error=hypot((1.0 - weight) * pilot.error, weight * scout.error))


def _within(times: float, pilots: tuple[Pilot, ...], names: list[str]) -> list[str]:
    """Those of ``names`` that the best of all pilots is not more than some ``times`` as efficient as."""
    best = max((pilot.efficiency for pilot in pilots), default=0.0)
    near = {pilot.name for pilot in pilots if times * pilot.efficiency >= best}
    return [name for name in names if name in near]


def _known(pilots: Iterable[Pilot]) -> tuple[Pilot, ...]:
    every = tuple(pilots)
    return tuple(pilot.against(every) for pilot in every)


def _is_guided(name: str) -> bool:
    return ENLIGHTENED.items() <= CANDIDATES[name].items()


def fit_candidates(summary: SceneSummary, settings: ContextSettings) -> list[str]:
    """Candidates that find all light of a scene that any of them finds: pilots do not see what is lost."""
    whole = RenderSettings(integrator="bdpt", max_depth=settings.max_depth, context=settings)
    losses: dict[str, int] = {}
    for name in CANDIDATES:
        try:
            reach.check(summary, candidate(whole, name))
        except SettingsRejected:
            continue
        losses[name] = reach.lost(summary, candidate(whole, name))
    return [name for name, loss in losses.items() if loss == min(losses.values())]


def candidate(settings: RenderSettings, name: str) -> RenderSettings:
    """``settings`` as the candidate ``name`` renders them."""
    open_settings = settings.model_copy(update={"path": PathSettings(), "bdpt": BdptSettings(), "integrator": "bdpt"})
    return with_overrides(open_settings, {**CANDIDATES[name], "context.adaptive": False})


def choose(settings: RenderSettings, statistics: Mapping[str, Any] | None) -> Choice:
    """What renders ``settings``, by the statistics of the context.

    ``auto`` takes the candidate of the greatest efficiency. An integrator that is named takes its plain form where
    that was more efficient in pilots than its enlightened one; and chains, if nothing is said, walk over samples of
    path where these were more efficient than those of bdpt.

    Raises:
        ContextMismatch: there is something to choose and there are no pilots.
    """
    if not settings.adaptive:
        return Choice(settings, None)
    pilots = _pilots(statistics or {})
    if settings.integrator == "auto":
        name = max(pilots, key=lambda pilot: pilot.efficiency).name
        return Choice(candidate(settings, name), name, pilots)
    efficiency = {pilot.name: pilot.efficiency for pilot in pilots}
    title = settings.integrator
    if title == "pssmlt" and not settings.pssmlt.multiplexed:
        # What was left out, because nothing like it was near the best, is no choice.
        asked = tuple(FORMS) if settings.pssmlt.over is None else (settings.pssmlt.over,)
        over = max(asked, key=lambda name: max(efficiency.get(form, 0.0) for form in FORMS[name]))
        settings, title = with_overrides(settings, {"pssmlt.over": over}), f"{title} over {over}"
        forms = FORMS[over]
    else:
        forms = _forms(settings.integrator, settings.bdpt)
    if settings.light_sampling not in ("adjoint", "context"):
        forms = tuple(form for form in forms if form not in (LIT_PATH, LIT_UNJOINED))
    best = max(reversed(forms), key=lambda form: _of(form, efficiency))
    if best == forms[-1]:
        return Choice(settings, f"{title}, enlightened", pilots)
    lit = best in (LIT_PATH, LIT_UNJOINED)
    changes: dict[str, Any] = {**(LIT if lit else PLAIN), "context.adaptive": False}
    if settings.roulette != "context":
        del changes["roulette"]
    elif settings.integrator == "pssmlt":  # Chains are not paid where paths end, and do better without
        changes["roulette"] = "albedo"
    name = "lit by context" if lit else "plain"
    return Choice(with_overrides(settings, changes), f"{title}, {name}", pilots)


def _forms(integrator: str, bdpt: BdptSettings) -> tuple[str, ...]:
    """The candidates that speak for an integrator, from the plain one to the enlightened."""
    if integrator == "path":
        return FORMS["path"]
    if integrator != "bdpt" or (bdpt.joins and bdpt.eye_paths == 1):
        return FORMS["bdpt"]
    return ("bdpt, plain", "bdpt, enlightened, 4 eye paths") if bdpt.joins else FORMS["unjoined"]


def _of(name: str, efficiency: Mapping[str, float]) -> float:
    """Efficiency of a candidate; of what is nearest to it where it was left out, 0 if nothing is."""
    near = (name, *JOINED, WITH_CAUSTICS, EYE_PATHS) if name in JOINED else (name, TWINS.get(name, name))
    return next((efficiency[other] for other in near if other in efficiency), 0.0)


def _pilots(statistics: Mapping[str, Any]) -> tuple[Pilot, ...]:
    try:
        pilots = _known(Pilot(**entry) for entry in statistics[PILOTS])
        fit = pilots and all(p.name in CANDIDATES and isfinite(p.efficiency) for p in pilots)
    except (KeyError, TypeError):
        fit = False
    if not fit:
        raise ContextMismatch("the context has no pilots to choose by: build it with context.adaptive on")
    return pilots
