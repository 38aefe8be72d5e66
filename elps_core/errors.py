"""Errors that a user can act on: one line, what to do, and nothing of the host."""

from __future__ import annotations


class ElpsError(Exception):
    """Base of every error that is shown to a user as it stands.

    The message is one line, says what to do, and contains neither a path of the host nor the
    content of a file.
    """


class DeviceUnavailable(ElpsError):
    """No usable rendering device: a variant or its backend library is missing or broken."""


class SceneRejected(ElpsError):
    """A scene upload or scene file that is malformed, hostile, too large or unsupported."""


class NothingScatters(SceneRejected):
    """A scene of mirrors, glass or emitters alone, of which no table can be made."""


class SettingsRejected(ElpsError):
    """Settings that are valid in form but name something unknown, unbuilt or contradictory."""


class ContextMismatch(ElpsError):
    """A global context that was built for another scene, sensor or format version."""


class RenderFailed(ElpsError):
    """Rendering stopped for a reason that lies in the scene (NaN camera, empty film ...)."""
