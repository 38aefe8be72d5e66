"""Which light an integrator cannot find in a scene, however long it renders. Imports no Mitsuba.

A path from a light L to the sensor E is a word over D, a surface that scatters, and S, one that reflects
or refracts into single directions or lets light straight through (the notation of Heckbert 1990). A
strategy finds a path if what it joins can be joined: two neighbours of which neither is S, a light that
has no extent only by being joined to D, a pinhole likewise. What no strategy finds is missing from the
image, and nothing in the image says so.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product

from elps_core.errors import SettingsRejected
from elps_core.paths import strategies
from elps_core.paths.strategies import Strategies
from elps_core.scene.summary import SceneSummary
from elps_core.settings import MAX_DEPTH, UNLIMITED, RenderSettings

STRAIGHT = frozenset({"circular", "mask", "null", "polarizer", "retarder"})
"""Materials of which a part lets light straight through."""
MIRRORS = frozenset({"conductor", "dielectric", "plastic", "thindielectric"})
"""Materials that reflect or refract into single directions."""
WRAPPERS = frozenset({"blendbsdf", "bumpmap", "mask", "normalmap", "twosided"})
"""Materials made of others, which are listed beside them."""
NEVER_SCATTER = (STRAIGHT | MIRRORS | WRAPPERS) - {"plastic"}
"""Materials that have no part of their own that scatters."""
NEVER_MET = frozenset({"directional", "point", "projector", "spot"})
"""Emitters without extent: no path meets them by chance."""
APERTURES = frozenset({"thinlens"})
"""Sensors that a light path can meet."""

_LONGEST = 3
"""Surfaces of the longest word that is asked about: a longer one that is not found has a shorter one in it."""
_THROUGH_NULL = ("mi_volpath", "mi_volpathmis", "mi_prbvolpath")
"""Integrators of Mitsuba whose shadow rays pass materials that let light straight through."""
_OTHER_BASELINES = ("mi_depth", "mi_direct")
"""Those that are not meant to find all light."""
ONE_WAY = frozenset({"hair"})
"""Materials through which one sees out and not in: paths from the light that scatter there would be wrong (a fifth
too dark after two strands), and not only noisy."""

BENT = frozenset({"bumpmap", "normalmap"})
"""Materials that turn another's frame."""
ROUGH_GLASS = frozenset({"principled", "principledthin", "roughdielectric"})
"""Materials that let light through and scatter it."""


def check(summary: SceneSummary, settings: RenderSettings) -> None:
    """Refuse a render whose image nothing can reach, or in which light paths would go wrong.

    Raises:
        SettingsRejected: so it is; what to change.
    """
    if settings.is_baseline or settings.integrator == "auto":  # which takes nothing that would
        return
    if settings.integrator == "pssmlt" and summary.sensors[settings.sensor].film.pixels == "bands":
        raise SettingsRejected("pssmlt keeps colours, and not the bands of a 'specfilm': choose path, bdpt or mi_path")
    chosen = strategies.chosen(settings, aperture=_has_aperture(summary, settings))
    if chosen.light_paths and ONE_WAY & set(summary.bsdfs):
        raise SettingsRejected(f"{settings.integrator} cannot render the material 'hair': choose path or mi_path")
    if chosen.shown is not None and not chosen.aperture and all(t == 0 for _, t in chosen.shown):
        raise SettingsRejected("bdpt.strategies: no light path meets a pinhole: use a 'thinlens' sensor, or t above 0")


