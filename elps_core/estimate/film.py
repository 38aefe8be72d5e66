"""Chunks of an image, and their sum."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from elps_core.estimate.stats import relative_error

Image = NDArray[np.float32]

RGB = ("R", "G", "B")
"""Channels of an image as a rule: linear, with the primaries of Rec. 709."""
RGBA = (*RGB, "A")
"""The same, and how much of each pixel is covered: colours hold that part already."""

MANY_SAMPLES = 8
"""Samples per pixel from which on the weights of a filter with lobes add up to a positive number. The sum over one
random sample in each pixel has a standard deviation of half of its mean at most ('lanczos', 'catmullrom',
'mitchell')."""
LEAST_SHARE = 0.25
"""What they are taken for at least, over their mean: over so many samples it is four standard deviations away."""
_STATISTIC, _LEFT_OUT = "statistic ", "left out "
"""Prefixes of names in a record: of statistics, and of what is seen where samples were left out."""
MOST_NAMED = 3
"""Things that one warning names."""


class Statistic(NamedTuple):
    """A number that an algorithm says of its own work, such as the share of accepted mutations."""

    mean: float
    """Over all chunks, weighted by their samples."""
    standard_error: float | None
    """Of the mean, from the scatter of the chunks; None with fewer than two."""


@dataclass(frozen=True)
class Chunk:
    """An independent estimate of the whole image: the unit of rendering and of merging."""

    index: int
    spp: int
    """Samples per pixel."""
    seconds: float
    """Time that rendering it took."""
    image: Image
    """Mean radiance, float32 [height, width, channels]."""
    weight: Image
    """Weight of each pixel's mean, float32 [height, width]: samples times the filter's weight."""
    statistics: Mapping[str, float] = field(default_factory=dict)
    """Numbers that the algorithm says of its work, by name; each is a mean over the chunk's samples."""
    channels: tuple[str, ...] = RGB
    """Names: :data:`RGB`, :data:`RGBA`, or those of the film's bands."""
    filtered: Image | None = None
    """Of filters whose weights are negative in places: the sum of the samples' weights over ``weight``, [height,
    width], 1 on average. Many chunks' images are divided by their mean of it: see :class:`Accumulation`."""
    left_out: Mapping[str, int] = field(default_factory=dict)
    """Samples that were not finite and count nowhere, by what the camera sees where they fell."""
    dark: tuple[str, ...] = ()
    """Why the image may be black, where it is; empty otherwise."""

    def to_bytes(self) -> bytes:
        """The chunk as one safetensors record."""
        facts = np.array([self.index, self.spp, self.seconds], np.float64)
        statistics = {_STATISTIC + name: np.array([value], np.float64) for name, value in self.statistics.items()}
        record: dict[str, NDArray[Any]] = {"facts": facts, "image": self.image, "weight": self.weight, **statistics}
        record |= _named(_LEFT_OUT, self.left_out)
        record["channels"] = _packed(self.channels)
        if self.dark:
            record["dark"] = _packed(self.dark)
        if self.filtered is not None:
            record["filtered"] = self.filtered
        return save_tensors(record)

    @classmethod
    def from_bytes(cls, data: bytes) -> Chunk:
        """The inverse of :meth:`to_bytes`."""
        record = load_tensors(data)
        index, spp, seconds = record["facts"]
        statistics = {name: float(values[0]) for name, values in _in(record, _STATISTIC).items()}
        image, channels = record["image"], _unpacked(record["channels"])
        filtered = record.get("filtered")
        left_out = _counts_in(record)
        weight, dark = record["weight"], _dark_in(record)
        return cls(int(index), int(spp), float(seconds), image, weight, statistics, channels, filtered, left_out, dark)


