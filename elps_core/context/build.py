"""The preprocessing pass: measures a scene step by step, each step guided by the ones before."""

from __future__ import annotations

import time
from dataclasses import asdict, astuple, fields, replace
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from elps_core.context import adjoint
from elps_core.context.adjoint import AdjointMeasurement, best_estimate
from elps_core.context.saved import UNFIT
from elps_core.context.store import DirectionalParts, GlobalContext
from elps_core.context.tables import TableBuilder
from elps_core.context.training import CompilesTooLong
from elps_core.errors import ContextMismatch, NothingScatters
from elps_core.sampling.start import StartDensity, power_table
from elps_core.scene.digest import context_digest
from elps_core.scene.emission import Emission
from elps_core.scene.failing import told
from elps_core.scene.loader import LoadedScene
from elps_core.scene.sensors import Camera
from elps_core.selection.candidates import (
    CANDIDATES,
    GUIDED_PATH,
    MEANWHILE,
    TRIALS,
    Candidate,
    Trial,
    fit_candidates,
    plain_of,
)
from elps_core.selection.race import (
    ENDLESS,
    Allowance,
    brought_up,
    contenders,
    hard_to_find,
    in_the_middle,
    next_trial,
    training_pays,
)
from elps_core.selection.trials import TrialRunner
from elps_core.settings import ContextSettings
from elps_core.timing import KernelClock

COMPARED_AFTER = 3
"""Steps of filling after which it is asked whether tables will pay: 2^15 + 2^16 + 2^17 paths."""
TRAINING_KERNELS, PATHS = 6.0, 3.0
"""What it takes to have tables that help at all: time to compile the kernels of training, over that of plain paths, and
seconds to trace paths."""
EYE_KERNEL = 2.0
"""Time that the first of these kernels takes to compile, over that of plain paths: 1.8 to 2.3 were seen."""
COMPARED_BY = 0.5
"""Part of the time for preparing after which tables are compared with what needs none, however few paths there were."""


