"""Which algorithm renders: as asked for, or the candidate that trials have shown to be the most efficient [no regret].

Trials are measured with a scene's context and kept in it, so that all its renders choose alike, on whatever machine.
Their samples enter no image: a choice by the samples themselves would be biased. Imports no Mitsuba.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from math import isfinite
from typing import Any, Literal

from elps_core.errors import ContextMismatch, SettingsRejected
from elps_core.scene import reach
from elps_core.scene.summary import SceneSummary
from elps_core.settings import BdptSettings, ContextSettings, PathSettings, RenderSettings, with_overrides

Guiding = Literal["none", "lights", "full"]
"""What a candidate takes from the tables of regions: nothing, which lamps light them, or directions too."""

PLAIN = {"direction_sampling": "scattering", "roulette": "albedo"}
GUIDED: dict[Guiding, dict[str, Any]] = {
    "none": PLAIN,
    "lights": {"light_sampling": "context", "direction_sampling": "scattering", "roulette": "context"},
    "full": {"direction_sampling": "context", "roulette": "context"},
}
"""Settings of each kind of guiding. Regions know their lamps, and how much light there is, long before they know where
it comes from."""


@dataclass(frozen=True)
class Candidate:
    """A way to render: everything that is known of it follows from these fields."""

    name: str
    guiding: Guiding
    light_paths: Literal["none", "unjoined", "joined"] = "none"
    """Eye paths alone; light paths that bring to the sensor what they meet; or light paths joined to eye paths."""
    eye_paths: int = 1
    """For each light path."""
    guided_light: bool = False
    """Whether light paths are guided, too."""

    def settings(self, settings: RenderSettings) -> RenderSettings:
        """``settings`` as this candidate renders them."""
        whole = settings.model_copy(update={"path": PathSettings(), "bdpt": BdptSettings(), "integrator": "bdpt"})
        changes = {
            "integrator": "path" if self.light_paths == "none" else "bdpt",
            "bdpt.joins": self.light_paths != "unjoined",
            "bdpt.eye_paths": self.eye_paths,
            "bdpt.guided_light": self.guided_light,
            **GUIDED[self.guiding],
            "context.adaptive": False,
        }
        if self == PATH:
            # The adjoint image helps eye paths little, and a kernel that asks for it is another one. As Mitsuba has it:
            # by power a sky outside takes the samples of the lamps that light a room; and roulette by albedo goes on
            # with paths that bring nothing (a classroom: a third fewer samples, a twentieth less efficient).
            changes |= {"light_sampling": "uniform", "roulette": "throughput"}
        return with_overrides(whole, changes)


PATH = Candidate("path, plain", "none")
LIT_PATH = Candidate("path, lit by context", "lights")
GUIDED_PATH = Candidate("path, enlightened", "full")
BDPT = Candidate("bdpt, plain", "none", "joined")
UNJOINED = Candidate("bdpt, enlightened, unjoined", "full", "unjoined", 4)
SPARSE_BDPT = Candidate("bdpt, enlightened, 4 eye paths", "full", "joined", 4)
GUIDED_BDPT = Candidate("bdpt, enlightened", "full", "joined", 1, True)
CANDIDATES = {each.name: each for each in (PATH, GUIDED_PATH, BDPT, LIT_PATH, UNJOINED, SPARSE_BDPT, GUIDED_BDPT)}
"""All that may race, by name; those that cost less to try come first."""
OVER = {"path": "none", "unjoined": "unjoined", "bdpt": "joined"}
"""Whose samples chains may walk over, and the light paths of the candidates that speak for each."""
SIGMAS = 3.0
"""Standard errors by which a mean may be off."""
LEAST = 1e-12
"""Of variance times microseconds: a black image has none."""
TRIALS, MEANWHILE = "trials", "plain"
"""Names among a context's statistics: of all trials, and of what renders while there is no context."""


