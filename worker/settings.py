"""Where the farm lives and what it allows: environment variables ``ELPS_...``."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AliasChoices, Field
from pydantic_settings import BaseSettings, SettingsConfigDict

DeviceClass = Literal["llvm", "cuda"]


class FarmSettings(BaseSettings):
    """Settings that the service and its workers share; all of them must agree on the two URLs."""

    model_config = SettingsConfigDict(env_prefix="ELPS_", extra="ignore", frozen=True, populate_by_name=True)

    redis_url: Annotated[str | None, Field(validation_alias=AliasChoices("ELPS_REDIS_URL", "REDIS_URL"))] = None
    """Coordination: ``redis://[:password@]host:port/db``. Absent where a server is yet to be embedded."""
    store_url: str | None = None
    """Artefacts: ``file:///folder``, ``s3://bucket/prefix`` or ``memory:///`` (one process only).
    Credentials and endpoint of S3 come from the usual ``AWS_...`` variables."""

    max_pixels: Annotated[int, Field(ge=1)] = 4096 * 4096
    """Largest film of a job, width times height."""
    max_samples: Annotated[int, Field(ge=1)] = 2**20
    """Most samples per pixel that a job may ask for."""
    max_seconds: Annotated[float, Field(gt=0.0)] = 24 * 3600.0
    """Longest wall-clock time that a job may ask for, seconds."""

    device: DeviceClass = "llvm"
    """What this worker renders on; it takes only jobs whose variant belongs to it."""
    warm_variant: str = "llvm_ad_rgb"
    """Variant that a worker loads before its first job, so that the job need not wait for it."""
    lease_seconds: Annotated[float, Field(gt=0.0)] = 8.0
    """How long a chunk stays with a worker that stopped renewing it; well under the 15 s promised."""
    sweep_seconds: Annotated[float, Field(gt=0.0)] = 1.0
    """Time between two looks for lost chunks and stuck jobs."""
    stall_seconds: Annotated[float, Field(gt=0.0)] = 300.0
    """A task without progress for this long is given up: loading, compiling and a chunk fit many times over."""
    publish_seconds: Annotated[float, Field(gt=0.0)] = 3.0
    """Shortest time between two partial images in a job's first minute."""
