"""Classical particles: photons from walks that start at the lights, importons from walks that start at the sensor.

Every vertex of a walk gives one particle, with the weight that the walk has when it arrives [thesis
(5.11), (5.12)]. With roulette by albedo from the first vertex on the weights of one kind are almost
constant, so that their density tells radiance and importance [thesis (5.13)].
"""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi

from elps_core.integrators.bdpt import Bdpt
from elps_core.particles.records import IMPORTON, PHOTON, ParticleBuffer, Particles, Worth, everywhere
from elps_core.paths.roulette import RouletteRule
from elps_core.paths.stream import Stream
from elps_core.paths.vertex import Vertex
from elps_core.paths.walk import Walk, random_walk
from elps_core.sampling.start import StartDensity
from elps_core.scene.sensors import Camera
from elps_core.scene.spectrum import luminance, sample_wavelengths

ROULETTE = RouletteRule("albedo", 1)
MAX_PARTICLES = 1 << 22
"""Room for the particles of one batch, 200 MB where all are used: deep walks get fewer lanes."""


class ClassicalSampler:
    """Particles from ``paths`` light walks and as many eye walks.

    Particles lie on surfaces that scatter into more than single directions: others have no use for them.

    Args:
        scene: what is walked in.
        camera: where importance comes from.
        lights: the density of light vertices.
        max_depth: greatest number of segments of a walk.
        paths: walks of each kind in a run.
        first_hits: keep the importons that the sensor sees directly; connecting light vertices to the
            sensor covers that already.
        roulette: when walks end early.
        worth: what importance counts by where on the film it comes from.
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
        roulette: RouletteRule = ROULETTE,
        worth: Worth = everywhere,
    ) -> None:
        self.paths = paths
        self.first_hits = first_hits
        self._worth = worth
        self._walks = Bdpt(scene, camera, lights, max_depth=max_depth, roulette=roulette)
        lanes = max(1, min(paths, MAX_PARTICLES // max_depth))
        self._batches = -(-paths // lanes)

    def run(self, key: tuple[int, ...]) -> Iterator[Particles]:
        """Batches of photons and of importons in turn; see :class:`elps_core.particles.records.ParticleSampler`."""
        for batch in range(self._batches):
            lanes = (batch + 1) * self.paths // self._batches - batch * self.paths // self._batches
            yield self._photons(Stream.of(lanes, *key, batch, PHOTON), lanes)
            yield self._importons(Stream.of(lanes, *key, batch, IMPORTON), lanes)

    def _photons(self, stream: Stream, lanes: int) -> Particles:
        walks = self._walks
        wavelengths, scale = sample_wavelengths(stream.next_1d() if mi.is_spectral else mi.Float(0.5))
        start = walks.lights.sample(stream.next_2d(), stream.next_2d(), wavelengths, dr.full(mi.Bool, True, lanes))
        return self._walk(walks.light_start(start, stream), scale, lanes, PHOTON)

    def _importons(self, stream: Stream, lanes: int) -> Particles:
        walks = self._walks
        position = stream.next_2d() * mi.Point2f(walks.camera.size)
        start = walks.eye_start(walks.primary(position, stream), stream)
        return self._walk(start, mi.UnpolarizedSpectrum(self._worth(position)), lanes, IMPORTON)

    def _walk(self, start: Walk, scale: mi.UnpolarizedSpectrum, lanes: int, kind: int) -> Particles:
        """One particle for each vertex; ``scale`` turns what a walk carries into what counts."""
        walks = self._walks
        buffer = ParticleBuffer(lanes * walks.max_depth)
        wavelengths = start.ray.wavelengths
        share = dr.opaque(mi.Float, 1.0 / self.paths)
        first = 1 if kind == PHOTON or self.first_hits else 2

        def visit(_: Walk, vertex: Vertex, none: mi.Bool, active: mi.Bool) -> mi.Bool:
            smooth = active & walks.connector.surfaces.flags.smooth(vertex.si)
            weight = luminance(mi.UnpolarizedSpectrum(vertex.beta) * scale, wavelengths) * share
            buffer.record(vertex.si, weight, vertex.depth, kind, smooth & (vertex.depth >= first))
            return none

        random_walk(
            walks.lights.emission.rays,
            start,
            visit,
            dr.zeros(mi.Bool, lanes),
            side="light" if kind == PHOTON else "eye",
            max_depth=walks.max_depth,
            roulette=walks.roulette,
            heuristic=walks.heuristic,
            directions=walks.directions,
            label=f"elps {'photons' if kind == PHOTON else 'importons'}",
        )
        dr.eval(buffer.state)
        return buffer.take()
