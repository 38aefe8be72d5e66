"""Images from Markov chains: independent sets of chains, each with its own bootstrap [thesis 3.8.2, 4.7.4].

The state space is a union of groups, each a unit cube. A set of chains goes through

1. bootstrap: uniform samples of each group give its b, the mean of the target, and the initial states
   of its chains, drawn in proportion to the target. The product of that very b and the average over
   such chains has the right expectation from the first state on: no start-up bias [Veach 1997, 11.3.1];
2. mutations: small and large steps [Kelemen et al. 2002], where old and new state both count with their
   expected share.

Bootstrap and large steps are uniform samples besides, and weigh in by the balance heuristic. If a group
has C mutations, U uniform samples among them and its bootstrap, and r = U / C, a state with target I and
contributions f adds

    f (b / C) / (I + a r b')  as a chain's state,      f (a b' / C) / (I + a r b')  as a uniform sample,

where a is the number of a chain's states that tell as much as one uniform sample: neighbours in a chain
are alike. So chains show what uniform samples rarely find, and the image is not much noisier than those
alone would make it. The weights need an estimate b' that is independent of the set, else they would be
correlated with b: it comes from a pilot run, once, which also says how many chains a group gets.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.integrators.chains import (
    SLOT_BYTES,
    Chains,
    PixelWeight,
    Put,
    Step,
    Target,
    advance,
    alike,
    remaining,
    to_film,
)
from elps_core.paths.stream import key_seed, opaque_key
from elps_core.settings import PssmltSettings

MUTATIONS = 16
"""Fewest mutations of a chain: small chunks have fewer chains. Many short chains beat few long ones."""
NARROWEST = 1024
"""Chains below which that does not hold: a kernel as narrow as this costs little more than its launch."""
BOOTSTRAP_SHARE = 4
"""A bootstrap sample for this many mutations at least: more than any other number they decide how noisy an image is."""
CORRELATION = 16.0
"""The number a in the module's text."""
FLOOR = 0.25
"""Share of chains and samples that goes to all groups alike, in case the pilot has missed one's light."""
MAX_CHAIN_BYTES = 1 << 29
"""Bound of the memory of all chains: deep paths get fewer."""
PILOT = -1
"""Key of the pilot: no chain set has it, because seeds are not negative."""
BOOTSTRAP, RESAMPLING, FIRST = range(3)
"""Last part of the keys of random numbers: what they are for; mutations count from the last one."""

Floats: TypeAlias = "NDArray[np.float64]"
Ints: TypeAlias = "NDArray[np.int64]"


@dataclass(frozen=True)
class Brightness:
    """Statistics of the target over uniform samples, by group."""

    mean: Floats
    deviation: Floats  # Standard deviation of one sample
    samples: Ints

    @staticmethod
    def of(values: Floats, samples: Ints) -> Brightness:
        """Of values sorted by group."""
        parts = np.split(values, np.cumsum(samples)[:-1])
        return Brightness(np.array([p.mean() for p in parts]), np.array([p.std() for p in parts]), samples)

    @property
    def b(self) -> float:
        """The mean luminance of the film."""
        return float(self.mean.sum())

    @property
    def error(self) -> float:
        """Standard error of :attr:`b`."""
        return float(np.sqrt((self.deviation**2 / self.samples).sum()))


@dataclass(frozen=True)
class Scales:
    """What visits count, by group: see :class:`Step`."""

    chain: Floats
    uniform: Floats
    offset: Floats


