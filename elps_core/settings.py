"""What a render is asked to do: JSON in, JSON out. Imports no Mitsuba.

These models are the vocabulary that the command line, the HTTP API and the workers share. Fields
that change the expected cost but not the expected image are kept out of the digests where that
lets jobs share work (see :mod:`elps_core.scene.digest`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from elps_core.errors import SettingsRejected

Variant = Literal["llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral", "cuda_ad_rgb", "cuda_ad_mono", "cuda_ad_spectral"]
LightSampling = Literal["uniform", "power", "adjoint", "context"]
DirectionSampling = Literal["scattering", "context"]
Roulette = Literal["none", "throughput", "albedo", "context"]
ParticleSource = Literal["walks", "classical", "bidirectional", "metropolis"]
TableEncoding = Literal["float32", "float16", "log8"]
HeuristicKind = Literal["balance", "power", "maximum", "cutoff"]

MAX_DEPTH = 256
"""Longest path in segments. Walks store every light vertex, so memory grows with it."""
UNLIMITED = -1
"""What ``max_depth`` is where roulette alone ends paths, as Mitsuba has it."""
ENDLESS = 2**32 - 1
"""Segments that no path has: what depths are compared with where there is no limit."""
MAX_PIXELS_SIDE = 16384
"""Largest film side in pixels that the settings accept; services set tighter limits."""

BUILT_INTEGRATORS = ("path", "light", "bdpt", "pssmlt")
"""Integrators of our own that exist; ``mi_<name>`` names any integrator plugin of Mitsuba."""
DEPTH_BASELINES = ("path", "volpath", "volpathmis", "ptracer", "prb", "prbvolpath")
"""Mitsuba integrators that take ``max_depth`` and ``rr_depth``."""
MITSUBA_BASELINES = (*DEPTH_BASELINES, "direct", "depth")
"""Mitsuba integrators that may be named as ``mi_<name>``."""
INTEGRATORS = ("auto", *BUILT_INTEGRATORS, *(f"mi_{name}" for name in MITSUBA_BASELINES))
"""All that the setting ``integrator`` takes."""
HIDING = ("auto", "path", "mi_path", "mi_volpath", "mi_volpathmis", "mi_direct")
"""Integrators that can hide emitters from the camera."""
USUAL_PATHS, MOST_PATHS = 2**21, 2**23
"""Paths for the tables of a render without a limit of time, and at most: with more, tables hardly gain."""
LONGEST = 4096.0
"""Seconds of a job above which its context is given no more."""
PREPARATION = 0.25
"""Part of a job's time that preparing may take."""

_STRATEGIES = re.compile(r"^(all|[0-9]{1,3},[0-9]{1,3}( [0-9]{1,3},[0-9]{1,3}){0,255})$")
PRESETS: dict[str, dict[str, Any]] = {
    "enlightened": {"integrator": "auto"},
    "thesis": {
        "integrator": "bdpt",
        "direction_sampling": "context",
        "table_share": 0.5,
        "roulette": "context",
        "rr_depth": 1,
        "bdpt": {"guided_light": True},
        "context": {
            "particles": "metropolis",
            "regions": 16384,
            "rows": 16,
            "columns": 32,
            "exponent": 1.0,
            "adaptive": False,
        },
    },
}
"""Settings by name, which those that are given change: ours, and what the thesis measured [thesis 5.4.3]."""
VISIBLE = (0, 2)
"""The one strategy (s, t) of bidirectional path tracing for light that the sensor sees directly."""
_VERTICES = 3
"""Vertices of a path that meets a surface, at least."""


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class ContextSettings(_Model):
    """How the global context of a scene is measured.

    Everything here enters the context's digest, so that jobs that agree on it share one context.
    """

    resolution: Annotated[int, Field(ge=4, le=1024)] = 64
    """Cells along each side of the adjoint image; columns round up to a multiple of the emitters."""
    samples_per_cell: Annotated[int, Field(ge=1, le=4096)] = 16
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
    regions: Annotated[int, Field(ge=0, le=2**16)] = 2048
    """Regions that the surfaces are divided into, each with its tables of directions; 0: no tables at all. Twice as
    many had 8% less variance a sample at the door, and took seconds more to fill."""
    rows: Annotated[int, Field(ge=2, le=256)] = 32
    """Cells of a table from pole to pole, of equal solid angle."""
    columns: Annotated[int, Field(ge=4, le=512)] = 64
    """Cells of a table around."""
    particles: ParticleSource = "walks"
    """What fills the tables: the records that guided eye and light paths leave, or particles of one of three kinds."""
    paths: Annotated[int, Field(ge=1024, le=2**32)] | None = None
    """Paths that are traced for the tables, of each kind, unless the tables have converged before. Absent: as many as
    the time allows, or without one as many as a render of a minute can use."""
    seconds: Annotated[float, Field(gt=0.0)] | None = None
    """Length of the jobs that the context is made for, a power of two: its builder is given a quarter of a job's time,
    and takes what it needs of it. Absent: it is given as long as it takes. See :func:`suited`."""
    tolerance: Annotated[float, Field(ge=0.0, le=1.0)] = 0.05
    """Relative error of the sums of all regions at which no more paths are traced, and neither where those last traced
    have won little; 0: all are traced."""
    encoding: TableEncoding = "log8"
    """How a file keeps the tables."""
    adaptive: bool = True
    """Whether trials are made with the tables, so that renders use these only where they pay."""
    thorough: bool = False
    """Whether tables are filled to the end where ``auto`` will not use them, too. Renders that use them whatever else
    is better, such as ``path`` with directions by context, ask for it by themselves."""

    def without_tables(self) -> ContextSettings:
        """What the adjoint image alone depends on, so that all who want no more share it."""
        fields = ("resolution", "samples_per_cell", "epsilon", "exponent", "max_depth", "seed")
        return ContextSettings(regions=0, adaptive=False, **{name: getattr(self, name) for name in fields})


