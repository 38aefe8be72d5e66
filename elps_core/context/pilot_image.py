"""The pilot image: what the paths that fill tables have found of the image, small and blurred."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.context.lookup import RegionLookup
from elps_core.context.regions import Regions
from elps_core.scene.meeting import Meeting
from elps_core.scene.sensors import Camera

Doubles = NDArray[np.float64]

SIDE = 96
"""Longer side in pixels."""
DARK = 0.01
"""Part of the mean that is added to every pixel where variances are relative: dark ones are not to decide."""
CLEAR = 4.0
"""Relative variance of a path above which steps are not compared by it: where light is so hard to find, a step has more
of it than the one before because it has found more."""
LEAST_PATHS = 1e-9
"""Of a pixel, so that one without any is black."""
LEAST = 1e-300
"""In place of nothing, where something is divided by it."""
WORST = 0.02
"""Part of the pixels that is left out where the variance of steps is compared."""
NO_REGION = np.iinfo(np.uint16).max
"""What the view holds where no surface is seen."""


class PilotImage:
    """Sums by pixel of what eye paths have found, for a film of ``size`` pixels.

    Its resolution is its own: the longer side has :data:`SIDE` pixels.
    """

    def __init__(self, size: mi.ScalarVector2u) -> None:
        width, height = (int(side) for side in size)
        scale = SIDE / max(width, height)
        self.shape = (max(1, round(height * scale)), max(1, round(width * scale)))
        """Rows and columns."""
        self.sums: Doubles = np.zeros((2, *self.shape))
        """Of luminances, and of paths [2, rows, columns]."""
        self.newest: Doubles = np.zeros((2, 3, *self.shape))
        """The same and the sum of squares, of the step before the last one and of the last [2, 3, rows, columns]."""
        self.first: Doubles = np.zeros((3, *self.shape))
        """The same of the first step, whose paths no table has guided [3, rows, columns]."""

    def begin_step(self) -> None:
        """Noise is that of the paths from here on."""
        if not self.first.any():
            self.first = self.newest[1].copy()
        self.newest = np.stack([self.newest[1], np.zeros_like(self.newest[1])])

    def enter(self, place: mi.Point2f, found: mi.Float) -> None:
        """Add paths through ``place`` in [0, 1)^2 of the film that have found that luminance."""
        height, width = self.shape
        pixel = dr.minimum(mi.Point2u(place * mi.Point2f(width, height)), mi.Point2u(width - 1, height - 1))
        index = pixel.y * width + pixel.x
        found = dr.select(dr.isfinite(found), found, 0.0)
        sums = [dr.zeros(mi.Float, width * height) for _ in range(3)]
        for total, value in zip(sums, (found, mi.Float(1.0), dr.square(found)), strict=True):
            dr.scatter_reduce(dr.ReduceOp.Add, total, value, index)
        dr.eval(sums)
        entered = np.stack([np.array(total, np.float64).reshape(self.shape) for total in sums])
        self.sums += entered[:2]
        self.newest[1] += entered

    def image(self) -> NDArray[np.float32]:
        """Mean luminance [rows, columns], blurred."""
        sums, counts = (blurred(part) for part in self.sums)
        return np.asarray(sums / np.maximum(counts, LEAST_PATHS), np.float32)

    def noise(self) -> float:
        """Standard deviation of one path of the last step over the value of its pixel, the median of all pixels."""
        mean, _, squares = self.newest[1] / np.maximum(self.newest[1, 1], 1.0)
        lit = mean > 0.0
        ratio = np.maximum(squares[lit] / np.square(mean[lit]) - 1.0, 0.0)
        return float(np.sqrt(np.median(ratio))) if lit.any() else 0.0

    def gain(self) -> float:
        """Times that paths of the last step have less variance than those of the first; 1 where nothing is known.

        Of relative variances, averaged over the film but for the worst pixels: a single event is not to decide.
        """
        image = np.asarray(self.image(), np.float64)
        floor = np.square(image) + np.square(DARK * image.mean())
        both = []
        for sums, counts, squares in (self.first, self.newest[1]):
            known, n = (counts > 1.0) & (floor > 0.0), np.maximum(counts, 2.0)
            variance = np.sort(((squares - np.square(sums) / n) / ((n - 1.0) * np.maximum(floor, LEAST)))[known])
            both.append(float(variance[: int((1.0 - WORST) * variance.size) + 1].mean()) if variance.size else 0.0)
        return float(both[0] / both[1]) if min(both) > 0.0 else 1.0

    def won(self, errors: float) -> float:
        """Part of a path's variance that the last step had less than the one before; that many standard errors more.

        Of relative variances, averaged over the film. Infinite where nothing is known of either, and where the variance
        is above :data:`CLEAR`.
        """
        image = np.asarray(self.image(), np.float64)
        floor = np.square(image) + np.square(DARK * image.mean())
        sums, counts, squares = self.newest.swapaxes(0, 1)
        known = (counts > 1.0).all(axis=0) & (floor > 0.0)
        if known.sum() < 2:
            return float("inf")
        sums, counts, squares = (part[:, known] for part in (sums, counts, squares))
        before, now = (squares - np.square(sums) / counts) / ((counts - 1.0) * floor[known])
        # By pairs of pixels, because these differ more than steps do.
        less = before - now
        most = less.mean() + errors * less.std(ddof=1) / np.sqrt(less.size)
        return float(most / now.mean()) if 0.0 < now.mean() < CLEAR else float("inf")


def regions_in_view(
    scene: mi.Scene | Meeting, camera: Camera, regions: Regions, shape: tuple[int, int]
) -> NDArray[np.uint16]:
    """Region that the middle of each pixel shows of an image of that ``shape`` (rows, columns)."""
    height, width = shape
    pixel = dr.arange(mi.UInt32, height * width)
    row = pixel // width
    middle = mi.Point2f((mi.Float(pixel - row * width) + 0.5) / width, (mi.Float(row) + 0.5) / height)
    ray = camera.sample_ray(middle * mi.Point2f(camera.size), mi.Float(0.5), mi.Point2f(0.5)).ray
    si = scene.ray_intersect(ray)
    finder = RegionLookup(regions)
    seen = dr.select(si.is_valid(), finder.at(si, si.wi, si.is_valid()), int(NO_REGION))
    return np.array(seen).astype(np.uint16).reshape(height, width)


def blurred(image: Doubles) -> Doubles:
    """Each pixel with its neighbours, 1 : 2 : 1 along both axes."""
    for axis in (0, 1):
        last = image.shape[axis] - 1
        before, after = (np.clip(np.arange(last + 1) + step, 0, last) for step in (-1, 1))
        image = 0.25 * image.take(before, axis) + 0.5 * image + 0.25 * image.take(after, axis)
    return image
