"""One scene, one set of settings, any number of independent chunks."""

from __future__ import annotations

import time
from functools import cached_property
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.context.adjoint import density_of
from elps_core.context.build import check_lights
from elps_core.context.store import GlobalContext
from elps_core.errors import ContextMismatch, SettingsRejected
from elps_core.estimate.film import RGBA, Chunk
from elps_core.estimate.schedule import chunk_spp
from elps_core.integrators import make
from elps_core.integrators.alpha import AlphaFrames
from elps_core.integrators.canvas import Canvas
from elps_core.integrators.leftout import Counts, seen_at
from elps_core.paths.stream import key_seed
from elps_core.scene import darkness
from elps_core.scene.failing import told
from elps_core.scene.loader import LoadedScene
from elps_core.scene.sensors import Camera
from elps_core.selection.candidates import PATH, Choice, choose, fit_candidates, plain_of
from elps_core.settings import DEPTH_BASELINES, MAX_DEPTH, RenderSettings

_Image: TypeAlias = "NDArray[np.float32]"


class Renderer:
    """Renders chunks of one image: pure functions of (settings, chunk index).

    Without a context ``auto`` renders by the plain way of the scene, which needs none.

    Raises:
        ContextMismatch: the context does not belong to the scene, or is missing where it is needed.
        SceneRejected: something in the scene that the integrator does not support.
        RenderFailed: Mitsuba fails at something in the scene.
    """

    def __init__(self, scene: LoadedScene, settings: RenderSettings, context: GlobalContext | None = None) -> None:
        self.scene = scene
        self.settings = settings
        self.choice = self._choose(context)
        """What renders, of what was asked for."""
        self.size = scene.size
        with told(settings.integrator):
            self.frames = None if settings.integrator.startswith("mi_") else self._prepare(context)
        """What renders frames by one of our own integrators; None for one of Mitsuba's."""
        self._baseline = self._mitsuba_integrator() if self.frames is None else None
        film = scene.sensor.film()
        self._canvas = Canvas(film, beyond=film.sample_border() and self.frames is None)
        self._alpha: AlphaFrames | None = None
        self._spp = 0

    def _choose(self, context: GlobalContext | None) -> Choice:
        settings = self.settings
        if settings.integrator == "auto" and context is None:
            fit = fit_candidates(self.scene.summary, settings.context)
            plain = PATH if settings.hide_emitters else plain_of(fit)
            return Choice(plain.settings(settings), plain.name)
        return choose(settings, context.statistics if context else None)

    def _prepare(self, context: GlobalContext | None) -> make.Frames:
        settings, emission = self.choice.settings, self.scene.emission
        if context is None and self.settings.integrator != "auto" and settings.needs_context:
            raise ContextMismatch("sampling by context needs a context: build one first")
        parts = None
        if context is not None and settings.needs_context:
            if context.scene != self.scene.digest:
                raise ContextMismatch("the context belongs to another scene: build one for this scene")
            if settings.needs_tables and context.directions is None:
                raise ContextMismatch("the context has no tables: build one with context.regions of 1 or more")
            parts = context.directions if settings.needs_tables else None
        if context is not None:
            check_lights(context, emission)
        adjoint, measured = (context.adjoint, context.settings) if context else (None, settings.context)
        lights = density_of(settings.light_sampling, emission, adjoint, measured)
        return make.frames(self.scene.scene, self.scene.sensor, lights, settings, parts)

    def _mitsuba_integrator(self) -> mi.Integrator:
        name = self.settings.integrator[3:]
        description: dict[str, Any] = {"type": name}
        if name in DEPTH_BASELINES:
            never = self.settings.max_depth + 1  # Roulette is not asked for where there is no limit
            description["max_depth"] = self.settings.max_depth
            description["rr_depth"] = never if self.settings.roulette == "none" else self.settings.rr_depth
        if self.settings.hide_emitters:
            description["hide_emitters"] = True
        try:
            return mi.load_dict(description)
        except Exception:
            raise SettingsRejected(f"Mitsuba's integrator '{name}' cannot be used here: choose 'mi_path'") from None

    def chunk_spp(self, index: int) -> int:
        """Samples per pixel of chunk ``index``."""
        return chunk_spp(index, self.choice.settings, self.size)

    def render_chunk(self, index: int, spp: int | None = None) -> Chunk:
        """Render chunk ``index``; the same index gives the same image to float rounding.

        ``spp`` replaces the chunk's own number of samples where the caller merges by itself.

        Samples that are not finite are left out, and pixels whose sums are not: see :attr:`Chunk.left_out`.

        Raises:
            RenderFailed: Mitsuba fails at something in the scene.
        """
        with told(self.settings.integrator):
            return self._chunk(index, spp)

    def _chunk(self, index: int, spp: int | None) -> Chunk:
        begin = time.perf_counter()
        count = spp or self.chunk_spp(index)
        alpha: _Image | None = None
        if count != self._spp:
            # Dr.Jit keeps what it has freed, by size: of no use to larger arrays, which would begin with new pages.
            dr.flush_malloc_cache()
            self._spp = count
        if self.frames is not None:
            frame = self.frames.render(count, (self.settings.seed, index))
            image, weight, statistics = np.array(frame.image), np.array(frame.weight), frame.statistics
            filtered = None if frame.filtered is None else np.array(frame.filtered)
            left_out = frame.left_out
        else:
            image, weight, filtered, alpha = self._render_baseline(count, index)
            statistics, left_out = {}, np.zeros(self._canvas.shape, np.uint32)
        channels = self._canvas.names
        if self._canvas.has_alpha:
            alpha = self._render_alpha(count, index) if alpha is None else alpha
            image, channels = np.concatenate([image, alpha[..., None]], axis=-1), RGBA
        # Mitsuba's integrators tell of whole pixels alone, and sums of finite samples may be infinite.
        odd = ~np.isfinite(image).all(axis=-1)
        if odd.any():
            left_out = np.where(odd, np.uint32(count), left_out)
            image, weight = np.where(odd[..., None], np.float32(0.0), image), np.where(odd, np.float32(0.0), weight)
            filtered = None if filtered is None else np.where(odd, np.float32(0.0), filtered)
        seconds = time.perf_counter() - begin
        colours = image[..., : len(self._canvas.names)]
        dark = () if colours.any() or left_out.any() else self._reasons_for_darkness
        seen = self._seen_at(left_out)
        return Chunk(index, count, seconds, image, weight, statistics, channels, filtered, seen, dark)

    @cached_property
    def _reasons_for_darkness(self) -> tuple[str, ...]:
        try:
            return darkness.reasons(self.scene, self.settings)
        except RuntimeError:  # of Mitsuba's: what it cannot evaluate is no reason to lose the image
            return ("something in the scene cannot be asked why: look at its lamps and materials",)

    def _seen_at(self, left_out: Counts) -> dict[str, int]:
        return seen_at(self.scene.scene, self.scene.sensor, left_out) if left_out.any() else {}

    def _render_alpha(self, spp: int, index: int) -> _Image:
        """The alpha channel with the samples of chunk ``index``, [height, width]."""
        if self._alpha is None:
            scene = self.scene
            longest = min(self.settings.longest, MAX_DEPTH)
            self._alpha = AlphaFrames(
                scene.scene, Camera(scene.sensor), self._canvas, longest, hides=self.settings.hide_emitters
            )
        return np.array(self._alpha.render(spp, (self.settings.seed, index)))

    def _render_baseline(self, spp: int, index: int) -> tuple[_Image, _Image, _Image | None, _Image | None]:
        """By an integrator of Mitsuba's: image, weight, what was filtered and alpha, the last two where there are any.

        The film's sums are taken as they are: its own image is divided already, pixel by pixel.
        """
        seed = key_seed(self.settings.seed, index) & 0xFFFFFFFF
        scene, sensor, canvas = self.scene.scene, self.scene.sensor, self._canvas
        mi.render(scene, sensor=sensor, integrator=self._baseline, seed=dr.opaque(mi.UInt32, seed), spp=spp)
        stored = np.array(sensor.film().develop(raw=True), np.float32)
        sums, weight = stored[..., :-1], stored[..., -1]
        if not weight.any():  # Light paths alone: the film holds radiance.
            image = np.ascontiguousarray(sums[..., : canvas.channels])
            return image, np.full(canvas.shape, spp, np.float32), None, None
        by, rest = canvas.divisor(mi.Float(weight.ravel()), spp)
        divisor = np.array(by, np.float32).reshape(canvas.shape)
        filtered = None if rest is None else np.array(rest, np.float32).reshape(canvas.shape)
        pixels = np.asarray(sums / np.maximum(divisor, np.finfo(np.float32).tiny)[..., None], np.float32)
        alpha = pixels[..., canvas.channels] if canvas.has_alpha else None
        if self.settings.integrator == "mi_depth":  # Distances are those of the file
            pixels = pixels / np.float32(self.scene.scale)
        return np.ascontiguousarray(pixels[..., : canvas.channels]), divisor, filtered, alpha
