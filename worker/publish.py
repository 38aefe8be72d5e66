"""Merged images as multi-part EXR files in the store."""

from __future__ import annotations

import hashlib
import tempfile
from functools import cache
from importlib import metadata
from pathlib import Path

from elps_core.estimate.film import Accumulation
from elps_core.io.exr import write_exr
from worker.advance import ranges
from worker.models import Job
from worker.store import Store, name

IMAGE_PART = "image"
ERROR_PART = "standard error"


def publish(store: Store, job: Job, merged: Accumulation) -> str:
    """Write the image of a set of chunks, unless it is there, and return its key.

    Parts: ``image``, the mean in linear RGB; ``standard error`` of it, per pixel and channel.
    The key names the render digest and the chunks, so jobs with equal digests share images.

    Raises:
        StoreFull, StoreUnavailable: nothing was written.
    """
    chunks = ranges(merged.chunks)
    content = hashlib.sha256(chunks.encode()).hexdigest()
    key = f"images/{name(job.digest)}/{content}.exr"
    if not store.exists(key):
        with tempfile.TemporaryDirectory(prefix="elps-image-") as folder:
            path = Path(folder) / "image.exr"
            parts = {IMAGE_PART: merged.mean(), ERROR_PART: merged.standard_error()}
            write_exr(path, parts, _attributes(job, merged, chunks))
            store.put(key, path.read_bytes())
    return key


def _attributes(job: Job, merged: Accumulation, chunks: str) -> dict[str, str | int | float]:
    """Where the image comes from: enough to make it again."""
    settings = job.settings
    attributes: dict[str, str | int | float] = {
        "samples": merged.spp,
        "chunks": chunks,
        "seed": settings.seed,
        "integrator": settings.integrator,
        "lightSampling": settings.light_sampling,
        "directionSampling": settings.direction_sampling,
        "roulette": settings.roulette,
        "maxDepth": settings.max_depth,
        "sensor": settings.sensor,
        "device": settings.variant,
        "sceneDigest": job.scene,
        "renderDigest": job.digest,
        "secondsRendering": merged.seconds,
    }
    if job.context_digest is not None:
        attributes["contextDigest"] = job.context_digest
    return attributes | _versions()


@cache
def _versions() -> dict[str, str]:
    return {f"version:{package}": _version(package) for package in ("elps", "mitsuba", "drjit")}


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:  # run from a source tree that is not installed
        return "unknown"
