"""What the film of a scene file asks of the image file, and what it does not get. Imports no Mitsuba."""

from __future__ import annotations

from typing import cast, get_args

from elps_core.errors import SceneRejected
from elps_core.scene.markup import Node
from elps_core.scene.summary import FilmSummary, PixelFormat

BANDS = "specfilm"
"""The film that names the bands of its image."""
_FORMATS = tuple(name for name in get_args(PixelFormat) if name != "bands")
_COMPONENTS = ("float16", "float32")


def described(film: Node | None) -> FilmSummary:
    """The format of the image of a ``film`` element; Mitsuba's default one where there is none.

    Numbers have 32 bits unless the film says otherwise, though Mitsuba's films then write 16.
    """
    if film is None:
        return FilmSummary()
    half = _text(film, "component_format") == "float16"
    if film.type == BANDS:
        return FilmSummary(pixels="bands", half=half)
    pixels = _text(film, "pixel_format")
    return FilmSummary(pixels=cast("PixelFormat", pixels) if pixels in _FORMATS else "rgb", half=half)


def warnings(film: Node | None) -> tuple[str, ...]:
    """What a ``film`` element asks for and does not get, a line each."""
    if film is None:
        return ()
    lines = []
    component, file = _text(film, "component_format"), _text(film, "file_format")
    if component and component not in _COMPONENTS:
        lines.append(f"{film}: images have floating-point numbers: its component_format is taken for 'float32'")
    if file and file not in ("openexr", "exr"):
        lines.append(f"{film}: its file_format is left out: images are OpenEXR files, or PNG where '-o' ends in .png")
    border = film.property("boolean", "sample_border")
    if border is not None and border.attributes.get("value", "").strip().lower() == "true":
        lines.append(f"{film}: 'sample_border' is left out but by Mitsuba's own integrators: no sample lies outside")
    return tuple(lines)


def with_bands(root: Node) -> Node | None:
    """A film below ``root`` that keeps bands, which a variant without spectra cannot fill; None without one."""
    films = (node for node in root.objects() if node.tag == "film" and node.type == BANDS)
    return next(films, None)


def check(root: Node, variant: str) -> None:
    """Refuse films that a variant cannot fill.

    Raises:
        SceneRejected: there is one; which variant can.
    """
    film = with_bands(root)
    if film is not None and not variant.endswith("_spectral"):
        spectral = variant.rpartition("_")[0] + "_spectral"
        raise SceneRejected(f"{film}: its bands need a variant with spectra: choose {spectral}")


def _text(film: Node, name: str) -> str:
    given = film.property("string", name)
    return given.attributes.get("value", "").strip().lower() if given else ""
