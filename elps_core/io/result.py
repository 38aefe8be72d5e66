"""The file that a render ends in: image, its standard error, and where they come from."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib import metadata
from pathlib import Path

from elps_core.estimate.film import Accumulation
from elps_core.estimate.schedule import MEANTIME
from elps_core.io.exr import Attribute, Part, write_exr
from elps_core.io.formats import converted, of_variant
from elps_core.scene.summary import FilmSummary
from elps_core.settings import RenderSettings

IMAGE_PART = "image"
ERROR_PART = "standard error"


def write_result(
    path: Path,
    merged: Accumulation,
    settings: RenderSettings,
    *,
    scene: str,
    render: str,
    context: str | None,
    unreachable: Sequence[str] = (),
    film: FilmSummary | None = None,
) -> None:
    """Write a multi-part EXR: ``image``, the mean, and its ``standard error`` per pixel, with 32 bits.

    Channels are those that the ``film`` asks for, or else those of the image, linear RGB as a rule.
    ``scene``, ``render`` and ``context`` are digests. The attributes are enough to make the image
    again: settings, seed, digests, chunks, samples, versions. They also say what the algorithm told of
    its work (``statistic:NAME`` and its ``statistic:NAME:standardError``), and what the image lacks
    (``unreachable``, see :mod:`elps_core.scene.reach`), or what else there is to say against it (``warnings``).

    Raises:
        ImageUnwritable: nothing was written.
    """
    attributes: dict[str, Attribute] = {
        "samples": merged.spp,
        "chunks": ranges(merged.chunks),
        "seed": settings.seed,
        "integrator": settings.integrator,
        "lightSampling": settings.light_sampling,
        "directionSampling": settings.direction_sampling,
        "roulette": settings.roulette,
        "maxDepth": settings.max_depth,
        "sensor": settings.sensor,
        "device": settings.variant,
        "sceneDigest": scene,
        "renderDigest": render,
        "secondsRendering": merged.seconds,
        "settings": settings.model_dump_json(),
        **_versions(),
    }
    if context is not None:
        attributes["contextDigest"] = context
    if merged.chunks and min(merged.chunks) >= MEANTIME:
        attributes["preliminary"] = "by plain paths: the context is not there yet"
    if unreachable:
        attributes["unreachable"] = "; ".join(unreachable)
    if merged.warnings():
        attributes["warnings"] = "; ".join(merged.warnings())
    for name, statistic in merged.statistics().items():
        attributes[f"statistic:{name}"] = statistic.mean
        if statistic.standard_error is not None:
            attributes[f"statistic:{name}:standardError"] = statistic.standard_error
    film = of_variant(film or FilmSummary(), settings.variant)
    pixels, channels = converted(merged.mean(), merged.channels, film)
    errors, _ = converted(merged.standard_error(), merged.channels, film)
    attributes["channels"] = ",".join(channels)
    parts = {IMAGE_PART: Part(pixels, channels, film.half), ERROR_PART: Part(errors, channels)}
    write_exr(path, parts, attributes)


def ranges(indices: set[int] | frozenset[int]) -> str:
    """Whole numbers as ranges, such as ``0-3,5``."""
    parts: list[list[int]] = []
    for index in sorted(indices):
        if parts and index == parts[-1][1] + 1:
            parts[-1][1] = index
        else:
            parts.append([index, index])
    return ",".join(str(low) if low == high else f"{low}-{high}" for low, high in parts)


@cache
def _versions() -> dict[str, str]:
    return {f"version:{package}": _version(package) for package in ("elps", "mitsuba", "drjit")}


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:  # run from a source tree that is not installed
        return "unknown"
