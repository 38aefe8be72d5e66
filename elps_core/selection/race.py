"""Who is tried next, and whether tables that are being filled will pay. Imports no Mitsuba.

A candidate is worth a trial while the best that it can be, by what those before it have shown, beats the best that is
there; what its kernels take to compile counts against it.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from elps_core.selection.candidates import BDPT, GUIDED_PATH, PATH, Candidate, Trial, known_together
from elps_core.settings import PREPARATION

COSTS = {"none": 1.0, "unjoined": 1.1, "joined": 2.0}
"""Least time of a sample by the light paths that it has, over that of an eye path alone: 2.5 to 4 were seen of joined
ones in rooms, and 2 in Veach's scene."""
BEST = 0.25
"""Relative variance that no way with light paths is taken to go below: where eye paths are near it, none pays."""
LESS = {"lights": 1.25, "full": 1.25}
"""Times that a candidate may be better without what it takes from the tables, or with lamps alone."""
MORE = {"unjoined": 1.2, "joined": 1.5}
"""Times that guiding may do more for a candidate with light paths than it has done for eye paths."""
GROWTH = 1.1
"""Times by which guided paths may be behind when it is asked whether tables pay. They become 1.0 to 1.25 times better
after that in rooms and in a classroom, and what is left of the training costs an eighth of the job; the 2.7 that were
seen in a Cornell box come on top of a lead."""
UNTRIED = 1.5
"""As well, where no guided paths were tried and the paths of training speak for them: with a gain of 0.7 in a classroom
they were behind in the end, with 0.85 on a staircase, where there was less time, nearly twice ahead."""
FARTHEST = 3.0
"""Times that a candidate may be behind another one in the middle of training and yet ahead in the end."""
UNKNOWN = 30.0
"""Relative variance above which nothing is decided in the middle of training: where light is so hard to find, tables
do not know it yet."""
TRYING, FINISHING = 0.35, 0.5
"""Seconds that a trial takes once its kernels are there, and that tables take to be made of what was found."""
COMPILING = {"none": 1.0, "unjoined": 3.5, "joined": 2.5}
"""Time that kernels take to compile by the light paths that a candidate has, over those of eye paths alone."""
UNSEEN = 0.4
"""Seconds that a kernel of plain paths takes to compile where it is not known."""
COMPILING_GUIDED = 2.0
"""Times that they take longer where tables guide: 1.6 to 2.8 with points and gaps to aim at."""
TRAINING = 0.85
"""Part of the time for preparing after which tables are filled no further: the rest is for trials."""
BEGUN_BELOW = 0.125
"""Part of a job's time that the kernels of training may take to compile for training to be begun. It may find that
tables do not pay, and then that time is lost: plain paths win about a tenth over Mitsuba's, which is what can be lost
without falling behind it."""
HASTE, FAR = 0.05, 60.0
"""Part of the time left that a candidate may take to compile in the middle of training, and times that one which takes
longer may be better than all others: joined paths where eye paths hardly find any light."""
GUIDED_COSTS = 1.25
"""Time of a guided eye path over that of a plain one, at least: 1.3 to 1.7 were seen."""
SURE = 1.0
"""Standard errors by which an efficiency may be better or worse."""


@dataclass(frozen=True)
class Allowance:
    """The time that a job gives to its preparation."""

    until: float = float("inf")
    """Time of :func:`time.perf_counter` by which preparation has to end."""
    rendering: float = float("inf")
    """Seconds that will be rendered after that."""
    compiling: float = 0.0
    """Seconds that the kernel of plain paths took to compile: others take a multiple of it."""
    haste: float = 1.0
    """Part of the time left that a candidate may take to compile, unless it may be better by far than all others."""

    @classmethod
    def of(cls, begin: float, seconds: float | None, compiling: float = 0.0) -> Allowance:
        """A quarter of a job of so many ``seconds`` that began at ``begin``; without a limit, all that it takes."""
        if seconds is None:
            return cls(compiling=compiling)
        return cls(begin + PREPARATION * seconds, (1.0 - PREPARATION) * seconds, compiling)

    @property
    def compiling_at_most(self) -> float:
        """Seconds that the kernels of training may take to compile for training to be begun."""
        return BEGUN_BELOW * self.rendering / (1.0 - PREPARATION)

    def hasty(self) -> Allowance:
        """What may be spent in the middle of training: what takes long to compile is tried at the end, if at all."""
        return replace(self, haste=HASTE)

    def left(self, part: float = 1.0) -> float:
        """Seconds until a ``part`` of the whole quarter has passed."""
        spare = (1.0 - part) * self.rendering * PREPARATION / (1.0 - PREPARATION) if part < 1.0 else 0.0
        return self.until - spare - time.perf_counter() if self.until < float("inf") else float("inf")

    def left_for_training(self, after: float = 0.0) -> float:
        """Seconds until tables are filled no further: guided paths are yet to be compiled and tried.

        ``after``: seconds that something else takes between the two.
        """
        trials = COMPILING_GUIDED * self.compiling + FINISHING + 2.0 * TRYING
        return min(self.left(TRAINING), self.left() - trials - after)


ENDLESS = Allowance()