class PathSettings(_Model):
    """Unidirectional path tracing from the sensor."""

    next_event: bool = True
    """Whether every vertex is also joined to a light point; without it only paths that meet an emitter count."""


class LightSettings(_Model):
    """Path tracing from the lights."""

    connect: bool = True
    """Whether every vertex is joined to the sensor; without it only paths that meet its aperture count."""


class BdptSettings(_Model):
    """Which strategies of bidirectional path tracing are shown: a tool to look into a render."""

    strategies: Annotated[str, Field(json_schema_extra={"pattern": _STRATEGIES.pattern})] = "all"
    """``all``, or pairs s,t of numbers of light and eye vertices, such as ``1,3`` or ``0,4 2,2``; kept in order."""
    weighted: bool = True
    """Whether the strategies keep their weights among all; without, each is the whole of its paths' light."""

    @field_validator("strategies")
    @classmethod
    def _in_order(cls, text: str) -> str:
        if not _STRATEGIES.fullmatch(text):
            raise ValueError("give 'all' or pairs s,t of light and eye vertices, for example '1,3' or '0,4 2,2'")
        return text if text == "all" else " ".join(f"{s},{t}" for s, t in sorted(_pairs(text)))

    @model_validator(mode="after")
    def _check(self) -> BdptSettings:
        if self.strategies == "all" and not self.weighted:
            raise ValueError("without weights every strategy is a whole image: choose strategies to show")
        return self

    eye_paths: Literal[1, 4, 16] = 1
    """Eye paths for each light path. Where light paths help little they should cost little."""
    joins: bool = True
    """Whether eye and light paths are joined in the middle. Without, light paths bring to the sensor what they meet,
    caustics above all, and cost a fraction."""
    guided_light: bool = False
    """Whether context also guides light paths, here and in pssmlt, where it guides eye paths. On the door and the maze,
    with 16 eye paths for one, it cost more time than it saved noise."""

    def pairs(self) -> frozenset[tuple[int, int]] | None:
        """The chosen (s, t); None for all."""
        return None if self.strategies == "all" else _pairs(self.strategies)


def _pairs(text: str) -> frozenset[tuple[int, int]]:
    return frozenset((int(s), int(t)) for s, t in (pair.split(",") for pair in text.split()))


