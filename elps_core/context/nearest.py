"""The nearest of many centres for each of many points, exactly, by the distance of [thesis (5.16)].

Points are ordered along a space-filling curve and enclosed in balls, 16 points to a ball, 16 balls to
a larger one and so on. From the largest balls down, each ball keeps those of its parent's centres
that can be nearest to something in it, so that a point is left with a few dozen to try.

For unit normals ``1 - n . n_c`` is ``|n - n_c|^2 / 2``. The second form makes a ball of normals as good
as a ball of positions; and with normals of length zero, as the volume will need, only positions count.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.context.regions import Floats

FANOUT = 16
"""Members of a ball: the lanes of a vector register, which then read the same centres. Half as many or
twice as many took longer."""
COARSEST = 128
"""Balls of the coarsest level, at most: fewer would keep nearly all centres."""
CURVE_BITS = 10
"""Steps of the curve along each of its six coordinates, as a power of two: all that 64 bits can hold."""
ROUNDING = 4e-6
"""Share of the largest possible distance by which float32 may misjudge a bound."""
MAX_CANDIDATES = 1 << 26
"""Candidates that the balls of one level may keep together (256 MiB). Where they would keep more, as with
normals that point everywhere, they share the lists of their parents: slower, and as exact."""


@dataclass
class _Centre:
    position: mi.Point3f
    normal: mi.Vector3f


@dataclass
class _Balls:
    """Balls around sets of points, or points where the radii are zero."""

    middle: mi.Point3f
    radius: mi.Float
    normal: mi.Vector3f  # Middle of the members' normals, shorter than they are
    spread: mi.Float  # Largest distance of a member's normal from it

    def distance(self, centre: _Centre, alpha: mi.Float) -> mi.Float:
        """From the ball's middle to a centre."""
        return dr.fma(alpha, dr.norm(self.middle - centre.position), 0.5 * dr.squared_norm(self.normal - centre.normal))

    def margin(self, this: _Centre, other: _Centre, alpha: mi.Float) -> mi.Float:
        """By how much every member is nearer to ``this`` centre than to the ``other``, at least.

        Over the ball ``|x - c'| - |x - c|`` changes at most by the difference of the unit vectors from x
        to both centres, per unit of length, and that is at most ``2 |c - c'| / (|x - c| + |x - c'|)``:
        little for centres that are far away. The normals' part is linear in the normal.
        """
        near, far = dr.norm(self.middle - this.position), dr.norm(self.middle - other.position)
        apart = dr.norm(this.position - other.position)
        change = dr.minimum(2.0, 2.0 * apart / (near + far - 2.0 * self.radius))
        change = dr.select(near + far > 2.0 * self.radius, change, 2.0)
        turn = dr.squared_norm(self.normal - other.normal) - dr.squared_norm(self.normal - this.normal)
        return alpha * (far - near - self.radius * change) + (
            0.5 * turn - self.spread * dr.norm(this.normal - other.normal)
        )


@dataclass
class _Candidates:
    """Lists of centres, and which of the lists each ball of a level reads."""

    start: mi.UInt32  # [lists + 1]
    index: mi.UInt32  # [start[-1]], rising within each list
    lists: mi.UInt32  # [balls]


@dataclass
class _Centres:
    positions: mi.Float  # Four floats a centre, the last unused: one packet a read
    normals: mi.Float
    alpha: mi.Float
    rounding: mi.Float

    def at(self, index: mi.UInt32) -> _Centre:
        position = dr.gather(mi.Vector4f, self.positions, index)
        normal = dr.gather(mi.Vector4f, self.normals, index)
        return _Centre(mi.Point3f(position.x, position.y, position.z), mi.Vector3f(normal.x, normal.y, normal.z))


