"""The images of a job: the newest merged one, partial or final, and its standard error."""

from __future__ import annotations

from collections.abc import Callable
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

router = APIRouter(tags=["images"])


def binary(media_type: str, *kinds: str) -> dict[int | str, dict[str, Any]]:
    """OpenAPI responses of a route that answers with a file."""
    file = {"content": {media_type: {"schema": {"type": "string", "format": "binary"}}}}
    return {
        200: {
            "description": "The file; the headers Elps-State, Elps-Samples and Elps-Revision say how far it is",
            "headers": {"ETag": {"description": "Revision of the content.", "schema": {"type": "string"}}},
            **file,
        },
        206: {"description": "The range that was asked for", **file},
        304: {"description": "Nothing changed since the revision in If-None-Match"},
        **responses("not-found", "no-image", "range-not-satisfiable", "invalid-input", *kinds),
    }


def _answer(request: Request, job: Job, media_type: str, produce: Callable[[], tuple[int, bytes] | None]) -> Response:
    """The newest image in some form, made only where the client does not have it yet."""
    if job.image_revision:
        known = unchanged(request, etag(job.image_revision))
        if known is not None:
            return known
    made = produce()
    if made is None:
        raise Problem("no-image", "the first image comes with the first samples: follow the job's events")
    revision, data = made
    # The job was read before the image: a final state here means that nothing newer will come.
    headers = {"Elps-State": job.state, "Elps-Revision": str(revision), **(extra or {})}
    return content(request, data, media_type, etag(revision), headers)


@router.get(
    "/v1/jobs/{job_id:name}/image.exr",
    operation_id="getImage",
    summary="Image as OpenEXR",
    response_class=Response,
    responses=binary(EXR),
)
def image_exr(job: ExistingJob, farm: FarmOf, request: Request) -> Response:
    """Linear radiance, float; the parts are the image and its standard error."""

    def produce() -> tuple[int, bytes] | None:
        image = farm.image(job.id)
        return None if image is None else (image.revision, image.data)

    return _answer(request, job, EXR, produce)


@router.get(
    "/v1/jobs/{job_id:name}/image.png",
    operation_id="getPreview",
    summary="Image as PNG",
    response_class=Response,
    responses=binary(PNG),
)
def image_png(
    job: ExistingJob, farm: FarmOf, request: Request, exposure: Exposure = 0.0, tone: Tone = "srgb"
) -> Response:
    """The image for a screen."""
    return _answer(request, job, PNG, lambda: pictures.preview_png(farm, job.id, exposure, tone))


@router.get(
    "/v1/jobs/{job_id:name}/error.exr",
    operation_id="getError",
    summary="Standard error as OpenEXR",
    response_class=Response,
    responses=binary(EXR),
)
def error_exr(job: ExistingJob, farm: FarmOf, request: Request) -> Response:
    """Standard error of each pixel, in the unit of the image, estimated from independent chunks."""
    return _answer(request, job, EXR, lambda: pictures.error_exr(farm, job.id))


@router.get(
    "/v1/jobs/{job_id:name}/error.png",
    operation_id="getErrorPreview",
    summary="Relative error as PNG",
    response_class=Response,
    responses=binary(PNG),
)
def error_png(job: ExistingJob, farm: FarmOf, request: Request) -> Response:
    """Relative standard error of each pixel in false colours: black is 1% and less, white 100% and more."""
    return _answer(request, job, PNG, lambda: pictures.error_png(farm, job.id))