class PssmltSettings(_Model):
    """Metropolis light transport in primary sample space."""

    over: Literal["bdpt", "unjoined", "path"] | None = None
    """Whose samples the states of chains are: an eye path, a pair of paths that bdpt would join, or one whose light
    path only brings to the sensor what it meets. A pair costs more, and finds what eye paths alone seldom meet. Absent:
    of those that trials found the most efficient where there are trials, else of bdpt."""
    multiplexed: bool = False
    """Whether a state is a path by one strategy, which is faster, in place of all strategies of a pair of paths.
    On Veach's bidirectional scene 13 times as efficient as ``mi_path`` at equal time; without, 64 times."""
    large_step: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5
    """Probability of an independent proposal [thesis 5.4]."""
    bootstrap: Annotated[int, Field(ge=1024, le=2**22)] = 65536
    """Independent paths from which the initial states of a chunk are drawn, and its mean brightness."""
    chains: Annotated[int, Field(ge=1, le=2**18)] = 65536
    """Chains side by side in one chunk."""

    @model_validator(mode="after")
    def _check(self) -> PssmltSettings:
        if self.multiplexed and self.over in ("path", "unjoined"):
            raise ValueError("multiplexed: strategies are those of bdpt: leave pssmlt.over, or pssmlt.multiplexed")
        return self


