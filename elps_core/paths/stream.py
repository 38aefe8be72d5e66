"""Where a walk takes its random numbers from."""

from __future__ import annotations

import hashlib
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


@dataclass
class Stream:
    """Independent uniform numbers in [0, 1), one PCG32 sequence per lane."""

    rng: mi.PCG32

    @staticmethod
    def of(lanes: int, *key: int) -> Stream:
        """A stream of ``lanes`` lanes named by ``key``, such as (seed, chunk, pass)."""
        return Stream(generator(dr.arange(mi.UInt32, lanes), opaque_key(*key)))

    def next_1d(self) -> mi.Float:
        """One number per lane."""
        return self.rng.next_float32()

    def next_2d(self) -> mi.Point2f:
        """Two numbers per lane."""
        x = self.rng.next_float32()
        return mi.Point2f(x, self.rng.next_float32())