def promise(candidate: Candidate, trials: Iterable[Trial], *, caustics: bool = True) -> float:
    """The greatest efficiency that a candidate may have, by the trials of others; infinite where nothing tells.

    ``caustics``: whether mirrors or glass bring light to surfaces that scatter it.
    """
    known = {trial.name: trial for trial in known_together(trials)}
    eyes = [trial for trial in known.values() if trial.candidate.light_paths == "none"]
    if not eyes:
        return float("inf")
    fastest = min(trial.microseconds for trial in eyes)
    paths = max(trial.efficiency for trial in eyes)
    plain = next((trial.efficiency for trial in eyes if trial.candidate.guiding == "none"), paths)
    gain = max(1.0, paths / plain)
    same = [trial for trial in known.values() if trial.candidate.light_paths == candidate.light_paths]
    if candidate.light_paths == "unjoined" and not caustics:
        return 0.0
    bounds = [float("inf")]
    if candidate.light_paths != "none":
        bounds.append(1e6 / (BEST * fastest * COSTS[candidate.light_paths]))
    for trial in same:
        if trial.candidate.guiding != "none" and candidate.guiding in ("none", "lights"):
            bounds.append(LESS[trial.candidate.guiding] * trial.efficiency)
        elif candidate.light_paths != "none":  # Guided, or otherwise guided: as eye paths have gained by it
            bounds.append(MORE[candidate.light_paths] * gain * trial.efficiency)
    return min(bounds)


def next_trial(
    candidates: Iterable[Candidate],
    trials: Sequence[Trial],
    allowance: Allowance = ENDLESS,
    *,
    compiled: Iterable[str] = (),
    caustics: bool = True,
) -> Candidate | None:
    """The candidate to try next; None where no other can be the best, or where there is no time.

    Kernels of ``compiled`` candidates are there already.
    """
    tried, there = {trial.name for trial in trials}, set(compiled)
    best = max((trial.bound(SURE) for trial in known_together(trials)), default=0.0)
    for candidate in candidates:
        if candidate.name in tried:
            continue
        compiling = 0.0 if candidate.name in there else _compiling(candidate, trials, allowance)
        may = promise(candidate, trials, caustics=caustics)
        part = 1.0 if may > FAR * best and candidate.guiding == "none" else allowance.haste
        if compiling > part * (allowance.left() - TRYING):
            continue
        if (1.0 if compiling == 0.0 else max(0.0, 1.0 - compiling / allowance.rendering)) * may > best:
            return candidate
    return None


def in_the_middle(candidates: Iterable[Candidate]) -> list[Candidate]:
    """Candidates that tell whether tables should be filled further."""
    return [each for each in candidates if each in (PATH, GUIDED_PATH, BDPT)]


def contenders(candidates: Iterable[Candidate], middle: Sequence[Trial]) -> list[Candidate]:
    """Candidates that may be the best in the end, by what trials in the ``middle`` of training said of some."""
    known = {trial.name: trial for trial in known_together(middle)}
    best = max((trial.bound(SURE) for trial in known.values()), default=0.0)
    hopeless = {
        name
        for name, trial in known.items()
        if FARTHEST * trial.bound(-SURE) < best and (trial.candidate.guiding == "none" or trial.variance < UNKNOWN)
    }
    return [candidate for candidate in candidates if candidate.name not in hopeless]


def brought_up(trials: Sequence[Trial], middle: Iterable[Trial]) -> tuple[Trial, ...]:
    """The ``trials`` of the end, and those of the ``middle`` that needed no tables and were not repeated.

    Means are relative to the image that training had found by then: of another image they tell of no light that was
    missed.
    """
    tried = {trial.name for trial in trials}
    best = max(trials, key=lambda trial: trial.samples, default=None)
    left = [each for each in middle if each.candidate.guiding == "none" and each.name not in tried]
    if best is not None:
        left = [replace(each, mean=best.mean, mean_error=best.mean_error, rival=0.0) for each in left]
    return (*trials, *left)


def hard_to_find(trials: Iterable[Trial]) -> bool:
    """Whether plain paths hardly find the light, by their trial; so it is taken to be where there is none."""
    plain = [trial.variance for trial in trials if trial.candidate == PATH]
    return max(plain, default=UNKNOWN) >= UNKNOWN


def training_pays(trials: Sequence[Trial], gain: float) -> bool:
    """Whether tables should be filled further, by what trials in the middle of training said.

    ``gain``: times that a path of the last step had less variance than one before there were tables, which speaks for
    guided paths where none were tried.
    """
    known = known_together(trials)
    best = max(known, key=lambda trial: trial.bound(SURE), default=None)
    if best is None or best.candidate.guiding != "none" or best.variance > UNKNOWN:
        return True
    guided = [trial.efficiency for trial in known if trial.candidate.guiding == "full"]
    if guided:
        return GROWTH * max(guided) > best.efficiency
    plain = [trial.efficiency for trial in known if trial.candidate == PATH]
    return UNTRIED * gain / GUIDED_COSTS * max(plain, default=0.0) > best.efficiency


def _compiling(candidate: Candidate, trials: Sequence[Trial], allowance: Allowance) -> float:
    """Seconds that a candidate's kernels may take to compile, by what others have taken; those of plain paths do."""
    if candidate == PATH:
        return 0.0
    each = [trial.compiling / _kernels(trial.candidate) for trial in trials]
    # So many and so large kernels that they are not asked for on the chance that they are there.
    least = UNSEEN if candidate.light_paths == "unjoined" else 0.0
    return _kernels(candidate) * max([*each, allowance.compiling, least])


def _kernels(candidate: Candidate) -> float:
    """Time that a candidate's kernels take to compile, over that of plain eye paths."""
    return COMPILING[candidate.light_paths] * (1.0 if candidate.guiding == "none" else COMPILING_GUIDED)