class RenderSettings(_Model):
    """Which image, by which algorithm. Does not say how long: see :class:`StopCriterion`."""

    preset: Annotated[str, Field(json_schema_extra={"enum": sorted(PRESETS)})] | None = None
    """``enlightened`` or ``thesis``: values for all that is not given."""
    integrator: Annotated[str, Field(json_schema_extra={"enum": list(INTEGRATORS)})] = "auto"
    """``path``, ``light``, ``bdpt`` or ``pssmlt``; ``auto`` for the best of path and bdpt, plain and enlightened, by
    trials; or ``mi_<name>`` for an integrator of Mitsuba's own."""
    light_sampling: LightSampling = "adjoint"
    """Density of the first light vertex and of next event estimation. Three are one for the whole scene; ``context``
    has a table for each region besides the adjoint image, as paths have whose directions go by context, and pays where
    many lamps shine, most of them elsewhere."""
    direction_sampling: DirectionSampling = "scattering"
    table_share: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    """Chance of a direction from the context's table, where directions go by context; a half in the thesis [5.3.3].
    Absent: of eye paths what was best in each region when the tables were filled, if paths have filled them."""
    roulette: Roulette = "albedo"
    rr_depth: Annotated[int, Field(ge=1, le=MAX_DEPTH)] = 5
    """Path depth (segments) from which on Russian roulette may end a walk; where roulette by context pays for what it
    ends, the second one at the latest."""
    max_depth: Annotated[int, Field(ge=UNLIMITED, le=MAX_DEPTH)] = 16
    """Longest path in segments, as Mitsuba counts: 1 is directly visible emission only; -1 is no limit, so that
    roulette alone ends paths. Where light paths are kept to be joined, or chains have a number for every vertex, paths
    of more than 256 segments are left out then."""
    hide_emitters: bool = False
    """Whether the camera sees no emitters: it sees what is behind those with a surface, and black for the environment.
    Of our own integrators ``path`` and ``auto`` can, where no light paths reach the camera."""
    heuristic: HeuristicKind = "power"
    """How strategies that can make the same path share its light [thesis 3.7.1]."""
    path: PathSettings = PathSettings()
    light: LightSettings = LightSettings()
    bdpt: BdptSettings = BdptSettings()
    pssmlt: PssmltSettings = PssmltSettings()
    sensor: Annotated[int, Field(ge=0)] = 0
    width: Annotated[int, Field(ge=1, le=MAX_PIXELS_SIDE)] | None = None
    """Film width in pixels; the scene's own where absent. Width and height come together."""
    height: Annotated[int, Field(ge=1, le=MAX_PIXELS_SIDE)] | None = None
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    variant: Variant = "llvm_ad_rgb"
    context: ContextSettings = ContextSettings()

    @model_validator(mode="before")
    @classmethod
    def _of_preset(cls, data: Any) -> Any:
        name = data.get("preset") if isinstance(data, dict) else None
        if not isinstance(name, str):
            return data
        if name not in PRESETS:
            known = ", ".join(sorted(PRESETS))
            raise ValueError(f"unknown preset{_similar(str(name), PRESETS)}: choose one of {known}")
        merged = dict(PRESETS[name])
        for field, value in data.items():
            both = isinstance(value, dict) and isinstance(merged.get(field), dict)
            merged[field] = merged[field] | value if both else value
        return merged

    @model_validator(mode="after")
    def _check(self) -> RenderSettings:
        if self.integrator not in INTEGRATORS:
            raise ValueError(
                f"unknown integrator{_similar(self.integrator, INTEGRATORS)}: choose one of {', '.join(INTEGRATORS)}"
            )
        if self.max_depth == 0:
            raise ValueError("max_depth: give 1 or more segments, or -1 for no limit")
        if self.max_depth == UNLIMITED:
            self._check_unlimited()
        most = (MAX_DEPTH if self.max_depth == UNLIMITED else self.max_depth) + 1
        for s, t in sorted(self.bdpt.pairs() or ()) if self.integrator == "bdpt" else ():
            if (s, t) != VISIBLE and not _VERTICES <= s + t <= most:
                raise ValueError(
                    f"bdpt.strategies: '{s},{t}' is none: s + t is {_VERTICES} to {most} (max_depth + 1) vertices, "
                    f"or {VISIBLE[0]},{VISIBLE[1]} for light that is seen directly"
                )
        if self.needs_tables and self.context.regions == 0:
            raise ValueError("context.regions: what goes by context needs tables: give 1 or more regions")
        if self.hide_emitters and self.integrator not in HIDING:
            raise ValueError(f"hide_emitters: {self.integrator} shows them: choose one of {', '.join(HIDING)}")
        if self.integrator == "auto":
            self._check_auto()
        if self.integrator == "auto" and not self.context.adaptive:
            raise ValueError("context.adaptive: 'auto' chooses by trials: leave it on, or name an integrator")
        if (self.width is None) != (self.height is None):
            raise ValueError("give both width and height, or neither")
        return self

    def _check_unlimited(self) -> None:
        """Refuse what has no end where there is no greatest depth."""
        if self.roulette == "none" and self.integrator != "auto":
            raise ValueError("roulette: without any, paths need a limit: give max_depth, or choose 'throughput'")
        if self.heuristic == "cutoff" and not self.is_baseline:
            raise ValueError("heuristic: 'cutoff' keeps a number for every vertex: give max_depth, or choose 'power'")

    def _check_auto(self) -> None:
        """Refuse settings that ``auto`` would not follow, because it chooses them."""
        fields = type(self).model_fields
        for name in ("direction_sampling", "roulette", "path", "light", "bdpt", "pssmlt"):
            if getattr(self, name) != fields[name].default:
                raise ValueError(f"{name}: 'auto' chooses it: name an integrator, for example bdpt")

    @property
    def longest(self) -> int:
        """Segments of the longest path that is rendered; :data:`ENDLESS` where there is no limit."""
        if self.max_depth != UNLIMITED:
            return self.max_depth
        return MAX_DEPTH if self.keeps_vertices else ENDLESS

    @property
    def keeps_vertices(self) -> bool:
        """Whether the integrator needs memory for each vertex of a path."""
        return self.integrator == "pssmlt" or (self.integrator == "bdpt" and self.bdpt.joins)

    @property
    def is_baseline(self) -> bool:
        """Whether an integrator of Mitsuba's own renders."""
        return self.integrator.startswith("mi_")

    @property
    def samples_lights(self) -> bool:
        """Whether one of our integrators draws points on the lights."""
        return not self.is_baseline and (self.integrator != "path" or self.path.next_event)

    @property
    def needs_context(self) -> bool:
        """Whether the render samples with a global context that must exist first."""
        return (self.samples_lights and self.light_sampling == "adjoint") or self.needs_tables

    @property
    def guided(self) -> bool:
        """Whether paths go, or end, by what the context's tables say of directions."""
        by_context = "context" in (self.direction_sampling, self.roulette)
        return not self.is_baseline and (by_context or self.integrator == "auto")

    @property
    def needs_tables(self) -> bool:
        """Whether the render samples lights or directions, or ends paths, by the context's tables."""
        return self.guided or (self.samples_lights and self.light_sampling == "context")

    @property
    def adaptive(self) -> bool:
        """Whether trials decide what renders: not where a part of the image was asked for."""
        part = self.integrator == "bdpt" and self.bdpt.strategies != "all"
        return self.guided and self.context.adaptive and not part

    @property
    def keeps_to_tables(self) -> bool:
        """Whether tables pay for what was asked for even where another algorithm is better by far without them."""
        over = self.pssmlt.over if self.integrator == "pssmlt" else None
        alone = self.integrator in ("path", "light") or over in ("path", "unjoined")
        unjoined = self.integrator == "bdpt" and not self.bdpt.joins
        return self.adaptive and self.direction_sampling == "context" and (alone or unjoined)

    @property
    def measured(self) -> ContextSettings:
        """How the context that the render needs is measured."""
        return self.context if self.needs_tables else self.context.without_tables()


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


