"""Metropolis light transport in primary sample space: frames from chains [Kelemen et al. 2002; thesis 4.7.4].

A state is all strategies of a pair of paths, or of an eye path alone (:class:`Samples`), or one strategy of a
path of fixed length (:mod:`elps_core.integrators.multiplexed`). Light that the sensor sees directly is outside
the chains, where they would spend themselves on what a few plain samples show.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from elps_core.integrators.bdpt import Bdpt, Splat
from elps_core.integrators.chains import PixelWeight, Target, alike
from elps_core.integrators.frame import LANES, Frame, FrameRenderer
from elps_core.integrators.leftout import FiniteTarget, LeftOut
from elps_core.integrators.metropolis import Metropolis
from elps_core.integrators.multiplexed import SHORTEST, START_NUMBERS, Multiplexed, head_numbers, step_numbers
from elps_core.paths import strategies
from elps_core.paths.primary import PrimaryStream
from elps_core.settings import PssmltSettings

NEXT_EVENT_NUMBERS = 4
"""Numbers for a point on an emitter, at each eye vertex."""
FEWER = 4
"""Times as few lanes as in other passes: there are not as many chains as these have samples, and the last path of each
lane keeps others waiting."""
DIRECT_SHARE = 4
"""Mutations for one plain sample of what the sensor sees directly: there is no noise in it but at edges."""


class Samples:
    """States that are whole samples: one eye path, and with it one light path and all connections, if there are any."""

    def __init__(self, bdpt: Bdpt) -> None:
        self.bdpt = bdpt.selecting(replace(bdpt.strategies, direct=False))
        self.groups = 1
        aperture = 2 if bdpt.camera.has_aperture else 0
        step = step_numbers(bdpt)
        eye = head_numbers(bdpt) + bdpt.max_depth * (NEXT_EVENT_NUMBERS + step)
        light_depth = bdpt.max_depth if bdpt.strategies.aperture else bdpt.max_depth - 1
        light = START_NUMBERS + light_depth * (aperture + step) if bdpt.strategies.light_paths else 1
        self.dimensions = (np.array([eye], np.uint32), np.array([light], np.uint32))
        self.splats: tuple[int, ...] = (bdpt.max_depth,) * (bdpt.strategies.sensor + bdpt.strategies.aperture)

    def evaluate(
        self,
        streams: tuple[PrimaryStream, PrimaryStream],
        group: mi.UInt32,  # noqa: ARG002 (there is one)
        splat: Splat,
    ) -> tuple[mi.Point2f, mi.Spectrum, mi.Spectrum]:
        """The eye path's film position, radiance and wavelengths; what the light path shows is splatted."""
        eye, light = streams
        position = eye.next_2d() * mi.Point2f(self.bdpt.camera.size)
        eye, light = eye.begin(eye.next_1d() if mi.is_spectral else None), light.begin()
        turns = max(1, dr.width(position) // (LANES[dr.backend_v(mi.Float)] // FEWER))
        radiance, wavelengths = self.bdpt.trace(position, (eye, light), splat, turns=turns)
        return position, radiance, wavelengths


class MetropolisFrames:
    """Renders frames of one film by Metropolis light transport."""

    def __init__(self, bdpt: Bdpt, film: mi.Film, settings: PssmltSettings, weight: PixelWeight = alike) -> None:
        emission = bdpt.lights.emission
        self.statistics: dict[str, float] = {}
        """What the last render says of its chains: see :meth:`Metropolis.run`."""
        self._direct = FrameRenderer(bdpt.selecting(strategies.path(next_event=False), max_depth=1), film)
        self._visible = emission.has_surface or emission.has_environment
        self._chains: Metropolis | None = None
        self._left_out = LeftOut(self._direct.canvas.size)
        if bdpt.max_depth >= SHORTEST:
            target: Target = Multiplexed(bdpt) if settings.multiplexed else Samples(bdpt)
            self._chains = Metropolis(FiniteTarget(target, self._left_out), settings, weight)

    def render(self, spp: int, key: tuple[int, ...]) -> Frame:
        """``spp`` mutations per pixel by a set of chains of its own, named by ``key``."""
        canvas = self._direct.canvas
        image, weight = dr.zeros(mi.TensorXf, (*canvas.shape, 3)), mi.TensorXf(canvas.coverage(), canvas.shape)
        filtered: mi.TensorXf | None = None
        self._left_out.begin()
        left_out = self._left_out.counts
        if self._visible:
            samples = -(-spp // DIRECT_SHARE)
            seen = self._direct.render(samples, (*key, 0))
            # Frames are merged as those of eye paths: by weights that do not depend on what the chains find.
            image, weight, filtered = seen.image, seen.weight / samples, seen.filtered
            left_out = seen.left_out
        if self._chains:
            block = canvas.block(4)

            def put(where: mi.Point2f, rgb: mi.Color3f, active: mi.Bool) -> None:
                # Four channels travel as one packet, three would not.
                block.put(where, [*rgb, mi.Float(0.0)], active)
                dr.eval(block.tensor())

            self.statistics = self._chains.run(canvas.pixels * spp, (*key, 1), put)
            # What the chains put adds up to the film's mean, and not to a sum over pixels.
            shown = canvas.spread(block, 1.0 / canvas.pixels, 3, None if filtered is None else filtered.array)
            image = image + mi.TensorXf(shown, (*canvas.shape, 3))
            left_out = left_out + self._left_out.counts
        return Frame(image, weight * float(spp), left_out, self.statistics, filtered)
