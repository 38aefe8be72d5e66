"""Digests: what a scene, a context and a render depend on. Imports no Mitsuba.

All are ``sha256:`` and 64 hexadecimal digits. Equal digests may share results, whoever asks for them
and on whatever machine.
"""

from __future__ import annotations

import hashlib
import json
import math
from io import BufferedReader
from typing import Any

from elps_core.settings import DEPTH_BASELINES, ContextSettings, RenderSettings

SCENE_FORMAT = 1
"""Counts changes of the canonical text."""
CONTEXT_FORMAT = 18
"""Counts changes of a global context's content or file format."""
RENDER_FORMAT = 18
"""Counts changes of the algorithms that change the image of given settings."""


def file_hash(file: BufferedReader) -> str:
    """SHA-256 of an open file's content from its current position, in hexadecimal."""
    return hashlib.file_digest(file, "sha256").hexdigest()


def scene_digest(canonical: str) -> str:
    """Digest of a scene.

    Args:
        canonical: the checked scene as one text, in which content hashes stand for file names
            (:func:`elps_core.scene.loader.canonicalize` makes it), so that neither the place nor the
            packing of a bundle enters, nor files that the scene does not use.
    """
    return _digest("scene", SCENE_FORMAT, canonical)


def surroundings_digest(canonical: str) -> str:
    """Digest of a scene without its cameras, from a text as of :func:`scene_digest` that leaves them out."""
    return _digest("surroundings", SCENE_FORMAT, canonical)


def context_digest(scene: str, sensor: int, size: tuple[int, int], settings: ContextSettings, variant: str) -> str:
    """Digest of a global context.

    Args:
        scene: the scene's digest.
        sensor: index of the camera.
        size: (width, height) in pixels; only the aspect ratio enters, so that a preview and its final
            image share one context.
        settings: how the context is measured.
        variant: where it is measured: its device alone enters, because trials tell what is the fastest on that.
    """
    common = math.gcd(*size)
    aspect = [size[0] // common, size[1] // common]
    device = variant.partition("_")[0]
    return _digest("context", CONTEXT_FORMAT, [scene, sensor, aspect, settings.model_dump(mode="json"), device])


def render_digest(scene: str, settings: RenderSettings, size: tuple[int, int]) -> str:
    """Digest of a render: equal where every chunk of the same index is interchangeable.

    Args:
        scene: the scene's digest.
        settings: those enter that the chosen integrator reads.
        size: (width, height) of the image in pixels, in place of the optional ones in the settings.
    """
    return _digest("render", RENDER_FORMAT, [scene, _read_by_integrator(settings), list(size)])


def _read_by_integrator(settings: RenderSettings) -> dict[str, Any]:
    fields = {"integrator", "sensor", "seed", "variant"}
    if settings.integrator == "auto":  # What it chooses, it chooses whole.
        fields |= {"max_depth"}
    elif not settings.is_baseline:
        fields |= {"max_depth", "roulette", "direction_sampling", settings.integrator}
    elif settings.integrator.removeprefix("mi_") in DEPTH_BASELINES:
        fields |= {"max_depth", "roulette"}
    if settings.samples_lights:
        fields |= {"light_sampling", "heuristic"}
    if "roulette" in fields and settings.roulette != "none":
        fields.add("rr_depth")
    if settings.integrator == "auto":
        fields |= {"rr_depth", "table_share"}
    elif "direction_sampling" in fields and settings.direction_sampling == "context":
        fields.add("table_share")
    if settings.hide_emitters:
        fields.add("hide_emitters")
    values = settings.model_dump(mode="json", include=fields)
    if settings.integrator == "pssmlt" and settings.direction_sampling == "context":
        values["bdpt"] = {"guided_light": settings.bdpt.guided_light}
    if settings.needs_context:
        values["context"] = settings.measured.model_dump(mode="json")
    if settings.is_baseline and "rr_depth" in fields:
        values["roulette"] = "throughput"  # the only kind that Mitsuba has
    return values


def _digest(kind: str, version: int, content: Any) -> str:
    """Kind and version enter, so that digests of different things never meet."""
    text = json.dumps([kind, version, content], sort_keys=True, separators=(",", ":"), allow_nan=False)
    return "sha256:" + hashlib.sha256(text.encode()).hexdigest()
