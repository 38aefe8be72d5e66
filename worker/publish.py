"""Merged images as multi-part EXR files in the store."""

from __future__ import annotations

import hashlib
import tempfile
from pathlib import Path

from elps_core.estimate.film import Accumulation
from elps_core.io.result import ranges, write_result
from elps_core.scene.summary import FilmSummary, SceneSummary
from worker.models import Job, SceneRecord
from worker.store import Store, name


def publish(store: Store, job: Job, merged: Accumulation) -> str:
    """Write the image of a set of chunks, unless it is there, and return its key.

    The key names the render digest and the chunks, so jobs with equal digests share images.

    Raises:
        StoreFull, StoreUnavailable: nothing was written.
    """
    content = hashlib.sha256(ranges(merged.chunks).encode()).hexdigest()
    key = f"images/{name(job.digest)}/{content}.exr"
    if not store.exists(key):
        with tempfile.TemporaryDirectory(prefix="elps-image-") as folder:
            path = Path(folder) / "image.exr"
            write_result(
                path,
                merged,
                job.settings,
                scene=job.scene,
                render=job.digest,
                context=job.context_digest,
                unreachable=job.warnings,
                film=_film(store, job),
            )
            store.put(key, path.read_bytes())
    return key


def _film(store: Store, job: Job) -> FilmSummary | None:
    """What the camera's film asks of the file."""
    record = store.get(f"scenes/{name(job.scene)}.json")
    if record is None:
        return None
    summary = SceneSummary.model_validate(SceneRecord.model_validate_json(record).summary)
    return summary.sensors[job.settings.sensor].film
