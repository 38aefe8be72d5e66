"""Whole images from passes: film positions, filters, and the splats of light paths."""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

from elps_core.integrators.bdpt import Bdpt
from elps_core.paths.nets import BLOCK, Nets
from elps_core.paths.stream import opaque_key

MAX_SAMPLES = 1 << 20
"""Samples of one pass; more brings no speed and costs memory."""
LANES = {dr.JitBackend.LLVM: 1 << 13, dr.JitBackend.CUDA: 1 << 18}
"""Lanes of one pass: enough to keep all processors busy. Each takes one sample after the other."""
MAX_STORE_BYTES = 1 << 29
"""Bound of the light vertices of one pass: deep paths get fewer lanes."""
VERTEX_BYTES = 112
"""Upper bound of a stored vertex's size."""
COVERAGE_SIDE = 8
"""Side of the grid of positions per pixel over which a filter's mean weight is measured."""


@dataclass
class Frame:
    """An image and the weight behind each of its pixels."""

    image: mi.TensorXf  # Mean radiance, linear RGB, [height, width, 3]
    weight: mi.TensorXf  # Sum of filter weights of the eye paths, [height, width]
    statistics: dict[str, float] = field(default_factory=dict)  # What the algorithm says of its work


def to_rgb(value: mi.Spectrum, wavelengths: mi.Spectrum) -> mi.Color3f:
    """A spectrum as this variant represents it, in linear RGB."""
    if mi.is_spectral:
        return mi.spectrum_to_srgb(value, wavelengths)
    return mi.Color3f(value.x) if mi.is_monochromatic else value


class FrameRenderer:
    """Renders frames of one film by path, light or bidirectional path tracing.

    Eye paths are filtered and normalised as Mitsuba does (sum of weighted samples over the sum of
    weights). Light paths land anywhere on the film and are normalised by the *expected* weight of
    each pixel, which differs at the borders: else the image darkens there.
    """

    def __init__(self, bdpt: Bdpt, film: mi.Film) -> None:
        self.bdpt = bdpt
        self.size = bdpt.camera.size
        self.rfilter = film.rfilter()
        self.pixels = int(self.size.x) * int(self.size.y)
        self.is_box = self.rfilter.is_box_filter()
        self._coverage: mi.Float | None = None

    def render(self, spp: int, key: tuple[int, ...]) -> Frame:
        """``spp`` samples per pixel from the random streams named by ``key``."""
        # Samples with a light path come first, so that all lanes of a pass do alike.
        lit_spp = -(-spp // self.bdpt.thinning)
        most = min(MAX_SAMPLES, max(1, MAX_STORE_BYTES // (max(1, self.bdpt.slots) * VERTEX_BYTES)))
        eye, light = self._block(4), self._block(4)
        before = 0
        for count, scale in ((lit_spp, spp / lit_spp), (spp - lit_spp, None)):
            total = self.pixels * count
            passes = -(-total // most)
            samples = -(-total // max(1, passes))
            for first in range(0, total, max(1, samples)):
                self._render_pass(min(samples, total - first), before + first, key, scale, eye, light)
                dr.eval(eye.tensor(), light.tensor())
            before += total
        channels = eye.tensor().array
        pixel = dr.arange(mi.UInt32, self.pixels * 3) // 3
        channel = dr.arange(mi.UInt32, self.pixels * 3) % 3
        weight = dr.gather(mi.Float, channels, dr.arange(mi.UInt32, self.pixels) * 4 + 3)
        seen = dr.gather(mi.Float, channels, pixel * 4 + channel)
        image = seen / dr.maximum(dr.gather(mi.Float, weight, pixel), dr.smallest(mi.Float))
        if self.bdpt.strategies.light_paths:
            expected = lit_spp * dr.gather(mi.Float, self.coverage(), pixel)
            image = image + dr.gather(mi.Float, light.tensor().array, pixel * 4 + channel) / expected
        shape = (int(self.size.y), int(self.size.x))
        return Frame(mi.TensorXf(image, (*shape, 3)), mi.TensorXf(weight, shape))

    def _render_pass(
        self,
        samples: int,
        first: int,
        key: tuple[int, ...],
        light_scale: float | None,
        eye: mi.ImageBlock,
        light: mi.ImageBlock,
    ) -> None:
        turns = -(-samples // LANES[dr.backend_v(mi.Float)]) if self.bdpt.max_depth > 1 else 1
        number = dr.arange(mi.UInt32, samples) + dr.opaque(mi.UInt32, first)
        turn = number // self.pixels
        pixel = number - turn * self.pixels
        by_pixel = Nets(pixel, turn, opaque_key(*key, 0))
        at_large = Nets(number // BLOCK, number % BLOCK, opaque_key(*key, 1))
        lane = dr.arange(mi.UInt32, -(-samples // turns))
        streams = by_pixel.stream(lane), at_large.stream(lane)
        row = pixel // int(self.size.x)
        corner = mi.Point2f(mi.Float(pixel - row * int(self.size.x)), mi.Float(row))
        position = corner + by_pixel.positions()

        def splat(
            where: mi.Point2f,
            value: mi.Spectrum,
            wavelengths: mi.Spectrum,
            sample: mi.UInt32,  # noqa: ARG001 (all come to one film)
            active: mi.Bool,
        ) -> None:
            # Four channels travel as one packet, three would not; most splats are shadowed and stay away.
            rgb = to_rgb(value, wavelengths)
            light.put(where, [*rgb, mi.Float(0.0)], active & dr.any(rgb != 0.0))

        radiance, wavelengths = self.bdpt.trace(position, streams, splat, light_scale=light_scale, turns=turns)
        eye.put(position, [*to_rgb(radiance, wavelengths), mi.Float(1.0)])

    def coverage(self) -> mi.Float:
        """Expected sum of filter weights per pixel for one sample in every pixel of the film."""
        if self._coverage is None:
            if self.is_box:
                self._coverage = dr.ones(mi.Float, self.pixels)
            else:
                block = self._block(1)
                index = dr.arange(mi.UInt32, self.pixels)
                row = index // int(self.size.x)
                corner = mi.Point2f(mi.Float(index - row * int(self.size.x)), mi.Float(row))
                for k in range(COVERAGE_SIDE**2):
                    inside = [(n + 0.5) / COVERAGE_SIDE for n in (k % COVERAGE_SIDE, k // COVERAGE_SIDE)]
                    # Opaque, and one by one, so that all share one small kernel.
                    block.put(corner + dr.opaque(mi.Point2f, inside), [mi.Float(1.0 / COVERAGE_SIDE**2)])
                    dr.eval(block.tensor())
                self._coverage = mi.Float(block.tensor().array)
        return self._coverage

    def _block(self, channels: int) -> mi.ImageBlock:
        return mi.ImageBlock(self.size, mi.ScalarPoint2i(0, 0), channels, self.rfilter)
