"""What a user is told about a scene. Imports no Mitsuba."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict

PixelFormat = Literal["luminance", "luminance_alpha", "rgb", "rgba", "xyz", "xyza", "bands"]
"""What a film keeps of light: ``bands`` by the responses that the film names, the others as Mitsuba's films call it."""


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class FilmSummary(_Model):
    """What a film asks of the file that its image is written to."""

    pixels: PixelFormat = "rgb"
    half: bool = False
    """Whether numbers are to have 16 bits in place of 32."""

    @property
    def has_alpha(self) -> bool:
        """Whether there is a channel for what covers a pixel."""
        return self.pixels in ("luminance_alpha", "rgba", "xyza")


class SensorSummary(_Model):
    """A camera, and the size of its image in pixels."""

    type: str
    width: int
    height: int
    film: FilmSummary = FilmSummary()


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
