"""What an operator may set of the HTTP side; the job side has :class:`worker.settings.FarmSettings`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict


class ServiceSettings(BaseSettings):
    """Limits of the HTTP interface, read from the environment as ``ELPS_<NAME>``."""

    model_config = SettingsConfigDict(env_prefix="ELPS_", frozen=True)

    max_upload_bytes: Annotated[int, Field(ge=1)] = 512 * 2**20
    """Largest scene upload, counted while it arrives. The published test scenes zip to 5 to 80 MB."""
    max_json_bytes: Annotated[int, Field(ge=1)] = 64 * 2**10
    """Largest body of every other request; a job with all of its settings takes 1 KB."""
    scene_checks: Annotated[int, Field(ge=1)] = 2
    """Scenes that are checked at the same time; each one is a child process that loads the scene."""
    scene_uploads: Annotated[int, Field(ge=1)] = 8
    """Uploads in progress, the ones that wait for their check included; more are told to come back."""
