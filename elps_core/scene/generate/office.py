"""An open-plan office: a thousand small meshes of two dozen materials, lit from panels, windows and by the ceiling."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from pydantic import Field

from elps_core.scene.generate import furniture
from elps_core.scene.generate.common import Pixels, SceneBuilder, SceneDescription, generator
from elps_core.scene.generate.furniture import BOOKCASE_WIDTH, DESK_WIDTH, Part
from elps_core.scene.generate.mesh import Mesh, box, quad
from elps_core.scene.generate.mesh import merged as joined

HEIGHT = 3.0
"""Of the ceiling above the floor, metres."""
WALL = 0.3
"""Thickness of walls, floor slab and ceiling, metres."""
AISLE = 2.4
"""Free space around the desks, metres."""
PITCH = (DESK_WIDTH + 0.25, 4.0)
"""From desk to desk along x, and from one pair of rows to the next along y, metres."""
BACK_TO_BACK = 0.47
"""From the dividers of a pair of rows to the middles of its desks, metres."""
SEAT = 0.75
"""From the middle of a desk to its chair, metres."""
DESKS_PER_BOOKCASE = 6
BOOKCASE_PITCH = BOOKCASE_WIDTH + 0.15
SILL, LINTEL = 0.9, 2.6
"""Where windows begin and end above the floor, metres."""
PIER, WINDOW = 0.5, 1.9
"""Widths of the wall between two windows, and of a window, metres."""
FRAME = 0.05
PANEL = (1.1, 0.28)
"""Half sides of a ceiling panel along x and y, metres."""
PANEL_RADIANCE = (9.0, 8.6, 7.8)
SKY_RADIANCE = (2.2, 2.7, 3.4)
UPLIGHT_RADIANCE = (14.0, 11.0, 7.0)
"""Of the strips on bookcases, which shine at the ceiling."""
SEED = 20
"""Of all that lies about by chance: one seed makes one office."""
DIFFUSE = {
    "plaster": (0.78, 0.76, 0.72),
    "acoustic_tile": (0.84, 0.84, 0.82),
    "felt": (0.20, 0.34, 0.32),
    "fabric_blue": (0.08, 0.16, 0.38),
    "fabric_grey": (0.22, 0.22, 0.24),
    "paper": (0.82, 0.82, 0.78),
    "terracotta": (0.55, 0.24, 0.14),
    "leaf": (0.08, 0.24, 0.06),
}
ROUGH_PLASTIC = {
    "oak": ((0.50, 0.32, 0.17), 0.2),
    "birch": ((0.66, 0.52, 0.36), 0.25),
    "black_plastic": ((0.03, 0.03, 0.035), 0.2),
    "white_lacquer": ((0.75, 0.75, 0.74), 0.1),
    "grey_lacquer": ((0.36, 0.38, 0.40), 0.1),
}
"""Material -> colour, and roughness as the alpha of GGX."""
PLASTIC = {
    "screen": (0.012, 0.014, 0.02),
    "mug_white": (0.75, 0.74, 0.70),
    "mug_red": (0.60, 0.06, 0.05),
    "book_red": (0.52, 0.08, 0.07),
    "book_blue": (0.10, 0.20, 0.48),
    "book_green": (0.12, 0.34, 0.18),
    "book_ochre": (0.66, 0.44, 0.10),
}
METALS = {"steel": ("Cr", 0.3), "aluminium": ("Al", 0.2), "chrome": ("Cr", 0.08), "copper": ("Cu", 0.15)}
CARPET = ((0.23, 0.25, 0.28), (0.19, 0.21, 0.24))
"""Colours of the carpet's tiles, which are half a metre wide."""


