"""The alpha channel: how much of a pixel is covered by what is in the scene, as Mitsuba's integrators count it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from elps_core.integrators.canvas import Canvas, corner, within
from elps_core.integrators.frame import MAX_SAMPLES
from elps_core.paths.nets import Nets, NetStream
from elps_core.paths.stream import opaque_key
from elps_core.scene.groups import every_shape
from elps_core.scene.sensors import Camera


class AlphaFrames:
    """Renders the alpha channel of one film: 1 where a primary ray meets a surface that scatters it, 0 where it leaves.

    Rays pass surfaces as samples of their materials do that change nothing: of masks, null interfaces and thin glass.
    An environment that the camera sees covers the whole film. The film positions are those that
    :class:`elps_core.integrators.frame.FrameRenderer` draws from the same key, so that colour and alpha of an edge are
    measured with the same samples, and under the same weights.
    """

    def __init__(self, scene: mi.Scene, camera: Camera, canvas: Canvas, longest: int, *, hides: bool = False) -> None:
        """``longest`` is the greatest number of surfaces that a ray passes.

        ``hides``: emitters are hidden from the camera, and an environment covers nothing.
        """
        self._scene, self._camera, self._canvas = scene, camera, canvas
        self._longest, self._hides = longest, hides
        self._covered = scene.environment() is not None and not hides
        bsdfs = [shape.bsdf() for shape in every_shape(scene)]
        self._opaque = not hides and not any(bsdf and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in bsdfs)

    def render(self, spp: int, key: tuple[int, ...]) -> mi.TensorXf:
        """Mean of ``spp`` samples per pixel from the random streams named by ``key``, [height, width].

        It is divided as the canvas divides colours.
        """
        canvas = self._canvas
        block = canvas.block(2)
        total = canvas.pixels * spp
        samples = -(-total // -(-total // MAX_SAMPLES))
        for first in range(0, total, samples):
            self._render_pass(min(samples, total - first), first, key, block)
            dr.eval(block.tensor())
        alpha, _, _ = canvas.divided(block, spp)
        return mi.TensorXf(alpha, canvas.shape)

    def _render_pass(self, samples: int, first: int, key: tuple[int, ...], block: mi.ImageBlock) -> None:
        number = dr.arange(mi.UInt32, samples) + dr.opaque(mi.UInt32, first)
        turn = number // self._canvas.pixels
        pixel = number - turn * self._canvas.pixels
        nets = Nets(pixel, turn, opaque_key(*key, 0))
        position = within(corner(pixel, int(self._canvas.size.x)), nets.positions())
        stream = nets.stream(dr.arange(mi.UInt32, samples))
        aperture = stream.next_2d() if self._camera.has_aperture else mi.Point2f(0.5)
        ray = self._camera.sample_ray(position, mi.Float(0.5), aperture).ray
        if self._covered:
            met = dr.full(mi.Bool, True, samples)
        elif self._opaque:
            met = self._scene.ray_test(ray)
        else:

            def passes(
                ray: mi.Ray3f, met: mi.Bool, depth: mi.UInt32, stream: NetStream, active: mi.Bool
            ) -> tuple[mi.Ray3f, mi.Bool, mi.UInt32, NetStream, mi.Bool]:
                si = self._scene.ray_intersect(ray, active)
                active = active & si.is_valid()
                numbers = stream.next_1d(even=False), stream.next_2d(even=False)
                event, _ = si.bsdf().sample(mi.BSDFContext(), si, *numbers, active)
                hidden = si.shape.is_emitter() if self._hides else mi.Bool(False)
                through = active & (hidden | mi.has_flag(event.sampled_type, mi.BSDFFlags.Null))
                met = met | (active & ~through)
                return si.spawn_ray(ray.d), met, depth + 1, stream, through & (depth + 1 < self._longest)

            none, every = dr.full(mi.Bool, False, samples), dr.full(mi.Bool, True, samples)
            start = (mi.Ray3f(ray), none, dr.zeros(mi.UInt32, samples), stream, every)
            _, met, _, _, _ = dr.while_loop(start, lambda *state: state[-1], passes, label="elps alpha")
        block.put(position, [dr.select(met, mi.Float(1.0), 0.0), mi.Float(1.0)])
