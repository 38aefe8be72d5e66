"""The door of the worker package: what the service and the command line may ask of a farm."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elps_core.settings import RenderSettings, StopCriterion
from worker.models import ContextRecord, Event, Job, SceneRecord, WorkerInfo
from worker.settings import FarmSettings


@dataclass(frozen=True)
class Image:
    """A published multi-part EXR file of a job: parts ``image`` and ``standard error``."""

    revision: int
    """1 for the first partial image of the job."""
    key: str
    """Content-addressed name: equal keys mean equal bytes (a strong entity tag)."""
    data: bytes


class Farm:
    """Scenes, jobs, contexts and workers behind one Redis and one store."""

    @classmethod
    def connect(cls, settings: FarmSettings) -> Farm:
        """A farm on ``settings``; opens no connection yet, so it succeeds where Redis is down.

        Raises:
            SettingsRejected: ``redis_url`` or ``store_url`` is absent or malformed.
        """
        raise NotImplementedError

    def close(self) -> None:
        """Give the connections back."""
        raise NotImplementedError

    def add_scene(self, upload: Path, name: str) -> tuple[SceneRecord, bool]:
        """Check ``upload`` (a .zip or an .xml file) in a sandboxed child and store it; (record, created).

        Raises:
            SceneRejected: what is wrong, in one line; nothing is left behind.
        """
        raise NotImplementedError

    def scene(self, digest: str) -> SceneRecord | None:
        """The record of a stored scene."""
        raise NotImplementedError

    def scenes(self, limit: int = 50) -> list[SceneRecord]:
        """Stored scenes, newest first."""
        raise NotImplementedError

    def submit(self, scene: str, settings: RenderSettings, stop: StopCriterion, *, priority: int = 0) -> Job:
        """Create a job in state queued.

        Raises:
            SceneRejected: no such scene.
            SettingsRejected: sensor out of range, or over the farm's limits.
        """
        raise NotImplementedError

    def job(self, id: str) -> Job | None:  # noqa: A002
        """Where a job stands now."""
        raise NotImplementedError

    def jobs(self, limit: int = 50) -> list[Job]:
        """Jobs, newest first."""
        raise NotImplementedError

    def cancel(self, id: str) -> Job | None:  # noqa: A002
        """Make a job final; idempotent. Chunks that it has and are not yet published follow as one last image."""
        raise NotImplementedError

    def events(self, id: str, after: int = 0) -> list[Event]:  # noqa: A002
        """Events of a job numbered above ``after``, oldest first."""
        raise NotImplementedError

    def follow(self, id: str, after: int = 0) -> AsyncIterator[Event]:  # noqa: A002
        """Events as they come (an async generator); ends after the event of a final state."""
        raise NotImplementedError

    def image(self, id: str) -> Image | None:  # noqa: A002
        """The newest published image of a job."""
        raise NotImplementedError

    def pixels(self, id: str) -> tuple[int, NDArray[np.float32], NDArray[np.float32]] | None:  # noqa: A002
        """(revision, mean [H, W, C], standard error [H, W, C]) of the newest published image, linear."""
        raise NotImplementedError

    def context(self, digest: str) -> ContextRecord | None:
        """A context that some job named."""
        raise NotImplementedError

    def context_file(self, digest: str) -> bytes | None:
        """The file of a ready context."""
        raise NotImplementedError

    def adjoint(self, digest: str) -> NDArray[np.float32] | None:
        """The adjoint image [rows, columns] of a ready context."""
        raise NotImplementedError

    def workers(self) -> list[WorkerInfo]:
        """Workers heard of in the last seconds."""
        raise NotImplementedError

    def ready(self) -> bool:
        """Whether Redis and the store answer."""
        raise NotImplementedError
