"""Uploading and describing scenes."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Request, Response

from service.problems import busy, not_found, responses
from service.routes.common import Digest, FarmOf
from service.settings import ServiceSettings
from service.uploads import FIELD, FORM_TYPE, RAW_TYPES, received
from worker.models import SceneRecord

_BINARY = {"type": "string", "format": "binary"}
_FORM = {"type": "object", "required": [FIELD], "properties": {FIELD: _BINARY}, "additionalProperties": False}
_UPLOAD: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "A zip bundle with one scene XML at its top, or a single XML that names no other file.",
        "content": {
            FORM_TYPE: {"schema": _FORM},
            **{media_type: {"schema": _BINARY} for media_type in RAW_TYPES},
        },
    }
}


class Turnstile:
    """Bounds the uploads in progress, and how many of them are checked at the same time."""

    def __init__(self, settings: ServiceSettings) -> None:
        self.checks = CapacityLimiter(settings.scene_checks)
        self._free = settings.scene_uploads

    @asynccontextmanager
    async def enter(self) -> AsyncIterator[None]:
        """Holds one place.

        Raises:
            Problem: none is free; waiting would only hold more files on the disk.
        """
        if self._free == 0:
            raise busy("other scenes are being checked: send this one again a little later")
        self._free -= 1
        try:
            yield
        finally:
            self._free += 1


router = APIRouter(tags=["scenes"])


@router.post(
    "/v1/scenes",
    operation_id="createScene",
    summary="Upload a scene",
    status_code=201,
    response_model=SceneRecord,
    responses={
        200: {"description": "The scene was there already", "model": SceneRecord},
        **responses("bad-request", "too-large", "unsupported-media-type", "scene-rejected", "busy"),
    },
    openapi_extra=_UPLOAD,
)
async def create_scene(request: Request, response: Response, farm: FarmOf) -> SceneRecord:
    """Checks a scene in a sandbox and keeps it under the digest of its content."""
    turnstile: Turnstile = request.app.state.turnstile
    async with turnstile.enter(), received(request) as (path, name):
        record, created = await to_thread.run_sync(farm.add_scene, path, name, limiter=turnstile.checks)
    response.status_code = 201 if created else 200
    response.headers["Location"] = f"/v1/scenes/{record.digest}"
    return record


@router.get(
    "/v1/scenes/{digest}",
    operation_id="getScene",
    summary="Describe a scene",
    responses=responses("not-found", "invalid-input"),
)
def get_scene(digest: Digest, farm: FarmOf) -> SceneRecord:
    """Sensors, emitters, BSDF classes and warnings of a scene."""
    record = farm.scene(digest)
    if record is None:
        raise not_found("scene")
    return record
