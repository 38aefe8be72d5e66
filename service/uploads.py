"""Receiving a scene file: from the socket to a temporary file, and gone again afterwards.

The byte limit is not here: :class:`service.guard.Guard` counts what arrives, whatever its form.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import BinaryIO

from anyio import to_thread
from fastapi import Request
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException

from service.problems import Problem

RAW_TYPES = {
    "application/zip": ".zip",
    "application/x-zip-compressed": ".zip",
    "application/xml": ".xml",
    "text/xml": ".xml",
}
"""Content types of a body that is the file itself, with the suffix that such a file has."""
FORM_TYPE = "multipart/form-data"
FIELD = "file"
MAX_NAME = 100
"""Characters of the uploader's file name that are kept, to be shown."""


@asynccontextmanager
async def received(request: Request) -> AsyncIterator[tuple[Path, str]]:
    """The uploaded file on disk, with the name its sender gave it; removed at the end.

    Raises:
        Problem: another content type, or a form without the field ``file``.
    """
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type != FORM_TYPE and media_type not in RAW_TYPES:
        raise Problem(
            "unsupported-media-type",
            f"send the scene as {FORM_TYPE} with the field '{FIELD}', or as application/zip or application/xml",
        )
    with tempfile.TemporaryDirectory(prefix="elps-upload-") as folder:
        path = Path(folder) / "scene"
        name = f"scene{RAW_TYPES.get(media_type, '')}"
        with path.open("wb") as target:
            if media_type in RAW_TYPES:
                async for block in request.stream():
                    await to_thread.run_sync(target.write, block)
            else:
                name = await _from_form(request, target)
        yield path, name


async def _from_form(request: Request, target: BinaryIO) -> str:
    try:
        async with request.form(max_files=1, max_fields=0) as form:
            upload = form.get(FIELD)
            if isinstance(upload, UploadFile):
                await to_thread.run_sync(shutil.copyfileobj, upload.file, target)
                return _shown_name(upload.filename or "scene")
    except HTTPException as error:
        if isinstance(error, Problem):
            raise
    raise Problem("bad-request", f"send a form with one file in the field '{FIELD}' and nothing else")


def _shown_name(sent: str) -> str:
    """The last part of a path, printable and short."""
    last = sent.replace("\\", "/").rpartition("/")[2]
    return "".join(c for c in last if c.isprintable())[-MAX_NAME:] or "scene"
