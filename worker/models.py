"""Records that cross from the worker package to its users: jobs, scenes, contexts, events.

All are pydantic models, JSON in and JSON out; the HTTP API returns them as they are.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from elps_core.settings import ContextSettings, RenderSettings, StopCriterion

JobState = Literal["queued", "preparing", "rendering", "paused", "completed", "cancelled", "failed"]
FINAL_STATES: frozenset[str] = frozenset({"completed", "cancelled", "failed"})
ContextState = Literal["missing", "building", "ready", "failed"]


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SceneRecord(_Record):
    """A scene that was uploaded and passed the checks."""

    digest: str
    """Content hash of everything that the image depends on: ``sha256:<64 hex digits>``."""
    name: str
    """What the uploader called the file; shown, never used as a path."""
    summary: dict[str, Any]
    """Sensors with film sizes, emitters, BSDF classes, triangle count, warnings."""
    created: float
    """Unix time of the first upload, seconds."""
    defines: dict[str, str] = {}
    """Values of the scene's parameters that it was checked with."""


class ContextRecord(_Record):
    """A global context: built, being built, or known by name only."""

    digest: str
    state: ContextState
    scene: str
    sensor: int
    settings: ContextSettings
    progress: float = 0.0
    """Share of the preprocessing pass that is done, 0 to 1."""
    seconds: float | None = None
    """Time that building took, summed over its steps."""
    statistics: dict[str, Any] = {}
    error: str | None = None


class Statistic(_Record):
    """A number that an algorithm says of its own work, such as the share of accepted mutations."""

    mean: float
    standard_error: float | None
    """From the scatter of the chunks; absent with fewer than two."""


class Job(_Record):
    """One render request and where it stands."""

    id: str
    revision: int
    """Counts the changes of this record; the entity tag of the job."""
    state: JobState
    scene: str
    settings: RenderSettings
    stop: StopCriterion
    priority: int = 0
    created: float
    started: float | None = None
    finished: float | None = None
    queue_position: int | None = None
    width: int
    height: int
    samples_done: int = 0
    """Samples per pixel merged so far."""
    chunks_done: int = 0
    chunks_running: int = 0
    image_revision: int = 0
    """Counts the published images; 0 while there is none."""
    relative_error: float | None = None
    statistics: dict[str, Statistic] = {}
    """What the algorithm says of its work; of pssmlt its brightness and the acceptance of its mutations."""
    warnings: tuple[str, ...] = ()
    """What the image will lack, because this integrator cannot find it in this scene."""
    image_warnings: tuple[str, ...] = ()
    """What there is to say against the image as it is so far, such as samples that were left out."""
    context_digest: str | None = None
    context_hit: bool | None = None
    """True where the context existed before this job asked for it."""
    context_state: ContextState | None = None
    context_progress: float = 0.0
    choice: dict[str, Any] | None = None
    """What trials have shown to be the best, and their figures; absent until they ran, or where they do not decide."""
    seconds_context: float = 0.0
    seconds_rendering: float = 0.0
    """Sum over chunks of the time a worker spent on them."""
    seconds_loading: float = 0.0
    """Of these two and before them, summed over workers: loading the scene,"""
    seconds_compiling: float = 0.0
    """compiling kernels that were not on disk,"""
    seconds_tracing: float = 0.0
    """and the host's work between kernels, most of it telling what they are to do."""
    eta_seconds: float | None = None
    digest: str
    """Render digest: what the image depends on. Equal digests share chunks."""
    message: str | None = None
    """One line for the user where the job failed."""


class Event(_Record):
    """One change of a job, numbered per job from 1."""

    id: int
    type: Literal["state", "context", "progress", "image"]
    data: dict[str, Any]


class WorkerInfo(_Record):
    """A worker process that was heard of recently."""

    name: str
    device: str
    variants: list[str]
    busy: bool
    last_seen: float