class ContextBuilder:
    """Builds the global context of one scene and sensor in a few short steps.

    A step takes well under ten seconds. Between steps the state can be saved with
    :meth:`to_bytes` and taken up elsewhere with :meth:`restore`.
    """

    def __init__(self, scene: LoadedScene, settings: ContextSettings) -> None:
        self._scene, self._settings = scene, settings
        self._emission: Emission = scene.emission
        camera = Camera(scene.sensor)
        self._tables = TableBuilder(scene.scene, camera, settings) if settings.regions else None
        walks = self._tables is not None and settings.particles == "walks"
        # Paths that fill tables tell what each piece of the lights gives to the image: nothing else need measure it.
        self._adjoint = None if walks else AdjointMeasurement(scene.scene, camera, self._emission, settings)
        self._grid = adjoint.grid(self._emission.count, settings.resolution)
        self._candidates = fit_candidates(scene.summary, settings) if settings.regions and settings.adaptive else []
        self._middle: list[Trial] = []
        self._compared = settings.thorough or not self._candidates
        self._trials: list[Trial] = []
        self._stopped = False
        self._cut = False
        self._parts: DirectionalParts | None = None
        self._seconds = 0.0
        self._allowance = ENDLESS
        self._compiling = 0.0
        self.digest = context_digest(scene.digest, scene.sensor_index, scene.size, settings, scene.variant)

    @property
    def steps(self) -> int:
        """Steps in all, as far as is known; some at the end are left out where tables or trials are not worth them."""
        if self._cut:
            return self.done
        more = 0 if self._compared and self._next_trial() is None else 1
        return self.done + self._left() + more

    @property
    def done(self) -> int:
        """Steps taken."""
        measured = len(self._adjoint.batches) if self._adjoint else 0
        tried = len(self._middle) + (len(self._trials) if self._compared and not self._stopped else 0)
        return measured + (self._tables.done if self._tables else 0) + tried

    @property
    def progress(self) -> float:
        """Part of the steps that is taken, 0 to 1."""
        return self.done / self.steps if self.steps else 1.0

    def _left(self) -> int:
        """Steps of the adjoint image and of the tables that are left."""
        measured = adjoint.STEPS - len(self._adjoint.batches) if self._adjoint else 0
        return measured + (self._tables.steps - self._tables.done if self._tables else 0)

    def begin_from(self, other: GlobalContext) -> bool:
        """Take over what a context of the same surroundings and settings knows of light; whether it was of use.

        Raises:
            RuntimeError: steps have been taken.
        """
        same = other.settings.model_copy(update={"thorough": self._settings.thorough})
        fit = (other.surroundings, same) == (self._scene.surroundings, self._settings)
        if not fit or not other.statistics.get("thorough") or not self._tables or not other.directions:
            return False
        begun = self._tables.begin_from(other.directions, StartDensity(self._emission, power_table(self._emission)))
        self._compared = self._compared or begun
        return begun

    @told()
    def step(self, allowance: Allowance = ENDLESS) -> None:
        """Take the next step; none is left when :attr:`done` equals :attr:`steps`.

        The last step ends by the ``allowance``, and what is there by then is used.

        Raises:
            RenderFailed: Mitsuba fails at something in the scene.
        """
        begin = time.perf_counter()
        dr.flush_malloc_cache()  # Each step has larger arrays, and no use for memory of the sizes before
        # What had to be compiled was not on disk, and what comes after it will not be there.
        self._allowance = replace(allowance, compiling=max(allowance.compiling, self._compiling))
        first = self.done == 0
        with KernelClock() as kernels:
            self._take()
        if first:
            self._compiling = kernels.compiling / TRAINING_KERNELS
        self._seconds += time.perf_counter() - begin

    def _take(self) -> None:
        """Take the next step, whatever it is."""
        if self._adjoint and len(self._adjoint.batches) < adjoint.STEPS:
            self._adjoint.step()
        elif self._tables:
            self._advance(self._tables)

    def _advance(self, tables: TableBuilder) -> None:
        """One step of the tables, or one trial."""
        left, filling = self._allowance.left_for_training(tables.yet_to_come), tables.done < tables.steps
        if filling and not self._compared and self._to_be_compared(tables):
            if (candidate := self._next_trial()) is None:
                self._compared = True
                tables.seeks_slits = hard_to_find(self._middle)
                if not training_pays(self._middle, tables.gain):
                    self._stop(tables)
            else:
                self._middle.append(self._runner(tables).run(candidate, self._middle))
        elif filling and not tables.filled and self._may_do_without and not self._affordable(left):
            self._cut = True
        elif filling and tables.filled and not tables.worth_going_on(left):
            self._end(tables)
        elif filling:
            try:
                tables.step(self._lights(), left, self._patience)
            except CompilesTooLong:
                self._cut = True
                return
            except NothingScatters:
                if not self._may_do_without:
                    raise
                self._cut = True
                return
            self._parts = None
            if tables.done == tables.steps:
                self._end(tables)
        elif (candidate := self._next_trial()) is not None:
            self._trials.append(self._runner(tables).run(candidate, self._trials))

    @property
    def _may_do_without(self) -> bool:
        """Whether a job can render without tables: not one that keeps to them whatever else is better."""
        return bool(self._candidates) and not self._settings.thorough

    @property
    def _patience(self) -> float:
        """Seconds that the first of the kernels of training may take to compile: plain paths may have found theirs on
        disk, so that it is the first to tell how long all of them take."""
        most = self._allowance.compiling_at_most if self._may_do_without else float("inf")
        return EYE_KERNEL / TRAINING_KERNELS * most

    def _affordable(self, left: float) -> bool:
        """Whether the first steps fit into the time ``left``, and what they cost can be borne if tables do not pay."""
        allowance = self._allowance
        if self.done == 0 and TRAINING_KERNELS * allowance.compiling > allowance.compiling_at_most:
            return False
        return left >= self.first_needs(allowance)

    def first_needs(self, allowance: Allowance) -> float:
        """Seconds that have to be left for the next step: the first one is of no use without tables after it."""
        return TRAINING_KERNELS * allowance.compiling + PATHS if self.done == 0 else 0.0

    def _to_be_compared(self, tables: TableBuilder) -> bool:
        if not tables.filled or not tables.knows_nothing:
            return False
        return tables.filled >= COMPARED_AFTER or self._allowance.left(COMPARED_BY) < 0.0

    def _end(self, tables: TableBuilder) -> None:
        """Fill tables no further: they are as good as time allows, or have converged."""
        if self._allowance.left() > tables.yet_to_come:
            tables.look_for_slits()
        tables.stop()
        self._compared, self._parts = True, None

    def _stop(self, tables: TableBuilder) -> None:
        """Fill tables no further, because they will not pay: what was tried by then is all that is."""
        tables.stop()
        self._stopped = True
        self._trials = list(self._middle)

    def _next_trial(self) -> Candidate | None:
        if not self._candidates or self._stopped or self._cut:
            return None
        of_middle = self._tables is not None and not self._compared
        trials = self._middle if of_middle else self._trials
        fit = in_the_middle(self._candidates) if of_middle else contenders(self._candidates, self._middle)
        if not of_middle:  # What tables were filled for comes first: others were tried before, or can wait
            fit = sorted(fit, key=lambda candidate: candidate != GUIDED_PATH)
        caustics = self._tables is not None and self._tables.caustics
        allowance = self._allowance.hasty() if of_middle else self._allowance
        # Gaps that are aimed at by now were no part of the kernels then.
        same = self._tables is not None and not self._tables.slits_found
        compiled = [trial.name for trial in self._middle if same or trial.candidate.guiding != "full"]
        return next_trial(fit, trials, allowance, compiled=compiled, caustics=caustics)

    def _runner(self, tables: TableBuilder) -> TrialRunner:
        self._parts = self._parts or tables.result()
        camera = Camera(self._scene.sensor)
        return TrialRunner(self._scene.scene, camera, self._emission, self._image(), self._parts, self._settings)

    def _image(self) -> NDArray[np.float64]:
        """The adjoint image so far [rows, columns]."""
        if self._adjoint:
            return self._adjoint.image()
        flux = self._tables.flux(*self._grid) if self._tables else np.zeros((2, *self._grid))
        return best_estimate(flux, self._emission)

    def _lights(self) -> StartDensity:
        """By what is known of the lights so far; power keeps more than its usual share while that is little."""
        epsilon = max(self._settings.epsilon, 0.0 if self._adjoint else adjoint.EARLY_SHARE)
        table = adjoint.start_table(self._image(), self._emission, epsilon, self._settings.exponent)
        return StartDensity(self._emission, table, cells=True)

    def result(self) -> GlobalContext:
        """The context, once all steps are taken.

        Raises:
            RuntimeError: steps are left.
        """
        if self.done < self.steps:
            raise RuntimeError("the context is not finished: take the steps that are left")
        begin = time.perf_counter()
        tables = self._tables
        filled = tables is not None and (tables.filled > 0 or not tables.knows_nothing)
        if tables and filled:
            self._parts = self._parts or tables.result()
        parts = self._parts if filled else None
        image, statistics = self._image(), self._facts()
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
            statistics[TRIALS] = [asdict(trial) for trial in brought_up(self._trials, self._middle)]
            statistics[MEANWHILE] = plain_of(self._candidates).name
        self._seconds += time.perf_counter() - begin
        statistics = {"seconds": round(self._seconds, 3), **statistics}
        return GlobalContext(
            digest=self.digest,
            scene=self._scene.digest,
            sensor=self._scene.sensor_index,
            settings=self._settings,
            adjoint=image.astype(np.float32),
            emitters=self._emission.keys,
            statistics=statistics,
            directions=parts,
            surroundings=self._scene.surroundings,
        )

    def _facts(self) -> dict[str, Any]:
        """Of the adjoint image."""
        batches = self._adjoint.batches if self._adjoint else np.zeros((0, *self._grid))
        paths = int(self._settings.samples_per_cell * self._grid[0] * self._grid[1])
        if self._tables and not self._adjoint:
            batches, paths = self._tables.flux(*self._grid), self._tables.flux_paths
        flux = batches.sum(axis=(1, 2))
        return {
            "paths": paths,
            "emitters": self._emission.count,
            "rows": self._grid[0],
            "columns": self._grid[1],
            "flux": float(flux.mean()),
            "flux_standard_error": float(flux.std(ddof=1) / np.sqrt(len(flux))),
        }

    def to_bytes(self) -> bytes:
        """The state after the steps taken, as one safetensors record."""
        flags = [self._compared, self._stopped, self._cut]
        parts: dict[str, NDArray[Any]] = {
            "batches": self._adjoint.batches if self._adjoint else np.zeros((0, *self._grid)),
            "seconds": np.array([self._seconds]),
            "flags": np.array(flags),
            "middle": _rows(self._middle),
            "trials": _rows(self._trials),
        }
        if self._tables:
            parts |= {f"tables.{name}": array for name, array in self._tables.arrays().items()}
        return save_tensors({name: np.ascontiguousarray(array) for name, array in parts.items()})

    def restore(self, data: bytes) -> None:
        """Take up a state that :meth:`to_bytes` saved, in this process or another.

        Raises:
            ContextMismatch: the state belongs to another grid.
        """
        try:
            record = load_tensors(data)
            batches, seconds = record["batches"], float(record["seconds"][0])
            compared, stopped, cut = (bool(flag) for flag in record["flags"])
            middle, trials = (_trials(record[name]) for name in ("middle", "trials"))
        except (SafetensorError, KeyError, IndexError, TypeError, ValueError):
            raise ContextMismatch(UNFIT) from None
        most = adjoint.STEPS if self._adjoint else 0
        if batches.ndim != 3 or batches.shape[1:] != self._grid or len(batches) > most or batches.dtype != np.float64:
            raise ContextMismatch(UNFIT)
        if self._tables:
            prefix = "tables."
            kept = {name.removeprefix(prefix): part for name, part in record.items() if name.startswith(prefix)}
            self._tables.restore(kept)
        if self._adjoint:
            self._adjoint.batches = batches
        self._seconds, self._parts = seconds, None
        self._middle, self._trials = middle, trials
        self._compared, self._stopped, self._cut = compared, stopped, cut


