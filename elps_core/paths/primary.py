"""Primary sample space: the random numbers of a path as the state of a Markov chain [thesis 4.7.4].

A coordinate is a 32-bit integer, read as a number in [0, 1). Sums wrap around by themselves, so that a
small step is exactly symmetric and leaves the uniform distribution exactly alone: no number is ever
rounded to 1, and none drifts off the steps of 2^-23 that tables of cell probabilities count on.

A proposal is never stored. It follows from the chain's vector and from a generator keyed by (chain set,
iteration, chain): walks read it number by number (:class:`PrimaryStream`), and :func:`commit` computes
the same numbers again for the chains that accepted. Numbers are taken in a fixed order, a fixed count
at each vertex, so that a coordinate always belongs to the same decision at the same vertex.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import log

import drjit as dr
import mitsuba as mi

from elps_core.paths.stream import Stream

SMALLEST_STEP, LARGEST_STEP = 1.0 / 1024.0, 1.0 / 64.0
"""Bounds of a small step, its size exponentially distributed between them [Kelemen et al. 2002, section 4]."""
UNIT = 2.0**32
"""Steps of a coordinate in [0, 1)."""


def to_unit(coordinate: mi.UInt32) -> mi.Float:
    """The number in [0, 1) that walks see: the upper 23 bits, as Mitsuba's generator has them."""
    return mi.Float(coordinate >> 9) * 2.0**-23


def moved(coordinate: mi.UInt32, bits: mi.UInt32, large: mi.Bool) -> mi.UInt32:
    """The proposal for a coordinate from 32 random ``bits``: they themselves at a large step."""
    size = LARGEST_STEP * UNIT * dr.exp(to_unit(bits) * -log(LARGEST_STEP / SMALLEST_STEP))
    step = mi.UInt32(size)
    # The lowest bit is not part of the size.
    small = coordinate + dr.select((bits & 1) == 0, step, mi.UInt32(0) - step)
    return dr.select(large, bits, small)


@dataclass
class PrimaryStream(Stream):
    """A stream of random numbers that are a chain's proposal."""

    rng: mi.PCG32
    dimension: mi.UInt32
    """Coordinate that comes next."""
    large: mi.Bool
    """Whether the proposal is independent of the chain's state."""
    read: Callable[[mi.UInt32], mi.UInt32]
    """Coordinates of the chains' vectors by dimension."""

    def next_1d(self, *, even: bool = True) -> mi.Float:  # noqa: ARG002
        """One number per chain."""
        value = moved(self.read(self.dimension), self.rng.next_uint32(), self.large)
        self.dimension = self.dimension + 1
        return to_unit(value)

    def next_2d(self, *, even: bool = True) -> mi.Point2f:  # noqa: ARG002
        """Two numbers per chain."""
        x = self.next_1d()
        return mi.Point2f(x, self.next_1d())


def stream(vectors: mi.UInt32, rng: mi.PCG32, large: mi.Bool) -> PrimaryStream:
    """The proposals of all chains. ``vectors`` [dimensions, chains] holds their states, read and not kept.

    No more than ``dimensions`` numbers may be taken.
    """
    chains = dr.width(large)
    chain = dr.arange(mi.UInt32, chains)
    stride = dr.opaque(mi.UInt32, chains)

    def read(dimension: mi.UInt32) -> mi.UInt32:
        return dr.gather(mi.UInt32, vectors, dimension * stride + chain)

    return PrimaryStream(rng, dr.zeros(mi.UInt32, chains), large, read)


def commit(vectors: mi.UInt32, rng: mi.PCG32, large: mi.Bool, accepted: mi.Bool, dimensions: mi.UInt32) -> None:
    """Rewrite ``vectors`` in place: the proposals of the accepted chains, in their first ``dimensions`` coordinates.

    Arguments as those of the :func:`stream` that was evaluated; every coordinate moves, used or not.
    """
    proposal = stream(vectors, rng, large)
    chain = dr.arange(mi.UInt32, dr.width(large))
    stride = dr.opaque(mi.UInt32, dr.width(large))
    state, increment = rng.state, rng.inc

    def body(state: mi.UInt64, dimension: mi.UInt32) -> tuple[mi.UInt64, mi.UInt32]:
        # The increment never changes: as a part of the loop's state it would cost another copy of the vectors.
        rng = mi.PCG32()
        rng.state, rng.inc = state, increment
        value = moved(proposal.read(dimension), rng.next_uint32(), large)
        dr.scatter(vectors, value, dimension * stride + chain)
        return rng.state, dimension + 1

    start = (mi.UInt64(state), proposal.dimension)
    dr.while_loop(start, lambda _, dimension: accepted & (dimension < dimensions), body, label="elps commit")
