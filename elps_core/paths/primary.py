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

from dataclasses import dataclass
from math import log
from typing import cast

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


class Vectors:
    """The states of all chains, and where the streams of their proposals stand when walks begin."""

    def __init__(self, coordinates: mi.UInt32, chains: int) -> None:
        """``coordinates`` [chains, dimensions], read and not kept: no more than ``dimensions`` may be asked for.

        Chains in a packet are at different places in their paths, but each asks for one number after the other.
        """
        self._coordinates = coordinates
        self._stride = dr.opaque(mi.UInt32, dr.width(coordinates) // chains)
        self.begun: tuple[mi.PCG32, mi.UInt32, mi.Bool] | None = None
        """Generators, dimensions that come next, and whether steps are large, by chain."""
        self.u_wavelength: mi.Float | None = None
        """Numbers for the wavelengths, by chain."""

    def read(self, dimension: mi.UInt32, chain: mi.UInt32) -> mi.UInt32:
        """Coordinates by dimension."""
        return dr.gather(mi.UInt32, self._coordinates, chain * self._stride + dimension)


@dataclass
class PrimaryStream(Stream):
    """A stream of random numbers that are a chain's proposal."""

    rng: mi.PCG32
    dimension: mi.UInt32
    """Coordinate that comes next."""
    large: mi.Bool
    """Whether the proposal is independent of the chain's state."""
    chain: mi.UInt32
    vectors: Vectors

    def next_1d(self, *, even: bool = True) -> mi.Float:  # noqa: ARG002
        """One number per chain."""
        value = moved(self.vectors.read(self.dimension, self.chain), self.rng.next_uint32(), self.large)
        self.dimension = self.dimension + 1
        return to_unit(value)

    def next_2d(self, *, even: bool = True) -> mi.Point2f:  # noqa: ARG002
        """Two numbers per chain."""
        x = self.next_1d()
        return mi.Point2f(x, self.next_1d())

    def begin(self, u_wavelength: mi.Float | None = None) -> PrimaryStream:
        """This stream of all chains, from which walks of any chain can set out: see :meth:`at`.

        ``u_wavelength`` is the number that :meth:`wavelengths` is to give.
        """
        self.dimension = dr.zeros(mi.UInt32, dr.width(self.chain)) + self.dimension
        dr.make_opaque(self.rng, self.dimension, self.large)
        self.vectors.begun, self.vectors.u_wavelength = (self.rng, self.dimension, self.large), u_wavelength
        return self

    def wavelengths(self, samples: int, turns: int) -> mi.Float:  # noqa: ARG002
        """The number that each chain has for them."""
        return self.vectors.u_wavelength

    def at(self, sample: mi.UInt32, active: mi.Bool) -> PrimaryStream:
        """The numbers of other chains, from where their streams stood when walks began."""
        if self.vectors.begun is None:
            raise RuntimeError("no walk can begin before the stream of all chains has")
        every, dimension, large = self.vectors.begun
        rng = mi.PCG32()
        rng.state = dr.gather(mi.UInt64, every.state, sample, active)
        rng.inc = dr.gather(mi.UInt64, every.inc, sample, active)
        return PrimaryStream(
            rng,
            dr.gather(mi.UInt32, dimension, sample, active),
            dr.gather(mi.Bool, large, sample, active),
            sample,
            self.vectors,
        )

    def where(self, chosen: mi.Bool, other: Stream) -> PrimaryStream:
        """``other`` in ``chosen`` lanes, and this stream elsewhere."""
        there = cast("PrimaryStream", other)
        rng = mi.PCG32()
        rng.state = dr.select(chosen, there.rng.state, self.rng.state)
        rng.inc = dr.select(chosen, there.rng.inc, self.rng.inc)
        return PrimaryStream(
            rng,
            dr.select(chosen, there.dimension, self.dimension),
            dr.select(chosen, there.large, self.large),
            dr.select(chosen, there.chain, self.chain),
            self.vectors,
        )


def stream(coordinates: mi.UInt32, rng: mi.PCG32, large: mi.Bool) -> PrimaryStream:
    """The proposals of all chains, whose states are ``coordinates``: see :class:`Vectors`."""
    chains = dr.width(large)
    vectors = Vectors(coordinates, chains)
    return PrimaryStream(rng, dr.zeros(mi.UInt32, chains), large, dr.arange(mi.UInt32, chains), vectors)


def commit(vectors: mi.UInt32, rng: mi.PCG32, large: mi.Bool, accepted: mi.Bool, dimensions: mi.UInt32) -> None:
    """Rewrite ``vectors`` [chains, dimensions] in place: of accepted chains the first ``dimensions`` coordinates.

    They become what was proposed, whether a walk has used them or not. Arguments are those of the :func:`stream` that
    was evaluated.
    """
    proposal = stream(vectors, rng, large)
    chain = dr.arange(mi.UInt32, dr.width(large))
    stride = dr.opaque(mi.UInt32, dr.width(vectors) // dr.width(large))
    state, increment = rng.state, rng.inc

    def body(state: mi.UInt64, dimension: mi.UInt32) -> tuple[mi.UInt64, mi.UInt32]:
        # The increment never changes: as a part of the loop's state it would cost another copy of the vectors.
        rng = mi.PCG32()
        rng.state, rng.inc = state, increment
        value = moved(proposal.vectors.read(dimension, chain), rng.next_uint32(), large)
        dr.scatter(vectors, value, chain * stride + dimension)
        return rng.state, dimension + 1

    start = (mi.UInt64(state), proposal.dimension)
    dr.while_loop(start, lambda _, dimension: accepted & (dimension < dimensions), body, label="elps commit")