NAMES = tuple(CANDIDATES)
"""Of candidates, by their number in a saved state."""


def _rows(trials: list[Trial]) -> NDArray[np.float64]:
    """[n, 9]: all that trials say, candidates by number."""
    rows = [(NAMES.index(trial.name), *astuple(trial)[1:]) for trial in trials]
    return np.array(rows, np.float64).reshape(len(rows), len(fields(Trial)))


def _trials(rows: NDArray[np.float64]) -> list[Trial]:
    """What :func:`_rows` gave."""
    found = []
    for number, variance, error, mean, mean_error, microseconds, samples, rival, compiling in rows.tolist():
        name = NAMES[int(number)]
        found.append(Trial(name, variance, error, mean, mean_error, microseconds, int(samples), rival, compiling))
    return found


def check_lights(context: GlobalContext, emission: Emission) -> None:
    """Refuse a context that was measured with other emitters.

    Raises:
        ContextMismatch: so it was.
    """
    rows, columns = context.adjoint.shape
    same = context.emitters.shape == emission.keys.shape and np.allclose(
        context.emitters, emission.keys, rtol=1e-4, atol=1e-4
    )
    if not same or columns % emission.count or rows < 1:
        raise ContextMismatch("the context belongs to a scene with other lights: build it again for this scene")
