"""Random numbers that fill their ranges evenly, for the samples that make one picture.

The samples of a pixel take the points of digital (0,2)-sequences, one sequence for every pair of numbers that walks
ask for: any aligned 2^m points in a row lie one by one in all the cells of area 2^-m into which the unit square is
cut, so that a light's surface, the pixel and directions are covered far more evenly than by chance, and what is
smooth in them loses most of its noise. Pairs are decoupled by random orders, and every pair of every set has a random
digital shift, so that each point by itself is uniform, and the mean of any number of them unbiased.
[Sobol 1967; Kollig and Keller 2002; orders by hashing: Laine and Karras 2011, Burley 2020.]
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import drjit as dr
import mitsuba as mi

from elps_core.paths.stream import Key, Stream

BLOCK = 1 << 16
"""Light paths of one set: they share the film, and not a pixel."""
POSITION, WAVELENGTH, WALK = 0, 2, 3
"""Numbers of a sample: the film position comes first, then the wavelengths, then what walks ask for."""
_APART = 0x9E3779B9
"""Steps of this keep the hashes of consecutive numbers apart: 2^32 over the golden ratio."""
_SHIFTS = 0xB5297A4D, 0x68E31DA5
"""Odd factors that make the shifts of a pair out of one hash."""


class Nets:
    """Points for many samples: of each, the ``number`` in its set, and the ``group`` that names the set."""

    def __init__(self, group: mi.UInt32, number: mi.UInt32, key: Key) -> None:
        # Sequences count by their bits in reverse.
        self._order = dr.brev(number)
        self._seed = _hashed(_hashed(group + key[0]) ^ key[1])
        dr.eval(self._order, self._seed)

    def stream(self, sample: mi.UInt32, active: mi.Bool | bool = True) -> NetStream:
        """What walks ask for that belong to ``sample``."""
        return NetStream(
            order=dr.gather(mi.UInt32, self._order, sample, active),
            seed=dr.gather(mi.UInt32, self._seed, sample, active),
            dimension=dr.full(mi.UInt32, WALK, dr.width(sample)),
            nets=self,
        )

    def positions(self) -> mi.Point2f:
        """The first two numbers of all samples."""
        return self._all(POSITION).next_2d()

    def wavelengths(self) -> mi.Float:
        """The third number of all samples."""
        return self._all(WAVELENGTH).next_1d()

    def _all(self, first: int) -> NetStream:
        return NetStream(self._order, self._seed, dr.full(mi.UInt32, first, dr.width(self._order)), self)


@dataclass
class NetStream(Stream):
    """The numbers of one sample per lane."""

    order: mi.UInt32
    """Place in the set's sequences, its bits reversed."""
    seed: mi.UInt32
    """Of the set."""
    dimension: mi.UInt32
    """Number that comes next."""
    nets: Nets

    def next_1d(self, *, even: bool = True) -> mi.Float:
        """One number per lane."""
        pick = self._pick(1)
        if not even:
            return _unit(_hashed(pick ^ self.order))
        return _unit(_shuffled(self.order, pick) ^ (pick * _SHIFTS[0]))

    def next_2d(self, *, even: bool = True) -> mi.Point2f:
        """Two numbers per lane."""
        if not even:
            return mi.Point2f(self.next_1d(even=False), self.next_1d(even=False))
        pick = self._pick(2)
        x = _shuffled(self.order, pick)
        return mi.Point2f(_unit(x ^ (pick * _SHIFTS[0])), _unit(_second(x) ^ (pick * _SHIFTS[1])))

    def wavelengths(self, samples: int, turns: int) -> mi.Float:  # noqa: ARG002
        """One number for each sample of the nets."""
        return self.nets.wavelengths()

    def at(self, sample: mi.UInt32, active: mi.Bool) -> NetStream:
        """The numbers of other samples."""
        return self.nets.stream(sample, active)

    def where(self, chosen: mi.Bool, other: Stream) -> NetStream:
        """``other`` in ``chosen`` lanes, and this stream elsewhere."""
        there = cast("NetStream", other)
        return NetStream(
            order=dr.select(chosen, there.order, self.order),
            seed=dr.select(chosen, there.seed, self.seed),
            dimension=dr.select(chosen, there.dimension, self.dimension),
            nets=self.nets,
        )

    def _pick(self, count: int) -> mi.UInt32:
        """A hash of the set and of the next number's place; ``count`` numbers are taken."""
        pick = _hashed(self.seed + self.dimension * _APART)
        self.dimension = self.dimension + count
        return pick


def _unit(bits: mi.UInt32) -> mi.Float:
    """The number in [0, 1): the upper 23 bits, as Mitsuba's generator has them."""
    return mi.Float(bits >> 9) * 2.0**-23


def _hashed(x: mi.UInt32) -> mi.UInt32:
    """All bits mixed, one to one (constants of low bias: Wellons 2018)."""
    x = (x ^ (x >> 16)) * 0x7FEB352D
    x = (x ^ (x >> 15)) * 0x846CA68B
    return x ^ (x >> 16)


def _shuffled(order: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """A random order of the sequence that takes each aligned block of 2^m numbers to another one.

    So the first 2^m stay neighbours: each bit is flipped by a hash of those below it, reversed as ``order`` is
    [Laine and Karras 2011; constants of Burley 2020].
    """
    x = order + seed
    x = x ^ (x * 0x6C50B47C)
    x = x ^ (x * 0xB82F1E52)
    x = x ^ (x * 0xC7AFE638)
    return x ^ (x * 0x8D22F6E6)


def _second(x: mi.UInt32) -> mi.UInt32:
    """The second coordinate of Sobol's sequence, ``x`` the first one: Pascal's triangle modulo 2 times its bits."""
    for step, mask in ((16, 0x0000FFFF), (8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        x = x ^ ((x & mask) << step)
    return x
