"""What a user is told about a scene. Imports no Mitsuba."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SensorSummary(_Model):
    """A camera, and the size of its image in pixels."""

    type: str
    width: int
    height: int


class EmitterSummary(_Model):
    """How many emitters of one class a scene has."""

    type: str
    count: int


class SceneSummary(_Model):
    """Counts and classes of a scene that was loaded."""

    sensors: tuple[SensorSummary, ...]
    """In the order of the scene file: the order that the setting ``sensor`` counts."""
    emitters: tuple[EmitterSummary, ...]
    bsdfs: tuple[str, ...]
    """Kinds of the materials on shapes, and of those that they are made of, sorted."""
    shapes: int
    """Shapes that the scene file names; Mitsuba may merge some."""
    triangles: int
    warnings: tuple[str, ...] = ()
