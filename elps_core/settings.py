"""What a render is asked to do: JSON in, JSON out. Imports no Mitsuba.

These models are the vocabulary that the command line, the HTTP API and the workers share. Fields
that change the expected cost but not the expected image are kept out of the digests where that
lets jobs share work (see :mod:`elps_core.scene.digest`).
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from elps_core.errors import SettingsRejected

Variant = Literal["llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral", "cuda_ad_rgb", "cuda_ad_mono", "cuda_ad_spectral"]
LightSampling = Literal["uniform", "power", "adjoint"]
DirectionSampling = Literal["scattering", "context"]
Roulette = Literal["none", "throughput", "albedo", "context"]

MAX_DEPTH = 256
"""Longest path in segments. Walks store every light vertex, so memory grows with it."""
MAX_PIXELS_SIDE = 16384
"""Largest film side in pixels that the settings accept; services set tighter limits."""

BUILT_INTEGRATORS = ("bdpt",)
"""Integrators of our own that exist; ``mi_<name>`` names any integrator plugin of Mitsuba."""
MITSUBA_BASELINES = ("path", "volpath", "volpathmis", "ptracer", "prb", "prbvolpath", "direct", "depth")
"""Mitsuba integrators that may be named as ``mi_<name>``."""
NOT_BUILT: dict[tuple[str, str], str] = {
    ("integrator", "path"): "integrator 'path' is not built yet: use 'bdpt' or 'mi_path'",
    ("integrator", "light"): "integrator 'light' is not built yet: use 'bdpt' or 'mi_ptracer'",
    ("integrator", "pssmlt"): "integrator 'pssmlt' is not built yet: use 'bdpt'",
    ("integrator", "auto"): "integrator 'auto' is not built yet: use 'bdpt' or 'mi_path'",
    ("direction_sampling", "context"): "direction sampling 'context' is not built yet: use 'scattering'",
    ("roulette", "context"): "roulette 'context' is not built yet: use 'albedo', 'throughput' or 'none'",
}
"""What the contract names and this version refuses, with the line that is shown."""


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class ContextSettings(_Model):
    """How the global context of a scene is measured.

    Everything here enters the context's digest, so that jobs that agree on it share one context.
    """

    resolution: Annotated[int, Field(ge=4, le=1024)] = 64
    """Cells along each side of the adjoint image; columns round up to a multiple of the emitters."""
    samples_per_cell: Annotated[int, Field(ge=1, le=4096)] = 64
    """Mean number of light paths per cell of the adjoint image, over all passes."""
    epsilon: Annotated[float, Field(gt=0.0, le=1.0)] = 0.05
    """Share of the start density that follows emitted power, so that every cell keeps a chance."""
    exponent: Annotated[float, Field(gt=0.0, le=1.0)] = 0.75
    """Power to which the adjoint image is raised before light vertices are drawn from it; the thesis
    has 1. Below 1 the density is fairer to pixels that are lit by what matters little on the whole:
    on the maze the relative variance is 0.73 at 1, 0.67 at 0.85 and 0.7, 0.75 at 0.5."""
    max_depth: Annotated[int, Field(ge=2, le=MAX_DEPTH)] = 16
    """Longest path measured, in segments."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Random stream of the preprocessing pass."""


class RenderSettings(_Model):
    """Which image, by which algorithm. Does not say how long: see :class:`StopCriterion`."""

    integrator: str = "bdpt"
    """``bdpt``, or ``mi_<name>`` for an integrator plugin of Mitsuba (``mi_path`` is the baseline)."""
    light_sampling: LightSampling = "adjoint"
    """Density of the first light vertex and of next event estimation."""
    direction_sampling: DirectionSampling = "scattering"
    roulette: Roulette = "albedo"
    rr_depth: Annotated[int, Field(ge=1, le=MAX_DEPTH)] = 5
    """Path depth (segments) from which on Russian roulette may end a walk."""
    max_depth: Annotated[int, Field(ge=1, le=MAX_DEPTH)] = 16
    """Longest path in segments, as Mitsuba counts: 1 is directly visible emission only."""
    sensor: Annotated[int, Field(ge=0)] = 0
    width: Annotated[int, Field(ge=1, le=MAX_PIXELS_SIDE)] | None = None
    """Film width in pixels; the scene's own where absent. Width and height come together."""
    height: Annotated[int, Field(ge=1, le=MAX_PIXELS_SIDE)] | None = None
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    variant: Variant = "llvm_ad_rgb"
    context: ContextSettings = ContextSettings()

    @model_validator(mode="after")
    def _check(self) -> RenderSettings:
        for (field, value), message in NOT_BUILT.items():
            if getattr(self, field) == value:
                raise ValueError(message)
        name = self.integrator
        known = name in BUILT_INTEGRATORS or (name.startswith("mi_") and name[3:] in MITSUBA_BASELINES)
        if not known:
            names = ", ".join([*BUILT_INTEGRATORS, *(f"mi_{n}" for n in MITSUBA_BASELINES)])
            raise ValueError(f"unknown integrator: choose one of {names}")
        if (self.width is None) != (self.height is None):
            raise ValueError("give both width and height, or neither")
        return self

    @property
    def needs_context(self) -> bool:
        """Whether the render samples with a global context that must exist first."""
        return not self.integrator.startswith("mi_") and self.light_sampling == "adjoint"


class StopCriterion(_Model):
    """When a render is finished: at the first of the given limits. At least one must be given."""

    samples: Annotated[int, Field(ge=1, le=2**24)] | None = None
    """Samples per pixel."""
    seconds: Annotated[float, Field(gt=0.0, le=30 * 24 * 3600.0)] | None = None
    """Wall-clock seconds with everything counted: loading, context, compilation, rendering."""
    error: Annotated[float, Field(gt=0.0, le=10.0)] | None = None
    """Relative error of the image as :func:`elps_core.estimate.stats.relative_error` defines it."""

    @model_validator(mode="after")
    def _some_limit(self) -> StopCriterion:
        if self.samples is None and self.seconds is None and self.error is None:
            raise ValueError("give at least one of samples, seconds, error")
        return self


def first_problem(error: ValidationError) -> str:
    """One line for a user from a pydantic error: the field, and what is wrong with it."""
    entry = error.errors(include_url=False, include_context=False)[0]
    where = ".".join(str(part) for part in entry["loc"])
    text = str(entry["msg"]).removeprefix("Value error, ")
    return f"{where}: {text}" if where else text


def with_overrides(settings: RenderSettings, assignments: dict[str, Any]) -> RenderSettings:
    """A copy of ``settings`` with dotted names (``context.resolution``) set to new values.

    Raises:
        SettingsRejected: an unknown name, or a value that the models refuse.
    """
    data = settings.model_dump()
    for dotted, value in assignments.items():
        *parents, leaf = dotted.split(".")
        target: Any = data
        for name in parents:
            target = target.get(name) if isinstance(target, dict) else None
        if not isinstance(target, dict) or leaf not in target:
            raise SettingsRejected(f"unknown setting '{dotted}'")
        target[leaf] = value
    try:
        return RenderSettings.model_validate(data)
    except ValidationError as error:
        raise SettingsRejected(first_problem(error)) from None