@dataclass(frozen=True)
class Trial:
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
    compiling: float = 0.0
    """Seconds that its kernels took to compile."""

    @property
    def candidate(self) -> Candidate:
        """Whose trial it is."""
        return CANDIDATES[self.name]

    @property
    def efficiency(self) -> float:
        """1 / (variance time), time in seconds."""
        return 1e6 / max(self.variance * self.microseconds, LEAST)

    def bound(self, sigmas: float) -> float:
        """Efficiency with a variance that is so many standard errors greater; less, where they are negative."""
        return replace(self, variance=max(self.variance + sigmas * self.error, 0.0)).efficiency

    def against(self, trials: Iterable[Trial]) -> Trial:
        """This trial with the variance that its candidate is known to have: with that of light that it has not met.

        What others certainly find, and this one has not in n samples, it finds with less than about one in n: the
        variance is then n times the square of the light that is missing, at least. Of caustics that eye paths seldom
        meet, and which are then too bright by far, light paths can tell.
        """
        every = tuple(trials)
        certain = max(trial.mean - SIGMAS * trial.mean_error for trial in every)
        missing = max(0.0, certain - self.mean - SIGMAS * self.mean_error)
        alone = self.candidate.light_paths == "none"
        rival = max(trial.rival for trial in every) if alone else 0.0
        return replace(self, variance=max(self.variance + missing**2 * self.samples, rival))


@dataclass(frozen=True)
class Choice:
    """What renders, and why."""

    settings: RenderSettings
    name: str | None
    """The candidate that was chosen; None where there was nothing to choose."""
    trials: tuple[Trial, ...] = ()
    plain: str = PATH.name
    """What renders where there is no context yet."""

    @property
    def weight_of_meantime(self) -> float:
        """What a sample of the plain way counts beside one of the chosen: the inverse ratio of their variances.

        By trials alone, never by the samples that are weighted. 1 where nothing is known.
        """
        known = {trial.name: trial.variance for trial in self.trials}
        best, other = known.get(self.name or "", 0.0), known.get(self.plain, 0.0)
        return min(1.0, best / other) if best > 0.0 and other > 0.0 else 1.0

    def report(self) -> dict[str, Any] | None:
        """The choice and its evidence, for JSON; None where there was nothing to choose."""
        if self.name is None:
            return None
        trials = [asdict(trial) | {"efficiency": trial.efficiency} for trial in self.trials]
        return {"name": self.name, TRIALS: trials, "meantime": self.weight_of_meantime}

    def lines(self) -> list[str]:
        """The same for people: one line, with the efficiencies relative to the best one."""
        if self.name is None:
            return []
        if not self.trials:
            return [f"rendered by {self.name} (there was no time to measure others)"]
        most = max(trial.efficiency for trial in self.trials)
        shares = ", ".join(f"{trial.name} {trial.efficiency / most:.2f}" for trial in self.trials)
        return [f"rendered by {self.name} (efficiency in trials: {shares})"]


def known_together(trials: Iterable[Trial]) -> tuple[Trial, ...]:
    """Each with what is known of it by all, see :meth:`Trial.against`."""
    every = tuple(trials)
    return tuple(trial.against(every) for trial in every)


def fit_candidates(summary: SceneSummary, settings: ContextSettings) -> list[Candidate]:
    """Candidates that find all light of a scene that any of them finds: trials do not see what is lost."""
    whole = RenderSettings(integrator="bdpt", max_depth=settings.max_depth, context=settings)
    losses: dict[str, int] = {}
    for name, candidate in CANDIDATES.items():
        try:
            reach.check(summary, candidate.settings(whole))
        except SettingsRejected:
            continue
        losses[name] = reach.lost(summary, candidate.settings(whole))
    return [CANDIDATES[name] for name, loss in losses.items() if loss == min(losses.values())]


