"""What a user is told about a scene. Imports no Mitsuba."""

from __future__ import annotations

from typing import Any, Literal

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


class FileDefaults(_Model):
    """What the scene file says of its render; settings of a job overrule it."""

    integrator: str | None = None
    """Its integrator, where it is a known one: it decides nothing but the values below."""
    max_depth: int | None = None
    """Longest path in segments; -1 is unlimited."""
    rr_depth: int | None = None
    hide_emitters: bool | None = None
    samples: int | None = None
    """Samples per pixel, for a job that does not say when to stop."""

    def settings(self) -> dict[str, Any]:
        """The settings of a render that it has values for, by name."""
        return self.model_dump(exclude={"integrator", "samples"}, exclude_none=True)


class Parameter(_Model):
    """A parameter of a scene, and the value that holds."""

    name: str
    value: str


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
    defaults: FileDefaults = FileDefaults()
    parameters: tuple[Parameter, ...] = ()
    """Those that can be set (``-D``)."""
    ignored: tuple[str, ...] = ()
    """Files of the bundle that no scene has a use for; they were left out."""