def stop_or_default(stop: StopCriterion | None, samples: int | None) -> StopCriterion:
    """The criterion that was given, else the ``samples`` per pixel that the scene file asks for.

    Raises:
        SettingsRejected: neither is there.
    """
    if stop is None and samples is None:
        raise SettingsRejected("say when to stop: samples, seconds or error (--spp, --seconds or --error)")
    return stop or StopCriterion(samples=samples)


def suited(settings: RenderSettings, stop: StopCriterion) -> RenderSettings:
    """``settings`` with a context that suits the render: what they do not say of it follows from its time.

    How much time it is given, by powers of two and by nothing else, so that renders of about the same length share a
    context; and tables to the end where the render keeps to tables.
    """
    changes: dict[str, Any] = {}
    if settings.context.paths is None and settings.context.seconds is None and settings.needs_tables:
        seconds = stop.seconds
        if seconds is not None:
            changes["context.seconds"] = 2.0 ** math.floor(math.log2(min(max(seconds, 1.0), LONGEST)))
    if settings.keeps_to_tables:
        changes["context.thorough"] = True
    return with_overrides(settings, changes) if changes else settings


def with_file_defaults(settings: RenderSettings, defaults: Mapping[str, Any]) -> RenderSettings:
    """``settings`` with what a scene file says of its render, where they do not say it themselves.

    Args:
        settings: those that were given.
        defaults: names of settings and values; None where the file says nothing.

    Raises:
        SettingsRejected: what the file says contradicts what was given.
    """
    given = settings.model_fields_set
    changes = {name: value for name, value in defaults.items() if value is not None and name not in given}
    if changes.get("max_depth") == UNLIMITED and settings.keeps_vertices:
        changes["max_depth"] = MAX_DEPTH  # as long as it can keep: said in the settings, and no reason to warn
    return with_overrides(settings, changes) if changes else settings


def first_problem(error: ValidationError) -> str:
    """One line for a user from a pydantic error: the field, and what is wrong with it."""
    entry = error.errors(include_url=False, include_context=False)[0]
    where = ".".join(str(part) for part in entry["loc"])
    text = _PLAINER.get(entry["type"], str(entry["msg"]).removeprefix("Value error, "))
    return f"{where}: {text}" if where else text


def with_overrides(settings: RenderSettings, assignments: dict[str, Any]) -> RenderSettings:
    """A copy of ``settings`` with dotted names (``context.resolution``) set to new values.

    Raises:
        SettingsRejected: an unknown name, or a value that the models refuse.
    """
    data = settings.model_dump(exclude_unset=True)  # What was not given stays so: a scene file may say it
    known = settings.model_dump()
    for dotted, value in assignments.items():
        *parents, leaf = dotted.split(".")
        there, target = known, data
        for name in parents:
            inner = there.get(name)
            there = inner if isinstance(inner, dict) else {}
            target = target.setdefault(name, {}) if there else {}
        if leaf not in there:
            raise SettingsRejected(f"unknown setting '{dotted}'{_similar(dotted, _names(known))}")
        if isinstance(there[leaf], dict):
            raise SettingsRejected(f"'{dotted}' is a group of settings: name one of {', '.join(_names(known, dotted))}")
        target[leaf] = value
    try:
        return RenderSettings.model_validate(data)
    except ValidationError as error:
        raise SettingsRejected(first_problem(error)) from None


_PLAINER = {
    "bool_type": "give true or false",
    "int_type": "give a whole number",
    "float_type": "give a number",
    "string_type": "give a word",
    "extra_forbidden": "unknown field: remove it or correct its name",
}
"""Kinds of pydantic errors whose own text speaks to programmers."""


def _names(data: dict[str, Any], below: str = "") -> list[str]:
    """The dotted names of all settings, or of those in one group."""
    names = []
    for name, value in data.items():
        names += [f"{name}.{leaf}" for leaf in value] if isinstance(value, dict) else [name]
    return [name for name in names if name.startswith(f"{below}.")] if below else names


def _similar(word: str, known: Iterable[str]) -> str:
    """The known word that was probably meant, as an end of a sentence."""
    found = get_close_matches(word, known, n=1)
    return f" (did you mean '{found[0]}'?)" if found else ""