def plain_of(candidates: Iterable[Candidate]) -> Candidate:
    """What renders while nothing is known of a scene: the first of its ``candidates`` without guiding."""
    return next((each for each in candidates if each.guiding == "none"), PATH)


def choose(settings: RenderSettings, statistics: Mapping[str, Any] | None) -> Choice:
    """What renders ``settings``, by the statistics of the context.

    ``auto`` takes the candidate of the greatest efficiency, and the plain one where none was measured. An integrator
    that is named takes what guiding was the most efficient for its kind; and chains, if nothing is said, walk over
    samples of what was the most efficient in trials.

    Raises:
        ContextMismatch: there is something to choose, and the context was built without trials.
    """
    if not settings.adaptive:
        return Choice(settings, None)
    trials = _trials(statistics)
    tables = "table_paths" in (statistics or {})
    if settings.integrator == "auto":
        plain = CANDIDATES.get(str((statistics or {}).get(MEANWHILE)), PATH)
        # Of paths without a limit joins lose those of more than MAX_DEPTH segments: in a closed room of albedo 0.95
        # two millionths of the light.
        fit = trials
        if settings.hide_emitters:  # Light paths would show them
            plain, fit = PATH, tuple(trial for trial in trials if trial.candidate.light_paths == "none")
        best = max(fit, key=lambda trial: trial.efficiency).candidate if fit else plain
        return Choice(best.settings(settings), best.name, trials, plain.name)
    title, kind = settings.integrator, _light_paths(settings)
    if title == "pssmlt" and not settings.pssmlt.multiplexed:
        over = settings.pssmlt.over or _best_over(trials)
        settings, title, kind = with_overrides(settings, {"pssmlt.over": over}), f"{title} over {over}", OVER[over]
    guiding: Guiding = "none"
    if tables:
        guiding = _guiding(trials, kind, lights=settings.light_sampling in ("adjoint", "context"))
    if guiding == "full":
        return Choice(settings, f"{title}, enlightened", trials)
    changes: dict[str, Any] = {**GUIDED[guiding], "context.adaptive": False}
    if settings.roulette != "context":
        del changes["roulette"]
    elif settings.integrator == "pssmlt":  # Chains are not paid where paths end, and do better without
        changes["roulette"] = "albedo"
    name = "lit by context" if guiding == "lights" else "plain"
    return Choice(with_overrides(settings, changes), f"{title}, {name}", trials)


def _light_paths(settings: RenderSettings) -> str:
    """The light paths of the candidates that speak for a named integrator."""
    if settings.integrator == "path":
        return "none"
    return "joined" if settings.integrator != "bdpt" or settings.bdpt.joins else "unjoined"


def _best_over(trials: tuple[Trial, ...]) -> str:
    best = max(trials, key=lambda trial: trial.efficiency, default=None)
    return next(name for name, kind in OVER.items() if best is None or kind == best.candidate.light_paths)


def _guiding(trials: tuple[Trial, ...], kind: str, *, lights: bool) -> Guiding:
    """The guiding that is best for candidates with light paths of a ``kind``, or else for eye paths; full unless known.

    Without ``lights`` guided light selection was not asked for.
    """
    for of_kind in (kind, "none"):
        fit = [
            trial
            for trial in trials
            if trial.candidate.light_paths == of_kind and (lights or trial.candidate.guiding != "lights")
        ]
        if len({trial.candidate.guiding for trial in fit}) > 1:
            return max(fit, key=lambda trial: trial.efficiency).candidate.guiding
    return "full"


def _trials(statistics: Mapping[str, Any] | None) -> tuple[Trial, ...]:
    try:
        trials = known_together(Trial(**entry) for entry in (statistics or {})[TRIALS])
        fit = all(trial.name in CANDIDATES and isfinite(trial.efficiency) for trial in trials)
    except (KeyError, TypeError):
        fit = False
    if not fit:
        raise ContextMismatch("the context has no trials to choose by: build it with context.adaptive on")
    return trials
