"""One strategy at a time: the strategy is a coordinate of the state [Hachisuka, Kaplanyan and Dachsbacher 2014].

A state is one path of a fixed length k, made by one strategy (s, t), s + t = k + 1: a light walk to its
last vertex, an eye walk to its last vertex, one connection with its full weight over the chance of the
strategy. Nothing is stored on the way.

A coordinate that takes few values is better enumerated than drawn: most strategies of most paths have
next to no light, and a large step that falls on one is lost. So each strategy of the shorter paths has
chains of its own, as many as it has light. Lanes lie in this order, and neighbours walk alike.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from elps_core.arrays import on_device
from elps_core.integrators.bdpt import Bdpt, Splat
from elps_core.paths.mis import Side
from elps_core.paths.primary import PrimaryStream
from elps_core.paths.vertex import Vertex
from elps_core.paths.walk import Walk, random_walk
from elps_core.sampling.lights import NOWHERE

SHORTEST = 2
"""Segments of the shortest path: light that the sensor sees directly is not a matter of chains."""
APART = 16
"""Segments of the longest path whose strategies have chains of their own. 150 groups up to there: with those
of longer paths, whose strategies are drawn, there are never more than 400."""
START_NUMBERS = 6
"""Numbers before the light walk: point on an emitter, first direction."""


def head_numbers(bdpt: Bdpt) -> int:
    """Numbers before the eye walk: film position, wavelength, aperture."""
    return 2 + (1 if mi.is_spectral else 0) + (2 if bdpt.camera.has_aperture else 0)


def step_numbers(bdpt: Bdpt) -> int:
    """Numbers that a walk takes at a vertex: lobe, direction, roulette."""
    return 3 if bdpt.roulette.kind == "none" else 4


@dataclass
class _End:
    """The end of a subpath."""

    walk: Walk  # Its last segment; not active where the subpath has ended before
    vertex: Vertex
    solid: mi.Bool  # Whether it ends on a surface


class Multiplexed:
    """Paths of 2 to ``max_depth`` segments; a group is a length and a range of strategies."""

    def __init__(self, bdpt: Bdpt) -> None:
        self.bdpt = bdpt
        emission = bdpt.lights.emission
        # No ray meets a point light; none meets a pinhole.
        first = 0 if emission.has_surface or emission.has_environment else 1
        ranges = []
        for length in range(SHORTEST, bdpt.max_depth + 1):
            last = length + 1 if bdpt.strategies.aperture else length
            apart = length <= APART
            ranges += [(length, s, 1) for s in range(first, last + 1)] if apart else [(length, first, last + 1 - first)]
        self.groups = len(ranges)
        lengths, least, choices = np.array(ranges, np.uint32).T
        self.dimensions = (
            # The first is the strategy.
            1 + head_numbers(bdpt) + step_numbers(bdpt) * (np.maximum(lengths, least) - least),
            START_NUMBERS + step_numbers(bdpt) * (np.maximum(least + choices, 2) - 2),
        )
        self.splats: tuple[int, ...] = ()
        self._length, self._least, self._choices = (on_device(mi.UInt32, x) for x in (lengths, least, choices))

    def evaluate(
        self,
        streams: tuple[PrimaryStream, PrimaryStream],
        group: mi.UInt32,
        splat: Splat,  # noqa: ARG002 (there is one contribution, and it is returned)
    ) -> tuple[mi.Point2f, mi.Spectrum, mi.Spectrum]:
        """One path per lane: its film position, its contribution over the chance of its strategy, its wavelengths."""
        bdpt, connector = self.bdpt, self.bdpt.connector
        eye_stream, light_stream = streams
        length, least, choices = (
            dr.gather(mi.UInt32, table, group) for table in (self._length, self._least, self._choices)
        )
        s = least + mi.UInt32(eye_stream.next_1d() * mi.Float(choices))
        t = length + 1 - s
        position = eye_stream.next_2d() * mi.Point2f(bdpt.camera.size)
        # With one light vertex, it is where the light path would start that has more; and the aperture
        # point is the same whatever comes after it.
        to_light, to_sensor = dr.copy(light_stream), dr.copy(eye_stream)
        if mi.is_spectral:
            to_sensor.next_1d()
        primary = bdpt.primary(position, eye_stream)
        wavelengths = primary.ray.wavelengths

        start = bdpt.lights.sample(light_stream.next_2d(), light_stream.next_2d(), wavelengths, s >= 2)
        light = self._walk(bdpt.light_start(start, light_stream), s, "light")
        eye = self._walk(bdpt.eye_start(primary, eye_stream), t, "eye")
        at_eye, at_light = _smooth(eye), _smooth(light)

        eye.walk.active = eye.walk.active & (s == 0)
        met, _ = connector.hit_emitter(eye.walk, eye.vertex, mi.UInt32(NOWHERE), eye.solid & (s == 0))
        lit, _ = connector.connect_light(eye.vertex, mi.UInt32(NOWHERE), to_light, at_eye & (s == 1))
        joined = connector.connect_vertices(eye.vertex, light.vertex, at_eye & at_light)
        seen, sample = connector.connect_sensor(light.vertex, to_sensor, at_light & (t == 1))
        value = met + lit + joined + seen * primary.weight
        position = dr.select(t == 1, sample.position, position)
        if bdpt.strategies.aperture:
            seen, sample = connector.hit_aperture(light.walk, light.walk.active & (t == 0))
            value = value + seen * primary.weight
            position = dr.select(t == 0, sample.position, position)
        return position, value * mi.Float(choices), wavelengths

    def _walk(self, start: Walk, vertices: mi.UInt32, side: Side) -> _End:
        """Walk until the subpath has that many vertices; lanes with fewer than two do not start."""
        bdpt = self.bdpt
        lanes = dr.width(vertices)
        start.active = start.active & (vertices >= 2)
        si = dr.zeros(mi.SurfaceInteraction3f, lanes)
        si.wavelengths = start.ray.wavelengths
        vertex = Vertex(si, dr.zeros(mi.Spectrum, lanes), start.partial, dr.zeros(mi.UInt32, lanes))
        nowhere = dr.zeros(mi.Bool, lanes)
        none = _End(replace(start, active=nowhere), vertex, nowhere)

        def visit(walk: Walk, vertex: Vertex, end: _End, active: mi.Bool) -> _End:
            last = walk.active & (walk.depth + 2 == vertices)
            found: _End = dr.select(last, _End(walk, vertex, active), end)
            return found

        return random_walk(
            bdpt.lights.emission.rays,
            start,
            visit,
            none,
            side=side,
            max_depth=vertices - 1,
            roulette=bdpt.roulette,
            heuristic=bdpt.heuristic,
            directions=bdpt.directions,
            label=f"elps multiplexed {side} walk",
        )


def _smooth(end: _End) -> mi.Bool:
    """Where a connection is possible."""
    return end.solid & mi.has_flag(end.vertex.si.bsdf().flags(), mi.BSDFFlags.Smooth)
