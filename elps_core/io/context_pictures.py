"""Pictures of a global context for eyes: particles, regions and tables [thesis 5.2]. Needs no Mitsuba."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from elps_core.io.preview import adjoint_picture, encode, false_colour
from elps_core.io.pyramid import BACKGROUND, BRIGHT, GAP, TONE

if TYPE_CHECKING:
    from elps_core.context.encoding import DirectionalTables
    from elps_core.context.store import DirectionalParts, GlobalContext

Pixels = NDArray[np.uint8]

GROUND = np.array([int(BACKGROUND[i : i + 2], 16) for i in (1, 3, 5)], np.uint8)
OUTLINE = np.array([255, 255, 255], np.uint8)
MAP_SIDE = 512
"""Side in pixels of what is seen from above, at least."""
VIEW_WIDTH = 960
"""Width in pixels of the region map, at least."""
TABLE_WIDTH = 256
"""Width in pixels of a table, at least."""
DECADES = 3.0
"""Range of a logarithmic scale, from its top down. A table's floor lies about as deep below its brightest cells."""
CROWDED = 99.5
"""Percentile of the occupied cells that is the top of a map's scale: walls seen edge-on lie above, and are few."""
TILES = (2, 3)
"""Rows and columns that the view is divided into; each lends one region to the picture of the tables."""
NOWHERE = -1
"""In place of a region's number."""
FRAME_WIDTH = 4
"""Pixels of its region's colour round a table."""
GOLDEN_ANGLE = 0.6180339887
"""Step of hue from region to region, in turns: keeps any run of numbers apart."""
SHADE = 0.25
"""Brightness of a region where the image is black: dark regions are regions too."""
BORDER = 0.45
"""What a pixel on the border of two regions keeps of its brightness."""


def pictures(context: GlobalContext) -> dict[str, Pixels]:
    """All pictures of a context by file name, 8-bit RGB [height, width, 3]."""
    found = {"adjoint.png": adjoint_picture(context.adjoint)}
    if context.directions is not None:
        chosen = chosen_regions(context.directions)
        found["particles.png"] = particles_picture(context.directions.density)
        found["regions.png"] = regions_picture(context.directions, chosen)
        found["tables.png"] = tables_picture(context.directions, chosen)
    return found


