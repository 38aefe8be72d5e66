"""Artefacts in an object store: a local folder, S3 or memory, chosen by URL.

Every key is written once and never changed, so a reader needs no lock and a second writer of the
same key has nothing to do. Compare-and-swap does not exist on local folders: what changes lives in
Redis (:mod:`worker.state`). Keys:

======================================  =====================================================
``scenes/{scene}.zip`` or ``.xml``      the upload as it came
``scenes/{scene}.json``                 its :class:`~worker.models.SceneRecord`; written last
``contexts/{context}.safetensors``      a global context
``contexts/{context}.json``             its :class:`~worker.models.ContextRecord`; written last
``contexts/{context}/{steps}``          checkpoint after so many steps; deleted once it is ready
``surroundings/{digest}/{context}``     empty: which contexts tell of a scene without its cameras
``chunks/{render}/{index}``             a rendered chunk
``images/{render}/{chunks}.exr``        the merged image of a set of chunks
``jobs/{job}/submitted``, ``/final``    the job's record as it began and as it ended
======================================  =====================================================
"""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import obstore
from obstore.exceptions import (
    AlreadyExistsError,
    BaseError,
    PermissionDeniedError,
    UnauthenticatedError,
)
from obstore.store import LocalStore, from_url

from elps_core.errors import SettingsRejected
from worker.errors import StoreFull, StoreUnavailable

_NO_SPACE = (f"os error {errno.ENOSPC}", f"os error {errno.EDQUOT}", "InsufficientStorage", "XMinioStorageFull")
"""How local folders and S3 servers say that they are full; obstore has no type of its own for it."""
_DIGEST_PREFIX = "sha256:"


def name(digest: str) -> str:
    """A digest as a part of a key: without its prefix, whose colon is awkward in file names."""
    return digest.removeprefix(_DIGEST_PREFIX)


def chunk_key(render: str, index: int) -> str:
    """Key of one chunk of a render digest."""
    return f"chunks/{name(render)}/{index}"


class Store:
    """Write-once artefacts under one URL. Safe between threads; open it anew after a fork."""

    def __init__(self, url: str) -> None:
        """Open ``file:///folder`` (created where absent), ``s3://bucket/prefix`` or ``memory:///``.

        Raises:
            SettingsRejected: a URL that names no store.
            StoreUnavailable: a local folder that cannot be created.
        """
        local: dict[str, Any] = {"mkdir": True} if url.startswith("file:") else {}
        try:
            self._store = from_url(url, **local)
        except OSError:
            raise StoreUnavailable("the folder of the artefact store cannot be created") from None
        except (BaseError, ValueError):
            raise SettingsRejected("store URL: use file:///folder, s3://bucket/prefix or memory:///") from None

    def put(self, key: str, data: bytes) -> bool:
        """Write ``data`` whole unless ``key`` exists; True where this call wrote it. Atomic.

        An answer of S3 that got lost makes the writer itself find the key there: False is no proof of
        another writer.

        Raises:
            StoreFull, StoreUnavailable: nothing was written.
        """
        with _typed_errors():
            try:
                # A multipart upload would ignore the mode, and with it the one winner.
                obstore.put(self._store, key, data, mode="create", use_multipart=False)
            except AlreadyExistsError:
                return False
        return True

    def get(self, key: str) -> bytes | None:
        """The bytes under ``key``, or None. Raises StoreUnavailable."""
        with _typed_errors():
            try:
                return bytes(obstore.get(self._store, key).bytes())
            except FileNotFoundError:
                return None

    def exists(self, key: str) -> bool:
        """Whether ``key`` was written. Raises StoreUnavailable."""
        with _typed_errors():
            try:
                obstore.head(self._store, key)
            except FileNotFoundError:
                return False
        return True

    def keys(self, prefix: str) -> list[str]:
        """Every key below the folder ``prefix``, in no order. Raises StoreUnavailable."""
        with _typed_errors():
            return [entry["path"] for batch in obstore.list(self._store, prefix) for entry in batch]

    def delete(self, key: str) -> None:
        """Forget ``key``; fine where it is already gone. Raises StoreUnavailable."""
        with _typed_errors():
            try:
                obstore.delete(self._store, key)
            except FileNotFoundError:
                return

    def fetch(self, key: str, folder: Path) -> Path | None:
        """A local file with the bytes of ``key``, for readers that map memory.

        The stored file itself where the store is a local folder, else a copy in ``folder``.
        Never write to it. Raises StoreUnavailable.
        """
        if isinstance(self._store, LocalStore) and self._store.prefix is not None:
            path = Path(self._store.prefix) / key
            return path if path.exists() else None
        data = self.get(key)
        if data is None:
            return None
        copy = folder / key.replace("/", "-")
        copy.write_bytes(data)
        return copy

    def check(self) -> None:
        """Ask the store for something. Raises StoreUnavailable where no answer comes."""
        self.exists("ready")


@contextmanager
def _typed_errors() -> Iterator[None]:
    try:
        yield
    except (PermissionDeniedError, UnauthenticatedError):
        raise StoreUnavailable("the artefact store refuses access: check its credentials and rights") from None
    except (BaseError, OSError) as error:
        text = str(error)
        if any(sign in text for sign in _NO_SPACE):
            raise StoreFull("the artefact store is full: free space or ask the operator") from None
        raise StoreUnavailable("the artefact store does not answer: try again later") from None
