"""The preprocessing pass: measures a scene step by step, each step guided by the ones before."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from elps_core.context import adjoint
from elps_core.context.store import GlobalContext
from elps_core.errors import ContextMismatch
from elps_core.integrators.bdpt import Bdpt
from elps_core.integrators.frame import MAX_LANES
from elps_core.paths.roulette import RouletteRule
from elps_core.sampling.start import StartDensity
from elps_core.scene.digest import context_digest
from elps_core.scene.emission import Emission
from elps_core.scene.loader import LoadedScene
from elps_core.scene.sensors import Camera
from elps_core.settings import ContextSettings

STEPS = 8
"""Batches of a pass. Each starts its light paths by what the ones before have measured; their
scatter tells how much of the image is noise."""
ROULETTE = RouletteRule("albedo", 5)
STREAM = 0xE1B5
"""Key that sets the pass's random numbers apart from those of renders with the same seed."""


class ContextBuilder:
    """Builds the global context of one scene and sensor in :data:`STEPS` short steps.

    A step takes well under ten seconds. Between steps the state can be saved with
    :meth:`to_bytes` and taken up elsewhere with :meth:`restore`.
    """

    steps = STEPS

    def __init__(self, scene: LoadedScene, settings: ContextSettings) -> None:
        self._scene = scene
        self._settings = settings
        self._camera = Camera(scene.sensor)
        self._emission = Emission(scene.scene)
        self._grid = adjoint.grid(self._emission.count, settings.resolution)
        self._batches: NDArray[np.float64] = np.zeros((0, *self._grid))
        self._seconds = 0.0
        self.digest = context_digest(scene.digest, scene.sensor_index, scene.size, settings)

    @property
    def done(self) -> int:
        """Steps taken."""
        return len(self._batches)

    def step(self) -> None:
        """Take the next step; none is left when :attr:`done` equals :attr:`steps`."""
        if self.done >= self.steps:
            return
        begin = time.perf_counter()
        rows, columns = self._grid
        wanted = max(1, self._settings.samples_per_cell * rows * columns // self.steps)
        image = np.zeros(self._grid) if not self.done else adjoint.shrunk(self._batches, self._emission.count)
        density = StartDensity(self._emission, adjoint.start_table(image, self._emission, self._guide_share()))
        bdpt = Bdpt(
            self._scene.scene, self._camera, density, max_depth=self._settings.max_depth, roulette=ROULETTE
        )
        passes = -(-wanted // (MAX_LANES // 4))
        lanes = -(-wanted // passes)
        batch = np.zeros(self._grid)
        for number in range(passes):
            batch += adjoint.measure(bdpt, lanes, (self._settings.seed, STREAM, self.done, number))
        self._batches = np.concatenate([self._batches, batch[None] / passes])
        self._seconds += time.perf_counter() - begin

    def _guide_share(self) -> float:
        # Half of the early paths still follow power: what the first batches missed must be found.
        return max(self._settings.epsilon, 0.5)

    def result(self) -> GlobalContext:
        """The context, once all steps are taken.

        Raises:
            RuntimeError: steps are left.
        """
        if self.done < self.steps:
            raise RuntimeError("the context is not finished: take the steps that are left")
        image = adjoint.shrunk(self._batches, self._emission.count)
        rows, columns = self._grid
        scatter = self._batches.sum(axis=(1, 2))
        statistics = {
            "seconds": round(self._seconds, 3),
            "paths": int(self._settings.samples_per_cell * rows * columns),
            "emitters": self._emission.count,
            "rows": rows,
            "columns": columns,
            "flux": float(scatter.mean()),
            "flux_standard_error": float(scatter.std(ddof=1) / np.sqrt(len(scatter))),
        }
        return GlobalContext(
            digest=self.digest,
            scene=self._scene.digest,
            sensor=self._scene.sensor_index,
            settings=self._settings,
            adjoint=image.astype(np.float32),
            emitters=self._emission.keys,
            statistics=statistics,
        )

    def to_bytes(self) -> bytes:
        """The state after the steps taken, as one safetensors record."""
        facts = np.array([self._seconds], np.float64)
        return save_tensors({"batches": self._batches, "seconds": facts}, metadata={"digest": self.digest})

    def restore(self, data: bytes) -> None:
        """Take up a state that :meth:`to_bytes` saved, in this process or another.

        Raises:
            ContextMismatch: the state belongs to another grid.
        """
        record = load_tensors(data)
        batches = record["batches"]
        if batches.ndim != 3 or batches.shape[1:] != self._grid or len(batches) > self.steps:
            raise ContextMismatch("the saved state of the context does not fit: it is measured again")
        self._batches, self._seconds = batches, float(record["seconds"][0])


def start_density(context: GlobalContext, emission: Emission) -> StartDensity:
    """The density of light vertices that ``context`` proposes, for the scene of ``emission``.

    Raises:
        ContextMismatch: the context was measured with other emitters.
    """
    rows, columns = context.adjoint.shape
    same = context.emitters.shape == emission.keys.shape and np.allclose(
        context.emitters, emission.keys, rtol=1e-4, atol=1e-4
    )
    if not same or columns % emission.count or rows < 1:
        raise ContextMismatch("the context belongs to a scene with other lights: build it again for this scene")
    return StartDensity(emission, adjoint.start_table(context.adjoint, emission, context.settings.epsilon))
