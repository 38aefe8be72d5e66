"""Conditional and partial requests (RFC 9110, 13 and 14) for content that lies in memory."""

from __future__ import annotations

import re
from collections.abc import Mapping

from fastapi import Request, Response

from service.problems import Problem

_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})", re.ASCII)


def etag(revision: int | str) -> str:
    """The strong entity tag of a resource's revision."""
    return f'"{revision}"'


def unchanged(request: Request, tag: str) -> Response | None:
    """304 where the client already has what ``tag`` names, else None."""
    known = request.headers.get("if-none-match")
    if known is None:
        return None
    tags = {part.strip().removeprefix("W/") for part in known.split(",")}
    return Response(status_code=304, headers={"ETag": tag}) if tag in tags or "*" in tags else None


def content(request: Request, data: bytes, media_type: str, tag: str, headers: Mapping[str, str]) -> Response:
    """``data``, or the one range of it that was asked for.

    Several ranges, other units and what cannot be parsed are answered with the whole, as the RFC
    allows.

    Raises:
        Problem: the range starts behind the end.
    """
    shared = {**headers, "ETag": tag, "Accept-Ranges": "bytes", "Cache-Control": "no-cache"}
    span = _span(request.headers.get("range"), len(data))
    if span is None or request.headers.get("if-range", tag) != tag:
        return Response(data, headers=shared, media_type=media_type)
    first, last = span
    if first >= len(data):
        raise Problem(
            "range-not-satisfiable",
            f"ask for a range within the {len(data)} bytes",
            headers={"Content-Range": f"bytes */{len(data)}"},
        )
    shared["Content-Range"] = f"bytes {first}-{last}/{len(data)}"
    return Response(data[first : last + 1], 206, headers=shared, media_type=media_type)


def _span(header: str | None, size: int) -> tuple[int, int] | None:
    """First and last byte that a Range header names; the first may lie behind the end."""
    match = _RANGE.fullmatch(header.replace(" ", "")) if header else None
    if match is None or match[0] == "bytes=-":
        return None
    first, last = match.groups()
    if not first:  # the last n bytes
        return (max(size - int(last), 0), size - 1) if int(last) else (size, size)
    if last and int(last) < int(first):
        return None
    return int(first), min(int(last), size - 1) if last else size - 1
