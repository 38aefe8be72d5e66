"""A corpus of scene files in the styles in which people have them."""

from __future__ import annotations

from collections.abc import Mapping

from tests.corpus import blender, bundles, mitsuba06, mitsuba2, mitsuba3, radio, tungsten, tutorials, written
from tests.corpus.entry import Entry

STYLES: Mapping[str, list[Entry]] = {
    "blender": blender.ENTRIES,
    "radio": radio.ENTRIES,
    "0.x": mitsuba06.ENTRIES,
    "2": mitsuba2.ENTRIES,
    "3": mitsuba3.ENTRIES,
    "tungsten": tungsten.ENTRIES,
    "tutorials": tutorials.ENTRIES,
    "written": written.ENTRIES,
    "bundles": bundles.ENTRIES,
}
"""Style -> its scenes."""
