"""Pictures of a context: everything in its place, in the colour that its value has."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from elps_core.context.encoding import DirectionalTables
from elps_core.context.regions import Regions, Table
from elps_core.context.store import DirectionalParts, GlobalContext
from elps_core.io.context_pictures import (
    BORDER,
    FRAME_WIDTH,
    GROUND,
    NOWHERE,
    OUTLINE,
    SHADE,
    chosen_regions,
    particles_picture,
    pictures,
    region_colours,
    regions_picture,
    tables_picture,
)
from elps_core.io.preview import false_colour
from elps_core.io.pyramid import GAP
from elps_core.settings import ContextSettings

Array = np.ndarray[Any, Any]

COUNT = 12
ROWS, COLUMNS = 4, 8
TOP, BOTTOM = (false_colour(np.array([[value]]), 1e-3, 1.0)[0, 0].tolist() for value in (1.0, 1e-3))


def tables(values: Array | None = None, evidence: Array | None = None) -> DirectionalTables:
    values = np.ones((COUNT, ROWS, COLUMNS)) if values is None else values
    return DirectionalTables.of(values, np.ones(COUNT), np.zeros(COUNT, np.int64) if evidence is None else evidence)


@pytest.fixture
def parts() -> DirectionalParts:
    """A view of 2 x 3 tiles of 20 x 20 pixels: tile i has region 2 i on its left half and 2 i + 1 on its right."""
    tile = np.arange(6).reshape(2, 3)
    half = np.stack([2 * tile, 2 * tile + 1], axis=2).reshape(2, 6)
    view = half.repeat(20, axis=0).repeat(10, axis=1).astype(np.uint16)
    rng = np.random.default_rng(0)
    normals = np.tile(np.array([[0, 0, 1]], np.float32), (COUNT, 1))
    table = Table((0.0, 0.0, 0.0), 1.0, np.array([[[1]]], np.uint32), np.zeros((6, 1), np.uint16))
    regions = Regions(rng.random((COUNT, 3)).astype(np.float32), normals, 1.0, table)
    density = rng.random((2, 16, 16)).astype(np.float32)
    return DirectionalParts(
        regions,
        tables(),
        tables(),
        np.ones(view.shape, np.float32),
        1.0,
        np.ones((regions.count, 2), np.float32),
        view,
        density,
    )


def context(parts: DirectionalParts | None) -> GlobalContext:
    adjoint, emitters = np.ones((8, 9), np.float32), np.ones((3, 7), np.float32)
    return GlobalContext("a", "b", 0, ContextSettings(resolution=8), adjoint, emitters, {}, parts)


def test_a_context_without_tables_has_one_picture(parts: DirectionalParts) -> None:
    assert set(pictures(context(None))) == {"adjoint.png"}
    found = pictures(context(parts))
    assert set(found) == {"adjoint.png", "particles.png", "regions.png", "tables.png"}
    assert all(picture.dtype == np.uint8 and picture.shape[2] == 3 for picture in found.values())


def test_photons_are_on_the_left_and_importons_on_the_right() -> None:
    density = np.zeros((2, 4, 4), np.float32)
    density[0, 0, 1] = 0.5  # From above, the first row is the upper one
    density[1, 3, 2] = 0.0005
    picture = particles_picture(density)
    scale = (picture.shape[0] - 2 * GAP) // 4

    def cell(kind: int, row: int, column: int) -> list[int]:
        left = GAP + kind * (4 * scale + GAP)
        block = picture[GAP + row * scale :, left + column * scale :][:scale, :scale].reshape(-1, 3)
        assert (block == block[0]).all()
        return [int(value) for value in block[0]]

    assert cell(0, 0, 1) == TOP
    assert cell(1, 3, 2) == BOTTOM
    for place in [(0, 3, 2), (1, 0, 1), (0, 1, 0)]:
        assert cell(*place) == GROUND.tolist()


def test_of_each_tile_the_region_that_most_is_known_of_is_chosen(parts: DirectionalParts) -> None:
    evidence = np.arange(COUNT) + 1
    evidence[4] = 1000
    assert chosen_regions(replace(parts, radiance=tables(evidence=evidence))).tolist() == [[1, 3, 4], [7, 9, 11]]
    # Of little use where nothing is known of the importance.
    both = replace(
        parts, radiance=tables(evidence=evidence), importance=tables(evidence=1000 * (np.arange(COUNT) == 6))
    )
    assert chosen_regions(both).tolist() == [[1, 3, 4], [6, 9, 11]]


def test_what_is_not_in_view_is_not_chosen(parts: DirectionalParts) -> None:
    view = parts.view.copy()
    view[view == 1] = 0
    view[:20, 20:40] = 65535  # The sky
    hidden = replace(parts, view=view, radiance=tables(evidence=np.where(np.arange(COUNT) == 1, 9, 0)))
    chosen = chosen_regions(hidden)
    assert chosen[0].tolist() == [0, NOWHERE, 4]
    regions = regions_picture(hidden, chosen)
    scale = regions.shape[1] // 60
    assert not regions[5 * scale : 15 * scale, 25 * scale : 35 * scale].any()
    picture = tables_picture(hidden, chosen)
    width = (picture.shape[1] - GAP) // 3
    assert (picture[: picture.shape[0] // 2, width + GAP : 2 * width] == GROUND).all()


def test_regions_are_coloured_shaded_and_outlined(parts: DirectionalParts) -> None:
    pilot = parts.pilot.copy()
    pilot[20:] = 0.0
    picture = regions_picture(replace(parts, pilot=pilot), np.array([[1]]))
    scale = picture.shape[1] // 60
    assert picture.shape == (40 * scale, 60 * scale, 3)

    def at(row: float, column: float) -> Array:
        return picture[int(row * scale), int(column * scale)].astype(float)

    colours = 255.0 * region_colours(COUNT)
    assert at(10.5, 15.5) == pytest.approx(colours[1], abs=1)  # Chosen: as it is
    ratio = at(10.5, 35.5) / colours[3]
    assert ratio == pytest.approx(ratio[0], abs=0.02)
    assert SHADE + 0.3 < ratio[0] <= 1.0
    assert at(35.5, 35.5) == pytest.approx(SHADE * colours[9], abs=1)
    # The border between regions 8 and 9, and that of the chosen one.
    assert at(35.5, 30.0) == pytest.approx(BORDER * SHADE * colours[9], abs=1)
    assert (picture[10 * scale, 10 * scale - 2 : 10 * scale] == OUTLINE).all()
    assert (picture == OUTLINE).all(axis=2).sum() == pytest.approx(2 * scale * (20 + 20 + 10), rel=0.05)


def test_colours_of_many_regions_are_apart() -> None:
    colours = region_colours(4096)
    assert ((colours >= 0.0) & (colours <= 1.0)).all()
    for step in (1, 2, 3):
        assert np.abs(colours[step:] - colours[:-step]).max(axis=1).min() > 0.1
    assert len(np.unique((255 * colours).round(), axis=0)) > 3000


@pytest.mark.parametrize("encoding", ["float32", "log8"])
def test_tables_stand_where_their_regions_are(parts: DirectionalParts, encoding: Any) -> None:
    radiance, importance = (np.full((COUNT, ROWS, COLUMNS), 1e-6) for _ in range(2))
    radiance[9, 1, 2] = importance[9, 3, 7] = 1.0
    filled = replace(
        parts, radiance=tables(radiance).encoded(encoding), importance=tables(importance).encoded(encoding)
    )
    chosen = np.array([[0, 2, 4], [6, 9, 10]])
    picture = tables_picture(filled, chosen)
    height, width = ((side - GAP) // count for side, count in zip(picture.shape, chosen.shape, strict=False))
    one = picture[GAP + height : 2 * height, GAP + width : 2 * width]
    frame = (255.0 * region_colours(COUNT)[9]).round()
    assert (one[:FRAME_WIDTH] == frame).all()
    assert (one[:, -FRAME_WIDTH:] == frame).all()
    scale = (one.shape[1] - 2 * FRAME_WIDTH) // COLUMNS
    above, below = (one[FRAME_WIDTH + i * (ROWS * scale + FRAME_WIDTH) :, FRAME_WIDTH:] for i in (0, 1))
    for table, cell in [(above, (1, 2)), (below, (3, 7))]:
        cells = table[scale // 2 :: scale, scale // 2 :: scale][:ROWS, :COLUMNS]
        bright = [
            (row, column) for row in range(ROWS) for column in range(COLUMNS) if cells[row, column].tolist() == TOP
        ]
        assert bright == [cell]
        assert cells[0, 0].tolist() == BOTTOM


def test_what_is_empty_is_drawn_all_the_same(parts: DirectionalParts) -> None:
    density = np.full_like(parts.density, np.nan)
    empty = replace(parts, pilot=np.zeros_like(parts.pilot), density=density, view=np.full_like(parts.view, 65535))
    found = pictures(context(empty))
    assert not found["regions.png"].any()
    assert (found["particles.png"] == GROUND).all()
    assert (found["tables.png"] == GROUND).all()
