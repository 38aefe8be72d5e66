"""The adjoint image: how much each piece of the lights gives to the picture [thesis 5.2.1]."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.integrators.bdpt import Bdpt
from elps_core.integrators.frame import LANES
from elps_core.paths.roulette import RouletteRule
from elps_core.paths.stream import Stream
from elps_core.sampling.start import StartDensity, power_table, uniform_table
from elps_core.scene.emission import Emission
from elps_core.scene.emitters import MANY
from elps_core.scene.sensors import Camera
from elps_core.scene.spectrum import luminance
from elps_core.settings import ContextSettings, LightSampling

Table = NDArray[np.float64]

STEPS = 8
"""Batches of a measurement: enough to tell noise from signal, few enough to be cheap to launch."""
EARLY_SHARE = 0.5
"""Share of a batch's light paths that follow power, so that what earlier ones missed is found."""
PATHS = 1 << 16
"""Of one pass of a batch, at most."""
FAINTEST = 1e-6
"""Power of an emitter over the mean, at least: one whose samples are all black may emit after all."""
ROULETTE = RouletteRule("albedo", 5)
STREAM = 0xE1B5
"""Sets the measurement's random numbers apart from those of renders with the same seed."""


def grid(emitters: int, resolution: int) -> tuple[int, int]:
    """(rows, columns) of an adjoint image: columns a multiple of the emitters, about resolution^2 cells."""
    columns = -(-resolution // emitters) * emitters
    rows = resolution if columns < 2 * resolution else max(1, resolution * resolution // columns)
    return rows, columns


def start_table(adjoint: NDArray[np.floating[Any]], emission: Emission, epsilon: float, exponent: float = 1.0) -> Table:
    """Weights of the start density: a power of the adjoint image, plus a share ``epsilon`` of emitted power.

    The share keeps every cell alive: measurements are estimates, and a cell that they missed must
    still be drawn [thesis 5.2.1].
    """
    rows, columns = adjoint.shape
    per_cell = rows * (columns // emission.count)
    power = np.repeat(emission.power / per_cell, columns // emission.count)[None, :].repeat(rows, axis=0)
    measured = np.asarray(adjoint, np.float64) ** exponent
    if measured.sum() <= 0.0:
        return power
    share = power / max(power.sum(), np.finfo(float).tiny)
    return np.asarray((1.0 - epsilon) * measured / measured.sum() + epsilon * share)


def density_of(
    sampling: LightSampling, emission: Emission, adjoint: NDArray[np.floating[Any]] | None, settings: ContextSettings
) -> StartDensity:
    """The density of light vertices that ``sampling`` asks for, by ``adjoint`` [rows, columns] where it is theirs."""
    if adjoint is not None and sampling in ("adjoint", "context"):
        table = start_table(adjoint, emission, settings.epsilon, settings.exponent)
        # Tables by region count pieces of lights, which a density that is flat by chance would have fewer of.
        return StartDensity(emission, table, cells=settings.regions > 0)
    return StartDensity(emission, uniform_table(emission) if sampling == "uniform" else power_table(emission))


class AdjointMeasurement:
    """Measures the adjoint image of one scene and sensor in :data:`STEPS` equal batches.

    Each batch starts its light paths by what the ones before have found; the scatter between
    batches tells how much of the image is noise.
    """

    def __init__(self, scene: mi.Scene, camera: Camera, emission: Emission, settings: ContextSettings) -> None:
        self.scene, self.camera, self.emission, self.settings = scene, camera, emission, settings
        self.rows, self.columns = grid(emission.count, settings.resolution)
        self.batches: Table = np.zeros((0, self.rows, self.columns))
        """Unbiased estimates of the image, [steps taken, rows, columns]."""

    def step(self) -> None:
        """Measure one more batch."""
        number = len(self.batches)
        guide = start_table(self.image(), self.emission, max(self.settings.epsilon, EARLY_SHARE))
        lights = StartDensity(self.emission, guide, cells=True)
        bdpt = Bdpt(self.scene, self.camera, lights, max_depth=self.settings.max_depth, roulette=ROULETTE)
        # No more for many emitters than for one, whose cells are about as many as a square of the resolution.
        cells = min(self.rows * self.columns, 2 * self.settings.resolution**2)
        wanted = max(1, self.settings.samples_per_cell * cells // STEPS)
        passes = -(-wanted // PATHS)
        batch = np.zeros((self.rows, self.columns))
        for part in range(passes):
            batch += measure(bdpt, -(-wanted // passes), (self.settings.seed, STREAM, number, part))
        self.batches = np.concatenate([self.batches, batch[None] / passes])

    def image(self) -> Table:
        """The best estimate of the adjoint image so far, [rows, columns]; zeros before the first step."""
        return best_estimate(self.batches, self.emission) if len(self.batches) else np.zeros((self.rows, self.columns))


def measure(bdpt: Bdpt, paths: int, key: tuple[int, ...]) -> Table:
    """One unbiased estimate of the adjoint image [rows, columns] from as many eye as light ``paths``.

    Every contribution that the paths make to the film's mean luminance is entered where its light
    vertex lies, whatever the strategy; cells sum to the mean luminance of the film.
    """
    lights: StartDensity = bdpt.lights
    turns = -(-paths // LANES[dr.backend_v(mi.Float)])
    streams = (Stream.of(-(-paths // turns), *key, 0), Stream.of(-(-paths // turns), *key, 1))
    position = Stream.of(paths, *key, 2).next_2d() * mi.Point2f(bdpt.camera.size)
    cells = lights.rows * lights.columns
    light_sums, eye_sums = dr.zeros(mi.Float, cells), dr.zeros(mi.Float, cells)
    target = light_sums

    def deposit(cell: mi.UInt32, value: mi.Spectrum, wavelengths: mi.Spectrum, active: mi.Bool) -> None:
        amount = luminance(mi.UnpolarizedSpectrum(value), wavelengths)
        dr.scatter_reduce(dr.ReduceOp.Add, target, amount, cell, active & dr.isfinite(amount) & (amount > 0.0))

    def splat(*_: object) -> None:
        """The film's own picture is not wanted here."""

    def switch() -> None:
        # The light kernel has run when the eye kernel is traced: one buffer each, because no kernel
        # may write a buffer that another pending one writes too.
        nonlocal target
        target = eye_sums

    bdpt.trace(position, streams, splat, deposit, between=switch, turns=turns)
    dr.eval(light_sums, eye_sums)
    total = np.array(light_sums, np.float64) + np.array(eye_sums, np.float64)
    return np.asarray(total.reshape(lights.columns, lights.rows).T / paths)


def best_estimate(batches: NDArray[np.float64], emission: Emission) -> Table:
    """An adjoint image [rows, columns] from equal batches [n, rows, columns], as free of noise as they allow."""
    image = shrunk(batches, emission.count)
    return image if emission.count <= MANY else evened(image, batches, emission.power)


def shrunk(batches: NDArray[np.float64], emitters: int) -> Table:
    """The mean of equal batches [n, rows, columns], noisy cells drawn towards what is around them.

    From the whole emitter down, by halves of both sides: of what cells differ in from the mean of their block, that
    share is kept which the scatter between batches does not explain (James and Stein), one share for all blocks of an
    emitter that are of a size. So a converged image stays as it is, and every emitter keeps its sum.
    """
    n, rows, columns = batches.shape
    if n < 2:
        return np.asarray(batches.mean(axis=0))
    per_emitter = columns // emitters
    drawn = _drawn_to_blocks(batches.reshape(n, rows, emitters, per_emitter), np.ones((rows, 1, per_emitter)))
    return drawn.reshape(rows, columns)


def evened(image: Table, batches: NDArray[np.float64], power: NDArray[np.float64]) -> Table:
    """An image [rows, columns] whose emitters are drawn towards their neighbours in what they give for their power.

    Each of thousands is known by a few paths. Neighbours in the order of emitters are neighbours in space; of what an
    emitter differs in from its block, that share is kept which the scatter between ``batches`` does not explain. Power
    weighs, so that a strong lamp among weak ones stays as strong as it is.
    """
    n, (rows, columns) = len(batches), image.shape
    emitters = len(power)
    if n < 2:
        return image
    weight = np.maximum(power, FAINTEST * max(float(power.mean()), np.finfo(float).tiny))[None, None, :]
    sums = batches.reshape(n, rows, emitters, -1).sum(axis=(1, 3))[:, None, None, :]
    drawn = (_drawn_to_blocks(sums, weight) * weight)[0, 0]
    own = image.reshape(rows, emitters, -1)
    total = own.sum(axis=(0, 2))
    even = np.full_like(own, 1.0 / (rows * own.shape[2]))
    shares = np.divide(own, total[None, :, None], out=even, where=total[None, :, None] > 0.0)
    return np.asarray((shares * drawn[None, :, None]).reshape(rows, columns))


def _drawn_to_blocks(sums: NDArray[np.float64], cells: NDArray[np.float64]) -> Table:
    """Means as of :func:`shrunk`, of batches of sums [n, rows, emitters, columns of one] over ``cells`` each."""
    n, rows, _, columns = sums.shape
    means = sums / cells
    mean = means.mean(axis=0)
    if rows == columns == 1:
        return np.asarray(mean)
    blocks, cells_of_block = _by_blocks(sums), _by_blocks(cells)

    def spread(part: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(part.repeat(2, axis=-3)[..., :rows, :, :].repeat(2, axis=-1)[..., :columns])

    around = spread(blocks.mean(axis=0) / cells_of_block)
    worth = np.divide(cells, around, out=np.zeros_like(mean), where=around > 0.0)
    differs = np.square(mean - around) * worth
    noise = (means - spread(blocks / cells_of_block)).var(axis=0, ddof=1) / n * worth
    found, explained = (part.sum(axis=(0, 2), keepdims=True) for part in (differs, noise))
    keep = np.clip(1.0 - np.divide(explained, found, out=np.ones_like(found), where=found > 0.0), 0.0, 1.0)
    # By ratios, so that nothing becomes negative where a block itself is drawn down.
    ratio = np.divide(mean, around, out=np.ones_like(mean), where=around > 0.0)
    return np.asarray(spread(_drawn_to_blocks(blocks, cells_of_block)) * (1.0 + keep * (ratio - 1.0)))


def _by_blocks(part: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums of two by two cells [..., rows, emitters, columns]; the last ones of an odd number stay apart."""
    rows, columns = (np.arange(0, part.shape[axis], 2) for axis in (-3, -1))
    return np.asarray(np.add.reduceat(np.add.reduceat(part, rows, axis=-3), columns, axis=-1))
