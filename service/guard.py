"""What every request passes before it meets a route: body limits, and nobody but this machine.

Without keys, anyone who reaches the socket may use the service. It listens on the loopback
interface only, but a web page that is open in a browser on the same machine can still send
requests there: under its own name (Origin), or by a name of its own that resolves to 127.0.0.1
(Host). Both are refused.
"""

from __future__ import annotations

from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.problems import Problem
from service.settings import ServiceSettings

LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
UPLOAD_PATH = "/v1/scenes"


class Guard:
    """ASGI middleware that applies the limits of :class:`ServiceSettings` to every request."""

    def __init__(self, app: ASGIApp, settings: ServiceSettings) -> None:
        self._app = app
        self._settings = settings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes the request on, or answers it with a problem."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limit = self._settings.max_upload_bytes if scope["path"] == UPLOAD_PATH else self._settings.max_json_bytes
        too_large = Problem("too-large", f"send at most {limit} bytes", headers={"Connection": "close"})
        headers = Headers(scope=scope)
        received = 0

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > limit:
                raise too_large
            return message

        async def careful(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)["X-Content-Type-Options"] = "nosniff"
            await send(message)

        refusal = _foreign(headers)
        if refusal is None and _declared_length(headers) > limit:
            refusal = too_large
        if refusal is not None:
            await refusal.response()(scope, receive, careful)
            return
        await self._app(scope, counted, careful)


def _foreign(headers: Headers) -> Problem | None:
    if _host_name(f"//{headers.get('host', '')}") not in LOOPBACK_NAMES:
        return Problem("wrong-host", "address the service as 127.0.0.1 or localhost")
    origin = headers.get("origin")
    if origin is not None and _host_name(origin) not in LOOPBACK_NAMES:
        return Problem("foreign-origin", "open the service from this machine, not from another web site")
    return None


def _declared_length(headers: Headers) -> float:
    """Content-Length in bytes, 0 where it is absent or no number (then the bytes are counted)."""
    text = headers.get("content-length", "")
    # As a float: an int of thousands of digits raises.
    return float(text) if text.isascii() and text.isdigit() else 0.0


def _host_name(url: str) -> str | None:
    try:
        return urlsplit(url).hostname
    except ValueError:
        return None
