"""One image in this process, by the clock: a picture from the start, preparation, and what it makes of the rest."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from elps_core.context.build import ContextBuilder
from elps_core.context.store import GlobalContext
from elps_core.estimate.film import Accumulation
from elps_core.estimate.schedule import MEANTIME
from elps_core.estimate.stats import MIN_CHUNKS, ends_by_error
from elps_core.renderer import Renderer
from elps_core.scene.loader import LoadedScene
from elps_core.selection.race import Allowance
from elps_core.settings import PREPARATION, RenderSettings, StopCriterion
from elps_core.timing import KernelClock

RESERVE = 0.97
"""Part of the time left that a chunk is sized for: rates vary by a few percent."""
SAVING, SAVING_PIXEL = 0.05, 4e-7
"""Seconds that it takes to write the image, and more for each of its pixels."""


class Report(Protocol):
    """Is told how far a render is."""

    def __call__(self, what: str, share: float, merged: Accumulation | None = None) -> None:
        """``what`` is being done, how much of the way to the end is behind (0 to 1), and the image so far."""
        ...


@dataclass
class Rendered:
    """An image, and what it took."""

    merged: Accumulation
    renderer: Renderer
    """What rendered it in the end."""
    context: GlobalContext | None = None
    hit: bool = False
    """Whether the context was there already."""
    preparing: float = 0.0
    """Seconds."""
    meantime: Accumulation | None = field(default=None, repr=False)
    """What was rendered before there was a context, where that is a part of the image."""


class ProgressiveRender:
    """Renders one image until the first limit of ``stop``, counted from ``begin`` (:func:`time.perf_counter`)."""

    def __init__(
        self, scene: LoadedScene, settings: RenderSettings, stop: StopCriterion, begin: float, report: Report
    ) -> None:
        self._scene, self._settings, self._stop, self._begin, self._report = scene, settings, stop, begin, report
        self._saving = SAVING + SAVING_PIXEL * scene.size[0] * scene.size[1]
        self._preparing = 0.0
        self._compiling = 0.0

    def run(self, context: GlobalContext | None = None) -> Rendered:
        """Render with a ``context`` that is there already, or prepare one where the settings ask for it."""
        if context is not None or not self._settings.needs_context:
            renderer = Renderer(self._scene, self._settings, context)
            merged = self._chunks(renderer, Accumulation.empty(*renderer.size), 0)
            return Rendered(merged, renderer, context, context is not None)
        if self._settings.integrator == "auto":
            return self._auto()
        context = self._prepare(lambda: False)
        renderer = Renderer(self._scene, self._settings, context)
        merged = self._chunks(renderer, Accumulation.empty(*renderer.size), 0)
        return Rendered(merged, renderer, context, preparing=self._preparing)

    def _auto(self) -> Rendered:
        """Plain paths until a context tells a better way, and both together."""
        plain = Renderer(self._scene, self._settings)
        early = Accumulation.empty(*plain.size)

        def meantime() -> bool:
            """One more chunk of plain paths; whether that was the last."""
            index = MEANTIME + len(early.chunks)
            count = self._count(plain, index, early)
            if count < 1:
                return True
            with KernelClock() as kernels:
                early.add(plain.render_chunk(index, count))
            self._compiling = max(self._compiling, kernels.compiling)
            self._tell(early)
            return False

        context = None if meantime() else self._prepare(meantime)
        if context is None:
            return Rendered(early, plain, preparing=self._preparing, meantime=early)
        renderer = Renderer(self._scene, self._settings, context)
        if renderer.choice.settings == plain.choice.settings:
            renderer.frames = plain.frames
        merged = Accumulation.empty(*renderer.size)
        merged.merge(early.weighted(renderer.choice.weight_of_meantime))
        return Rendered(self._chunks(renderer, merged, 0), renderer, context, preparing=self._preparing, meantime=early)

    def _prepare(self, meantime: Callable[[], bool]) -> GlobalContext | None:
        """The context, as good as a quarter of the time allows; None where ``meantime`` came to the end of the job.

        A job without a limit of time renders in the meantime, so that preparing takes a quarter of what has passed.
        """
        builder = ContextBuilder(self._scene, self._settings.measured)
        allowance = Allowance.of(self._begin, self._stop.seconds, self._compiling)
        takes = builder.first_needs(allowance)
        while builder.done < builder.steps:
            begin = time.perf_counter()
            late = self._preparing + takes > PREPARATION * (begin - self._begin)
            if self._stop.seconds is None and self._settings.integrator == "auto" and late:
                if meantime():
                    return None
                continue
            builder.step(allowance)
            takes = time.perf_counter() - begin
            self._preparing += takes
            self._report("measuring the scene", builder.progress)
        begin = time.perf_counter()
        context = builder.result()
        self._preparing += time.perf_counter() - begin
        return context

    def _chunks(self, renderer: Renderer, merged: Accumulation, first: int) -> Accumulation:
        """Add chunks until the first limit of the job."""
        own = Accumulation.empty(*renderer.size)
        index = first
        while (count := self._count(renderer, index, merged, own)) >= 1:
            chunk = renderer.render_chunk(index, count)
            merged.add(chunk)
            own.seconds, own.spp = chunk.seconds, chunk.spp
            self._tell(merged)
            index += 1
        return merged

    def _count(self, renderer: Renderer, index: int, merged: Accumulation, last: Accumulation | None = None) -> int:
        """Samples per pixel of the next chunk; 0 where the job has come to its end.

        ``last`` holds what rendered last, which tells how long samples take.
        """
        stop, last = self._stop, merged if last is None else last
        count = renderer.chunk_spp(index)
        if stop.samples is not None:
            count = min(count, -(-stop.samples // MIN_CHUNKS), stop.samples - merged.spp)
        if stop.seconds is not None and merged.spp:
            left = self._begin + stop.seconds - self._saving - time.perf_counter()
            if not last.spp:
                count = count if left > 0.0 else 0
            else:
                count = min(count, int(RESERVE * left * last.spp / last.seconds))
        if stop.error is not None and ends_by_error(merged.relative_error(), len(merged.chunks), stop.error):
            return 0
        return count

    def _tell(self, merged: Accumulation) -> None:
        """Report how much of the way to the nearest limit is done."""
        stop, shares = self._stop, []
        if stop.samples is not None:
            shares.append(merged.spp / stop.samples)
        if stop.seconds is not None:
            shares.append((time.perf_counter() - self._begin) / stop.seconds)
        if stop.error is not None:
            error = merged.relative_error()
            shares.append(min(1.0, stop.error / error) ** 2 if error else 0.0)
        self._report(f"rendering, {merged.spp} spp", min(1.0, max(shares)), merged)
