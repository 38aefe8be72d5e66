"""Trials: how efficient a candidate is in a scene, measured on samples that no image will hold."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.context.adjoint import density_of
from elps_core.context.pilot_image import DARK, blurred
from elps_core.context.store import DirectionalParts
from elps_core.integrators.bdpt import Bdpt, Splat
from elps_core.integrators.make import paths_of
from elps_core.paths.nets import Nets
from elps_core.paths.stream import Stream, opaque_key
from elps_core.scene.emission import Emission
from elps_core.scene.sensors import Camera
from elps_core.scene.spectrum import luminance
from elps_core.selection.candidates import Candidate, Trial
from elps_core.settings import ContextSettings, RenderSettings
from elps_core.timing import KernelClock

BLOCK = 1 << 15
"""Samples of a block."""
POINTS = 16
"""Samples of a set, spread evenly as in renders; each pixel has two sets, whose difference tells of noise alone."""
LEAST, MOST, SECONDS = 2, 16, 0.25
"""Blocks of a trial; no more are begun after this time."""
PAIRS = BLOCK // (2 * POINTS)
"""Pixels of a block."""
TURNS = 4
"""Samples of a lane, one after the other, as in renders."""
BLURS = 8
"""Times that the pilot image is blurred once more: pixels where little was found by chance are not to decide."""
SMALLEST = 1e-18
"""What a pixel of a black image counts as: its inverse has a square that is a float."""
STREAM = 0x9170
"""Sets the random numbers of trials apart from those of renders and tables with the same seed."""
RIVALS = 1 << 17
"""Light paths that tell of the variance of eye paths."""
RIVAL = 0xFFFF
"""Keeps their random numbers apart from those of blocks."""
SINGULAR = 0.5
"""Part of a variance above which one pair of sets says nothing of it."""
SUMS = 1 << 10
"""Places that a sum is spread over by the number of the path: threads seldom meet, and the scatter tells its error."""
BEHIND = 4.0
"""Times as efficient as a candidate another one is, where the least blocks have told enough of it, even if it is better
by a standard error."""
SURELY = 2.0
"""Standard errors by which what light paths tell of eye paths is taken to be less: at a door that is ajar by 3 degrees
it was 14 to 660 and is 0 to 6 so, with a bulb in glass 300 to 550 and is 190 to 290."""


@dataclass(frozen=True)
class _Block:
    by_eye: NDArray[np.float64]
    """Variance and mean by eye paths [2, pixels], in parts that add up to them."""
    by_light: NDArray[np.float64]
    """The same by light paths that meet the sensor [2, SUMS]."""


def without_singular(variance: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which parts of a variance count: none that is greater than all others together.

    A variance that one event has decided is not known: the same event, met or not met by chance, would speak for or
    against a candidate. What it has brought counts as not met then, in the mean, too. Light paths tell of what they
    can bring in place of such an event, see :class:`Trial`.
    """
    kept = np.ones(variance.shape, bool)
    left = variance.copy()
    while (most := left.max()) > SINGULAR * left.sum():
        kept[left == most] = False
        left[left == most] = 0.0
    return kept


def at_least(parts: NDArray[np.float64]) -> float:
    """What the mean of independent ``parts`` surely is: a few of them may have decided it."""
    return float(parts.mean() - SURELY * parts.std(ddof=1) / np.sqrt(len(parts)))


def _said(name: str, found: list[_Block], seconds: list[float]) -> Trial:
    """What blocks of a candidate say, whose kernels took so many ``seconds`` each; no rival yet."""
    count = len(found)
    kinds = [np.stack(every, axis=1) for every in ([b.by_eye for b in found], [b.by_light for b in found])]
    parts = np.concatenate(kinds, axis=2)  # [2, blocks, pixels and light paths]
    parts *= without_singular(parts[0])
    both = parts.sum(axis=2)
    # Errors by blocks, and by their parts: a few blocks may come out alike by chance.
    by_block = both.std(axis=1, ddof=1) / np.sqrt(count)
    kinds = np.split(parts, [kinds[0].shape[2]], axis=2)
    by_part = np.sqrt(sum(kind.var(axis=2, ddof=1).mean(axis=1) * kind.shape[2] for kind in kinds) / count)
    (variance, mean), (error, mean_error) = both.mean(axis=1), np.maximum(by_block, by_part)
    return Trial(
        name=name,
        variance=float(variance),
        error=float(error),
        mean=float(mean),
        mean_error=float(mean_error),
        microseconds=1e6 * min(seconds) / BLOCK,  # What else the machine does makes all the others longer
        samples=BLOCK * count,
    )


