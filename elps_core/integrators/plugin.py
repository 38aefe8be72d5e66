"""Our integrators as Mitsuba plugins: ``elps_path``, ``elps_light``, ``elps_bdpt``, ``elps_pssmlt``.

``mi.render`` and scene files can name them.

====================  =========  =====================================================================
property              default    meaning
====================  =========  =====================================================================
``max_depth``         16         longest path in segments, as in Mitsuba; 1 is visible emission only, -1 is no limit
``rr_depth``          5          depth from which on Russian roulette may end a walk
``roulette``          albedo     ``albedo``, ``throughput`` or ``none``
``light_sampling``    power      ``uniform``, ``power`` or ``adjoint`` (measures the scene when first used)
``heuristic``         power      ``balance``, ``power``, ``maximum`` or ``cutoff``
====================  =========  =====================================================================
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from pydantic import ValidationError

from elps_core.context import adjoint
from elps_core.errors import SettingsRejected
from elps_core.integrators import make
from elps_core.sampling.start import StartDensity, power_table, uniform_table
from elps_core.scene.emission import Emission
from elps_core.scene.sensors import Camera
from elps_core.settings import BUILT_INTEGRATORS, MAX_DEPTH, ContextSettings, RenderSettings, first_problem

_registered: set[str] = set()


def register() -> None:
    """Register our integrators with the current variant; again for each variant, harmless twice."""
    variant = mi.variant()
    if variant not in _registered:
        _registered.add(variant)
        for name in BUILT_INTEGRATORS:
            mi.register_integrator(f"elps_{name}", _integrator_class(name))


def _integrator_class(name: str) -> Any:
    """The plugin's class: made here because its base exists once a variant is set."""

    class Integrator(mi.CppADIntegrator):
        """One of our integrators; see the module's text for its properties."""

        def __init__(self, properties: mi.Properties) -> None:
            super().__init__(properties)
            try:
                self.settings = RenderSettings(
                    integrator=name,
                    light_sampling=properties.get("light_sampling", "power"),
                    roulette=properties.get("roulette", "albedo"),
                    max_depth=properties.get("max_depth", 16),
                    rr_depth=properties.get("rr_depth", 5),
                    heuristic=properties.get("heuristic", "power"),
                )
            except ValidationError as error:
                raise SettingsRejected(first_problem(error)) from None
            if self.settings.needs_tables:
                raise SettingsRejected(
                    "there is no context here: render with 'elps render', or by 'adjoint' and 'albedo'"
                )
            self._scene: mi.Scene | None = None
            self._sensor: mi.Sensor | None = None
            self._frames: make.Frames | None = None

        def render(
            self,
            scene: mi.Scene,
            sensor: int | mi.Sensor = 0,
            seed: int = 0,
            spp: int = 0,
            develop: bool = True,  # noqa: ARG002 (Mitsuba's signature; the result is always developed)
            evaluate: bool = True,  # noqa: ARG002 (and always evaluated)
        ) -> mi.TensorXf:
            """Render ``spp`` samples per pixel; returns linear RGB [height, width, 3]."""
            chosen = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            count = spp or chosen.sampler().sample_count()
            frame = self._renderer(scene, chosen).render(count, (int(np.array(mi.UInt32(seed))[0]),))
            return frame.image

        def _renderer(self, scene: mi.Scene, sensor: mi.Sensor) -> make.Frames:
            if self._frames is None or self._scene is not scene or self._sensor is not sensor:
                self._scene, self._sensor = scene, sensor
                self._frames = make.frames(scene, sensor, _lights(scene, sensor, self.settings), self.settings)
            return self._frames

        def to_string(self) -> str:
            return f"elps_{name}[light_sampling={self.settings.light_sampling}, max_depth={self.settings.max_depth}]"

    return Integrator


def _lights(scene: mi.Scene, sensor: mi.Sensor, settings: RenderSettings) -> StartDensity:
    emission = Emission(scene)
    table = uniform_table(emission) if settings.light_sampling == "uniform" else power_table(emission)
    if settings.light_sampling == "adjoint":
        options = ContextSettings(max_depth=min(max(2, settings.longest), MAX_DEPTH))
        measurement = adjoint.AdjointMeasurement(scene, Camera(sensor), emission, options)
        for _ in range(adjoint.STEPS):
            measurement.step()
        table = adjoint.start_table(measurement.image(), emission, options.epsilon, options.exponent)
    return StartDensity(emission, table)