class PointSet:
    """Points that ask, as often as centres move, which centre is nearest.

    ``position`` [n, 3] and ``normal`` [n, 3] are finite; ``alpha`` weighs positions against normals.
    """

    def __init__(self, position: Floats, normal: Floats, alpha: float) -> None:
        self.alpha = alpha
        self.order = _along_curve(position, normal, alpha)
        """Number, as given, of each point in the order in which :attr:`position` and the answers are."""
        self.position = np.ascontiguousarray(position[self.order])
        self.normal = np.ascontiguousarray(normal[self.order])
        # Bounds are sums and differences of distances, so float32 must not spend its digits on an
        # origin that lies far away.
        self._origin = (self.position.min(axis=0) + self.position.max(axis=0)) / 2
        middle = self.position - self._origin
        self._reach = float(np.abs(middle).max())
        self._levels = [_points(middle, self.normal)]
        while dr.width(self._levels[0].radius) > COARSEST or len(self._levels) == 1:
            self._levels.insert(0, _enclosed(self._levels[0]))

    def facing(self, normal: Floats) -> PointSet:
        """The same positions in the same order, all with one ``normal`` [3]."""
        other = copy(self)
        other.normal = np.broadcast_to(normal.astype(np.float32), self.normal.shape)
        axis = mi.Vector3f(*normal.tolist())
        dr.make_opaque(axis)
        other._levels = [
            _Balls(level.middle, level.radius, axis, dr.zeros(mi.Float, dr.width(level.radius)))
            for level in self._levels
        ]
        return other

    def nearest(self, centres: Floats, normals: Floats) -> tuple[NDArray[np.uint32], Floats]:
        """Index of the nearest centre and distance to it for each point; of equals the first counts.

        The distance is that of (5.16); indices are the same on every run.
        """
        data = self._centres(centres, normals)
        root = dr.zeros(mi.UInt32, dr.width(self._levels[0].radius))
        candidates = _Candidates(on_device(mi.UInt32, [0, len(centres)]), dr.arange(mi.UInt32, len(centres)), root)
        dr.eval(candidates.index)
        for balls, members in pairwise(self._levels):
            candidates = _narrowed(balls, data, candidates)
            parent = dr.arange(mi.UInt32, dr.width(members.radius)) // FANOUT
            candidates.lists = dr.gather(mi.UInt32, candidates.lists, parent)
        distance, index = _closest(self._levels[-1], data, candidates)
        return np.array(index), np.array(distance)

    def distance(self, centres: Floats, normals: Floats, index: NDArray[np.uint32]) -> Floats:
        """Distance (5.16) of each point to the centre that ``index`` [n] names for it."""
        data, points = self._centres(centres, normals), self._levels[-1]
        return np.array(points.distance(data.at(on_device(mi.UInt32, index)), data.alpha))

    def _centres(self, centres: Floats, normals: Floats) -> _Centres:
        positions = centres - self._origin
        reach = 2.0 * self.alpha * max(self._reach, float(np.abs(positions).max())) + 2.0
        padded = (np.pad(part, ((0, 0), (0, 1))).ravel() for part in (positions, normals))
        # Opaque, so that the numbers are data of the kernels and not part of their code.
        numbers = (dr.opaque(mi.Float, number) for number in (self.alpha, ROUNDING * reach))
        return _Centres(*(on_device(mi.Float, part) for part in padded), *numbers)


def _closest(balls: _Balls, centres: _Centres, candidates: _Candidates) -> tuple[mi.Float, mi.UInt32]:
    """The candidate nearest to the middle of each ball."""
    k, end = _range(candidates)

    def body(k: mi.UInt32, least: mi.Float, nearest: mi.UInt32) -> tuple[mi.UInt32, mi.Float, mi.UInt32]:
        index = dr.gather(mi.UInt32, candidates.index, k)
        distance = balls.distance(centres.at(index), centres.alpha)
        nearer = distance < least
        return k + 1, dr.select(nearer, distance, least), dr.select(nearer, index, nearest)

    state = (k, dr.full(mi.Float, dr.inf, dr.width(k)), dr.zeros(mi.UInt32, dr.width(k)))
    _, least, nearest = dr.while_loop(state, lambda k, *_: k < end, body, label="closest centre")
    dr.eval(least, nearest)
    return least, nearest


