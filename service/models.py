"""Bodies that exist in the HTTP interface only; all others are the records of :mod:`worker.models`."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from elps_core.settings import RenderSettings, StopCriterion
from worker.models import Job, WorkerInfo

MAX_DEFINE = 1000
"""Characters of the value of a scene's parameter."""
ParameterName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_]{1,64}$")]
EXAMPLE_DIGEST = "sha256:" + "0123456789abcdef" * 4


class JobRequest(BaseModel):
    """What to render and when to stop."""

    model_config = ConfigDict(
        extra="forbid",
        strict=True,
        json_schema_extra={
            "examples": [
                {
                    "scene": EXAMPLE_DIGEST,
                    "settings": {"integrator": "bdpt", "light_sampling": "adjoint", "width": 512, "height": 512},
                    "stop": {"samples": 1024, "seconds": 600.0},
                },
                {
                    "scene": EXAMPLE_DIGEST,
                    "settings": {"integrator": "pssmlt", "pssmlt": {"large_step": 0.3}, "max_depth": 12},
                    "stop": {"error": 0.05},
                },
            ]
        },
    )

    scene: Annotated[str, Field(pattern=r"^sha256:[0-9a-f]{64}$")]
    """Digest of an uploaded scene."""
    settings: RenderSettings = RenderSettings()
    """What they do not say, the scene file may say: depths, and whether emitters are hidden."""
    stop: StopCriterion | None = None
    """Absent: at the samples per pixel that the scene file asks for."""
    defines: dict[ParameterName, Annotated[str, Field(max_length=MAX_DEFINE)]] = {}
    """Values of the scene's parameters (its ``<default>`` elements). Where they matter, it is another scene."""
    priority: Annotated[int, Field(ge=-9, le=9)] = 0
    """Higher is sooner; 0 is the ordinary job."""


class JobList(BaseModel):
    """Jobs, newest first."""

    jobs: list[Job]


class WorkerList(BaseModel):
    """Workers that were heard of recently."""

    workers: list[WorkerInfo]


class Health(BaseModel):
    """An answer that says only that there is one."""

    status: str = "ok"
