"""Which of many paths a lane takes after another.

Lanes run in packets that would wait for the longest path of each. So there are more paths than lanes, and a lane
begins its next path as soon as one has ended.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


class Turns:
    """Shares ``paths`` out among ``lanes``, no more than there are: lane l takes path l, l + lanes, l + 2 lanes ..."""

    def __init__(self, paths: int, lanes: int) -> None:
        # Data of the kernel, and not part of its code.
        self.paths, self._lanes = dr.opaque(mi.UInt32, paths), dr.opaque(mi.UInt32, lanes)
        self.first = dr.arange(mi.UInt32, lanes)
        """The path that each lane begins with."""

    def after(self, path: mi.UInt32, ended: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
        """The path that follows in lanes that have ``ended`` one, and which of them have one."""
        following = path + self._lanes
        return following, ended & (following < self.paths)

    def left(self, path: mi.UInt32) -> mi.Bool:
        """Which lanes have a path to finish, as :meth:`after` counts."""
        return path < self.paths
