"""The public door: scenes in, arrays out. Everything here is re-exported by the package itself."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from elps_core import device
from elps_core.scene import reach
from elps_core.scene.loader import LoadedScene
from elps_core.scene.loader import load_scene as _load_scene
from elps_core.settings import (
    ContextSettings,
    RenderSettings,
    StopCriterion,
    stop_or_default,
    suited,
    with_file_defaults,
    with_overrides,
)

if TYPE_CHECKING:
    from elps_core.context.store import GlobalContext
    from elps_core.estimate.film import Accumulation


@dataclass(frozen=True)
class Progress:
    """How far a render is."""

    what: str
    """What is being done."""
    share: float
    """Of the way to the end, 0 to 1."""
    image: NDArray[np.float32] | None
    """The image so far, linear, [height, width, channels]; None before there is one."""


@dataclass(frozen=True)
class Image:
    """A finished image."""

    pixels: NDArray[np.float32]
    """Linear radiance [height, width, channels]."""
    channels: tuple[str, ...]
    """Names of the channels, such as R, G, B."""
    error: float | None
    """Relative error of the image; None where nothing is known of it."""
    spp: int
    """Samples per pixel."""
    settings: RenderSettings
    """What rendered, as it was chosen."""
    context: GlobalContext | None
    """What the render learnt of the scene, to be given to the next one; None where it asked for nothing."""
    warnings: tuple[str, ...]
    """What there is to say of the scene and against the image, a line each."""


def load_scene(
    source: str | Path,
    *,
    variant: str = RenderSettings().variant,
    sensor: int = 0,
    size: tuple[int, int] | None = None,
    root: str | Path | None = None,
    defines: Mapping[str, str] | None = None,
) -> LoadedScene:
    """Load a scene file, a bundle or a folder.

    Args:
        source: an .xml file of Mitsuba 0.5 to 3, a .zip bundle or a folder.
        variant: Mitsuba variant, which stays set.
        sensor: which of its cameras, counted from 0.
        size: width and height of the image in pixels, in place of the file's.
        root: a folder above an .xml file, whose files it may use as well.
        defines: values of the scene's parameters.

    Raises:
        SceneRejected: damaged, hostile, too large or unsupported.
        DeviceUnavailable: the variant does not run here.
    """
    above = None if root is None else Path(root)
    return _load_scene(Path(source), variant, sensor=sensor, size=size, root=above, defines=defines)


def build_context(
    scene: LoadedScene | str | Path,
    settings: ContextSettings | None = None,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> GlobalContext:
    """Measure how light flows through a scene, for all renders by its camera.

    Args:
        scene: a loaded scene, or what to load.
        settings: how it is measured.
        progress: is told after each step.

    Raises:
        ElpsError: the scene does not load, or cannot be measured.
    """
    loaded = scene if isinstance(scene, LoadedScene) else load_scene(scene)
    device.use(loaded.variant)
    from elps_core.context.build import ContextBuilder

    builder = ContextBuilder(loaded, settings or ContextSettings())
    while builder.done < builder.steps:
        builder.step()
        if progress:
            progress(Progress("measuring the scene", builder.progress, None))
    return builder.result()


def render(
    scene: LoadedScene | str | Path,
    settings: RenderSettings | None = None,
    *,
    samples: int | None = None,
    seconds: float | None = None,
    error: float | None = None,
    context: GlobalContext | None = None,
    progress: Callable[[Progress], None] | None = None,
    **changes: Any,
) -> Image:
    """Render a scene until the first limit that is given, else with the samples per pixel of the scene file.

    Args:
        scene: a loaded scene, or what to load.
        settings: how; ``auto`` and its defaults if absent. What they do not say the scene file may say.
        samples: per pixel.
        seconds: with everything counted from this call on.
        error: relative error of the image.
        context: what an earlier render or :func:`build_context` has learnt of the scene.
        progress: is told after each step of the way.
        changes: settings by name, such as ``integrator="bdpt"``.

    Raises:
        ElpsError: the scene does not load, or the settings do not fit.
    """
    begin = time.perf_counter()
    chosen = with_overrides(settings or RenderSettings(), changes)
    limited = (samples, seconds, error) != (None, None, None)
    given = StopCriterion(samples=samples, seconds=seconds, error=error) if limited else None
    if isinstance(scene, LoadedScene):
        loaded = scene
    else:
        size = (chosen.width, chosen.height) if chosen.width and chosen.height else None
        loaded = load_scene(scene, variant=chosen.variant, sensor=chosen.sensor, size=size)
    device.use(loaded.variant)
    from elps_core.progressive import ProgressiveRender

    defaults = loaded.summary.defaults
    stop = stop_or_default(given, defaults.samples)
    chosen = suited(with_file_defaults(chosen, defaults.settings()), stop)
    reach.check(loaded.summary, chosen)

    def report(what: str, share: float, merged: Accumulation | None = None) -> None:
        if progress:
            progress(Progress(what, share, None if merged is None else merged.mean()))

    done = ProgressiveRender(loaded, chosen, stop, begin, report).run(context)
    merged = done.merged
    told = (*loaded.summary.warnings, *reach.unreachable(loaded.summary, chosen), *merged.warnings())
    return Image(
        merged.mean(),
        merged.channels,
        merged.relative_error(),
        merged.spp,
        done.renderer.choice.settings,
        done.context,
        told,
    )


def register(variant: str = RenderSettings().variant) -> None:
    """Let ``mi.render`` and ``mi.load_dict`` name our integrators: ``elps_path``, ``elps_bdpt`` and the others."""
    device.use(variant)
    from elps_core.integrators import plugin

    plugin.register()
