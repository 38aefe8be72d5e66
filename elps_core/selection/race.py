"""Who is tried next, and whether tables that are being filled will pay. Imports no Mitsuba.

A candidate is worth a trial while the best that it can be, by what those before it have shown, beats the best that is
there; what its kernels take to compile counts against it.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from elps_core.selection.candidates import PATH, Candidate, Trial, known_together
from elps_core.settings import PREPARATION

COSTS = {"none": 1.0, "unjoined": 1.1, "joined": 2.0}
"""Least time of a sample by the light paths that it has, over that of an eye path alone: 2.5 to 4 were seen of joined
ones in rooms, and 2 in Veach's scene."""
BEST = 0.25
"""Relative variance that no way is taken to go below: where eye paths are near it, nothing else pays."""
LESS = {"lights": 1.25, "full": 1.25}
"""Times that a candidate may be better without what it takes from the tables, or with lamps alone."""
MORE = {"unjoined": 1.2, "joined": 1.5}
"""Times that guiding may do more for a candidate with light paths than it has done for eye paths."""
GROWTH = 2.0
"""Times that tables may still become better once a quarter of the training is over: 1.1 on a staircase, 2.7 seen in a
Cornell box, where they win anyway."""
FARTHEST = 3.0
"""Times that a candidate may be behind another one in the middle of training and yet ahead in the end."""
UNKNOWN = 30.0
"""Relative variance above which nothing is decided in the middle of training: where light is so hard to find, tables
do not know it yet."""
COMPILING = {"none": 1.0, "unjoined": 2.0, "joined": 2.5}
"""Time that kernels take to compile by the light paths that a candidate has, over those of eye paths alone."""
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

    @classmethod
    def of(cls, begin: float, seconds: float | None, compiling: float = 0.0) -> Allowance:
        """A quarter of a job of so many ``seconds`` that began at ``begin``; without a limit, all that it takes."""
        if seconds is None:
            return cls(compiling=compiling)
        return cls(begin + PREPARATION * seconds, (1.0 - PREPARATION) * seconds, compiling)

    def left(self, part: float = 1.0) -> float:
        """Seconds until a ``part`` of the whole quarter has passed."""
        spare = (1.0 - part) * self.rendering * PREPARATION / (1.0 - PREPARATION) if part < 1.0 else 0.0
        return self.until - spare - time.perf_counter() if self.until < float("inf") else float("inf")


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
    bounds = [1e6 / (BEST * fastest * COSTS[candidate.light_paths])]
    for trial in same:
        if trial.candidate.guiding != "none" and candidate.guiding in ("none", "lights"):
            bounds.append(LESS[trial.candidate.guiding] * trial.efficiency)
        elif candidate.light_paths != "none":  # Guided, or otherwise guided: as eye paths have gained by it
            bounds.append(MORE[candidate.light_paths] * gain * trial.efficiency)
    return min(bounds)


def next_trial(
    candidates: Iterable[Candidate], trials: Sequence[Trial], allowance: Allowance = ENDLESS, *, caustics: bool = True
) -> Candidate | None:
    """The candidate to try next; None where no other can be the best, or where there is no time."""
    tried = {trial.name for trial in trials}
    best = max((trial.bound(SURE) for trial in known_together(trials)), default=0.0)
    for candidate in candidates:
        compiling = _compiling(candidate, trials, allowance)
        if candidate.name in tried or compiling > allowance.left():
            continue
        left = 1.0 if compiling == 0.0 else max(0.0, 1.0 - compiling / allowance.rendering)
        if left * promise(candidate, trials, caustics=caustics) > best:
            return candidate
    return None


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


def training_pays(trials: Sequence[Trial]) -> bool:
    """Whether tables should be filled further, by what trials in the middle of training said."""
    known = known_together(trials)
    best = max(known, key=lambda trial: trial.bound(SURE), default=None)
    if best is None or best.candidate.guiding != "none" or best.variance > UNKNOWN:
        return True
    guided = [trial for trial in known if trial.candidate.guiding == "full"]
    return any(GROWTH * trial.bound(-SURE) > best.bound(SURE) for trial in guided)


def _compiling(candidate: Candidate, trials: Sequence[Trial], allowance: Allowance) -> float:
    """Seconds that a candidate's kernels may take to compile, by what others have taken; those of plain paths do."""
    if candidate == PATH:
        return 0.0
    each = [trial.compiling / COMPILING[trial.candidate.light_paths] for trial in trials]
    return COMPILING[candidate.light_paths] * max([*each, allowance.compiling])
