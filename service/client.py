"""A small client of the HTTP interface, for the command line and for scripts."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import httpx

from elps_core.errors import ElpsError
from elps_core.settings import RenderSettings, StopCriterion
from service.models import WorkerList
from worker.models import FINAL_STATES, Event, Job, SceneRecord, WorkerInfo

DEFAULT_URL = "http://127.0.0.1:8000"
TIMEOUT = httpx.Timeout(30.0, write=None)
"""Seconds; uploads may take as long as they take."""
CHECK_TIMEOUT = 300.0
"""Seconds to wait for the check of an uploaded scene, which loads it."""
SILENCE = 40.0
"""Seconds without a byte after which an event stream counts as broken; the service pings every 15 s."""
GIVE_UP = 30.0
"""Seconds without any answer after which following a job ends with an error."""
NO_IMAGE = "urn:elps:problem:no-image"
"""Type of the problem that means: not yet."""
PAUSE = 0.5
"""Seconds between two attempts to connect again."""


class ServiceError(ElpsError):
    """The service refused a request or did not answer; the message is the problem's own line."""


class Unreachable(ServiceError):
    """Nothing answers where the service should be."""


class Client:
    """Scenes, jobs, events and images of one service.

    Every method raises :class:`ServiceError` where the service refuses or cannot be reached.
    """

    def __init__(self, url: str = DEFAULT_URL) -> None:
        self.url = url.rstrip("/")
        # The proxies of the environment have no business between two ends of one machine.
        self._http = httpx.Client(base_url=self.url, timeout=TIMEOUT, trust_env=False)

    def __enter__(self) -> Client:
        """The client itself; leaving closes its connections."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._http.close()

    def upload(self, scene: Path) -> SceneRecord:
        """Sends a .zip or an .xml file and returns the scene's record."""
        media_type = "application/xml" if scene.suffix.lower() == ".xml" else "application/zip"
        with scene.open("rb") as file:
            answer = self._send(
                "POST",
                "/v1/scenes",
                files={"file": (scene.name, file, media_type)},
                timeout=httpx.Timeout(CHECK_TIMEOUT, write=None),
            )
        return SceneRecord.model_validate_json(answer.content)

    def submit(
        self,
        scene: str,
        settings: RenderSettings,
        stop: StopCriterion | None,
        priority: int = 0,
        defines: Mapping[str, str] | None = None,
    ) -> Job:
        """Creates a job for the scene with that digest; what is left open here, the scene file may say."""
        body: dict[str, Any] = {
            "scene": scene,
            "settings": settings.model_dump(mode="json", exclude_none=True, exclude_unset=True),
            "priority": priority,
            "defines": dict(defines or {}),
        }
        if stop is not None:
            body["stop"] = stop.model_dump(mode="json", exclude_none=True)
        return Job.model_validate_json(self._send("POST", "/v1/jobs", json=body).content)

    def job(self, job_id: str) -> Job:
        """Where the job stands."""
        return Job.model_validate_json(self._send("GET", f"/v1/jobs/{job_id}").content)

    def cancel(self, job_id: str) -> Job:
        """Cancels the job."""
        return Job.model_validate_json(self._send("POST", f"/v1/jobs/{job_id}:cancel").content)

    def workers(self) -> list[WorkerInfo]:
        """The workers that were heard of recently."""
        return WorkerList.model_validate_json(self._send("GET", "/v1/workers").content).workers

    def image(self, job_id: str, known: int = 0) -> tuple[int, bytes] | None:
        """Revision and EXR of the job's newest image; None without one, or where ``known`` is its revision."""
        answer = self._send("GET", f"/v1/jobs/{job_id}/image.exr", headers={"If-None-Match": f'"{known}"'}, none=True)
        return (int(answer.headers["Elps-Revision"]), answer.content) if answer.is_success else None

    def file(self, path: str, **query: str | float) -> bytes:
        """The content of a path such as ``/v1/jobs/{id}/image.exr``."""
        return self._send("GET", path, params=query).content

    def follow(self, job_id: str, after: int = 0) -> Iterator[Event]:
        """Events of the job until it has ended; connects again where the stream breaks and misses none."""
        answered = time.monotonic()
        while True:
            try:
                for event in self._stream(job_id, after):
                    after, answered = event.id, time.monotonic()
                    yield event
                if self.job(job_id).state in FINAL_STATES:
                    return
                answered = time.monotonic()
            except (httpx.TransportError, Unreachable) as error:
                if time.monotonic() - answered > GIVE_UP:
                    raise Unreachable(f"the service at {self.url} stopped answering") from error
            time.sleep(PAUSE)

    def _stream(self, job_id: str, after: int) -> Iterator[Event]:
        headers = {"Last-Event-ID": str(after), "Accept": "text/event-stream"}
        timeout = httpx.Timeout(SILENCE)
        with self._http.stream("GET", f"/v1/jobs/{job_id}/events", headers=headers, timeout=timeout) as answer:
            if answer.is_error:
                answer.read()
                raise _refused(answer)
            fields: dict[str, str] = {}
            for line in answer.iter_lines():
                if line:
                    name, _, value = line.partition(":")
                    fields[name] = value.removeprefix(" ")
                    continue
                if {"id", "event", "data"} <= fields.keys():
                    yield Event.model_validate(
                        {"id": int(fields["id"]), "type": fields["event"], "data": json.loads(fields["data"])}
                    )
                fields = {}

    def _send(self, method: str, path: str, *, none: bool = False, **arguments: Any) -> httpx.Response:
        """The answer; one that has no content yet (304, or 404 for an image) is an error unless ``none``."""
        try:
            answer = self._http.request(method, path, **arguments)
        except httpx.TransportError as error:
            raise Unreachable(f"no service answers at {self.url}: start one with 'elps serve'") from error
        nothing_yet = none and (answer.status_code == httpx.codes.NOT_FOUND and _field(answer, "type") == NO_IMAGE)
        if answer.is_error and not nothing_yet:
            raise _refused(answer)
        return answer


def _refused(answer: httpx.Response) -> ServiceError:
    return ServiceError(_field(answer, "detail") or f"the service answered with status {answer.status_code}")


def _field(answer: httpx.Response, name: str) -> str | None:
    """A field of a problem document; None where the answer is something else."""
    try:
        document = answer.json()
    except ValueError:
        return None
    value = document.get(name) if isinstance(document, dict) else None
    return value if isinstance(value, str) else None
