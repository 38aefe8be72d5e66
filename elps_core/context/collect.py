"""Tables from particles of the classical, bidirectional and Metropolis samplers, as the thesis fills them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from elps_core.context.directional import DirectionalAccumulator
from elps_core.context.gather import sampler
from elps_core.context.lookup import RegionLookup
from elps_core.context.pilot_image import PilotImage
from elps_core.context.saved import TableState
from elps_core.integrators.bdpt import Bdpt
from elps_core.integrators.frame import LANES
from elps_core.particles.records import IMPORTON, PHOTON, Particles
from elps_core.paths import strategies
from elps_core.paths.roulette import RouletteRule
from elps_core.paths.stream import Stream
from elps_core.sampling.context import PixelWorth
from elps_core.sampling.start import StartDensity
from elps_core.scene.sensors import Camera
from elps_core.scene.spectrum import luminance
from elps_core.settings import ContextSettings

PILOT_PATHS = 1 << 19
"""Paths of the pilot image, since particles tell nothing of it."""


def collect(
    scene: mi.Scene,
    camera: Camera,
    settings: ContextSettings,
    lights: StartDensity,
    finder: RegionLookup,
    made: TableState,
    paths: int,
    key: tuple[int, ...],
) -> None:
    """Add particles of both kinds to the sums of ``made``; each half of the step is a batch."""
    if not made.pilot.sums.any():
        plain = Bdpt(
            scene,
            camera,
            lights,
            max_depth=settings.max_depth,
            roulette=RouletteRule("albedo", 5),
            strategies=strategies.path(),
        )
        _trace(made.pilot, plain, key)
    pixels = PixelWorth(made.pilot.image(), made.pilot.noise(), camera.size)

    def worth(position: mi.Point2f) -> mi.Float:
        return pixels(position) / pixels.gain

    for part in range(2):
        particle_sampler = sampler(scene, camera, settings, lights, max(1024, paths // 2), worth=worth)
        for particles in particle_sampler.run((*key, part)):
            for kind, name in ((PHOTON, "photons"), (IMPORTON, "importance")):
                # Light that comes straight from a lamp is the business of light sampling.
                _enter(particles.of(kind), finder, made.sources[name], 2 if kind == PHOTON else 1)
        for name in ("photons", "importance"):
            made.sources[name].close_batch(made.areas)


def _trace(pilot: PilotImage, plain: Bdpt, key: tuple[int, ...]) -> None:
    turns = -(-PILOT_PATHS // LANES[dr.backend_v(mi.Float)])
    streams = (Stream.of(-(-PILOT_PATHS // turns), *key, 2), Stream.of(1, *key, 3))
    place = Stream.of(PILOT_PATHS, *key, 4).next_2d()
    film = place * mi.Point2f(plain.camera.size)
    radiance, wavelengths = plain.trace(film, streams, lambda *_: None, light_scale=None, turns=turns)
    pilot.enter(place, luminance(mi.UnpolarizedSpectrum(radiance), wavelengths))


def _enter(particles: Particles, finder: RegionLookup, table: DirectionalAccumulator, first: int) -> None:
    """Add particles of a depth of ``first`` or more."""
    if not len(particles):
        return
    region, _ = finder.back(particles)
    table.add(region, particles.direction, particles.weight, particles.depth >= first)
    dr.eval(table.state)