@generator
def office(
    desks: Annotated[int, Field(ge=1, le=400)] = 24, merged: bool = False, width: Pixels = 480, height: Pixels = 300
) -> SceneDescription:
    """An open-plan office with ``desks`` desks: 33 mesh shapes for each, and 25 materials.

    With ``merged`` the same triangles are one mesh for each material. The camera looks along the rows to
    the bookcases; the windows are on the left, and a bright sky is behind them.

    Raises:
        SettingsRejected: a parameter is out of its range.
    """
    random = np.random.default_rng(SEED)
    columns = max(2, round(math.sqrt(desks * 0.8)))
    rows = 2 * math.ceil(desks / (2 * columns))
    size = (columns * PITCH[0] + 2 * AISLE, rows // 2 * PITCH[1] + AISLE)
    parts = _shell(*size)
    for number in range(desks):
        parts += [_named(f"place_{number}", part) for part in _workplace(number, columns, random)]
    cases = max(1, min(desks // DESKS_PER_BOOKCASE, int(size[0] // BOOKCASE_PITCH)))
    middles = size[0] / 2 + BOOKCASE_PITCH * (np.arange(cases) - (cases - 1) / 2)
    for number, x in enumerate(middles):
        case = furniture.moved(furniture.bookcase(random), (float(x), size[1], 0.0))
        parts += [_named(f"bookcase_{number}", part) for part in case]
    for number, (x, y) in enumerate(((0.5, size[1] - 0.5), (size[0] - 0.5, size[1] - 0.5), (0.5, size[1] / 2))):
        plant = furniture.moved(furniture.plant(random), (x, y, 0.0), 50.0 * number)
        parts += [_named(f"plant_{number}", part) for part in plant]
    scene = SceneBuilder()
    _materials(scene)
    for part in _one_for_each_material(parts) if merged else parts:
        scene.mesh(part.name, part.mesh, part.material, flat=part.flat)
    _lights(scene, size, middles)
    origin = (size[0] - 0.9, 0.5, 1.75)
    scene.camera(origin, (size[0] * 0.36, size[1] * 0.62, 0.8), fov=54.0, size=(width, height))
    return scene.finish()


def _workplace(number: int, columns: int, random: np.random.Generator) -> list[Part]:
    """A desk and its chair. Two rows share their dividers and face each other."""
    row, column = divmod(number, columns)
    pair, far = divmod(row, 2)
    middle = (AISLE + PITCH[0] * (column + 0.5), AISLE + PITCH[1] * (pair + 0.35))
    chair = furniture.chair(random)
    chair = furniture.moved(chair, (float(random.uniform(-0.2, 0.2)), -SEAT, 0.0), float(random.uniform(-50.0, 50.0)))
    side = 1.0 if far else -1.0
    place = (middle[0], middle[1] + side * BACK_TO_BACK, 0.0)
    return furniture.moved(furniture.desk(random) + chair, place, 180.0 if far else 0.0)


def _named(owner: str, part: Part) -> Part:
    return Part(f"{owner}_{part.name}", part.mesh, part.material, part.flat)


def _one_for_each_material(parts: list[Part]) -> list[Part]:
    groups: dict[tuple[str, bool], list[Mesh]] = {}
    for part in parts:
        groups.setdefault((part.material, part.flat), []).append(part.mesh)
    return [Part(f"all_{material}", joined(*meshes), material, flat) for (material, flat), meshes in groups.items()]


def _shell(width: float, depth: float) -> list[Part]:
    """Slabs, walls and windows around [0, ``width``] x [0, ``depth``]; windows are at x = 0."""
    low, high = -WALL, HEIGHT + WALL
    parts = [
        Part("ceiling", box((low, low, HEIGHT), (width + WALL, depth + WALL, high)), "acoustic_tile"),
        Part("slab", box((low, low, low), (width + WALL, depth + WALL, -0.005)), "plaster"),
        Part("wall_south", box((low, low, 0), (width + WALL, 0, HEIGHT)), "plaster"),
        Part("wall_north", box((low, depth, 0), (width + WALL, depth + WALL, HEIGHT)), "plaster"),
        Part("wall_east", box((width, 0, 0), (width + WALL, depth, HEIGHT)), "plaster"),
        Part("sill", box((low, 0, 0), (0, depth, SILL)), "plaster"),
        Part("lintel", box((low, 0, LINTEL), (0, depth, HEIGHT)), "plaster"),
    ]
    windows = max(1, int((depth - PIER) // (PIER + WINDOW)))
    pier = (depth - windows * WINDOW) / (windows + 1)
    for number in range(windows + 1):
        y = number * (pier + WINDOW)
        parts.append(Part(f"pier_{number}", box((low, y, SILL), (0, y + pier, LINTEL)), "plaster"))
        if number == windows:
            break
        start, end, x = y + pier, y + pier + WINDOW, -WALL / 2
        frame = [
            box((x - FRAME, start, SILL), (x, start + FRAME, LINTEL)),
            box((x - FRAME, end - FRAME, SILL), (x, end, LINTEL)),
            box((x - FRAME, (start + end - FRAME) / 2, SILL), (x, (start + end + FRAME) / 2, LINTEL)),
            box((x - FRAME, start, SILL), (x, end, SILL + FRAME)),
            box((x - FRAME, start, LINTEL - FRAME), (x, end, LINTEL)),
        ]
        parts += [Part(f"frame_{number}_{bar}", mesh, "white_lacquer") for bar, mesh in enumerate(frame)]
        # A blind that is drawn down to a different height at each window.
        drop = 0.25 + 0.2 * (number % 3)
        slats = [quad((-0.08, start + 0.05, LINTEL - d), (0.03, 0, 0.02), (0, WINDOW - 0.1, 0))
                 for d in np.arange(0.05, drop, 0.04)]  # fmt: skip
        parts.append(Part(f"blind_{number}", joined(*slats), "aluminium"))
    return parts


def _materials(scene: SceneBuilder) -> None:
    for name, color in DIFFUSE.items():
        scene.diffuse(name, color)
    for name, (color, roughness) in ROUGH_PLASTIC.items():
        scene.plastic(name, color, roughness)
    for name, color in PLASTIC.items():
        scene.plastic(name, color)
    for name, (material, roughness) in METALS.items():
        scene.metal(name, material, roughness)


def _lights(scene: SceneBuilder, size: tuple[float, float], bookcases: np.ndarray) -> None:
    """The carpet and everything that shines."""
    width, depth = size
    carpet = scene.checkered("carpet", *CARPET, tiles=(width, depth))
    scene.flat("rectangle", "floor", (width / 2, depth / 2, 0.0), (width / 2, 0, 0), (0, depth / 2, 0), carpet)
    white = "plaster"
    across, along = max(1, round(width / 4.5)), max(1, round(depth / 4.0))
    for i in range(across):
        for j in range(along):
            place = (width * (i + 0.5) / across, depth * (j + 0.5) / along, HEIGHT - 0.02)
            scene.flat("rectangle", f"panel_{i}_{j}", place, (0, PANEL[1], 0), (PANEL[0], 0, 0), white, PANEL_RADIANCE)
    for number, x in enumerate(bookcases):
        place = (float(x), depth - 0.16, furniture.BOOKCASE_HEIGHT + 0.02)
        scene.flat("rectangle", f"uplight_{number}", place, (0.5, 0, 0), (0, 0.05, 0), white, UPLIGHT_RADIANCE)
    scene.sky("sky", SKY_RADIANCE)
