"""The first direction of light paths: as lamps emit, or to where the sensor asks for light [thesis 5.3.1].

For each piece of the emitters a table tells into which directions the light leaves that reaches the image. It is mixed
with the emission's own density [thesis (5.17)], and counts what leaves together with what arrives, which the thesis
wished for and had to do without. Lamps without extent and those at infinity keep to their own density.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import drjit as dr
import mitsuba as mi

from elps_core.context.encoding import DirectionalTables
from elps_core.context.field import DirectionalField
from elps_core.errors import ContextMismatch

PieceOf: TypeAlias = "Callable[[mi.UInt32, mi.Bool], mi.UInt32]"
"""From a cell of the start density to the piece that holds it."""
SHARE = 0.75
"""Chance of a direction from the table, where a piece has one."""
ENOUGH = 64
"""Records that a piece's table rests on, at least."""


class Departures:
    """Densities of directions from the pieces of all emitters' unit square."""

    def __init__(self, tables: DirectionalTables, pieces: int, piece_of: PieceOf) -> None:
        """``pieces`` is their number, ``piece_of`` tells which one holds a cell of the square.

        Raises:
            ContextMismatch: there are not as many tables.
        """
        if tables.shape[0] != pieces:
            raise ContextMismatch("the context belongs to a scene with other lights: build it again for this scene")
        self._field = DirectionalField(None, tables)
        self._piece_of = piece_of
        self._share = dr.opaque(mi.Float, SHARE)

    def choose(self, cell: mi.UInt32, u: mi.Point2f, active: mi.Bool) -> tuple[mi.Bool, mi.Vector3f, mi.Point2f]:
        """Whether a direction is drawn by the table, that direction (world space), and what is left of ``u`` if not."""
        piece, share = self._piece(cell, active)
        by_table = active & (u.x < share)
        left = dr.select(by_table, u.x / share, (u.x - share) / (1.0 - share))
        u = mi.Point2f(dr.clip(left, 0.0, mi.Float(dr.one_minus_epsilon(mi.Float))), u.y)
        direction, _ = self._field.sample(piece, u, by_table)
        return by_table, direction, u

    def mixed(self, pdf: mi.Float, cell: mi.UInt32, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """The density of the mixture in ``direction`` (world space), per solid angle, ``pdf`` that of the emission."""
        piece, share = self._piece(cell, active)
        by_table = self._field.pdf(piece, direction, active & (share > 0.0))
        return dr.lerp(pdf, by_table, share)

    def _piece(self, cell: mi.UInt32, active: mi.Bool) -> tuple[mi.UInt32, mi.Float]:
        piece = self._piece_of(cell, active)
        known = active & (self._field.evidence(piece, active) >= ENOUGH)
        return piece, dr.select(known, self._share, 0.0)