def particles_picture(density: NDArray[np.floating[Any]]) -> Pixels:
    """Where particles are, from above [thesis fig. 5.13]: photons on the left, importons on the right.

    ``density`` [2, n, n] is drawn as it lies, on one logarithmic scale. Cells without particles are grey.
    """
    values = np.nan_to_num(density, nan=0.0, posinf=0.0, neginf=0.0)
    occupied = values[values > 0.0]
    top = float(np.percentile(occupied, CROWDED)) if occupied.size else 1.0
    scale = max(1, -(-MAP_SIDE // values.shape[2]))
    maps = []
    for kind in values:
        colours = false_colour(kind, top * 10.0**-DECADES, top)
        colours[kind <= 0.0] = GROUND
        maps.append(_enlarged(colours, scale))
    return _board([maps])


def chosen_regions(parts: DirectionalParts) -> NDArray[np.int64]:
    """The regions whose tables are worth a look: in each of :data:`TILES` of the view the one that most is known of.

    A region belongs to the tile that its middle is in. :data:`NOWHERE` for a tile without any.
    """
    count = parts.regions.count
    evidence = np.log1p(parts.radiance.evidence) + np.log1p(parts.importance.evidence)
    seen = parts.view < count
    region = parts.view[seen].astype(np.int64)
    pixels = np.bincount(region, minlength=count)
    tile = np.zeros(count, np.int64)
    for axis, (side, tiles) in enumerate(zip(parts.view.shape, TILES, strict=True)):
        middle = np.bincount(region, np.nonzero(seen)[axis] + 0.5, count) / np.maximum(pixels, 1)
        tile = tile * tiles + np.minimum(middle * tiles / side, tiles - 1).astype(np.int64)
    chosen = np.full(TILES, NOWHERE, np.int64)
    for place in range(chosen.size):
        candidates = np.flatnonzero((tile == place) & (pixels > 0))
        if candidates.size:
            chosen.flat[place] = candidates[np.argmax(evidence[candidates])]
    return chosen


def regions_picture(parts: DirectionalParts, chosen: NDArray[np.int64]) -> Pixels:
    """The regions as the camera sees them [thesis fig. 5.9], a colour each, shaded by the image.

    Those of ``chosen`` are bright and have a white outline. What belongs to no region is black.
    """
    height, width = parts.view.shape
    scale = max(1, -(-VIEW_WIDTH // width))
    pilot = np.maximum(parts.pilot, 0.0)
    lit = pilot[pilot > 0.0]
    stops = -float(np.log2(np.percentile(lit, BRIGHT))) if lit.size else 0.0
    grey = encode(np.repeat(pilot[..., None], 3, axis=2), stops, TONE)
    smooth = Image.fromarray(grey).resize((width * scale, height * scale), Image.Resampling.BICUBIC)
    view = _enlarged(parts.view.astype(np.int64), scale)
    shade = SHADE + (1.0 - SHADE) * np.asarray(smooth, np.float64) / 255.0
    shade[_edges(view)] *= BORDER
    marked = np.where(np.isin(view, chosen), view, NOWHERE)
    shade[marked != NOWHERE] = 1.0
    colours = region_colours(parts.regions.count)
    inside = view < len(colours)
    colour = np.where(inside[..., None], colours[np.where(inside, view, 0)], 0.0) * shade
    outline = _edges(marked)
    outline = (outline | _edges(outline)) & (marked == NOWHERE)  # Two pixels around
    return np.where(outline[..., None], OUTLINE, (255.0 * colour).round()).astype(np.uint8)


def tables_picture(parts: DirectionalParts, chosen: NDArray[np.int64]) -> Pixels:
    """Radiance, and below it importance, of the regions ``chosen`` [rows, columns], in frames of their colours.

    A table is drawn as its cells lie, a map of all directions of equal area: +z along the top, -z along the
    bottom, azimuth from left to right. Its scale is logarithmic down from its own largest value.
    """
    colours = (255.0 * region_colours(parts.regions.count)).round().astype(np.uint8)
    _, rows, columns = parts.radiance.shape
    scale = max(1, -(-TABLE_WIDTH // columns))
    blank = np.broadcast_to(
        GROUND, (2 * (rows * scale + FRAME_WIDTH) + FRAME_WIDTH, columns * scale + 2 * FRAME_WIDTH, 3)
    )

    def pair(region: int) -> Pixels:
        result = blank.copy()
        if region == NOWHERE:
            return result
        result[:] = colours[region]
        for place, tables in enumerate((parts.radiance, parts.importance)):
            top = FRAME_WIDTH + place * (rows * scale + FRAME_WIDTH)
            cells = Image.fromarray(_table(tables, region)).resize(
                (columns * scale, rows * scale), Image.Resampling.NEAREST
            )
            result[top : top + rows * scale, FRAME_WIDTH:-FRAME_WIDTH] = np.asarray(cells)
        return result

    return _board([[pair(int(region)) for region in row] for row in chosen])


def region_colours(count: int) -> NDArray[np.float64]:
    """A colour for each region [count, 3] in [0, 1], neighbours in number far apart."""
    index = np.arange(count)
    turn = index * GOLDEN_ANGLE % 1.0
    depth = np.array([0.38, 0.24, 0.31])[index % 3]
    level = np.array([0.62, 0.74, 0.50])[index // 3 % 3]
    wave = np.cos(2.0 * np.pi * (turn[:, None] + np.array([0.0, 1.0, 2.0]) / 3.0))
    return np.asarray(np.clip(level[:, None] + depth[:, None] * wave, 0.0, 1.0))


def _table(tables: DirectionalTables, region: int) -> Pixels:
    one = slice(region, region + 1)
    alone = replace(
        tables,
        values=tables.values[one],
        scale=tables.scale[one],
        irradiance=tables.irradiance[one],
        evidence=tables.evidence[one],
    )
    share = alone.decoded()[0]
    top = max(float(share.max()), float(np.finfo(np.float32).tiny))
    return false_colour(share, top * 10.0**-DECADES, top)


def _edges(view: NDArray[Any]) -> NDArray[np.bool_]:
    """Pixels [height, width] whose neighbour to the right or below is of another region, or they of its."""
    edge = np.zeros(view.shape, np.bool_)
    across, down = view[:, 1:] != view[:, :-1], view[1:] != view[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge


def _enlarged(values: NDArray[Any], scale: int) -> NDArray[Any]:
    return np.repeat(np.repeat(values, scale, axis=0), scale, axis=1)


def _board(rows: list[list[Pixels]]) -> Pixels:
    """Pictures of one size in rows, with gaps between and around them."""
    height, width = rows[0][0].shape[:2]
    board = np.empty((GAP + len(rows) * (height + GAP), GAP + len(rows[0]) * (width + GAP), 3), np.uint8)
    board[:] = GROUND
    for i, row in enumerate(rows):
        for j, picture in enumerate(row):
            y, x = GAP + i * (height + GAP), GAP + j * (width + GAP)
            board[y : y + height, x : x + width] = picture
    return board
