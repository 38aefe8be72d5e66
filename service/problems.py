"""Errors as RFC 9457 problem documents: one shape for everything that goes wrong.

A problem says what to do in one line and never quotes the host: no path, no traceback, no text of
a file, and nothing of the request beyond the names of its fields.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Mapping
from http import HTTPStatus
from typing import Any, NamedTuple

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Match

from elps_core.errors import ElpsError, SceneRejected, SettingsRejected
from worker.errors import FarmUnavailable

MEDIA_TYPE = "application/problem+json"
TYPE_PREFIX = "urn:elps:problem:"

MAX_FIELD_ERRORS = 20
"""Field errors listed in one problem; a hostile body can hold thousands."""
MAX_TEXT = 400
"""Characters of a line shown to the client; longer ones are cut."""
MAX_FIELD_NAME = 64
"""Characters of one name in a field path: names of unknown fields are the client's own text."""
RETRY_SECONDS = 5
"""What Retry-After proposes where the service is busy or its parts do not answer."""

log = logging.getLogger("elps.service")


class Kind(NamedTuple):
    """What a problem type means: its status and its title, the same at each occurrence."""

    status: int
    title: str


KINDS = {
    "bad-request": Kind(400, "The request cannot be read"),
    "foreign-origin": Kind(403, "Requests of other web sites are not served"),
    "not-found": Kind(404, "No such resource"),
    "no-image": Kind(404, "There is no image yet"),
    "method-not-allowed": Kind(405, "The resource has no such method"),
    "too-large": Kind(413, "The body is too large"),
    "unsupported-media-type": Kind(415, "The content type is not supported"),
    "range-not-satisfiable": Kind(416, "The range lies outside of the content"),
    "wrong-host": Kind(421, "The request was meant for another host"),
    "invalid-input": Kind(422, "The input is invalid"),
    "scene-rejected": Kind(422, "The scene was rejected"),
    "settings-rejected": Kind(422, "The settings were rejected"),
    "rejected": Kind(422, "The request was rejected"),
    "internal": Kind(500, "The service failed"),
    "busy": Kind(503, "The service is busy"),
    "not-ready": Kind(503, "The service is not ready"),
}
"""Every problem that the service reports, by the last part of its type."""

_BY_STATUS = {400: "bad-request", 404: "not-found", 405: "method-not-allowed", 413: "too-large"}
_DETAILS = {
    404: "no such path: see /openapi.json for those that exist",
    405: "use one of the methods that the Allow header lists",
}


class FieldError(BaseModel):
    """One field of the input that is wrong."""

    model_config = ConfigDict(extra="forbid")

    field: str
    """Where: ``body.settings.max_depth``, ``query.limit``."""
    message: str


class ProblemDetails(BaseModel):
    """An RFC 9457 problem document."""

    model_config = ConfigDict(extra="forbid")

    type: str
    """``urn:elps:problem:<kind>``; stable, made for programs."""
    title: str
    status: int
    detail: str
    """One line that says what to do."""
    errors: list[FieldError] | None = None
    """The fields that are wrong, where the input as a whole could be read."""


