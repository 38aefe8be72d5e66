"""Many Markov chains side by side: one step of Metropolis-Hastings in primary sample space [thesis 3.8.2].

A state's target is the luminance of all its contributions to the film [Kelemen et al. 2002], weighted by where
they fall, so that chains can be sent to where the relative noise is. Contributions are
kept in memory, on sheets of two halves: one for the chain's state, one for its proposal; to accept is to
swap them. Both count with their expected share, and a state goes to the film once, when a chain leaves it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.integrators.bdpt import Splat
from elps_core.integrators.canvas import to_rgb
from elps_core.paths.primary import PrimaryStream, commit, stream
from elps_core.paths.stream import ChanceStream, Key, Stream, generator
from elps_core.scene.spectrum import luminance

GENERATORS = 3
"""Generators of a chain in one step: for its decisions, and for the two streams of the proposal."""
SLOT_BYTES = 48
"""Memory of one contribution on both halves of a sheet."""

Put: TypeAlias = "Callable[[mi.Point2f, mi.Color3f, mi.Bool], None]"
"""Adds linear RGB at film positions, pixels relative to the crop window."""


PixelWeight: TypeAlias = "Callable[[mi.Point2f], mi.Float]"
"""What a unit of luminance counts in the target at a film position; positive."""


def alike(position: mi.Point2f) -> mi.Float:
    """All pixels count the same."""
    return dr.full(mi.Float, 1.0, dr.width(position))


class Target(Protocol):
    """What the chains sample: light as a function of primary samples, in one or more groups of states."""

    groups: int
    """Parts of the state space, such as path lengths: a chain stays in its own."""
    dimensions: tuple[NDArray[np.uint32], NDArray[np.uint32]]
    """Numbers taken from each of the two streams at most, by group."""
    splats: tuple[int, ...]
    """Greatest number of splats of a state, for each call of ``splat`` in the code."""

    def evaluate(
        self, streams: tuple[PrimaryStream, PrimaryStream], group: mi.UInt32, splat: Splat
    ) -> tuple[mi.Point2f, mi.Spectrum, mi.Spectrum]:
        """The contributions of one state per lane, in units of the film's mean radiance.

        Returns one of them (film position in pixels, value, wavelengths); ``splat`` takes the others.
        """
        ...


@dataclass
class Sheet:
    """Contributions of the chains' states and proposals."""

    where: mi.Float  # Film positions, [2, slots, chains, 2]
    value: mi.Float  # Linear RGB and weighted luminance, [2, slots, chains, 4]
    count: mi.UInt32  # Slots that the chains' states fill
    slots: int

    @staticmethod
    def empty(slots: int, chains: int) -> Sheet:
        """Room for ``slots`` contributions of each chain."""
        where, value = (dr.zeros(mi.Float, 2 * slots * chains * floats) for floats in (2, 4))
        return Sheet(where, value, dr.zeros(mi.UInt32, chains), slots)

    def write(
        self,
        index: mi.UInt32,
        where: mi.Point2f,
        value: mi.Spectrum,
        wavelengths: mi.Spectrum,
        weight: PixelWeight,
        active: mi.Bool,
    ) -> mi.Float:
        """Keep a contribution and return its weighted luminance. What is not a number counts as nothing."""
        rgb, bright = mi.Color3f(to_rgb(value, wavelengths)), luminance(value, wavelengths) * weight(where)
        finite = dr.isfinite(bright + dr.sum(rgb) + dr.sum(where))
        bright = dr.select(finite, dr.maximum(bright, 0.0), 0.0)
        rgb, where = dr.select(finite, rgb, 0.0), dr.select(finite, where, 0.0)
        dr.scatter(self.where, where, index, active)
        dr.scatter(self.value, mi.Vector4f(*rgb, bright), index, active)
        return bright


