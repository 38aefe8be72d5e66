"""Jobs: creating, reading, following and cancelling them."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from starlette.exceptions import HTTPException

from service.conditional import etag, unchanged
from service.models import JobList, JobRequest
from service.problems import not_found, responses
from service.routes.common import ExistingJob, FarmOf, JobId, json_only
from worker.models import FINAL_STATES, Job

RETRY_MILLISECONDS = 1000
"""How long a client waits before it connects again: events are replayed, so soon costs nothing."""
MAX_LISTED = 200
"""Jobs in one answer."""

_ETAG = {"ETag": {"description": "The job's revision.", "schema": {"type": "string"}}}

router = APIRouter(tags=["jobs"])


@router.post(
    "/v1/jobs",
    operation_id="createJob",
    summary="Render a scene",
    status_code=202,
    dependencies=[json_only],
    responses={
        202: {"headers": {"Location": {"description": "The job.", "schema": {"type": "string"}}, **_ETAG}},
        **responses(
            "bad-request",
            "too-large",
            "unsupported-media-type",
            "invalid-input",
            "scene-rejected",
            "settings-rejected",
        ),
    },
)
def create_job(body: JobRequest, response: Response, farm: FarmOf) -> Job:
    """Queues a render; its state, events and images are found under the returned location."""
    job = farm.submit(body.scene, body.settings, body.stop, priority=body.priority, defines=body.defines)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    response.headers["ETag"] = etag(job.revision)
    return job


@router.get("/v1/jobs", operation_id="listJobs", summary="List jobs", responses=responses("invalid-input"))
def list_jobs(farm: FarmOf, limit: Annotated[int, Query(ge=1, le=MAX_LISTED)] = 50) -> JobList:
    """The newest jobs first."""
    return JobList(jobs=farm.jobs(limit))


@router.get(
    "/v1/jobs/{job_id:name}",
    operation_id="getJob",
    summary="Read a job",
    response_model=Job,
    responses={
        200: {"headers": _ETAG},
        304: {"description": "Nothing changed since the revision in If-None-Match"},
        **responses("not-found", "invalid-input"),
    },
)
def get_job(job: ExistingJob, request: Request, response: Response) -> Job | Response:
    """State, samples done, error estimate and context of a job."""
    tag = etag(job.revision)
    response.headers["ETag"] = tag
    response.headers["Cache-Control"] = "no-cache"
    return unchanged(request, tag) or job


@router.post(
    "/v1/jobs/{job_id:name}:cancel",
    operation_id="cancelJob",
    summary="Cancel a job",
    responses=responses("not-found", "invalid-input"),
)
def cancel_job(job_id: JobId, farm: FarmOf) -> Job:
    """Ends a job after its running chunks; it keeps its best image. Cancelling twice is harmless."""
    job = farm.cancel(job_id)
    if job is None:
        raise not_found("job")
    return job


LastEventId = Annotated[int, Header(ge=0, lt=2**53, description="The last event that the client has seen.")]


def _anything_left(job: ExistingJob, farm: FarmOf, last_event_id: LastEventId = 0) -> Job:
    """The job, unless it has ended and the client knows it: 204 tells an EventSource to stay away."""
    if job.state in FINAL_STATES and not farm.events(job.id, last_event_id):
        raise HTTPException(204)
    return job


@router.get(
    "/v1/jobs/{job_id:name}/events",
    operation_id="followJob",
    summary="Follow a job",
    response_class=EventSourceResponse,
    responses={
        204: {"description": "The job has ended and the client has seen its last event"},
        **responses("not-found", "invalid-input"),
    },
)
async def follow_job(
    job: Annotated[Job, Depends(_anything_left)], farm: FarmOf, last_event_id: LastEventId = 0
) -> AsyncIterator[ServerSentEvent]:
    """Server-sent events, numbered per job: state, context, progress and image.

    Everything after Last-Event-ID is replayed first. The stream ends after the event of the final
    state.
    """
    yield ServerSentEvent(retry=RETRY_MILLISECONDS)
    async for event in farm.follow(job.id, last_event_id):
        yield ServerSentEvent(id=str(event.id), event=event.type, data=event.data)
