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
        return (*measured, *(pilot for pilot in known_together(said) if pilot.name not in again))
    before, after = min(twice, key=lambda pair: pair[0].mean_error / pair[0].mean)
    scale, level = (after.mean / before.mean) ** 2, (after.mean, after.mean_error)
    early = {p.name: replace(p, variance=scale * p.variance, error=scale * p.error) for p in said}
    known = {p.name: replace(p, variance=scale * p.variance, error=scale * p.error) for p in known_together(said)}
    left = [replace(p, mean=level[0], mean_error=level[1], rival=0.0) for n, p in known.items() if n not in again]
    return (
        *(_averaged(pilot, early.get(pilot.name)) for pilot in measured),
        *(_like_its_twin(pilot, early, again) for pilot in left),
    )


def _like_its_twin(scout: Pilot, early: Mapping[str, Pilot], again: Mapping[str, Pilot]) -> Pilot:
    """A guided scout with what tables have won since for the one that makes the same eye paths."""
    twin = TWINS.get(scout.name, "")
    if not is_guided(scout.name) or twin not in again or twin not in early:
        return scout
    return replace(scout, variance=scout.variance * min(1.0, again[twin].variance / max(early[twin].variance, LEAST)))


def _averaged(pilot: Pilot, scout: Pilot | None) -> Pilot:
    """The variance of both, by how well each knows it."""
    if scout is None or (is_guided(pilot.name) and scout.variance >= pilot.variance):
        return pilot
    least = LEAST + ALIKE * pilot.variance
    weight = max(pilot.error, least) ** 2 / (max(pilot.error, least) ** 2 + max(scout.error, least) ** 2)
    variance = pilot.variance + weight * (scout.variance - pilot.variance)
    return replace(pilot, variance=variance, error=hypot((1.0 - weight) * pilot.error, weight * scout.error))


def known_together(pilots: Iterable[Pilot]) -> tuple[Pilot, ...]:
    """Each with what is known of it by all, see :meth:`Pilot.against`."""
    every = tuple(pilots)
    return tuple(pilot.against(every) for pilot in every)


def is_guided(name: str) -> bool:
    """Whether a candidate follows tables of directions."""
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
        pilots = known_together(Pilot(**entry) for entry in statistics[PILOTS])
        fit = pilots and all(p.name in CANDIDATES and isfinite(p.efficiency) for p in pilots)
    except (KeyError, TypeError):
        fit = False
    if not fit:
        raise ContextMismatch("the context has no pilots to choose by: build it with context.adaptive on")
    return pilots
