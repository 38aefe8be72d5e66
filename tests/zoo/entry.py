"""What a scene of the zoo says of itself, and which algorithms must render it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any
from zlib import crc32

from elps_core import device

Dict = dict[str, Any]
Make = Callable[[Any, Path], Any]
"""From the Mitsuba module, with its variant set, and an empty folder for files to a dict for ``mi.load_dict``, or
to a scene that is loaded already."""

ALGORITHMS = ("path", "path pure", "light", "light pure", "bdpt", "pssmlt")
"""What must agree. ``pure`` is without next event estimation, or without connections to the sensor."""

PINHOLE = "no light path meets a pinhole, or an orthographic sensor, by chance"
NO_EXTENT = "an emitter without extent, or in one direction only, is never met by chance"
SPECULAR_VIEW = "the sensor sees specular surfaces, which no light path can be joined to"
UNREACHABLE = "light without extent comes through specular surfaces, which next event estimation does not pass"
ONE_WAY = "one sees out through a strand and not into it, so that no light path may hold a point on one"
TOO_NOISY = "too noisy to find any bias"


@dataclass(frozen=True)
class Entry:
    """One scene: how it is made, what it covers, and who must agree about it."""

    name: str
    make: Make
    about: str
    left_out: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    """Algorithm -> why it cannot make this image. ``light pure`` is left out unless the entry has a ``lens``."""
    lens: bool = False
    """Whether the aperture is wide enough for light paths to meet it."""
    max_depth: int = 5
    variant: str = "llvm_ad_rgb"
    reference: str = "mi_path"
    """What makes the reference: ``mi_ptracer`` where ``path`` does not see all light, ``naive`` where it errs."""
    effort: float = 1.0
    """Samples in the test suite, as a multiple of what the others take."""

    @property
    def seed(self) -> int:
        """Scenes have random numbers of their own: luck would else be the same in all."""
        return crc32(self.name.encode())

    def load(self, folder: Path) -> Any:
        """The scene; its variant stays set. ``folder`` is empty and may go afterwards."""
        mi = device.use(self.variant)
        level = mi.log_level()
        mi.set_log_level(mi.LogLevel.Error)  # Films announce that they turn monochrome.
        try:
            made = self.make(mi, folder)
            return mi.load_dict(made) if isinstance(made, dict) else made
        finally:
            mi.set_log_level(level)

    def reason_without(self, algorithm: str) -> str | None:
        """Why ``algorithm`` is left out; None where it must agree."""
        if algorithm == "light pure" and not self.lens and algorithm not in self.left_out:
            return PINHOLE
        return self.left_out.get(algorithm)

    def algorithms(self) -> list[str]:
        """Those that must agree with the reference, in the order of :data:`ALGORITHMS`."""
        return [algorithm for algorithm in ALGORITHMS if self.reason_without(algorithm) is None]


def specular() -> dict[str, str]:
    """Left out where the sensor sees specular surfaces."""
    return {"light": SPECULAR_VIEW}


def without_extent() -> dict[str, str]:
    """Left out where some emitter cannot be met."""
    return {"path pure": NO_EXTENT}
