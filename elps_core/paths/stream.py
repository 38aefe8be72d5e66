"""Where a walk takes its random numbers from."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TypeAlias

import drjit as dr
import mitsuba as mi

TEA_ROUNDS = 8
"""Rounds of the tiny encryption algorithm; six are enough, four are not."""

Key: TypeAlias = "tuple[mi.UInt32, mi.UInt32]"
"""64 bits that name random streams: data of the kernel, not part of its code."""


def key_seed(*key: int) -> int:
    """64 bits that name a random stream, such as (seed, chunk, pass)."""
    text = ":".join(str(part) for part in key).encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "little")


def opaque_key(*key: int) -> Key:
    """The :data:`Key` of what the numbers ``key`` name."""
    seed = key_seed(*key)
    return dr.opaque(mi.UInt32, seed & 0xFFFFFFFF), dr.opaque(mi.UInt32, seed >> 32)


def generator(number: mi.UInt32, key: Key) -> mi.PCG32:
    """The generator ``number`` of those that ``key`` names.

    State and sequence constant are hashes of both: no two (key, number) pairs share a sequence but by a
    rare accident of 64 bits each. Started from consecutive numbers, PCG32 would be a lattice over them.
    """
    return mi.PCG32(
        initstate=mi.sample_tea_64(number, key[0], TEA_ROUNDS), initseq=mi.sample_tea_64(number, key[1], TEA_ROUNDS)
    )


class Stream(ABC):
    """Uniform numbers in [0, 1), which walks ask for in a fixed order, a fixed count at each vertex."""

    @staticmethod
    def of(lanes: int, *key: int) -> ChanceStream:
        """A stream of ``lanes`` lanes of independent numbers, named by ``key``, such as (seed, chunk, pass)."""
        return ChanceStream(generator(dr.arange(mi.UInt32, lanes), opaque_key(*key)))

    @abstractmethod
    def next_1d(self, *, even: bool = True) -> mi.Float:
        """One number per lane; where they need not be ``even``, a stream may spare the effort to spread them evenly."""

    @abstractmethod
    def next_2d(self, *, even: bool = True) -> mi.Point2f:
        """Two numbers per lane, as :meth:`next_1d`."""

    def wavelengths(self, samples: int, turns: int) -> mi.Float:
        """One number for each of ``samples``, ``turns`` for a lane: sample s is of lane s modulo lanes."""
        drawn = [self.next_1d() for _ in range(turns)]
        # Of the last turn some lanes have no sample.
        return drawn[0] if turns == 1 else dr.gather(mi.Float, dr.concat(drawn), dr.arange(mi.UInt32, samples))

    def at(self, sample: mi.UInt32, active: mi.Bool) -> Stream:  # noqa: ARG002
        """What a walk takes its numbers from that belongs to ``sample``."""
        return self

    def where(self, chosen: mi.Bool, other: Stream) -> Stream:  # noqa: ARG002
        """``other``, which comes of :meth:`at`, in ``chosen`` lanes, and this stream elsewhere."""
        return self


@dataclass
class ChanceStream(Stream):
    """Independent uniform numbers in [0, 1), one PCG32 sequence per lane."""

    rng: mi.PCG32

    def next_1d(self, *, even: bool = True) -> mi.Float:  # noqa: ARG002
        """One number per lane."""
        return self.rng.next_float32()

    def next_2d(self, *, even: bool = True) -> mi.Point2f:  # noqa: ARG002
        """Two numbers per lane."""
        x = self.rng.next_float32()
        return mi.Point2f(x, self.rng.next_float32())