@dataclass
class Chains:
    """The current states of all chains."""

    vectors: tuple[mi.UInt32, mi.UInt32]  # Primary samples of the two streams, [chains, dimensions]
    sheets: list[Sheet]  # One for what the target returns, then one for each call of splat
    half: mi.UInt32  # Which half of the sheets holds the chain's state
    target: mi.Float
    weight: mi.Float  # What the state's contributions count so far
    large: mi.Float  # Large steps so far
    took_large: mi.Float  # Sum of their probabilities of acceptance
    took_small: mi.Float  # The same of small steps

    @staticmethod
    def dark(target: Target, chains: int) -> Chains:
        """Chains whose states have no light, so that they accept whatever comes first."""
        first, second = (dr.zeros(mi.UInt32, int(dimensions.max()) * chains) for dimensions in target.dimensions)
        state = Chains(
            vectors=(first, second),
            sheets=[Sheet.empty(slots, chains) for slots in (1, *target.splats)],
            half=dr.zeros(mi.UInt32, chains),
            target=dr.zeros(mi.Float, chains),
            weight=dr.zeros(mi.Float, chains),
            large=dr.zeros(mi.Float, chains),
            took_large=dr.zeros(mi.Float, chains),
            took_small=dr.zeros(mi.Float, chains),
        )
        dr.make_opaque(state)
        return state


@dataclass
class Step:
    """How a step is made and what its states count for; one entry for each chain but in ``key`` and ``large``."""

    key: Key
    large: mi.Float  # Probability of a large step
    source: mi.UInt32  # Names the chain's random numbers under ``key``
    group: mi.UInt32
    dimensions: tuple[mi.UInt32, mi.UInt32]  # Coordinates of the two vectors in use
    chain_scale: mi.Float  # A visit of a chain counts chain_scale / (target + offset),
    uniform_scale: mi.Float  # a uniform sample uniform_scale / (target + offset)
    offset: mi.Float


@dataclass
class Left:
    """What a step leaves behind: for each chain the state that it does not keep, old or proposed."""

    half: mi.UInt32
    weight: mi.Float
    count: list[mi.UInt32]  # Its splats on each sheet
    target: mi.Float  # Of the proposal, left behind or not


def advance(
    target: Target, state: Chains, step: Step, put: Put, weight: PixelWeight = alike, *, move: bool = True
) -> mi.Float:
    """Take the chains one step on, in place; returns the targets of what was proposed.

    States that are left are ``put`` on the film. Without ``move`` the chains forget their primary samples.
    """
    left, large, accepted = propose(target, state, step, weight)
    dr.eval(state, left, large, accepted)
    if move:
        for vectors, proposal, used in zip(state.vectors, streams(state, step)[1:], step.dimensions, strict=True):
            commit(vectors, proposal.rng, large, accepted, used)
        dr.eval(state.vectors)
    to_film(state, left, put)
    return left.target


