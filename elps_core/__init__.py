"""The renderer: scenes, paths, global context, integrators, estimates.

``import elps_core as elps`` is the public door: ``elps.render("scene.xml", seconds=60)`` gives an image as an array.
Knows no HTTP, no Redis and no Celery. Importing the package costs nothing: Mitsuba is loaded by the first scene.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str

    from elps_core.api import Image, Progress, build_context, load_scene, register, render
    from elps_core.context.store import GlobalContext
    from elps_core.errors import ElpsError
    from elps_core.renderer import Renderer
    from elps_core.scene.loader import LoadedScene
    from elps_core.settings import ContextSettings, RenderSettings

_MODULES = {
    "ContextSettings": "settings",
    "ElpsError": "errors",
    "GlobalContext": "context.store",
    "Image": "api",
    "LoadedScene": "scene.loader",
    "Progress": "api",
    "RenderSettings": "settings",
    "Renderer": "renderer",
    "build_context": "api",
    "load_scene": "api",
    "register": "api",
    "render": "api",
}
"""Public name -> where it is defined; imported when it is first asked for."""

__all__ = [
    "ContextSettings",
    "ElpsError",
    "GlobalContext",
    "Image",
    "LoadedScene",
    "Progress",
    "RenderSettings",
    "Renderer",
    "__version__",
    "build_context",
    "load_scene",
    "register",
    "render",
]


def __getattr__(name: str) -> Any:
    """A public name, from the module that defines it; the version is that of what is installed."""
    if name == "__version__":
        return version("elps")
    if name not in _MODULES:
        raise AttributeError(f"module 'elps_core' has no attribute '{name}'")
    if name == "Renderer":  # its modules need a variant
        import mitsuba

        if mitsuba.variant() is None:
            settings, device = import_module("elps_core.settings"), import_module("elps_core.device")
            device.use(settings.RenderSettings().variant)
    return getattr(import_module(f"elps_core.{_MODULES[name]}"), name)
