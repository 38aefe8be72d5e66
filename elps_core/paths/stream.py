"""Where a walk takes its random numbers from."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

SEQUENCE = 0x9E3779B97F4A7C15
"""Sets the sequence constants apart from the states (the golden ratio, in 64 bits)."""


def key_seed(*key: int) -> int:
    """64 bits that name a random stream, such as (seed, chunk, pass)."""
    text = ":".join(str(part) for part in key).encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "little")


@dataclass
class Stream:
    """Independent uniform numbers in [0, 1), one PCG32 sequence per lane.

    Lanes of one stream have different sequence constants, streams of different keys different
    states: no two (key, lane) pairs share a sequence but by a 2^-64 accident.
    """

    rng: mi.PCG32

    @staticmethod
    def of(lanes: int, *key: int) -> Stream:
        """A stream of ``lanes`` lanes named by ``key``, such as (seed, chunk, pass)."""
        state = key_seed(*key)
        # Opaque, so that the key is data of the kernel and not part of its code.
        start = dr.opaque(mi.UInt64, state)
        return Stream(mi.PCG32(size=lanes, initstate=start, initseq=start ^ SEQUENCE))

    def next_1d(self) -> mi.Float:
        """One number per lane."""
        return self.rng.next_float32()

    def next_2d(self) -> mi.Point2f:
        """Two numbers per lane."""
        x = self.rng.next_float32()
        return mi.Point2f(x, self.rng.next_float32())
