"""Parametric scenes: the project's own test scenes, written as bundles that the service accepts."""

from __future__ import annotations

from collections.abc import Callable

from elps_core.scene.generate.common import SceneDescription, write
from elps_core.scene.generate.cornell import cornell
from elps_core.scene.generate.door import door
from elps_core.scene.generate.lamps import lamps
from elps_core.scene.generate.maze import maze
from elps_core.scene.generate.office import office
from elps_core.scene.generate.sphere import sphere

GENERATORS: dict[str, Callable[..., SceneDescription]] = {
    "maze": maze,
    "door": door,
    "cornell": cornell,
    "lamps": lamps,
    "sphere": sphere,
    "office": office,
}
"""Every scene by the name that the command line gives it."""

__all__ = ["GENERATORS", "SceneDescription", "cornell", "door", "lamps", "maze", "office", "sphere", "write"]
