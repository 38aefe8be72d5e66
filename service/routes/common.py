"""What several routes need: the farm, and the resources that a path names."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Path, Request
from starlette.convertors import StringConvertor, register_url_convertor

from service.models import EXAMPLE_DIGEST
from service.problems import Problem, not_found
from worker.farm import Farm
from worker.models import Job


class _NameConvertor(StringConvertor):
    """A path segment without a colon, so that ``jobs/x:cancel`` is never the job called ``x:cancel``."""

    regex = "[^/:]+"


register_url_convertor("name", _NameConvertor())

JobId = Annotated[str, Path(description="The job's id, as its creation returned it.", examples=["01k9h3v2"])]
Digest = Annotated[str, Path(description="`sha256:` and 64 hexadecimal digits.", examples=[EXAMPLE_DIGEST])]


async def _farm(request: Request) -> Farm:
    farm = request.app.state.farm
    assert isinstance(farm, Farm)  # noqa: S101 (set by create_app)
    return farm


FarmOf = Annotated[Farm, Depends(_farm)]


def _existing_job(job_id: JobId, farm: FarmOf) -> Job:
    job = farm.job(job_id)
    if job is None:
        raise not_found("job")
    return job


ExistingJob = Annotated[Job, Depends(_existing_job)]


async def _json_only(request: Request) -> None:
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type != "application/json":
        raise Problem("unsupported-media-type", "send application/json")


json_only = Depends(_json_only)
"""Refuses a body of another content type, before its fields are looked at."""
