"""A zoo of small scenes: every emitter, sensor, film and BSDF class that the renderer takes."""

from __future__ import annotations

from dataclasses import replace

from tests.zoo import emitters, geometry, materials, rooms
from tests.zoo.entry import ALGORITHMS, Entry

_BASE = {entry.name: entry for entry in (*emitters.ENTRIES, *materials.ENTRIES, *geometry.ENTRIES, *rooms.ENTRIES)}


def _in(name: str, variant: str) -> Entry:
    return replace(_BASE[name], name=f"{name}, {variant.rsplit('_', 1)[-1]}", variant=variant)


ZOO: dict[str, Entry] = _BASE | {
    entry.name: entry
    for entry in (
        _in("mixed", "llvm_ad_spectral"),
        _in("roughconductor", "llvm_ad_spectral"),
        _in("area-textured", "llvm_ad_spectral"),
        _in("envmap", "llvm_ad_spectral"),
        _in("sunsky", "llvm_ad_spectral"),
        _in("roughdielectric", "llvm_ad_mono"),
        _in("spot-textured", "llvm_ad_mono"),
    )
}

__all__ = ["ALGORITHMS", "ZOO", "Entry"]