@dataclass
class Accumulation:
    """The weighted mean of independent chunks, and what their scatter says of its error.

    While it is empty it has the channels of a colour image; then those of its chunks, which must agree.

    Chunks y with weights w may say what their filter's weights x added up to (:attr:`Chunk.filtered`). From
    :data:`MANY_SAMPLES` on the image is then the quotient sum w y / sum w x, which is without noise where radiance is
    even, and right for many samples; before, x is taken for 1, its mean.
    """

    width: int
    height: int
    chunks: set[int] = field(default_factory=set)
    """Indices of the chunks it holds."""
    spp: int = 0
    seconds: float = 0.0
    channels: tuple[str, ...] = RGB
    left_out: dict[str, int] = field(default_factory=dict)
    """Of all chunks: see :attr:`Chunk.left_out`."""
    dark: tuple[str, ...] = ()
    """Of black chunks: see :attr:`Chunk.dark`."""
    _weight: NDArray[np.float64] = field(init=False, repr=False)
    _sum: NDArray[np.float64] = field(init=False, repr=False)
    _square: NDArray[np.float64] = field(init=False, repr=False)
    _filtered: NDArray[np.float64] | None = field(init=False, repr=False, default=None)
    """Sums of w x and w x^2, and of w x y for each channel, in this order; None where chunks have none."""
    _statistics: dict[str, list[tuple[float, float]]] = field(init=False, repr=False, default_factory=dict)
    """(samples, value) of each chunk, by name: few numbers beside its image."""

    def __post_init__(self) -> None:
        """Start from an empty image."""
        self._begin(self.channels)

    def _begin(self, channels: tuple[str, ...]) -> None:
        self.channels = channels
        self._weight = np.zeros((self.height, self.width, 1))
        self._sum = np.zeros((self.height, self.width, len(channels)))
        self._square = np.zeros((self.height, self.width, len(channels)))
        self._filtered = None

    @classmethod
    def empty(cls, width: int, height: int) -> Accumulation:
        """No samples yet; sizes in pixels."""
        return cls(width, height)

    def add(self, chunk: Chunk, factor: float = 1.0) -> None:
        """Add a chunk, whose samples count ``factor`` as much as others: it must not depend on the samples.

        Raises:
            ValueError: the chunk's size or channels differ, or its index is already in.
        """
        if not self.chunks:
            self._begin(chunk.channels)
        if chunk.channels != self.channels or chunk.image.shape != self._sum.shape:
            raise ValueError("the chunk has another size")
        if chunk.index in self.chunks:
            raise ValueError(f"chunk {chunk.index} is already in")
        weight = factor * chunk.weight.astype(np.float64)[..., None]
        image = chunk.image.astype(np.float64)
        self._weight += weight
        self._sum += weight * image
        self._square += weight * image * image
        if chunk.filtered is not None:
            share = chunk.filtered.astype(np.float64)[..., None]
            parts = np.concatenate([weight * share, weight * share * share, weight * share * image], axis=-1)
            self._filtered = parts if self._filtered is None else self._filtered + parts
        self.chunks.add(chunk.index)
        self.spp += chunk.spp
        self.seconds += chunk.seconds
        self._leave_out(chunk.left_out)
        self.dark = self.dark or chunk.dark
        for name, value in chunk.statistics.items():
            if math.isfinite(value):  # a share of nothing says nothing
                self._statistics.setdefault(name, []).append((float(chunk.spp), value))

    def add_all(self, chunks: Iterable[Chunk]) -> None:
        """Add several chunks."""
        for chunk in chunks:
            self.add(chunk)

    def weighted(self, factor: float) -> Accumulation:
        """The same image, whose samples count ``factor`` as much as others when it is merged with these.

        The factor must not depend on the samples themselves.
        """
        other = replace(self, chunks=set(self.chunks), left_out=dict(self.left_out))
        other._weight, other._sum, other._square = (factor * part for part in (self._weight, self._sum, self._square))
        other._filtered = None if self._filtered is None else factor * self._filtered
        other._statistics = {name: list(values) for name, values in self._statistics.items()}
        return other

    def merge(self, other: Accumulation) -> None:
        """Add all that ``other`` holds.

        Raises:
            ValueError: sizes or channels differ, or both hold the same chunk.
        """
        if not other.chunks:
            return
        if not self.chunks:
            self._begin(other.channels)
        alike = other.channels == self.channels and other._sum.shape == self._sum.shape
        if not alike or self.chunks & other.chunks:
            raise ValueError("the accumulations differ in size or channels, or share chunks")
        self._weight += other._weight
        self._sum += other._sum
        self._square += other._square
        if other._filtered is not None:
            self._filtered = other._filtered + (0.0 if self._filtered is None else self._filtered)
        self.chunks |= other.chunks
        self.spp += other.spp
        self.seconds += other.seconds
        self._leave_out(other.left_out)
        self.dark = self.dark or other.dark
        for name, values in other._statistics.items():
            self._statistics.setdefault(name, []).extend(values)

    def _leave_out(self, counts: Mapping[str, int]) -> None:
        for name, count in counts.items():
            self.left_out[name] = self.left_out.get(name, 0) + count

    def warnings(self) -> tuple[str, ...]:
        """What there is to say against the image, a line each."""
        if not self.left_out:
            return self.darkness
        count, samples = sum(self.left_out.values()), self.spp * self.width * self.height
        named = sorted(self.left_out, key=lambda name: (-self.left_out[name], name))
        others = [f"and {len(named) - MOST_NAMED} other things"] if len(named) > MOST_NAMED else []
        seen = ", ".join([*named[:MOST_NAMED], *others])
        what = f"{count:,} samples that are not finite are left out (the image has {samples:,})"
        return (
            f"{what}: their pixels show {seen}; check these materials, and how bright the lights are",
            *self.darkness,
        )

    @property
    def darkness(self) -> tuple[str, ...]:
        """Why the image is black, a line each; empty where it has light."""
        if self._sum[..., : len(self.channels) - (self.channels == RGBA)].any():
            return ()
        return tuple(f"the image is black: {reason}" for reason in self.dark)

    def mean(self) -> Image:
        """The image, float32 [height, width, channels]; zeros where nothing was sampled."""
        return self._mean().astype(np.float32)

    def standard_error(self) -> Image:
        """Standard error of :meth:`mean` per pixel and channel; zeros with fewer than two chunks.

        Chunks weigh by their samples: Var = sum w (m - mean)^2 / ((K - 1) sum w).
        """
        count = len(self.chunks)
        if count < 2:
            return np.zeros(self._sum.shape, np.float32)
        mean, share = self._mean(), self._share()
        if self._filtered is None or share is None:
            spread = self._square - self._weight * mean * mean
        else:  # Of y - mean x
            spread = self._square - 2.0 * mean * self._filtered[..., 2:] + mean * mean * self._filtered[..., 1:2]
        variance = _divide(np.maximum(spread, 0.0), self._weight * (count - 1))
        error = np.sqrt(variance) if share is None else np.sqrt(variance) / share
        return np.asarray(error, np.float32)

    def relative_error(self) -> float | None:
        """Of the light, see :func:`elps_core.estimate.stats.relative_error`; None with fewer than two chunks."""
        if len(self.chunks) < 2:
            return None
        light = slice(len(RGB) if self.channels == RGBA else None)
        return relative_error(self.mean()[..., light], self.standard_error()[..., light])

    def statistics(self) -> dict[str, Statistic]:
        """What the algorithm says of its work, by name.

        Var = sum w^2 (x - mean)^2 / ((sum w)^2 - sum w^2), w the samples: right for values whose variance
        falls with a chunk's samples, and close for those that every chunk measures equally well.
        """
        result = {}
        for name, values in sorted(self._statistics.items()):
            weight, value = np.array(values, np.float64).T
            mean = float((weight * value).sum() / weight.sum())
            error = None
            if len(values) >= 2:
                spread = (weight**2 * (value - mean) ** 2).sum() / (weight.sum() ** 2 - (weight**2).sum())
                error = float(np.sqrt(spread))
            result[name] = Statistic(mean, error)
        return result

    def _mean(self) -> NDArray[np.float64]:
        share = self._share()
        return _divide(self._sum, self._weight if share is None else self._weight * share)

    def _share(self) -> NDArray[np.float64] | None:
        """What the filter's weights added up to, over what is expected of them; None where that is taken for 1."""
        if self._filtered is None or self.spp < MANY_SAMPLES:
            return None
        return np.maximum(_divide(self._filtered[..., :1], self._weight), LEAST_SHARE)

    def to_bytes(self) -> bytes:
        """The accumulation as one safetensors record."""
        record: dict[str, NDArray[Any]] = {
            "facts": np.array([self.width, self.height, self.spp, self.seconds], np.float64),
            "chunks": np.array(sorted(self.chunks), np.int64),
            "channels": _packed(self.channels),
            **({} if self._filtered is None else {"filtered": self._filtered}),
            "weight": self._weight,
            "sum": self._sum,
            "square": self._square,
            **{_STATISTIC + name: np.array(values, np.float64) for name, values in self._statistics.items()},
            **_named(_LEFT_OUT, self.left_out),
            **({"dark": _packed(self.dark)} if self.dark else {}),
        }
        return save_tensors(record)

    @classmethod
    def from_bytes(cls, data: bytes) -> Accumulation:
        """The inverse of :meth:`to_bytes`."""
        record = load_tensors(data)
        width, height, spp, seconds = record["facts"]
        chunks, channels = {int(i) for i in record["chunks"]}, _unpacked(record["channels"])
        result = cls(
            int(width), int(height), chunks, int(spp), float(seconds), channels, _counts_in(record), _dark_in(record)
        )
        result._weight, result._sum, result._square = record["weight"], record["sum"], record["square"]
        result._filtered = record.get("filtered")
        result._statistics = {
            name: [(float(weight), float(value)) for weight, value in values]
            for name, values in _in(record, _STATISTIC).items()
        }
        return result


def _packed(names: tuple[str, ...]) -> NDArray[np.uint8]:
    return np.frombuffer("\n".join(names).encode(), np.uint8)


def _unpacked(names: NDArray[Any]) -> tuple[str, ...]:
    return tuple(names.tobytes().decode().split("\n"))


def _named(prefix: str, counts: Mapping[str, int]) -> dict[str, NDArray[Any]]:
    return {prefix + name: np.array([count], np.int64) for name, count in counts.items()}


def _in(record: dict[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    return {key.removeprefix(prefix): values for key, values in record.items() if key.startswith(prefix)}


def _counts_in(record: dict[str, NDArray[Any]]) -> dict[str, int]:
    return {name: int(values[0]) for name, values in _in(record, _LEFT_OUT).items()}


def _dark_in(record: dict[str, NDArray[Any]]) -> tuple[str, ...]:
    return _unpacked(record["dark"]) if "dark" in record else ()


def _divide(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.divide(a, b, out=np.zeros(np.broadcast_shapes(a.shape, b.shape)), where=b > 0)
