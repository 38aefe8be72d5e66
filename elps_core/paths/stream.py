"""Where a walk takes its random numbers from."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

TEA_ROUNDS = 8
"""Rounds of the tiny encryption algorithm; six are enough, four are not."""


def key_seed(*key: int) -> int:
    """64 bits that name a random stream, such as (seed, chunk, pass)."""
    text = ":".join(str(part) for part in key).encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "little")


@dataclass
class Stream:
    """Independent uniform numbers in [0, 1), one PCG32 sequence per lane.

    State and sequence constant of a lane are hashes of its number and of the stream's key: no two
    (key, lane) pairs share a sequence but by a rare accident of 64 bits each.
    """

    rng: mi.PCG32

    @staticmethod
    def of(lanes: int, *key: int) -> Stream:
        """A stream of ``lanes`` lanes named by ``key``, such as (seed, chunk, pass)."""
        # Hashed per lane: PCG32 started from consecutive numbers is a lattice over the lanes.
        # Opaque, so that the key is data of the kernel and not part of its code.
        seed = key_seed(*key)
        low, high = (dr.opaque(mi.UInt32, half) for half in (seed & 0xFFFFFFFF, seed >> 32))
        lane = dr.arange(mi.UInt32, lanes)
        state = mi.sample_tea_64(lane, low, TEA_ROUNDS)
        sequence = mi.sample_tea_64(lane, high, TEA_ROUNDS)
        return Stream(mi.PCG32(initstate=state, initseq=sequence))

    def next_1d(self) -> mi.Float:
        """One number per lane."""
        return self.rng.next_float32()

    def next_2d(self) -> mi.Point2f:
        """Two numbers per lane."""
        x = self.rng.next_float32()
        return mi.Point2f(x, self.rng.next_float32())
