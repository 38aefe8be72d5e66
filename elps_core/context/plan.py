"""How the paths of a build are shared out among its steps."""

from __future__ import annotations

from collections.abc import Iterator

FIRST_PATHS, MOST_PATHS = 1 << 15, 1 << 20
"""Paths of the first step of filling; each next one has twice as many, up to the most."""


def filling(paths: int) -> Iterator[int]:
    """Sizes of the steps that fill tables: each twice the one before, bounded, ``paths`` in all."""
    size = FIRST_PATHS
    while paths > 0:
        step = min(size, paths)
        # What would be left as less than a half belongs to this step.
        step = paths if paths - step < step // 2 else step
        yield step
        paths -= step
        size = min(2 * size, MOST_PATHS)
