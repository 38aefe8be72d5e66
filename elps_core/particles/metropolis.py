"""Metropolis particles: from the states of Markov chains over paths [thesis 5.2.2].

The chains walk through the random numbers of :class:`elps_core.particles.joining.PathJoiner` with small and large
steps [Kelemen et al. 2002]; their target is f / p of the path [thesis (5.15)], so that paths come
with a density of f, and a photon at every vertex of theirs has the density of [thesis (5.14)]: radiance
times importance. Particles are those of :mod:`elps_core.particles.bidirectional`, weights included.

Chains see whole paths only. The particles of broken ones, and of light that never reaches the sensor, come from
uniform samples: the bootstrap and the large steps, which are made anyway. Both sorts weigh by the balance heuristic:
with C visits of chains to the paths of a length, U uniform samples among those and the bootstrap's, and a target I,

    of a chain's state: (b / C) / (I + r b')      of a uniform sample: (b' / C) / (I + r b')      r = U / C

times the weight in the bidirectional sampler. b is the bootstrap's mean of I, which goes with the states
drawn from it; b' an estimate from other samples, the same for all runs. A path that chains hardly ever visit thus
has at most the weight that it has without them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.integrators.metropolis import multiple, resample, shares
from elps_core.particles.bidirectional import Harvest
from elps_core.particles.joining import HEAD_NUMBERS, START_NUMBERS, STEP_NUMBERS, Joined, PathJoiner
from elps_core.particles.records import ParticleBuffer, Particles, Worth, everywhere
from elps_core.particles.subpaths import STEP_BYTES, StepStore
from elps_core.paths.primary import PrimaryStream, commit, stream
from elps_core.paths.stream import ChanceStream, Key, Stream, generator, key_seed, opaque_key
from elps_core.sampling.start import StartDensity
from elps_core.scene.sensors import Camera

SHORTEST = 2
"""Segments of the shortest path: no chain is spent on light that the sensor sees directly."""
GENERATORS = 3
"""Generators of a chain in one iteration: for its decisions, and for the two streams of the proposal."""
PILOT_SHARE = 4
"""The pilot has this fraction of the bootstrap's samples: its estimates only shape weights."""
PILOT = -1
"""Key of the pilot: no run has it, because seeds are not negative."""
BOOTSTRAP, RESAMPLING, FIRST = range(3)
"""Last part of the keys of random numbers: what they are for; mutations count from the last one."""
BATCH = 1 << 20
"""Particles of a batch, about."""
HALVES = 2
"""Of the stores: one for the vertices of a chain's state, one for those of its proposal."""
MAX_STORE_BYTES = 1 << 28
"""Bound of the vertices of all chains: deep paths get fewer chains."""
LEAST = 1e-6
"""Smallest estimate of a mean target by length, relative to the largest: what the pilot did not see is not nothing."""

Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass
class _Chains:
    """States of all chains."""

    vectors: tuple[mi.UInt32, mi.UInt32]  # Primary samples for the eye and the light walk, [dimensions, chains]
    stores: tuple[StepStore, StepStore]  # Vertices of the light and of the eye walk, of the state and of the proposal
    half: mi.UInt32  # Which half of the stores holds the state
    path: Joined = field(init=False)  # The state's, once there is one


