"""The images of a job: the newest merged one, partial or final, and its standard error."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request, Response

from service.conditional import content, etag, unchanged
from service.problems import Problem, responses
from service.routes.common import ExistingJob, FarmOf
from worker import pictures
from worker.models import Job

EXR = "image/x-exr"
PNG = "image/png"

Exposure = Annotated[float, Query(ge=-20.0, le=20.0, description="Stops by which the image is brightened.")]
Tone = Annotated[Literal["srgb", "filmic"], Query(description="Curve from linear light to the screen.")]

HEADERS = {
    "ETag": "Revision of the content.",
    "Elps-State": "State of the job.",
    "Elps-Revision": "Counts the images of the job from 1.",
    "Elps-Samples": "Samples per pixel in the image (`image.exr` only).",
}

router = APIRouter(tags=["images"])


def binary(media_type: str, headers: Mapping[str, str]) -> dict[int | str, dict[str, Any]]:
    """OpenAPI responses of a route that answers with a file and these headers (name to description)."""
    file = {"content": {media_type: {"schema": {"type": "string", "format": "binary"}}}}
    return {
        200: {
            "description": "The file",
            "headers": {name: {"description": text, "schema": {"type": "string"}} for name, text in headers.items()},
            **file,
        },
        206: {"description": "The range that was asked for", **file},
        304: {"description": "Nothing changed since the revision in If-None-Match"},
        **responses("not-found", "no-image", "range-not-satisfiable", "invalid-input"),
    }


def _known(request: Request, job: Job) -> Response | None:
    """304 where the client has the newest image already; nothing is read or made for it then."""
    return unchanged(request, etag(job.image_revision)) if job.image_revision else None


def _content(
    request: Request, job: Job, media_type: str, made: tuple[int, bytes] | None, samples: int | None = None
) -> Response:
    if made is None:
        raise Problem("no-image", "the first image comes with the first samples: follow the job's events")
    revision, data = made
    # The job was read before the image, so a completed job comes with its last one.
    headers = {"Elps-State": job.state, "Elps-Revision": str(revision)}
    if samples is not None:
        headers["Elps-Samples"] = str(samples)
    return content(request, data, media_type, etag(revision), headers)


@router.get(
    "/v1/jobs/{job_id:name}/image.exr",
    operation_id="getImage",
    summary="Image as OpenEXR",
    response_class=Response,
    responses=binary(EXR, HEADERS),
)
def image_exr(job: ExistingJob, farm: FarmOf, request: Request) -> Response:
    """Linear radiance, float; the parts are the image and its standard error."""
    known = _known(request, job)
    if known is not None:
        return known
    image = farm.image(job.id)
    made = None if image is None else (image.revision, image.data)
    return _content(request, job, EXR, made, None if image is None else image.samples)


@router.get(
    "/v1/jobs/{job_id:name}/image.png",
    operation_id="getPreview",
    summary="Image as PNG",
    response_class=Response,
    responses=binary(PNG, HEADERS),
)
def image_png(
    job: ExistingJob, farm: FarmOf, request: Request, exposure: Exposure = 0.0, tone: Tone = "srgb"
) -> Response:
    """The image for a screen."""
    return _known(request, job) or _content(request, job, PNG, pictures.preview_png(farm, job.id, exposure, tone))


@router.get(
    "/v1/jobs/{job_id:name}/error.exr",
    operation_id="getError",
    summary="Standard error as OpenEXR",
    response_class=Response,
    responses=binary(EXR, HEADERS),
)
def error_exr(job: ExistingJob, farm: FarmOf, request: Request) -> Response:
    """Standard error of each pixel, in the unit of the image, estimated from independent chunks."""
    return _known(request, job) or _content(request, job, EXR, pictures.error_exr(farm, job.id))


@router.get(
    "/v1/jobs/{job_id:name}/error.png",
    operation_id="getErrorPreview",
    summary="Relative error as PNG",
    response_class=Response,
    responses=binary(PNG, HEADERS),
)
def error_png(job: ExistingJob, farm: FarmOf, request: Request) -> Response:
    """Relative standard error of each pixel in false colours: black is 1% and less, white 100% and more."""
    return _known(request, job) or _content(request, job, PNG, pictures.error_png(farm, job.id))
