"""Global contexts: their statistics and the picture of where useful light starts."""

from __future__ import annotations

from collections.abc import Callable

from fastapi import APIRouter, Request, Response

from service.conditional import content, etag, unchanged
from service.problems import Problem, not_found, responses
from service.routes.common import Digest, FarmOf
from service.routes.images import EXR, PNG, binary
from worker import pictures
from worker.farm import Farm
from worker.models import ContextRecord

HEADERS = {"ETag": "Digest of the context, which never changes once it is built."}

router = APIRouter(tags=["contexts"])


@router.get(
    "/v1/contexts/{digest}",
    operation_id="getContext",
    summary="Describe a context",
    responses=responses("not-found", "invalid-input"),
)
def get_context(digest: Digest, farm: FarmOf) -> ContextRecord:
    """State, settings, cost and statistics of a global context."""
    record = farm.context(digest)
    if record is None:
        raise not_found("context")
    return record


def _answer(
    request: Request, farm: Farm, digest: str, media_type: str, produce: Callable[[Farm, str], bytes | None]
) -> Response:
    record = get_context(digest, farm)
    # A context never changes once it is built: its digest is its tag.
    known = unchanged(request, etag(digest)) if record.state == "ready" else None
    if known is not None:
        return known
    data = produce(farm, digest)
    if data is None:
        raise Problem("no-image", "the context is not built yet: follow the job that needs it")
    return content(request, data, media_type, etag(digest), {})


@router.get(
    "/v1/contexts/{digest}/adjoint.exr",
    operation_id="getAdjoint",
    summary="Adjoint image as OpenEXR",
    response_class=Response,
    responses=binary(EXR, HEADERS),
)
def adjoint_exr(digest: Digest, farm: FarmOf, request: Request) -> Response:
    """Flux of the image per cell of the light sources: columns run over emitters, rows over their surface."""
    return _answer(request, farm, digest, EXR, pictures.adjoint_exr)


@router.get(
    "/v1/contexts/{digest}/adjoint.png",
    operation_id="getAdjointPreview",
    summary="Adjoint image as PNG",
    response_class=Response,
    responses=binary(PNG, HEADERS),
)
def adjoint_png(digest: Digest, farm: FarmOf, request: Request) -> Response:
    """The adjoint image for a screen."""
    return _answer(request, farm, digest, PNG, pictures.adjoint_png)