class TrialRunner:
    """Tries candidates in one scene, each for about a quarter of a second."""

    def __init__(
        self,
        scene: mi.Scene,
        camera: Camera,
        emission: Emission,
        adjoint: NDArray[np.floating[Any]],
        parts: DirectionalParts,
        settings: ContextSettings,
    ) -> None:
        """``adjoint`` [rows, columns] and ``parts`` are what the context knows so far."""
        self._scene, self._camera, self._parts = scene, camera, parts
        self._emission, self._adjoint = emission, adjoint
        self._settings = RenderSettings(integrator="bdpt", max_depth=settings.max_depth, context=settings)
        pilot = np.asarray(parts.pilot, np.float64)
        for _ in range(BLURS):
            pilot = blurred(pilot)
        # Fixed before any of the samples: a mean of the samples themselves would hide their outliers.
        floored = np.sqrt(np.square(pilot) + (DARK * pilot.mean()) ** 2)
        self._inverse = on_device(mi.Float, 1.0 / np.maximum(floored, SMALLEST))
        height, width = pilot.shape
        self._width = dr.opaque(mi.UInt32, width)
        self._last = dr.opaque(mi.Point2u, [width - 1, height - 1])
        self._scale = dr.opaque(mi.Point2f, [width / int(camera.size.x), height / int(camera.size.y)])

    def run(self, candidate: Candidate, others: Iterable[Trial] = ()) -> Trial:
        """Measure a candidate: no longer than it takes where one of the ``others`` is far ahead of it."""
        settings = candidate.settings(self._settings)
        lights = density_of(settings.light_sampling, self._emission, self._adjoint, settings.context)
        bdpt = paths_of(self._scene, self._camera, lights, settings, self._parts if settings.needs_tables else None)
        # The same numbers for all candidates: what one has met by chance others have, where they make the same paths.
        key = (self._settings.context.seed, STREAM)
        best = max((trial.efficiency for trial in others), default=0.0)
        found: list[_Block] = []
        seconds: list[float] = []
        compiling, begin = 0.0, time.perf_counter()
        while len(found) < LEAST or (len(found) < MOST and time.perf_counter() - begin < SECONDS):
            # Of kernels alone: what comes before they run is the same for the many more samples of a chunk.
            with KernelClock() as kernels:
                found.append(self._block(bdpt, (*key, len(found))))
            seconds.append(kernels.running)
            compiling += kernels.compiling
            if len(found) == 1:  # Compiled, and perhaps for the first time
                begin = time.perf_counter()
            elif len(found) == LEAST and BEHIND * _said(candidate.name, found, seconds).bound(-1.0) < best:
                break
        tells = candidate.light_paths == "unjoined"
        rival = self._rival(bdpt, (*key, RIVAL)) if tells else 0.0
        return replace(_said(candidate.name, found, seconds), rival=rival, compiling=compiling)

    def _block(self, bdpt: Bdpt, key: tuple[int, ...]) -> _Block:
        """What a block's samples say of variance and mean, see :class:`Trial`.

        Eye paths come in two sets for a pixel: half the square of their difference. Of light paths
        the sum of squares: what all that meet a pixel bring together is far more than one brings.
        """
        thinning = bdpt.thinning
        lit_pairs, lit = PAIRS // thinning, BLOCK // thinning
        splat, squares, sums = self._light_sums()
        pixels = dr.floor(Stream.of(PAIRS, *key, 0).next_2d() * mi.Point2f(self._camera.size))
        by_eye = []
        # Those with a light path come first; they share the time, and the image, with the others.
        for first, pairs, scale in ((0, lit_pairs, float(thinning)), (lit_pairs, PAIRS - lit_pairs, None)):
            if not pairs:
                continue
            count = 2 * POINTS * pairs
            sample = dr.arange(mi.UInt32, count)
            group = sample % (2 * pairs)
            pair = group % pairs + dr.opaque(mi.UInt32, first)
            # Two sets for a pixel, the same ones for all candidates.
            nets = Nets(pair + group // pairs * PAIRS, sample // (2 * pairs), opaque_key(*key, 1))
            position = dr.gather(mi.Point2f, pixels, pair) + nets.positions()
            lane = dr.arange(mi.UInt32, -(-count // TURNS))
            at_large = Nets(dr.zeros(mi.UInt32, count), sample, opaque_key(*key, 2))
            streams = nets.stream(lane), at_large.stream(lane)
            radiance, wavelengths = bdpt.trace(position, streams, splat, light_scale=scale, turns=TURNS)
            found = luminance(mi.UnpolarizedSpectrum(radiance), wavelengths) * self._worth(position)
            relative = np.array(found, np.float64).reshape(POINTS, 2, pairs)
            means = np.where(np.isfinite(relative), relative, 0.0).mean(axis=0)
            noise = 0.5 * POINTS * np.square(means[0] - means[1])
            by_eye.append(np.stack([noise, means.mean(axis=0)]) / PAIRS)
        by_light = np.array([squares, sums], np.float64) / np.array([[lit / thinning], [lit]])
        return _Block(np.concatenate(by_eye, axis=1), by_light)

    def _rival(self, bdpt: Bdpt, key: tuple[int, ...]) -> float:
        """Variance of the eye paths of ``bdpt`` without its light paths, by what light paths meet.

        Eye paths meet a caustic once in a million, and it decides their variance: a pilot would not see it. Light paths
        that make the same paths with density p know the density q of eye paths: E_p[(f / p)^2 p / q] = E_q[(f / q)^2].
        Counted where p > q alone, where that mean is the easier one to know.
        """
        lights_alone = bdpt.selecting(replace(bdpt.strategies, rivals=True))
        splat, squares, _ = self._light_sums()
        sample = dr.arange(mi.UInt32, RIVALS)
        nets = Nets(dr.zeros(mi.UInt32, RIVALS), sample, opaque_key(*key))
        lane = dr.arange(mi.UInt32, RIVALS // TURNS)
        streams = Stream.of(RIVALS // TURNS, *key, 1), nets.stream(lane)
        lights_alone.trace(dr.zeros(mi.Point2f, RIVALS), streams, splat, turns=TURNS)
        # The square of their mean is no variance: they bring a pixel's light at most, which counts as 1.
        return max(0.0, at_least(np.array(squares, np.float64) * (SUMS / RIVALS)) - 1.0)

    def _light_sums(self) -> tuple[Splat, mi.Float, mi.Float]:
        """What takes the contributions of light paths, and the sums [SUMS] of their squares and of themselves.

        Relative to the pilot image; spread over places, which :data:`SUMS` counts.
        """
        squares, sums = dr.zeros(mi.Float, SUMS), dr.zeros(mi.Float, SUMS)

        def splat(
            where: mi.Point2f,
            value: mi.Spectrum,
            wavelengths: mi.Spectrum,
            sample: mi.UInt32,
            active: mi.Bool,
        ) -> None:
            amount = luminance(mi.UnpolarizedSpectrum(value), wavelengths)
            relative = amount * self._worth(where)
            place = sample & (SUMS - 1)
            active = active & dr.isfinite(relative)
            dr.scatter_reduce(dr.ReduceOp.Add, squares, dr.square(relative), place, active)
            dr.scatter_reduce(dr.ReduceOp.Add, sums, relative, place, active)

        return splat, squares, sums

    def _worth(self, position: mi.Point2f) -> mi.Float:
        """1 / the pilot image at film positions."""
        pixel = dr.minimum(mi.Point2u(dr.maximum(position * self._scale, 0.0)), self._last)
        return dr.gather(mi.Float, self._inverse, pixel.y * self._width + pixel.x)
