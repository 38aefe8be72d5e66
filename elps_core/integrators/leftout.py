"""Samples that are not finite: left out of the image, counted where they fall, and named by what is seen there."""

from __future__ import annotations

from collections import Counter
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from elps_core.arrays import on_device
from elps_core.integrators.bdpt import Splat
from elps_core.integrators.chains import Target
from elps_core.paths.primary import PrimaryStream
from elps_core.scene.groups import every_shape, numbers

Counts: TypeAlias = "NDArray[np.uint32]"
"""Samples that were left out of each pixel [height, width]."""


class LeftOut:
    """Counts what is left out of one frame. Where every sample is finite, it costs a comparison for each."""

    def __init__(self, size: mi.ScalarVector2u) -> None:
        """``size``: width and height in pixels."""
        self._width, self._height = int(size.x), int(size.y)
        self._last = mi.ScalarPoint2f(self._width - 1, self._height - 1)
        self._counts = dr.zeros(mi.UInt32, self._width * self._height)

    def keep(self, where: mi.Point2f, amount: mi.Float, active: mi.Bool | bool = True) -> mi.Bool:
        """Which contributions are finite, of those that are active; the others are counted.

        ``where`` are film positions in pixels, ``amount`` a sum of all that is to be finite.
        """
        finite = dr.isfinite(amount)
        place = mi.Point2u(dr.clip(dr.select(dr.isfinite(where), where, 0.0), 0.0, self._last))
        lost = ~finite & active
        dr.scatter_reduce(dr.ReduceOp.Add, self._counts, mi.UInt32(1), place.y * self._width + place.x, lost)
        return finite & active

    @property
    def counts(self) -> Counts:
        """How many were left out so far."""
        return np.array(self._counts).reshape(self._height, self._width)

    def begin(self) -> None:
        """Count from 0 again."""
        self._counts = dr.zeros(mi.UInt32, self._width * self._height)


class FiniteTarget:
    """What chains sample, without contributions that are not finite."""

    def __init__(self, target: Target, left_out: LeftOut) -> None:
        self._target, self._left_out = target, left_out
        self.groups, self.dimensions, self.splats = target.groups, target.dimensions, target.splats

    def evaluate(
        self, streams: tuple[PrimaryStream, PrimaryStream], group: mi.UInt32, splat: Splat
    ) -> tuple[mi.Point2f, mi.Spectrum, mi.Spectrum]:
        """As of :class:`elps_core.integrators.chains.Target`."""

        def finite(
            where: mi.Point2f, value: mi.Spectrum, wavelengths: mi.Spectrum, sample: mi.UInt32, active: mi.Bool
        ) -> None:
            splat(where, value, wavelengths, sample, self._left_out.keep(where, dr.sum(value), active))

        where, value, wavelengths = self._target.evaluate(streams, group, finite)
        return where, dr.select(self._left_out.keep(where, dr.sum(value)), value, 0.0), wavelengths


def seen_at(scene: mi.Scene, sensor: mi.Sensor, counts: Counts) -> dict[str, int]:
    """What the camera sees where samples were left out -> how many.

    Of each pixel the middle alone is looked at: what a path met later on is not known.
    """
    rows, columns = np.nonzero(counts)
    lost = counts[rows, columns]
    height, width = counts.shape
    place = [on_device(mi.Float, ((k + 0.5) / of).astype(np.float32)) for k, of in ((columns, width), (rows, height))]
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(*place), mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    shapes = every_shape(scene)
    of = dict(zip(numbers(shapes).tolist(), shapes, strict=True))
    met = np.broadcast_to(np.array(dr.reinterpret_array(mi.UInt32, si.shape)), len(lost))
    found: Counter[str] = Counter()
    for number, count in zip(met.tolist(), lost.tolist(), strict=True):
        found[_called(of[number]) if number in of else "the surroundings"] += count
    return dict(found)


def _called(shape: mi.Shape) -> str:
    """A shape by its id or kind, and its material by its own."""
    material: Any = shape.bsdf()
    made_of = f"of {_quoted(material)}" if material is not None else "without a material"
    # Meshes of one material are one mesh by now, which has the id of one of them.
    return f"meshes {made_of}" if shape.class_name() == "Mesh" else f"{_quoted(shape)} {made_of}"


def _quoted(thing: mi.Object) -> str:
    return f"'{thing.id()}'" if thing.id() else str(thing.class_name())