def _narrowed(balls: _Balls, centres: _Centres, candidates: _Candidates) -> _Candidates:
    """The candidates that can be nearest to some member of their ball."""
    k, end = _range(candidates)
    nearest = centres.at(_closest(balls, centres, candidates)[1])

    def count(k: mi.UInt32, kept: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        other = centres.at(dr.gather(mi.UInt32, candidates.index, k))
        keep = balls.margin(nearest, other, centres.alpha) <= centres.rounding
        return k + 1, kept + dr.select(keep, mi.UInt32(1), mi.UInt32(0))

    state = (k, dr.zeros(mi.UInt32, dr.width(k)))
    _, kept = dr.while_loop(state, lambda k, *_: k < end, count, label="count candidates")
    ends = np.cumsum(np.array(kept), dtype=np.int64)
    if ends[-1] > MAX_CANDIDATES:
        return candidates
    start = on_device(mi.UInt32, np.concatenate([[0], ends]))
    result = dr.zeros(mi.UInt32, int(ends[-1]))

    def fill(k: mi.UInt32, place: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        index = dr.gather(mi.UInt32, candidates.index, k)
        keep = balls.margin(nearest, centres.at(index), centres.alpha) <= centres.rounding
        dr.scatter(result, index, place, keep)
        return k + 1, place + dr.select(keep, mi.UInt32(1), mi.UInt32(0))

    own = dr.arange(mi.UInt32, dr.width(k))
    state = (k, dr.gather(mi.UInt32, start, own))
    dr.eval(dr.while_loop(state, lambda k, *_: k < end, fill, label="keep candidates"), result)
    return _Candidates(start, result, own)


def _range(candidates: _Candidates) -> tuple[mi.UInt32, mi.UInt32]:
    first = dr.gather(mi.UInt32, candidates.start, candidates.lists)
    end = dr.gather(mi.UInt32, candidates.start, candidates.lists + 1)
    dr.eval(first, end)
    return first, end


def _along_curve(position: Floats, normal: Floats, alpha: float) -> NDArray[np.int64]:
    """An order in which neighbours in position and normal follow one another (Morton's curve)."""
    # In these six coordinates squared distance weighs a normal as (5.16) does.
    points = np.concatenate([alpha * position, normal / np.float32(np.sqrt(2.0))], axis=1)
    points -= points.min(axis=0)
    extent = float(points.max())
    steps = (points * (((1 << CURVE_BITS) - 1) / extent if extent > 0.0 else 0.0)).astype(np.uint32)
    number = np.arange(1 << CURVE_BITS, dtype=np.uint64)
    spread = np.zeros_like(number)  # Bit b moved to bit 6 b
    for bit in range(CURVE_BITS):
        spread |= (number >> np.uint64(bit) & np.uint64(1)) << np.uint64(6 * bit)
    code = np.zeros(len(points), np.uint64)
    for axis in range(6):
        code |= spread[steps[:, axis]] << np.uint64(axis)
    return np.argsort(code, kind="stable")


def _points(position: Floats, normal: Floats) -> _Balls:
    """Points as balls of no size, around [n, 3] and [n, 3]."""
    columns = [[on_device(mi.Float, column) for column in rows.T] for rows in (position, normal)]
    nothing = dr.zeros(mi.Float, len(position))
    return _Balls(mi.Point3f(*columns[0]), nothing, mi.Vector3f(*columns[1]), nothing)


def _enclosed(balls: _Balls) -> _Balls:
    """A ball around every :data:`FANOUT` balls; the last one is filled up with copies of the last."""
    count = dr.width(balls.radius)
    place = dr.arange(mi.UInt32, -(-count // FANOUT) * FANOUT)
    member, group = dr.minimum(place, dr.opaque(mi.UInt32, count - 1)), place // FANOUT

    def around(middles: Any, radii: mi.Float) -> tuple[Any, mi.Float]:
        kind = type(middles)
        each, radius = dr.gather(kind, middles, member), dr.gather(mi.Float, radii, member)
        dr.eval(each, radius)
        centre = kind(*(0.5 * (_per_ball(dr.ReduceOp.Min, x) + _per_ball(dr.ReduceOp.Max, x)) for x in each))
        dr.eval(centre)
        reach = dr.norm(each - dr.gather(kind, centre, group)) + radius
        return centre, _per_ball(dr.ReduceOp.Max, reach)

    return _Balls(*around(balls.middle, balls.radius), *around(balls.normal, balls.spread))


def _per_ball(operation: dr.ReduceOp, values: mi.Float) -> mi.Float:
    return dr.block_reduce(operation, values, FANOUT)
