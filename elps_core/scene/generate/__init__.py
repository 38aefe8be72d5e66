"""Parametric scenes: the project's own test scenes, written as bundles that the service accepts."""

from __future__ import annotations

from collections.abc import Callable

from elps_core.scene.generate.common import SceneDescription, write
from elps_core.scene.generate.maze import maze

GENERATORS: dict[str, Callable[..., SceneDescription]] = {"maze": maze}
"""Every scene by the name that the command line gives it."""

__all__ = ["GENERATORS", "SceneDescription", "maze", "write"]
