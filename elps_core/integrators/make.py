"""From settings to what renders frames."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from elps_core.context.store import DirectionalParts
from elps_core.integrators.bdpt import Bdpt
from elps_core.integrators.chains import alike
from elps_core.integrators.frame import Frame, FrameRenderer
from elps_core.integrators.pssmlt import MetropolisFrames
from elps_core.paths.roulette import RouletteRule
from elps_core.paths.scattering import Materials
from elps_core.paths.strategies import Strategies, chosen
from elps_core.sampling.context import PixelWorth, guided
from elps_core.sampling.departures import Departures
from elps_core.sampling.direction import Directions
from elps_core.sampling.lights import PieceOf, RegionLights, pieces
from elps_core.sampling.start import StartDensity
from elps_core.scene.sensors import Camera
from elps_core.settings import RenderSettings

if TYPE_CHECKING:
    import mitsuba as mi

USUAL_SHARE = 0.7
"""Chance of a direction from a table where nobody knows a better one."""


class Frames(Protocol):
    """Renders frames of one film by one algorithm."""

    def render(self, spp: int, key: tuple[int, ...]) -> Frame:
        """``spp`` samples (or mutations) per pixel from the random streams named by ``key``."""
        ...


def frames(
    scene: mi.Scene,
    sensor: mi.Sensor,
    lights: StartDensity,
    settings: RenderSettings,
    parts: DirectionalParts | None = None,
) -> Frames:
    """What renders frames of one sensor by one of our own integrators.

    ``parts`` are needed where directions or roulette go by context.

    Raises:
        SceneRejected: the sensor's type is not supported.
        SettingsRejected: no path can be made of the strategies.
    """
    bdpt = paths_of(scene, Camera(sensor), lights, settings, parts)
    if settings.integrator == "pssmlt":
        weight = PixelWorth(parts.pilot, parts.noise, bdpt.camera.size) if parts else alike
        return MetropolisFrames(bdpt, sensor.film(), settings.pssmlt, weight)
    return FrameRenderer(bdpt, sensor.film())


def paths_of(
    scene: mi.Scene, camera: Camera, lights: StartDensity, settings: RenderSettings, parts: DirectionalParts | None
) -> Bdpt:
    """The paths that ``settings`` ask for; errors as of :func:`frames`."""
    strategies = chosen(settings, aperture=camera.has_aperture)
    if not strategies.light_paths:
        lights = lights.of_emitters()
    region_lights = _region_lights(settings, lights, parts)
    by_context = "context" in (settings.direction_sampling, settings.light_sampling)
    if parts and parts.departures and strategies.light_paths and by_context:
        lights = lights.departing(Departures(parts.departures, pieces(lights), PieceOf(lights)))
    # Chains ask for samples without negative parts, and joined paths find what tables do not count.
    known = parts if settings.roulette == "context" else None
    payable = settings.integrator != "pssmlt" and not strategies.joins
    pays = payable and known is not None and known.prospects is not None
    return Bdpt(
        scene,
        camera,
        lights,
        max_depth=settings.longest,
        roulette=RouletteRule(settings.roulette, settings.rr_depth, pays),
        strategies=strategies,
        heuristic=settings.heuristic,
        directions=_directions(Materials(scene), settings, strategies, parts),
        thinning=settings.bdpt.eye_paths if settings.integrator == "bdpt" else 1,
        region_lights=region_lights,
        hides=settings.hide_emitters,
        worth=PixelWorth(known.pilot, known.noise, camera.size, pays=pays) if known else None,
    )


def _directions(
    materials: Materials, settings: RenderSettings, strategies: Strategies, parts: DirectionalParts | None
) -> Directions:
    if parts is None:
        return Directions(materials)
    guided_light = settings.integrator == "light" or settings.bdpt.guided_light
    if not settings.guided:
        return guided(materials, parts, eye=None, light=None)
    share: float | NDArray[np.float32] = settings.table_share or USUAL_SHARE
    if settings.direction_sampling != "context":
        share = 0.0
    learned = parts.shares if settings.table_share is None and share else None
    return guided(
        materials,
        parts,
        eye=(share if learned is None else learned) if strategies.eye_paths else None,
        light=share if guided_light and strategies.light_paths else None,
    )


def _region_lights(
    settings: RenderSettings, lights: StartDensity, parts: DirectionalParts | None
) -> RegionLights | None:
    # Guided paths ask for lights by region, too, unless they are told to ask for all alike.
    ways = {"context", "adjoint"} if settings.direction_sampling == "context" else {"context"}
    by_context = settings.light_sampling in ways
    return RegionLights(lights, parts.lights) if parts and by_context and parts.lights.shape[1] else None
