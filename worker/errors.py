"""What goes wrong with the farm itself, as one line that a user or an operator can act on."""

from __future__ import annotations

from elps_core.errors import ElpsError


class FarmUnavailable(ElpsError):
    """Redis, the store or the queue does not answer: try again, or look at the deployment."""


class StoreUnavailable(FarmUnavailable):
    """The artefact store does not answer, or refuses the credentials."""


class StoreFull(FarmUnavailable):
    """The artefact store has no space left."""
