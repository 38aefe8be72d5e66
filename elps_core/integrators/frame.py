"""Whole images from passes: film positions, filters, and the splats of light paths."""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

from elps_core.integrators.bdpt import Bdpt
from elps_core.integrators.canvas import Canvas, corner, within
from elps_core.integrators.leftout import Counts, LeftOut
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


@dataclass
class Frame:
    """An image and the weight behind each of its pixels."""

    image: mi.TensorXf  # Mean radiance, linear RGB or bands, [height, width, channels]
    weight: mi.TensorXf  # What the eye paths of a pixel count when frames are merged, [height, width]
    left_out: Counts  # Samples that were not finite, by pixel
    statistics: dict[str, float] = field(default_factory=dict)  # What the algorithm says of its work
    filtered: mi.TensorXf | None = None  # Of filters with lobes, see Chunk.filtered, [height, width]


class FrameRenderer:
    """Renders frames of one film by path, light or bidirectional path tracing; see :class:`Canvas` for its pixels."""

    def __init__(self, bdpt: Bdpt, film: mi.Film) -> None:
        self.bdpt = bdpt
        self.canvas = Canvas(film)

    def render(self, spp: int, key: tuple[int, ...]) -> Frame:
        """``spp`` samples per pixel from the random streams named by ``key``."""
        # Samples with a light path come first, so that all lanes of a pass do alike.
        lit_spp = -(-spp // self.bdpt.thinning)
        most = min(MAX_SAMPLES, max(1, MAX_STORE_BYTES // (max(1, self.bdpt.slots) * VERTEX_BYTES)))
        canvas, channels = self.canvas, self.canvas.channels
        eye, light = canvas.block(channels + 1), canvas.block(channels + 1)
        left_out = LeftOut(canvas.size)
        before = 0
        for count, scale in ((lit_spp, spp / lit_spp), (spp - lit_spp, None)):
            total = canvas.pixels * count
            passes = -(-total // most)
            samples = -(-total // max(1, passes))
            for first in range(0, total, max(1, samples)):
                self._render_pass(min(samples, total - first), before + first, key, scale, eye, light, left_out)
                dr.eval(eye.tensor(), light.tensor())
            before += total
        image, weight, filtered = canvas.divided(eye, spp)
        if self.bdpt.strategies.light_paths:
            image = image + canvas.spread(light, lit_spp, channels, filtered)
        return Frame(
            mi.TensorXf(image, (*canvas.shape, channels)),
            mi.TensorXf(weight, canvas.shape),
            left_out.counts,
            filtered=None if filtered is None else mi.TensorXf(filtered, canvas.shape),
        )

    def _render_pass(
        self,
        samples: int,
        first: int,
        key: tuple[int, ...],
        light_scale: float | None,
        eye: mi.ImageBlock,
        light: mi.ImageBlock,
        left_out: LeftOut,
    ) -> None:
        turns = -(-samples // LANES[dr.backend_v(mi.Float)]) if self.bdpt.max_depth > 1 else 1
        number = dr.arange(mi.UInt32, samples) + dr.opaque(mi.UInt32, first)
        turn = number // self.canvas.pixels
        pixel = number - turn * self.canvas.pixels
        by_pixel = Nets(pixel, turn, opaque_key(*key, 0))
        at_large = Nets(number // BLOCK, number % BLOCK, opaque_key(*key, 1))
        lane = dr.arange(mi.UInt32, -(-samples // turns))
        streams = by_pixel.stream(lane), at_large.stream(lane)
        position = within(corner(pixel, int(self.canvas.size.x)), by_pixel.positions())

        def splat(
            where: mi.Point2f,
            value: mi.Spectrum,
            wavelengths: mi.Spectrum,
            sample: mi.UInt32,  # noqa: ARG001 (all come to one film)
            active: mi.Bool,
        ) -> None:
            # Four channels travel as one packet, three would not; most splats are shadowed and stay away.
            values = self.canvas.values(value, wavelengths)
            active = left_out.keep(where, sum(values, mi.Float(0.0)), active & self.canvas.any(values))
            light.put(where, [*values, mi.Float(0.0)], active)

        radiance, wavelengths = self.bdpt.trace(position, streams, splat, light_scale=light_scale, turns=turns)
        values = self.canvas.values(radiance, wavelengths)
        eye.put(position, [*values, mi.Float(1.0)], left_out.keep(position, sum(values, mi.Float(0.0))))
