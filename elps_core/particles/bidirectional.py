"""Bidirectional particles: whole paths hand out a photon and an importon at every vertex [thesis 5.2.2].

A path of k segments, z_0 on the light and z_k on the sensor, is made by one of k + 2 strategies: s
vertices from the light, t = k + 1 - s from the sensor. Let a photon lie at z_i, so that f_L is the flux
that z_0 .. z_i carries. It is weighted by

    n w f_L / (p_st q_i),    q_i = chance of a length of at least i,

p_st the density of z_0 .. z_i under the strategy, given the rest z_(i+1) .. z_k. Importons mirror this.

Which strategies share a photon (n of them, with weights w by the power heuristic)? Those that leave the rest
of the path to the sensor's walk, s <= i + 1: given that rest, all make the same photon, so n = i + 2
and w = p_st^2 / sum p^2. Where the walk ends at z_i and nothing joins it to the sensor's, the others'
densities are 0, and what is left is the classical photon. For s > i + 1 the rest belongs to the
light's own walk, which scatters it otherwise than the sensor's would: these photons are classical, n w = 1.

The thesis takes all k + 2 strategies into one sum, with the rest as the path at hand has it. That sum is 1
for no fixed rest, because the strategies do not draw it alike: already of k = 2, i = 1, where the rest is
the sensor itself, the walk (3, 0) misses a pinhole and counts 1/2, the other three
(1 + b) / (2 + b) with b > 0 wherever z_1 is seen, and together they count more than 1.
"""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.particles.joining import Branch, Joined, PathJoiner
from elps_core.particles.records import IMPORTON, PHOTON, ParticleBuffer, Particles, Worth, everywhere
from elps_core.particles.subpaths import Reached, Step, StepStore
from elps_core.paths.stream import Stream
from elps_core.sampling.start import StartDensity
from elps_core.scene.sensors import Camera
from elps_core.scene.spectrum import luminance

MAX_PARTICLES = 1 << 21
"""Room for the particles of one batch: long paths get fewer lanes."""


def chances(longest: int) -> NDArray[np.float64]:
    """p_k = 2^-k, the chance of a path of k segments, by k from 0 to ``longest`` [thesis 5.2.2].

    The longest gets what is left, so that q_i = 2^-(i - 1) for all i that there are; there is no path of length 0.
    """
    p: NDArray[np.float64] = np.exp2(-np.arange(longest + 1.0))
    p[0] = 0.0
    p[longest] *= 2.0
    return p


