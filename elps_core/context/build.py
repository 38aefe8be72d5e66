"""The preprocessing pass: measures a scene step by step, each step guided by the ones before."""

from __future__ import annotations

import time
from dataclasses import asdict, astuple
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from elps_core.choice import CANDIDATES, PILOTS, Pilot, fit_candidates, together
from elps_core.context import adjoint
from elps_core.context.adjoint import AdjointMeasurement
from elps_core.context.pilots import PilotRunner
from elps_core.context.saved import UNFIT
from elps_core.context.scouting import (
    FIRST_SCOUTS,
    SCOUTS,
    brought_up,
    falls_short,
    far_ahead,
    next_scout,
    to_compare_again,
    unguided_wins,
    worth_measuring,
)
from elps_core.context.store import DirectionalParts, GlobalContext
from elps_core.context.tables import TableBuilder
from elps_core.errors import ContextMismatch
from elps_core.sampling.start import StartDensity, power_table
from elps_core.scene.digest import context_digest
from elps_core.scene.emission import Emission
from elps_core.scene.loader import LoadedScene
from elps_core.scene.sensors import Camera
from elps_core.settings import ContextSettings

LOOKED_AFTER, SCOUTED_AFTER = 2, 3
"""Steps of filling before the first scouts, 2^15 + 2^16 paths, and before all of them: 2^17 more."""


