"""A figure of captioned pictures in a grid, for a front page."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

CELL = 400
"""Side of the square that a picture is fitted into, pixels."""
GAP = 28
TITLE_SIZE, CAPTION_SIZE, NOTE_SIZE = 30, 19, 15
"""Heights of the letters in pixels."""
LINE = 1.35
"""Distance of two lines, in heights of a letter."""
BACKGROUND, INK, PALE = "#14171c", "#f2f2f0", "#a7adb8"


@dataclass(frozen=True)
class Panel:
    """One picture with what stands below it."""

    png: bytes
    caption: str
    note: str = ""
    """A second, smaller line."""
    cells: bool = False
    """Whether its pixels are data to be told apart: enlarged as squares instead of smoothly."""


def save_figure(path: Path, title: str, subtitle: str, rows: Sequence[Sequence[Panel]]) -> None:
    """Writes the panels as a PNG, row by row, under a title."""
    head = GAP + int(LINE * (TITLE_SIZE + CAPTION_SIZE)) + GAP // 2
    row_height = CELL + GAP // 2 + int(LINE * (CAPTION_SIZE + NOTE_SIZE)) + GAP // 2
    columns = max(len(row) for row in rows)
    figure = Image.new("RGB", (GAP + columns * (CELL + GAP), head + len(rows) * row_height + GAP // 2), BACKGROUND)
    draw = ImageDraw.Draw(figure)
    draw.text((GAP, GAP), title, fill=INK, font=ImageFont.load_default(TITLE_SIZE))
    below_title = (GAP, GAP + int(LINE * TITLE_SIZE))
    draw.text(below_title, subtitle, fill=PALE, font=ImageFont.load_default(CAPTION_SIZE))
    for y, row in enumerate(rows):
        for x, panel in enumerate(row):
            _paste(figure, draw, panel, GAP + x * (CELL + GAP), head + y * row_height)
    figure.save(path, optimize=True)


def _paste(figure: Image.Image, draw: ImageDraw.ImageDraw, panel: Panel, left: int, top: int) -> None:
    with Image.open(io.BytesIO(panel.png)) as picture:
        scale = CELL / max(picture.size)
        size = (max(1, round(picture.width * scale)), max(1, round(picture.height * scale)))
        how = Image.Resampling.NEAREST if panel.cells else Image.Resampling.LANCZOS
        figure.paste(picture.convert("RGB").resize(size, how), (left, top + CELL - size[1]))
    text_top = top + CELL + GAP // 2
    draw.text((left, text_top), panel.caption, fill=INK, font=ImageFont.load_default(CAPTION_SIZE))
    note_top = text_top + int(LINE * CAPTION_SIZE)
    draw.text((left, note_top), panel.note, fill=PALE, font=ImageFont.load_default(NOTE_SIZE))