class MetropolisSampler:
    """Particles from ``iterations`` mutations of each of ``chains`` chains.

    Args:
        scene: what is walked in.
        camera: where importance comes from.
        lights: the density of light vertices.
        max_depth: greatest number of segments of a path, 2 or more.
        iterations: mutations of a chain in a run.
        chains: chains side by side, at least one for each length. The thesis has 1024; with so few the time
            goes into launching kernels.
        bootstrap: uniform samples from which the chains' first states are drawn.
        large_step: probability of an independent proposal.
        first_hits: keep importons that the sensor sees directly.
        uniform: let uniform samples count. Without, all particles are of chains and their density is
            that of (5.14) alone, but light and importance of broken paths is missing.
        worth: what importance, and with it the target, counts by where on the film it comes from.

    Raises:
        ValueError: ``max_depth`` is less than 2.
    """

    def __init__(
        self,
        scene: mi.Scene,
        camera: Camera,
        lights: StartDensity,
        *,
        max_depth: int,
        iterations: int,
        chains: int = 32768,
        bootstrap: int = 65536,
        large_step: float = 0.5,
        first_hits: bool = False,
        uniform: bool = True,
        worth: Worth = everywhere,
    ) -> None:
        if max_depth < SHORTEST:
            raise ValueError("chains need paths of two segments or more")
        self.iterations, self.large_step, self.uniform = iterations, large_step, uniform
        self._first_hits = first_hits
        self._joiner = PathJoiner(scene, camera, lights, max_depth=max_depth, worth=worth)
        self.groups = max_depth - SHORTEST + 1
        """Lengths of paths; a chain stays in its own."""
        most = MAX_STORE_BYTES // (HALVES * 2 * max_depth * STEP_BYTES)
        self.chains = max(min(chains, most), self.groups)
        self._samples = multiple(bootstrap, self.chains)
        self._dimensions = tuple(n + STEP_NUMBERS * max_depth for n in (HEAD_NUMBERS, START_NUMBERS))
        self._pilot: tuple[Doubles, Doubles] | None = None

    def run(self, key: tuple[int, ...]) -> Iterator[Particles]:
        """Batches of both kinds; see :class:`elps_core.particles.records.ParticleSampler`."""
        mean, deviation = self.pilot()
        members, samples = shares(mean, self.chains), shares(deviation, self._samples)
        visits = members * self.iterations
        drawn = self.large_step * visits + samples if self.uniform else np.zeros(self.groups)
        # A length counts by what is drawn of it: else few samples of one length would outweigh many of another.
        p = drawn / drawn.sum() if self.uniform else visits / visits.sum()
        harvest = Harvest(np.concatenate([np.zeros(SHORTEST), p]), first_hits=self._first_hits)
        uniform, offset = p * mean / visits, mean * drawn / visits
        # Always room for one path of every chain.
        buffer = ParticleBuffer(harvest.capacity(self.chains) + BATCH, ports=2)
        chains = self._dark()

        def collect(path: Joined, half: mi.UInt32, scale: mi.Float, offset: mi.Float) -> Iterator[Particles]:
            density = path.target + offset
            scale = dr.select(density > 0.0, scale / density, 0.0)
            dr.eval(scale)  # Data, not code: one kernel takes particles for any reason.
            harvest.take(path, chains.stores, self._row(half), scale, buffer)
            if sum(buffer.counts) > BATCH:
                yield buffer.take()

        targets = np.zeros(0)
        for path, group in self._bootstrap(chains, key, samples):
            targets = np.append(targets, np.array(path.target, np.float64))
            if self.uniform:
                yield from collect(path, 1 - chains.half, *_by_chain(group, uniform, offset))
        b = np.array([part.mean() for part in _by_group(targets, samples)])

        random = np.random.default_rng(key_seed(*key, RESAMPLING)).random(self.groups)
        chosen = on_device(mi.UInt32, resample(targets, samples, members, random))
        group = np.repeat(np.arange(self.groups), members)
        # A state without light gives way to whatever comes.
        chains.path = replace(path, target=dr.opaque(mi.Float, 0.0, self.chains))
        self._advance(chains, (*key, BOOTSTRAP), chosen, group, 1.0)
        lane = dr.arange(mi.UInt32, self.chains)
        dr.make_opaque(lane)
        by_state, by_sample, shift = _by_chain(group, p * b / visits, uniform, offset)
        for iteration in range(self.iterations):
            path, accepted, large = self._advance(chains, (*key, FIRST + iteration), lane, group, self.large_step)
            scale = by_state
            if self.uniform:
                refused = dr.select(large & ~accepted, by_sample, 0.0)
                yield from collect(path, 1 - chains.half, refused, shift)
                scale = by_state + dr.select(large & accepted, by_sample, 0.0)
            yield from collect(chains.path, chains.half, scale, shift)
        yield buffer.take()

    def pilot(self) -> tuple[Doubles, Doubles]:
        """Mean and standard deviation of the target by length, from a short run that is the same for all runs."""
        if self._pilot is None:
            samples = shares(np.ones(self.groups), multiple(self._samples // PILOT_SHARE, self.chains))
            paths = self._bootstrap(self._dark(), (PILOT,), samples)
            targets = np.concatenate([np.array(path.target, np.float64) for path, _ in paths])
            mean, deviation = (np.array([f(x) for x in _by_group(targets, samples)]) for f in (np.mean, np.std))
            self._pilot = np.maximum(mean, LEAST * mean.max() or 1.0), deviation
        return self._pilot

    def _bootstrap(self, chains: _Chains, key: tuple[int, ...], samples: Ints) -> Iterator[tuple[Joined, Ints]]:
        """Uniform samples sorted by length, ``samples`` of each, in passes; with the group of each."""
        group = np.repeat(np.arange(self.groups), samples)
        for first in range(0, len(group), self.chains):
            part = group[first : first + self.chains]
            source = dr.arange(mi.UInt32, self.chains) + dr.opaque(mi.UInt32, first)
            dr.eval(source)
            yield self._propose(chains, (*key, BOOTSTRAP), source, part, 1.0)[0], part

    def _advance(
        self, chains: _Chains, key: tuple[int, ...], source: mi.UInt32, group: Ints, large_step: float
    ) -> tuple[Joined, mi.Bool, mi.Bool]:
        """One mutation of every chain. Returns the proposals, and which of them were accepted and which large."""
        path, decide, streams = self._propose(chains, key, source, group, large_step)
        old, new = chains.path.target, path.target
        accepted = decide.next_1d() < dr.select(new < old, new / old, 1.0)
        large = streams[0].large
        chains.half = dr.select(accepted, 1 - chains.half, chains.half)
        chains.path = dr.select(accepted, path, chains.path)
        dr.eval(chains.half, chains.path, accepted, large)
        opaque = opaque_key(*key)
        for number, (vectors, dimensions) in enumerate(zip(chains.vectors, self._dimensions, strict=True)):
            rng = generator(source * GENERATORS + (number + 1), opaque)
            commit(vectors, rng, large, accepted, mi.UInt32(dimensions))
        dr.eval(chains.vectors)
        return path, accepted, large

    def _propose(
        self, chains: _Chains, key: tuple[int, ...], source: mi.UInt32, group: Ints, large_step: float
    ) -> tuple[Joined, Stream, tuple[PrimaryStream, PrimaryStream]]:
        """A path for every chain, its vertices in the half of the stores that holds no state."""
        opaque: Key = opaque_key(*key)
        decide = ChanceStream(generator(source * GENERATORS, opaque))
        large = decide.next_1d() < dr.opaque(mi.Float, large_step)
        eye, light = (
            stream(vectors, generator(source * GENERATORS + (number + 1), opaque), large)
            for number, vectors in enumerate(chains.vectors)
        )
        length = on_device(mi.UInt32, group + SHORTEST)
        path = self._joiner.join((eye, light), length, chains.stores, self._row(1 - chains.half))
        dr.eval(path, *(store.data for store in chains.stores))
        return path, decide, (eye, light)

    def _row(self, half: mi.UInt32) -> mi.UInt32:
        return half * dr.opaque(mi.UInt32, self.chains) + dr.arange(mi.UInt32, self.chains)

    def _dark(self) -> _Chains:
        """Chains without states."""
        lanes, depth = self.chains, self._joiner.max_depth
        stores = (StepStore(HALVES * lanes, depth), StepStore(HALVES * lanes, depth))
        vectors = [dr.opaque(mi.UInt32, 0, n * lanes) for n in self._dimensions]
        return _Chains((vectors[0], vectors[1]), stores, dr.opaque(mi.UInt32, 0, lanes))


def _by_chain(group: Ints, *values: Doubles) -> list[mi.Float]:
    """For each chain what stands for its group."""
    found = [on_device(mi.Float, value[group]) for value in values]
    dr.eval(found)
    return found


def _by_group(values: Doubles, samples: Ints) -> list[Doubles]:
    """Values that are sorted by group, apart."""
    return np.split(values, np.cumsum(samples)[:-1])