class ContextBuilder:
    """Builds the global context of one scene and sensor in a few short steps.

    A step takes well under ten seconds. Between steps the state can be saved with
    :meth:`to_bytes` and taken up elsewhere with :meth:`restore`.
    """

    def __init__(self, scene: LoadedScene, settings: ContextSettings) -> None:
        self._scene = scene
        self._settings = settings
        camera = Camera(scene.sensor)
        self._adjoint = AdjointMeasurement(scene.scene, camera, Emission(scene.scene), settings)
        self._tables = TableBuilder(scene.scene, camera, settings) if settings.regions else None
        self._candidates = fit_candidates(scene.summary, settings) if settings.regions and settings.adaptive else []
        self._scouts: list[Pilot] = []
        self._pilots: list[Pilot] = []
        self._stopped = False
        self._parts: DirectionalParts | None = None
        self._seconds = 0.0
        self.digest = context_digest(scene.digest, scene.sensor_index, scene.size, settings)

    @property
    def steps(self) -> int:
        """Steps in all; some at the end are left out where tables have converged before."""
        tables = self._tables.steps if self._tables else 0
        return adjoint.STEPS + tables + (1 if self._scouting else 0) + len(self._measured)

    @property
    def _scouting(self) -> bool:
        """Whether scouts say, or are yet to say, if training is to go on to its end."""
        if not self._tables or self._settings.thorough or not set(SCOUTS) & set(self._candidates):
            return False
        left = len(self._tables.filling) - SCOUTED_AFTER
        converged = self._tables.done == self._tables.steps and not self._scouts
        return self._tables.knows_nothing and left >= 1 and not converged

    @property
    def _measured(self) -> list[str]:
        """Candidates of which there are pilots in the end, or will be."""
        return worth_measuring(self._candidates, self._scouts, self._pilots, stopped=self._stopped)

    def begin_from(self, other: GlobalContext) -> bool:
        """Take over what a context of the same surroundings and settings knows of light; whether it was of use.

        Raises:
            RuntimeError: steps have been taken.
        """
        same = other.settings.model_copy(update={"thorough": self._settings.thorough})
        fit = (other.surroundings, same) == (self._scene.surroundings, self._settings)
        if not fit or not other.statistics.get("thorough") or not self._tables or not other.directions:
            return False
        emission = self._adjoint.emission
        return self._tables.begin_from(other.directions, StartDensity(emission, power_table(emission)))

    @property
    def done(self) -> int:
        """Steps taken."""
        scouted = 1 if self._scouts else 0
        return len(self._adjoint.batches) + (self._tables.done if self._tables else 0) + scouted + len(self._pilots)

    def step(self) -> None:
        """Take the next step; none is left when :attr:`done` equals :attr:`steps`."""
        begin = time.perf_counter()
        dr.flush_malloc_cache()  # Each step has larger arrays, and no use for memory of the sizes before
        measured = self._adjoint
        if len(measured.batches) < adjoint.STEPS:
            measured.step()
        elif self._tables and self.done < self.steps:
            table = adjoint.start_table(
                measured.image(), measured.emission, self._settings.epsilon, self._settings.exponent
            )
            lights = StartDensity(measured.emission, table)
            if self._scouting and not self._scouts and self._tables.filled == SCOUTED_AFTER:
                self._scout(self._tables, lights)
            elif self._tables.done < self._tables.steps:
                if not self._given_up(self._tables, lights):
                    self._tables.step(lights)
            else:
                self._parts = self._parts or self._tables.result()
                runner = self._runner(self._parts, lights)
                self._pilots.append(runner.run(self._measured[len(self._pilots)], self._pilots))
        self._seconds += time.perf_counter() - begin

    def _scout(self, tables: TableBuilder, lights: StartDensity) -> None:
        """Compare a few candidates by the tables so far; no more steps for these where a plain one will be better."""
        parts = tables.result()
        runner = self._runner(parts, lights)
        while (name := next_scout(self._candidates, self._scouts)) is not None:
            self._scouts.append(runner.run(name, self._scouts, scout=True))
        if unguided_wins(self._scouts):
            self._stop(tables, parts)

    def _given_up(self, tables: TableBuilder, lights: StartDensity) -> bool:
        """Whether a step before all scouts, or one after them, it is clear that tables will not pay."""
        if self._scouting and not self._scouts and tables.filled == LOOKED_AFTER:
            return tables.finds_noise and set(FIRST_SCOUTS) <= set(self._candidates) and self._look(tables, lights)
        again = to_compare_again(self._scouts) if self._scouting and tables.filled == SCOUTED_AFTER + 1 else []
        if not again:
            return False
        parts, after = tables.result(), list[Pilot]()
        runner = self._runner(parts, lights)
        for name in again:
            after.append(runner.run(name, after, scout=True))
        if falls_short(self._scouts, after, tables.doublings_left):
            self._scouts = brought_up(self._scouts, after)
            self._stop(tables, parts)
        return self._stopped

    def _look(self, tables: TableBuilder, lights: StartDensity) -> bool:
        """Whether joined subpaths are far ahead of what tables can do."""
        parts, scouts = tables.result(), list[Pilot]()
        runner = self._runner(parts, lights)
        for name in FIRST_SCOUTS:
            scouts.append(runner.run(name, scouts, scout=True, brief=True))
            if not far_ahead(scouts):
                return False
        self._scouts = scouts
        self._stop(tables, parts)
        return True

    def _stop(self, tables: TableBuilder, parts: DirectionalParts) -> None:
        """Fill tables no further."""
        tables.stop()
        self._stopped, self._parts = True, parts

    def _runner(self, parts: DirectionalParts, lights: StartDensity) -> PilotRunner:
        return PilotRunner(self._scene.scene, Camera(self._scene.sensor), lights, parts, self._settings)

    def result(self) -> GlobalContext:
        """The context, once all steps are taken.

        Raises:
            RuntimeError: steps are left.
        """
        if self.done < self.steps:
            raise RuntimeError("the context is not finished: take the steps that are left")
        measured = self._adjoint
        flux = measured.batches.sum(axis=(1, 2))
        statistics: dict[str, Any] = {
            "paths": int(self._settings.samples_per_cell * measured.rows * measured.columns),
            "emitters": measured.emission.count,
            "rows": measured.rows,
            "columns": measured.columns,
            "flux": float(flux.mean()),
            "flux_standard_error": float(flux.std(ddof=1) / np.sqrt(len(flux))),
        }
        begin = time.perf_counter()
        tables = self._tables
        parts = self._parts = self._parts or (tables.result() if tables else None)
        if tables and parts:
            statistics |= {
                "particles": tables.particles,
                "table_paths": tables.paths,
                "table_error": tables.relative_error(),
                "records": int(parts.radiance.evidence.sum()),
                "median_records": float(np.median(parts.radiance.evidence)),
                "thorough": not self._stopped,
            }
        if self._candidates:
            statistics[PILOTS] = [asdict(pilot) for pilot in together(self._scouts, self._pilots)]
        self._seconds += time.perf_counter() - begin
        statistics = {"seconds": round(self._seconds, 3), **statistics}
        return GlobalContext(
            digest=self.digest,
            scene=self._scene.digest,
            sensor=self._scene.sensor_index,
            settings=self._settings,
            adjoint=measured.image().astype(np.float32),
            emitters=measured.emission.keys,
            statistics=statistics,
            directions=parts,
            surroundings=self._scene.surroundings,
        )

    def to_bytes(self) -> bytes:
        """The state after the steps taken, as one safetensors record."""
        parts = {"batches": self._adjoint.batches, "seconds": np.array([self._seconds])}
        if self._tables:
            parts |= {f"tables.{name}": array for name, array in self._tables.arrays().items()}
        if self._pilots:
            parts["pilots"] = _rows(self._pilots)
        if self._scouts:
            parts |= {"scouts": _rows(self._scouts), "stopped": np.array([self._stopped])}
        return save_tensors({name: np.ascontiguousarray(array) for name, array in parts.items()})

    def restore(self, data: bytes) -> None:
        """Take up a state that :meth:`to_bytes` saved, in this process or another.

        Raises:
            ContextMismatch: the state belongs to another grid.
        """
        try:
            record = load_tensors(data)
            batches, seconds = record["batches"], float(record["seconds"][0])
            stopped = bool(record["stopped"][0]) if "stopped" in record else False
            scouts, pilots = (_pilots(record[name]) if name in record else [] for name in ("scouts", "pilots"))
        except (SafetensorError, KeyError, IndexError, TypeError, ValueError):
            raise ContextMismatch(UNFIT) from None
        grid = (self._adjoint.rows, self._adjoint.columns)
        if (
            batches.ndim != 3
            or batches.shape[1:] != grid
            or len(batches) > adjoint.STEPS
            or batches.dtype != np.float64
        ):
            raise ContextMismatch(UNFIT)
        if self._tables:
            prefix = "tables."
            kept = {name.removeprefix(prefix): part for name, part in record.items() if name.startswith(prefix)}
            self._tables.restore(kept)
        self._adjoint.batches, self._seconds = batches, seconds
        self._scouts, self._pilots, self._parts, self._stopped = scouts, pilots, None, stopped


NAMES = tuple(CANDIDATES)
"""Of candidates, by their number in a saved state."""


def _rows(pilots: list[Pilot]) -> NDArray[np.float64]:
    """[n, 8]: all that pilots say, candidates by number."""
    return np.array([(NAMES.index(pilot.name), *astuple(pilot)[1:]) for pilot in pilots], np.float64)


def _pilots(rows: NDArray[np.float64]) -> list[Pilot]:
    """What :func:`_rows` gave."""
    found = []
    for number, variance, error, mean, mean_error, microseconds, samples, rival in rows.tolist():
        found.append(Pilot(NAMES[int(number)], variance, error, mean, mean_error, microseconds, int(samples), rival))
    return found


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
    return StartDensity(
        emission, adjoint.start_table(context.adjoint, emission, context.settings.epsilon, context.settings.exponent)
    )