class Metropolis:
    """Sets of chains over one target; ``weight`` is what a unit of luminance counts in it, by place on the film."""

    def __init__(self, target: Target, settings: PssmltSettings, weight: PixelWeight = alike) -> None:
        self.target = target
        self.weight = weight
        self.settings = settings
        slots = 1 + sum(target.splats)
        size = SLOT_BYTES * slots + sum(4 * int(dimensions.max()) for dimensions in target.dimensions)
        self.most_chains = max(target.groups, min(settings.chains, MAX_CHAIN_BYTES // size))
        self._pilot: Brightness | None = None
        self._none = np.zeros(target.groups)

    def run(self, mutations: int, key: tuple[int, ...], put: Put) -> dict[str, float]:
        """One set of chains with at least ``mutations`` mutations in all; independent of all other sets.

        What is ``put`` on the film adds up to the film's mean radiance, each part where it belongs.
        Returns what there is to say of the set: ``b``, its standard error ``b_error``, and the mean
        probabilities of accepting a large and a small step.
        """
        groups, large_step, none = self.target.groups, self.settings.large_step, self._none
        chains = max(-(-mutations // MUTATIONS), min(mutations, NARROWEST))
        chains = max(groups, min(self.most_chains, chains))
        iterations = -(-mutations // chains)
        pilot = self.pilot()
        members = shares(pilot.mean, chains)
        wanted = max(min(self.settings.bootstrap, mutations), mutations // BOOTSTRAP_SHARE)
        samples = shares(pilot.deviation, multiple(wanted, chains))
        visits = members * iterations
        b = CORRELATION * pilot.mean
        scales = Scales(none, b / visits, b * (large_step + samples / visits))
        values = self._bootstrap(samples, chains, key, scales, put)
        measured = Brightness.of(values, samples)

        random = np.random.default_rng(key_seed(*key, RESAMPLING)).random(groups)
        chosen = resample(values, samples, members, random)
        group = np.repeat(np.arange(groups), members)
        state = Chains.dark(self.target, chains)
        # A large step with the numbers of the bootstrap, from no light: always taken.
        first = self._step((*key, BOOTSTRAP), chosen, group, 1.0, Scales(none, none, none))
        advance(self.target, state, first, put, self.weight)
        state.large, state.took_large = dr.zeros(mi.Float, chains), dr.zeros(mi.Float, chains)
        dr.make_opaque(state.large, state.took_large)
        scales = replace(scales, chain=measured.mean / visits)
        step = self._step((*key, FIRST), np.arange(chains), group, large_step, scales)
        for iteration in range(iterations):
            step.key = opaque_key(*key, FIRST + iteration)
            advance(self.target, state, step, put, self.weight)
        to_film(state, remaining(state), put)
        large, took_large, took_small = (
            float(np.array(x, np.float64).sum()) for x in (state.large, state.took_large, state.took_small)
        )
        return {
            "b": measured.b,
            "b_error": measured.error,
            "accepted_large": took_large / max(large, 1.0),
            "accepted_small": took_small / max(chains * iterations - large, 1.0),
        }

    def pilot(self) -> Brightness:
        """Estimates of a run that is the same for all chain sets: they shape weights, and cannot bias."""
        if self._pilot is None:
            chains = max(self.target.groups, min(self.most_chains, self.settings.bootstrap))
            samples = shares(self._none + 1.0, multiple(self.settings.bootstrap, chains))
            scales = Scales(self._none, self._none, self._none)
            values = self._bootstrap(samples, chains, (PILOT,), scales, lambda *_: None)
            self._pilot = Brightness.of(values, samples)
        return self._pilot

    def _bootstrap(self, samples: Ints, chains: int, key: tuple[int, ...], scales: Scales, put: Put) -> Floats:
        """Targets of uniform samples, sorted by group; their contributions are ``put``.

        They are chains that only make large steps, and of which only the proposals count.
        """
        state = Chains.dark(self.target, chains)
        group = np.repeat(np.arange(self.target.groups), samples)
        found = []
        for first in range(0, len(group), chains):
            names = np.arange(first, first + chains)
            step = self._step((*key, BOOTSTRAP), names, group[first : first + chains], 1.0, scales)
            found.append(advance(self.target, state, step, put, self.weight, move=False))
        to_film(state, remaining(state), put)
        return np.concatenate([np.array(target, np.float64) for target in found])

    def _step(self, key: tuple[int, ...], names: Ints, group: Ints, large: float, scales: Scales) -> Step:
        """A step of chains that draw the numbers ``names`` and belong to ``group`` each."""
        lane = dr.arange(mi.UInt32, len(names))
        chain_group = dr.gather(mi.UInt32, on_device(mi.UInt32, group), lane)
        by_group = [on_device(mi.Float, scale) for scale in (scales.chain, scales.uniform, scales.offset)]
        chain, uniform, offset = (dr.gather(mi.Float, table, chain_group) for table in by_group)
        first, second = (dr.gather(mi.UInt32, on_device(mi.UInt32, d), chain_group) for d in self.target.dimensions)
        step = Step(
            key=opaque_key(*key),
            large=dr.opaque(mi.Float, large),
            source=dr.gather(mi.UInt32, on_device(mi.UInt32, names), lane),
            group=chain_group,
            dimensions=(first, second),
            chain_scale=chain,
            uniform_scale=uniform,
            offset=offset,
        )
        dr.make_opaque(step)
        return step


def shares(weights: NDArray[Any], total: int) -> Ints:
    """``total`` divided in proportion to ``weights``, a part of it evenly, and at least one for each."""
    count = len(weights)
    even = np.full(count, 1.0 / count)
    wanted = FLOOR * even + (1.0 - FLOOR) * (weights / weights.sum() if weights.sum() > 0 else even)
    edges = np.round(np.concatenate([[0.0], np.cumsum(wanted)]) * (total - count)).astype(np.int64)
    edges[-1] = total - count
    return np.asarray(np.diff(edges) + 1)


def resample(values: Floats, samples: Ints, members: Ints, random: Floats) -> Ints:
    """Indices into ``values`` (sorted by group), ``members`` for each group, drawn in proportion to the values.

    Systematic: each index comes its expected number of times, rounded up or down. ``random`` holds one
    uniform number for each group. A group without light draws all alike.
    """
    chosen, first = [], 0
    for count, size, u in zip(members, samples, random, strict=True):
        part = values[first : first + size]
        cdf = np.cumsum(part if part.sum() > 0 else np.ones(size))
        at = (np.arange(count) + u) / count * cdf[-1]
        chosen.append(first + np.minimum(np.searchsorted(cdf, at, side="right"), size - 1))
        first += size
    return np.concatenate(chosen)


def multiple(number: int, of: int) -> int:
    """The smallest positive multiple of ``of`` that is not below ``number``."""
    return max(1, -(-number // of)) * of
