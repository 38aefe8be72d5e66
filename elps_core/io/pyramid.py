"""The pyramid picture of bidirectional path tracing: one small image for each strategy [Veach 1997, fig. 10.3].

Row k holds the paths of k segments. In a row, the image with s light vertices is the s-th from the left
(from 0), which makes the one with t eye vertices the t-th from the right.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from elps_core.io.preview import Tone, encode

Pair = tuple[int, int]
"""(s, t): numbers of light and eye vertices."""
Linear = NDArray[np.float32]

GAP = 14
MARGIN = 32
ROW_LABEL = 96
"""Pixels left of the images for what a row holds."""
TITLE, TEXT, SMALL = 26, 16, 13
"""Heights of letters in pixels."""
LINE = 1.4
"""Distance of two lines, in heights of a letter."""
MIN_WIDTH = 128
"""Narrower images are enlarged by whole numbers, so that there is room for what stands below them."""
BACKGROUND, INK, PALE, FRAME = "#14171c", "#f2f2f0", "#a7adb8", "#343a44"
TONE: Tone = "filmic"
BRIGHT = 90.0
"""Percentile of a row's lit pixels that becomes a light grey: lamps and fireflies above it do not darken the rest."""
SUM_ROWS = 2
"""Rows beside which the sum of all images stands."""


@dataclass(frozen=True)
class Row:
    """The images of the paths of one length."""

    segments: int
    images: Mapping[Pair, Linear]
    """In order of s."""

    @property
    def exposure(self) -> float:
        """Stops by which all images of the row are brightened alike, so that they can be compared."""
        brightest = np.max([image.max(axis=-1) for image in self.images.values()], axis=0)
        lit = brightest[brightest > 0.0]
        return -float(np.log2(np.percentile(lit, BRIGHT))) if lit.size else 0.0

    @property
    def is_dark(self) -> bool:
        """Whether no image of the row has any light."""
        return not any(image.any() for image in self.images.values())

    def shares(self) -> dict[Pair, float]:
        """How much of the row's light each image holds."""
        means = {pair: float(image.mean()) for pair, image in self.images.items()}
        whole = max(sum(means.values()), float(np.finfo(np.float32).tiny))
        return {pair: mean / whole for pair, mean in means.items()}


def rows_of(images: Mapping[Pair, Linear]) -> list[Row]:
    """The rows of the pyramid, shortest paths first."""
    lengths = sorted({s + t - 1 for s, t in images})
    return [
        Row(length, {pair: images[pair] for pair in sorted(images) if sum(pair) == length + 1}) for length in lengths
    ]


def draw(rows: list[Row], title: str, subtitle: str, *, weighted: bool) -> NDArray[np.uint8]:
    """The picture, 8-bit RGB [height, width, 3].

    ``weighted``: the images of a row add up to its light. Then each is labelled with its share, and their
    sum is shown beside the top of the pyramid where there is room.
    """
    height, width = next(iter(rows[0].images.values())).shape[:2]
    scale = max(1, -(-MIN_WIDTH // width))
    cell = _Cell(width * scale, height * scale)
    columns = max(len(row.images) for row in rows)
    left = MARGIN + ROW_LABEL
    top = MARGIN + int(LINE * (TITLE + TEXT)) + GAP
    right = max(
        left + columns * (cell.width + GAP) - GAP, MARGIN + _width(title, TITLE), MARGIN + _width(subtitle, TEXT)
    )
    size = (right + MARGIN, top + len(rows) * cell.pitch - GAP + MARGIN)
    figure = Image.new("RGB", size, BACKGROUND)
    pen = ImageDraw.Draw(figure)
    pen.text((MARGIN, MARGIN), title, fill=INK, font=_font(TITLE))
    pen.text((MARGIN, MARGIN + int(LINE * TITLE)), subtitle, fill=PALE, font=_font(TEXT))
    for number, row in enumerate(rows):
        y = top + number * cell.pitch
        pen.text((MARGIN, y), f"k = {row.segments}", fill=INK, font=_font(TEXT))
        stops = "no light" if row.is_dark else f"{row.exposure:+.1f} stops"
        pen.text((MARGIN, y + int(LINE * TEXT)), stops, fill=PALE, font=_font(SMALL))
        start = left + (columns - len(row.images)) * (cell.width + GAP) // 2
        for column, (pair, image) in enumerate(row.images.items()):
            x = start + column * (cell.width + GAP)
            _paste(figure, encode(image, row.exposure, TONE), (x, y), (cell.width, cell.height))
            note = f"{100 * row.shares()[pair]:.1f}%" if weighted and not row.is_dark else ""
            _caption(pen, (x, y + cell.height), cell.width, f"{pair[0]}, {pair[1]}", note)
    if weighted and len(rows) > SUM_ROWS:
        _paste_sum(figure, pen, rows, cell, (left + columns * (cell.width + GAP) - GAP, top), columns)
    return np.asarray(figure)


@dataclass(frozen=True)
class _Cell:
    width: int
    height: int

    @property
    def pitch(self) -> int:
        """From one row to the next."""
        return self.height + int(LINE * TEXT) + GAP


def _paste_sum(
    figure: Image.Image, pen: ImageDraw.ImageDraw, rows: list[Row], cell: _Cell, corner: Pair, columns: int
) -> None:
    """All light together, in the corner that the first rows leave free, if that is as wide as an image.

    ``corner`` is the upper right one of the pyramid.
    """
    free = (columns - max(len(row.images) for row in rows[:SUM_ROWS])) * (cell.width + GAP) // 2 - 2 * GAP
    room = (SUM_ROWS - 1) * cell.pitch + cell.height
    if free < cell.width:
        return
    scale = min(free / cell.width, room / cell.height)
    size = (int(cell.width * scale), int(cell.height * scale))
    whole = Row(0, {(0, 0): np.sum([image for row in rows for image in row.images.values()], axis=0)})
    left, top = corner[0] - size[0], corner[1]
    _paste(figure, encode(whole.images[0, 0], whole.exposure, TONE), (left, top), size)
    _caption(pen, (left, top + size[1]), size[0], "sum", f"{whole.exposure:+.1f} stops")


def _paste(figure: Image.Image, pixels: NDArray[np.uint8], corner: Pair, size: Pair) -> None:
    picture = Image.fromarray(np.ascontiguousarray(pixels))
    whole = size[0] % picture.width == 0 and size[1] % picture.height == 0
    picture = picture.resize(size, Image.Resampling.NEAREST if whole else Image.Resampling.LANCZOS)
    frame = (corner[0] - 1, corner[1] - 1, corner[0] + size[0], corner[1] + size[1])
    ImageDraw.Draw(figure).rectangle(frame, outline=FRAME)
    figure.paste(picture, corner)


def _caption(pen: ImageDraw.ImageDraw, corner: Pair, width: int, text: str, note: str) -> None:
    y = corner[1] + (int(LINE * TEXT) - TEXT) // 2
    pen.text((corner[0], y), text, fill=INK, font=_font(TEXT))
    pen.text((corner[0] + width, y + TEXT - SMALL), note, fill=PALE, font=_font(SMALL), anchor="ra")


def _width(text: str, size: int) -> int:
    return int(np.ceil(_font(size).getlength(text)))


def _font(size: int) -> ImageFont.ImageFont | ImageFont.FreeTypeFont:
    return ImageFont.load_default(size)
