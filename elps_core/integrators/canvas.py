"""The film as renders fill it: its pixels, its filter, and what the filter's weights add up to."""

from __future__ import annotations

from functools import reduce
from operator import or_

import drjit as dr
import mitsuba as mi

from elps_core.estimate.film import RGB

COVERAGE_SIDE = 8
"""Side of the grid of positions per pixel over which a filter's mean weight is measured."""
WITH_LOBES = ("CatmullRomFilter", "LanczosSincFilter", "MitchellNetravaliFilter")
"""Mitsuba's filters whose weights are negative in places."""
LAST = 1.0 - 2.0**-24
"""The greatest number below 1 in single precision. Times a whole number it gives the greatest one below that."""


def to_rgb(value: mi.Spectrum, wavelengths: mi.Spectrum) -> mi.Color3f:
    """A spectrum as this variant represents it, in linear RGB."""
    if mi.is_spectral:
        return mi.spectrum_to_srgb(value, wavelengths)
    return mi.Color3f(value.x) if mi.is_monochromatic else value


def corner(pixel: mi.UInt32, width: int) -> mi.Point2f:
    """Upper left corner of pixels that are counted along the rows, in pixels."""
    row = pixel // width
    return mi.Point2f(mi.Float(pixel - row * width), mi.Float(row))


def within(corner: mi.Point2f, offset: mi.Point2f) -> mi.Point2f:
    """Film positions at an ``offset`` in [0, 1) from the corners of their pixels, and inside these.

    The sum alone may be rounded to the edge, which belongs to the next pixel: the wider the film, the more often.
    """
    return dr.minimum(corner + offset, (corner + 1.0) * LAST)


class Canvas:
    """The pixels of one film, and how samples become their values.

    A pixel is the sum of filtered samples over the sum of their weights, as Mitsuba has it. Both are summed over all
    chunks of an image before they are divided, so that the quotient is right for many samples, and even areas have no
    noise of the filter: divided by the expected weight, one sample would have 23% under 'gaussian'. Where weights are
    negative in places, the sum of a few may be next to nothing or negative; there chunks are divided by the expected
    weight, and keep beside it how much of that their weights were, which is divided by when there are many samples
    (:attr:`elps_core.estimate.film.Chunk.filtered`).
    Light paths land anywhere on the film, and are always divided by what is expected.
    """

    def __init__(self, film: mi.Film, *, beyond: bool = False) -> None:
        """``beyond``: samples are also taken beyond the film's borders, as far as the filter reaches."""
        self.film = film
        self._beyond = beyond
        self.size = mi.ScalarVector2u(film.crop_size())
        self.pixels = int(self.size.x) * int(self.size.y)
        self.rfilter = film.rfilter()
        self.has_lobes = self.rfilter.class_name() in WITH_LOBES
        self._coverage: mi.Float | None = None
        self.names: tuple[str, ...] = RGB
        """What is kept of the light of a sample: linear RGB, or the bands of a film that has some."""
        self.has_alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
        self.has_bands = mi.has_flag(film.flags(), mi.FilmFlags.Special)
        if self.has_bands:
            film.prepare([])
            stored = film.bitmap(raw=True).struct_()
            self.names = tuple(stored[k].name for k in range(len(stored) - 1))  # The last one holds weights
        self.channels = len(self.names)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return int(self.size.y), int(self.size.x)

    def block(self, channels: int) -> mi.ImageBlock:
        """An empty image under the film's filter, without its crop window's offset."""
        return mi.ImageBlock(self.size, mi.ScalarPoint2i(0, 0), channels, self.rfilter)

    def values(self, light: mi.Spectrum, wavelengths: mi.Spectrum) -> list[mi.Float]:
        """What the film keeps of a sample's light, ``channels`` numbers."""
        if self.has_bands:
            return list(self.film.prepare_sample(light, wavelengths, self.channels + 1))[: self.channels]
        return list(to_rgb(light, wavelengths))

    @staticmethod
    def any(values: list[mi.Float]) -> mi.Bool:
        """Whether there is light in any of the channels."""
        return reduce(or_, (value != 0.0 for value in values))

    def divided(self, block: mi.ImageBlock, samples: int) -> tuple[mi.Float, mi.Float, mi.Float | None]:
        """Mean of what was put into a block whose last channel holds weights, what it was divided by, and the rest.

        ``samples`` were put into each pixel. The mean holds all other channels, pixel by pixel. The rest is the sum of
        weights over what the mean was divided by, where these differ.
        """
        channels = block.channel_count() - 1
        stored = block.tensor().array
        number = dr.arange(mi.UInt32, self.pixels)
        divisor, filtered = self.divisor(dr.gather(mi.Float, stored, number * (channels + 1) + channels), samples)
        pixel, channel = self._entries(channels)
        seen = dr.gather(mi.Float, stored, pixel * (channels + 1) + channel)
        return seen / dr.maximum(dr.gather(mi.Float, divisor, pixel), dr.smallest(mi.Float)), divisor, filtered

    def divisor(self, weight: mi.Float, samples: int) -> tuple[mi.Float, mi.Float | None]:
        """What the filtered samples of pixels are divided by, and the sum of their weights over it where they differ.

        ``weight`` is that sum.
        """
        if not self.has_lobes:
            return weight, None
        expected = self.coverage() * float(samples)
        return expected, weight / expected

    def spread(self, block: mi.ImageBlock, samples: float, channels: int, filtered: mi.Float | None = None) -> mi.Float:
        """What light paths have put, divided by the weight that ``samples`` in each pixel have on average.

        The block has one channel more than the ``channels`` of the result. ``filtered`` is what the image that it is
        added to will be divided by.
        """
        pixel, channel = self._entries(channels)
        expected = samples * dr.gather(mi.Float, self.coverage(), pixel)
        mean = dr.gather(mi.Float, block.tensor().array, pixel * (channels + 1) + channel) / expected
        return mean if filtered is None else mean * dr.gather(mi.Float, filtered, pixel)

    def coverage(self) -> mi.Float:
        """Expected sum of filter weights per pixel for one sample in every pixel of the film: less at the borders."""
        if self._coverage is None:
            if self.rfilter.is_box_filter():
                self._coverage = dr.ones(mi.Float, self.pixels)
            else:
                block = self.block(1)
                corners = corner(dr.arange(mi.UInt32, self.pixels), int(self.size.x))
                for k in range(COVERAGE_SIDE**2):
                    inside = [(n + 0.5) / COVERAGE_SIDE for n in (k % COVERAGE_SIDE, k // COVERAGE_SIDE)]
                    # Opaque, and one by one, so that all share one small kernel.
                    block.put(corners + dr.opaque(mi.Point2f, inside), [mi.Float(1.0 / COVERAGE_SIDE**2)])
                    dr.eval(block.tensor())
                inner = mi.Float(block.tensor().array)
                self._coverage = dr.max(inner) + dr.zeros(mi.Float, self.pixels) if self._beyond else inner
        return self._coverage

    def _entries(self, channels: int) -> tuple[mi.UInt32, mi.UInt32]:
        """Pixel and channel of each number of an image."""
        entry = dr.arange(mi.UInt32, self.pixels * channels)
        pixel = entry // channels
        return pixel, entry - pixel * channels