class Harvest:
    """Takes particles from paths, whose lengths come with the chances ``p``; ``first_hits`` as for the samplers."""

    def __init__(self, p: NDArray[np.float64], *, first_hits: bool) -> None:
        self.longest = len(p) - 1
        self.first_hits = first_hits
        at_least = np.cumsum(p[::-1])[::-1]
        self._inv_q = on_device(mi.Float, 1.0 / at_least)

    def capacity(self, lanes: int) -> int:
        """Particles at most, in each of a buffer's two ports, of one path for each of ``lanes`` lanes."""
        return lanes * self.longest

    def take(
        self,
        joined: Joined,
        stores: tuple[StepStore, StepStore],
        row: mi.UInt32,
        scale: mi.Float,
        buffer: ParticleBuffer,
    ) -> None:
        """Put the particles of every path into ``buffer``, their weights times ``scale``; none where it is 0.

        ``stores`` and ``row`` are those that :meth:`PathJoiner.join` was given, evaluated; ``buffer`` has two ports.
        """
        self._side(joined, joined.light, stores[0], row, scale, buffer, PHOTON)
        dr.eval(buffer.state)
        self._side(joined, joined.eye, stores[1], row, scale, buffer, IMPORTON)
        dr.eval(buffer.state)

    def _side(
        self,
        path: Joined,
        branch: Branch,
        store: StepStore,
        row: mi.UInt32,
        scale: mi.Float,
        buffer: ParticleBuffer,
        kind: int,
    ) -> None:
        """Walk one side from its end back to its beginning.

        ``kind`` is what this side's own walk brings; the other kind comes from across. Vertices count
        from the beginning: 0 is the light vertex on the light side; the sensor holds no particles.
        """
        lanes = dr.width(row)
        lowest = 0 if kind == PHOTON else 1
        wavelengths = path.wavelengths
        zero, one = dr.zeros(mi.Float, lanes), dr.ones(mi.Float, lanes)
        nothing = Step(
            p=dr.zeros(mi.Point3f, lanes),
            n=dr.zeros(mi.Normal3f, lanes),
            back=mi.Vector3f(-branch.toward),
            beta=dr.full(mi.UnpolarizedSpectrum, 1.0, lanes),
            reached=Reached(dr.copy(one), dr.copy(one), dr.copy(one), dr.copy(zero)),
            holds=dr.zeros(mi.Bool, lanes),
        )

        def body(
            left: mi.UInt32, after: Step, rev: mi.Float, product: mi.Float, total: mi.Float
        ) -> tuple[mi.UInt32, Step, mi.Float, mi.Float, mi.Float]:
            number = left - (1 - lowest)  # Of the vertex
            at_origin = number == 0
            step = store.read(number - 1, row, ~at_origin)
            if kind == PHOTON:
                step.p = dr.select(at_origin, path.origin.p, step.p)
                step.n = dr.select(at_origin, path.origin.n, step.n)
                step.reached.inv_pdf = dr.select(at_origin, path.origin.inv_pdf, step.reached.inv_pdf)
                step.holds = dr.select(at_origin, path.origin.holds, step.holds)
            from_smooth = at_origin | step.reached.smooth
            is_end = number + 1 == branch.vertices
            to_smooth = is_end | after.reached.smooth

            # From its own side: the end shares with the strategies of fewer vertices.
            brought = step.beta * path.emitted if kind == PHOTON else step.beta
            shared = dr.select(is_end, mi.Float(number + 2) / (1.0 + branch.fewer), 1.0)
            own = luminance(brought, wavelengths) * shared
            self._add(step, number, own * scale, step.back, kind, ~at_origin, buffer, 0)

            # From across: the strategies with more vertices here have it from the other side already.
            pdf = dr.select(is_end, branch.pdf_end, rev * after.reached.geometry)
            product = product * dr.square(pdf * step.reached.inv_pdf)
            total = total + dr.select(from_smooth & to_smooth, product, 0.0)
            passed = luminance(_divided(branch.carried, after.beta), wavelengths) * after.reached.spread
            across = dr.select(is_end, branch.arriving, passed) * step.reached.inv_pdf
            depth = path.length - number
            across = across * mi.Float(depth + 2) / total
            valid = path.joined & from_smooth & to_smooth & (depth >= 1)
            self._add(step, depth, across * scale, -after.back, 1 - kind, valid, buffer, 1)

            rev = dr.select(is_end, branch.pdf_next, after.reached.pdf_rev)
            return left - 1, step, rev, product, total

        # Vertices that are left, counted so that 0 is none.
        left = branch.steps + (1 - lowest)
        if kind == PHOTON:
            # A light walk that was to be longer has no particle at its first vertex.
            left = dr.select((branch.steps == 0) & (branch.vertices != 1), 0, left)
        left = dr.select(scale > 0.0, left, 0)
        dr.while_loop(
            (left, nothing, dr.copy(zero), dr.copy(one), 1.0 + branch.more + zero),
            lambda left, *_: left > 0,
            body,
            label=f"elps harvest {kind}",
        )

    def _add(
        self,
        step: Step,
        depth: mi.UInt32,
        weight: mi.Float,
        direction: mi.Vector3f,
        kind: int,
        active: mi.Bool,
        buffer: ParticleBuffer,
        port: int,
    ) -> None:
        active = active & step.holds
        if kind == IMPORTON and not self.first_hits:
            active = active & (depth >= 2)
        weight = weight * dr.gather(mi.Float, self._inv_q, dr.minimum(depth, self.longest), active)
        buffer.add(step.p, step.n, direction, weight, depth, kind, active, port=port)


class BidirectionalSampler:
    """Particles from ``paths`` independent paths.

    Arguments as those of :class:`elps_core.particles.classical.ClassicalSampler`; ``max_depth`` is the
    greatest number of segments of a path.
    """

    def __init__(
        self,
        scene: mi.Scene,
        camera: Camera,
        lights: StartDensity,
        *,
        max_depth: int,
        paths: int,
        first_hits: bool = False,
        worth: Worth = everywhere,
    ) -> None:
        self.paths = paths
        self._p = chances(max_depth)
        self._joiner = PathJoiner(scene, camera, lights, max_depth=max_depth, worth=worth)
        self._harvest = Harvest(self._p, first_hits=first_hits)
        lanes = max(1, min(paths, MAX_PARTICLES // (2 * max_depth)))
        self._batches = -(-paths // lanes)

    def run(self, key: tuple[int, ...]) -> Iterator[Particles]:
        """Batches of both kinds; see :class:`elps_core.particles.records.ParticleSampler`."""
        edges = on_device(mi.Float, np.cumsum(self._p)[:-1])
        for batch in range(self._batches):
            lanes = (batch + 1) * self.paths // self._batches - batch * self.paths // self._batches
            lengths, eye, light = (Stream.of(lanes, *key, batch, part) for part in range(3))
            u = lengths.next_1d()
            length = dr.binary_search(0, len(self._p) - 1, lambda i, u=u: dr.gather(mi.Float, edges, i) <= u)
            row = dr.arange(mi.UInt32, lanes)
            stores = (StepStore(lanes, self._joiner.max_depth), StepStore(lanes, self._joiner.max_depth))
            joined = self._joiner.join((eye, light), length, stores, row)
            dr.eval(joined, *(store.data for store in stores))
            buffer = ParticleBuffer(self._harvest.capacity(lanes), ports=2)
            self._harvest.take(joined, stores, row, dr.full(mi.Float, 1.0 / self.paths, lanes), buffer)
            yield buffer.take()


def _divided(value: mi.UnpolarizedSpectrum, by: mi.UnpolarizedSpectrum) -> mi.UnpolarizedSpectrum:
    """By channel. One that this side's walk has lost, on a surface without any red, tells nothing of the rest: 0."""
    return dr.select(by > 0.0, value / by, 0.0)