class Problem(HTTPException):
    """Ends a request with a problem document.

    It is an HTTPException so that the libraries below let it pass where they wrap other errors.
    """

    def __init__(
        self,
        kind: str,
        detail: str,
        *,
        errors: list[FieldError] | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(status_code=KINDS[kind].status, detail=detail, headers=headers)
        self.kind = kind
        self.errors = errors

    def response(self) -> Response:
        """The HTTP response that reports this problem."""
        known = KINDS[self.kind]
        document: dict[str, Any] = {
            "type": TYPE_PREFIX + self.kind,
            "title": known.title,
            "status": known.status,
            "detail": one_line(self.detail),
        }
        if self.errors is not None:
            document["errors"] = [error.model_dump() for error in self.errors]
        return Response(json.dumps(document), known.status, headers=self.headers, media_type=MEDIA_TYPE)


def one_line(text: str, limit: int = MAX_TEXT) -> str:
    """``text`` on a single line of at most ``limit`` characters."""
    flat = " ".join(text.split())
    return flat if len(flat) <= limit else flat[: limit - 3] + "..."


def busy(detail: str) -> Problem:
    """503 with the time after which to try again."""
    return Problem("busy", detail, headers={"Retry-After": str(RETRY_SECONDS)})


def not_found(what: str) -> Problem:
    """404 for a resource that is named by its kind, not by the text that the client sent."""
    return Problem("not-found", f"no such {what}: check its name")


def responses(*kinds: str) -> dict[int | str, dict[str, Any]]:
    """OpenAPI responses that document problems, for the ``responses`` argument of a route."""
    documented: dict[int | str, dict[str, Any]] = {}
    for kind in (*kinds, "foreign-origin", "wrong-host", "internal", "not-ready"):
        status, title = KINDS[kind]
        content = documented.setdefault(
            status,
            {
                "description": HTTPStatus(status).phrase,
                "content": {
                    MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/ProblemDetails"}, "examples": {}},
                },
            },
        )
        example = {"type": TYPE_PREFIX + kind, "title": title, "status": status, "detail": title.lower()}
        content["content"][MEDIA_TYPE]["examples"][kind] = {"value": example}
    return documented


def add_handlers(app: FastAPI) -> None:
    """Makes the application answer with problem documents only."""
    app.add_exception_handler(HTTPException, _on_http)
    app.add_exception_handler(RequestValidationError, _on_validation)
    app.add_exception_handler(ElpsError, _on_rejection)
    app.add_exception_handler(ClientDisconnect, _on_disconnect)
    app.add_exception_handler(Exception, _on_failure)


async def _on_http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)  # noqa: S101 (what the handler is registered for)
    if isinstance(error, Problem):
        return error.response()
    if error.status_code < HTTPStatus.BAD_REQUEST:
        return Response(status_code=error.status_code, headers=error.headers)
    headers = dict(error.headers or {})
    if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
        headers["Allow"] = ", ".join(_methods(request))
    kind = _BY_STATUS.get(error.status_code, "bad-request")
    detail = _unreadable(error.__cause__) or _DETAILS.get(error.status_code, KINDS[kind].title.lower())
    return Problem(kind, detail, headers=headers).response()


def _unreadable(cause: BaseException | None) -> str | None:
    """What to do about a body that the libraries could not parse."""
    if isinstance(cause, RecursionError):
        return "the JSON is nested too deeply: send the fields that the interface names"
    if isinstance(cause, UnicodeDecodeError):
        return "send JSON in UTF-8"
    if isinstance(cause, ValueError):
        return "the body cannot be parsed: send JSON with numbers of ordinary size"
    return None


def _methods(request: Request) -> Iterable[str]:
    """The methods that the path of ``request`` has, over all routes (each route knows its own only)."""
    for method in ("GET", "POST", "PUT", "DELETE"):
        scope = {**request.scope, "method": method}
        if any(route.matches(scope)[0] is Match.FULL for route in request.app.routes):
            yield method


async def _on_validation(_request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)  # noqa: S101
    entries = error.errors()
    if any(entry["type"] == "json_invalid" for entry in entries):
        return Problem("bad-request", "the body is not valid JSON: send one JSON object").response()
    fields = [_field_error(entry) for entry in entries[:MAX_FIELD_ERRORS]]
    detail = f"{fields[0].field}: {fields[0].message}"
    if len(entries) > 1:
        detail += f" (and {len(entries) - 1} more)"
    return Problem("invalid-input", detail, errors=fields).response()


def _field_error(entry: Mapping[str, Any]) -> FieldError:
    names = (one_line(str(part), MAX_FIELD_NAME) for part in entry["loc"])
    message = str(entry["msg"]).removeprefix("Value error, ")
    if entry["type"] == "extra_forbidden":
        message = "unknown field: remove it or correct its name"
    return FieldError(field=".".join(names), message=one_line(message))


async def _on_rejection(_request: Request, error: Exception) -> Response:
    if isinstance(error, FarmUnavailable):
        log.error("the farm does not answer: %s", error)
        return Problem("not-ready", str(error), headers={"Retry-After": str(RETRY_SECONDS)}).response()
    kind = "rejected"
    if isinstance(error, SceneRejected):
        kind = "scene-rejected"
    elif isinstance(error, SettingsRejected):
        kind = "settings-rejected"
    return Problem(kind, str(error)).response()


async def _on_disconnect(_request: Request, _error: Exception) -> Response:
    # Nobody reads this; without it the log would call a sender that hung up a failure of ours.
    return Problem("bad-request", "send the whole body").response()


async def _on_failure(_request: Request, _error: Exception) -> Response:
    # The server below logs the traceback; the client gets none of it.
    return Problem("internal", "try again; if it stays, look into the log of the service").response()
