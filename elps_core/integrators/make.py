"""From settings to what renders frames."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from elps_core.integrators.bdpt import Bdpt
from elps_core.integrators.frame import Frame, FrameRenderer
from elps_core.integrators.pssmlt import MetropolisFrames
from elps_core.paths.roulette import RouletteRule
from elps_core.paths.strategies import chosen
from elps_core.sampling.start import StartDensity
from elps_core.scene.sensors import Camera
from elps_core.settings import RenderSettings

if TYPE_CHECKING:
    import mitsuba as mi


class Frames(Protocol):
    """Renders frames of one film by one algorithm."""

    def render(self, spp: int, key: tuple[int, ...]) -> Frame:
        """``spp`` samples (or mutations) per pixel from the random streams named by ``key``."""
        ...


def frames(scene: mi.Scene, sensor: mi.Sensor, lights: StartDensity, settings: RenderSettings) -> Frames:
    """What renders frames of one sensor by one of our own integrators.

    Raises:
        SceneRejected: the sensor's type is not supported.
        SettingsRejected: no path can be made of the strategies.
    """
    camera = Camera(sensor)
    bdpt = Bdpt(
        scene,
        camera,
        lights,
        max_depth=settings.max_depth,
        roulette=RouletteRule(settings.roulette, settings.rr_depth),
        strategies=chosen(settings, aperture=camera.has_aperture),
        heuristic=settings.heuristic,
    )
    if settings.integrator == "pssmlt":
        return MetropolisFrames(bdpt, sensor.film(), settings.pssmlt)
    return FrameRenderer(bdpt, sensor.film())