def unreachable(summary: SceneSummary, settings: RenderSettings) -> tuple[str, ...]:
    """What the image of a render lacks, and what to do about it: one line each.

    Materials are judged by their kind, not by where they are, so that a line means that such light is
    lost wherever there is some.
    """
    if settings.integrator in _OTHER_BASELINES:
        return ()
    used = set(summary.bsdfs)
    singular, surfaces = _surfaces(used, settings)
    chosen = _strategies(summary, settings)
    if chosen.shown is not None:
        return ()  # a part of the image was asked for
    lines = []
    if chosen.light_paths and not chosen.eye_paths and used & BENT and used & ROUGH_GLASS:
        # Mitsuba asks on which side of the bent frame light goes on, and not on which it has come.
        lines.append(
            f"{settings.integrator} does not find a part of the light that {_listed(used & ROUGH_GLASS)} "
            f"lets through under {_listed(used & BENT)}: choose path or bdpt"
        )
    lights: dict[str, list[str]] = {}
    for emitter in summary.emitters:
        loss = _loss(chosen, emitter.type, surfaces, settings.longest)
        if loss:
            lights.setdefault(loss, []).append(emitter.type)
    lines += [
        f"{settings.integrator} {_LOSSES[loss].format(lights=_listed(types), surfaces=_listed(singular))}"
        for loss, types in sorted(lights.items())
    ]
    if settings.max_depth == UNLIMITED and settings.keeps_vertices:
        lines.append(f"{settings.integrator} leaves out paths of more than {MAX_DEPTH} segments: choose path or auto")
    return tuple(lines)


def lost(summary: SceneSummary, settings: RenderSettings) -> int:
    """The same as a number, to compare integrators by: 0 where all light is found, more for wider kinds of paths."""
    _, surfaces = _surfaces(set(summary.bsdfs), settings)
    chosen = _strategies(summary, settings)
    kinds = [_loss(chosen, emitter.type, surfaces, settings.longest) for emitter in summary.emitters]
    return sum(_BY_WIDTH.index(kind) for kind in kinds)


def _surfaces(used: set[str], settings: RenderSettings) -> tuple[set[str], str]:
    """Materials of single directions, and the letters of all."""
    singular = used & (MIRRORS if settings.integrator in _THROUGH_NULL else MIRRORS | STRAIGHT)
    return singular, "D" * bool(used - NEVER_SCATTER) + "S" * bool(singular)


_BY_WIDTH = (None, "both", "sent", "seen", "all")
"""Losses of one emitter, each wider than the one before."""
_LOSSES = {
    "all": "finds no light of {lights}, which no path meets by chance: set path.next_event=true, or choose bdpt",
    "seen": "does not find light of {lights} that the camera sees in or through {surfaces}: choose path or bdpt",
    "sent": "does not find light of {lights} that comes by way of {surfaces}: choose bdpt, or make the light an area",
    "both": "does not find light of {lights} that meets {surfaces} both before and after it is scattered: "
    "make the light an area, or the camera a 'thinlens'",
}
"""What is lost, by which end of a path the specular surfaces are at."""


def _loss(chosen: Strategies, emitter: str, surfaces: str, max_depth: int) -> str | None:
    """The widest kind of paths that are lost of one emitter; None where all are found."""
    met = emitter not in NEVER_MET
    lost = [
        word
        for length in range(1, min(_LONGEST, max_depth - 1) + 1)
        for word in map("".join, product(surfaces, repeat=length))
        # The image of a light without extent in mirrors alone is a point: invisible, as the light itself.
        if (met or "D" in word) and not _found(chosen, word, met)
    ]
    if "D" in lost:
        return "all"
    if any(word[0] == "D" for word in lost) or "S" in lost:
        return "seen"
    if any(word[-1] == "D" for word in lost):
        return "sent"
    return "both" if lost else None


def _found(chosen: Strategies, word: str, met: bool) -> bool:
    """Whether some strategy makes paths over the surfaces of ``word``, from the light to the sensor."""
    return (
        (chosen.emission and met)
        or (chosen.next_event and word[0] == "D")
        or (chosen.joins and "DD" in word)
        or (chosen.sensor and word[-1] == "D")
        or chosen.aperture
    )


def _strategies(summary: SceneSummary, settings: RenderSettings) -> Strategies:
    if settings.integrator == "mi_ptracer":
        return strategies.light()
    if settings.is_baseline:
        return strategies.path()
    if settings.integrator == "auto" and ONE_WAY & set(summary.bsdfs):
        return strategies.path()
    return strategies.chosen(settings, aperture=_has_aperture(summary, settings))


def _has_aperture(summary: SceneSummary, settings: RenderSettings) -> bool:
    return summary.sensors[settings.sensor].type in APERTURES


def _listed(names: Iterable[str]) -> str:
    return ", ".join(f"'{name}'" for name in sorted(names))