def propose(target: Target, state: Chains, step: Step, weight: PixelWeight = alike) -> tuple[Left, mi.Bool, mi.Bool]:
    """Make a proposal for every chain, and accept or reject it; renews all of ``state`` but the vectors.

    Returns what is left, and whether steps were large and were accepted.
    """
    decide, *proposals = streams(state, step)
    lanes = dr.width(state.half)
    lane = dr.arange(mi.UInt32, lanes)
    stride = dr.opaque(mi.UInt32, lanes)
    old, new = state.half, 1 - state.half
    first, *others = state.sheets
    counts = [dr.zeros(mi.UInt32, lanes) for _ in others]
    calls = 0

    def splat(
        where: mi.Point2f, value: mi.Spectrum, wavelengths: mi.Spectrum, chain: mi.UInt32, active: mi.Bool
    ) -> None:
        # A loop may write to an array from one place only, so that each call has its own.
        nonlocal calls
        sheet, count = others[calls % len(others)], counts[calls % len(others)]
        calls += 1
        active = active & dr.any(value != 0.0)
        slot = dr.scatter_inc(count, chain, active)
        half = 1 - dr.gather(mi.UInt32, old, chain, active)
        sheet.write((half * sheet.slots + slot) * stride + chain, where, value, wavelengths, weight, active)

    where, value, wavelengths = target.evaluate((proposals[0], proposals[1]), step.group, splat)
    bright = first.write(new * stride + lane, where, value, wavelengths, weight, mi.Bool(True))
    for sheet, count in zip(others, counts, strict=True):
        bright = bright + _luminance(sheet, new, stride, count)

    large = proposals[0].large
    accept = dr.select(bright < state.target, bright / state.target, 1.0)
    accepted = decide.next_1d() < accept
    old_weight = state.weight + (1.0 - accept) * step.chain_scale * _inverse(state.target + step.offset)
    share = accept * step.chain_scale + dr.select(large, step.uniform_scale, 0.0)
    new_weight = share * _inverse(bright + step.offset)
    left = Left(
        half=dr.select(accepted, state.half, new),
        weight=dr.select(accepted, old_weight, new_weight),
        count=[dr.select(accepted, sheet.count, count) for sheet, count in zip(others, counts, strict=True)],
        target=bright,
    )
    for sheet, count in zip(others, counts, strict=True):
        sheet.count = dr.select(accepted, count, sheet.count)
    state.half = dr.select(accepted, new, state.half)
    state.target = dr.select(accepted, bright, state.target)
    state.weight = dr.select(accepted, new_weight, old_weight)
    state.large = state.large + dr.select(large, 1.0, 0.0)
    state.took_large = state.took_large + dr.select(large, accept, 0.0)
    state.took_small = state.took_small + dr.select(large, 0.0, accept)
    return left, large, accepted


def streams(state: Chains, step: Step) -> tuple[Stream, PrimaryStream, PrimaryStream]:
    """The numbers that decide about each chain's step, and the two streams of its proposal."""
    name = step.source * GENERATORS
    decide = ChanceStream(generator(name, step.key))
    large = decide.next_1d() < step.large
    first, second = (stream(state.vectors[k], generator(name + (k + 1), step.key), large) for k in range(2))
    return decide, first, second


def remaining(state: Chains) -> Left:
    """The chains' last states, as if left."""
    return Left(state.half, state.weight, [sheet.count for sheet in state.sheets[1:]], state.target)


def to_film(state: Chains, left: Left, put: Put) -> None:
    """Send what a step has left to the film."""
    lanes = dr.width(left.half)
    stride = dr.opaque(mi.UInt32, lanes)
    for sheet, count in zip(state.sheets, [None, *left.count], strict=True):
        entry = dr.arange(mi.UInt32, sheet.slots * lanes)
        slot = entry // stride
        lane = entry - slot * stride
        scale = dr.gather(mi.Float, left.weight, lane)
        active = scale > 0.0
        if count is not None:
            active = active & (slot < dr.gather(mi.UInt32, count, lane))
        index = (dr.gather(mi.UInt32, left.half, lane, active) * sheet.slots + slot) * stride + lane
        value = dr.gather(mi.Vector4f, sheet.value, index, active)
        where = dr.gather(mi.Point2f, sheet.where, index, active)
        put(where, mi.Color3f(value.x, value.y, value.z) * scale, active)


def _luminance(sheet: Sheet, half: mi.UInt32, stride: mi.UInt32, count: mi.UInt32) -> mi.Float:
    """Sum over the first ``count`` contributions of each chain."""
    lanes = dr.width(half)
    lane = dr.arange(mi.UInt32, lanes)

    def add(slot: mi.UInt32, total: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        index = (half * sheet.slots + slot) * stride + lane
        return slot + 1, total + dr.gather(mi.Float, sheet.value, index * 4 + 3)

    start = (dr.zeros(mi.UInt32, lanes), dr.zeros(mi.Float, lanes))
    _, total = dr.while_loop(start, lambda slot, _: slot < count, add, label="elps splats")
    return total


def _inverse(x: mi.Float) -> mi.Float:
    return dr.select(x > 0.0, dr.rcp(x), 0.0)
