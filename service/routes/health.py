"""Whether the service lives, whether it can do its work, and who renders."""

from __future__ import annotations

from fastapi import APIRouter

from service.models import Health, WorkerList
from service.problems import Problem, responses
from service.routes.common import FarmOf

router = APIRouter(tags=["service"])


@router.get("/", operation_id="getIndex", summary="Where things are", responses=responses())
async def index() -> dict[str, str]:
    """Links to what a client starts from."""
    return {
        "openapi": "/openapi.json",
        "scenes": "/v1/scenes",
        "jobs": "/v1/jobs",
        "workers": "/v1/workers",
        "live": "/livez",
        "ready": "/readyz",
    }


@router.get("/livez", operation_id="getLive", summary="The process answers", responses=responses())
async def live() -> Health:
    """Answers as long as the process does; a supervisor restarts it otherwise."""
    return Health()


@router.get("/readyz", operation_id="getReady", summary="The service can take jobs", responses=responses())
def ready(farm: FarmOf) -> Health:
    """Answers 200 where the queue and the artefact store answer."""
    if not farm.ready():
        raise Problem("not-ready", "the queue or the artefact store does not answer: look into the service's log")
    return Health()


@router.get("/v1/workers", operation_id="listWorkers", summary="List workers", responses=responses())
def list_workers(farm: FarmOf) -> WorkerList:
    """Worker processes that were heard of recently."""
    return WorkerList(workers=farm.workers())
