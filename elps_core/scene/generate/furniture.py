"""Furniture of an office, each piece as many small meshes. Lengths are metres, z points up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from elps_core.scene.generate.mesh import Mesh, box, lathe, merged, smooth, tube

LATHE_SEGMENTS = 24
CURVE_STEPS = 4
DESK_WIDTH, DESK_DEPTH, DESK_HEIGHT = 1.6, 0.8, 0.74
MUG = ((0.0, 0.0), (0.04, 0.0), (0.042, 0.01), (0.042, 0.095), (0.037, 0.095), (0.036, 0.012), (0.0, 0.01))
"""Outline (radius, height), outside and then inside."""
POT = ((0.0, 0.0), (0.15, 0.0), (0.21, 0.36), (0.23, 0.4), (0.19, 0.4), (0.0, 0.36))
BOOKS = ("book_red", "book_blue", "book_green", "book_ochre", "black_plastic", "paper")
MUGS = ("mug_white", "mug_red")
FABRICS = ("fabric_blue", "fabric_grey")
SHELVES = 5
BOOKCASE_WIDTH, BOOKCASE_DEPTH, BOOKCASE_HEIGHT = 1.2, 0.32, 2.0
BOARD = 0.025
"""Thickness of a board."""


@dataclass(frozen=True)
class Part:
    """One mesh of a piece of furniture."""

    name: str
    mesh: Mesh
    material: str
    flat: bool = True
    """Whether triangles keep their own normals."""

    def moved(self, offset: ArrayLike, degrees: float = 0.0) -> Part:
        """The part turned about the z axis, and then moved."""
        return Part(self.name, self.mesh.turned(degrees).moved(offset), self.material, self.flat)


def moved(parts: list[Part], offset: ArrayLike, degrees: float = 0.0) -> list[Part]:
    """All parts turned about the z axis, and then moved."""
    return [part.moved(offset, degrees) for part in parts]


def desk(random: np.random.Generator) -> list[Part]:
    """A desk with all that lies on it; who works at it sits on the side of low y. Its middle is over the origin."""
    half, back = DESK_WIDTH / 2, DESK_DEPTH / 2
    top = DESK_HEIGHT
    parts = [Part("top", box((-half, -back, top - 0.03), (half, back, top)), "oak")]
    for side, x in (("left", -half + 0.08), ("right", half - 0.08)):
        posts = (box((x - 0.02, y - 0.02, 0.02), (x + 0.02, y + 0.02, top - 0.03)) for y in (-0.3, 0.3))
        parts.append(Part(f"leg_{side}", merged(*posts, box((x - 0.03, -0.36, 0), (x + 0.03, 0.36, 0.02))), "steel"))
    screen = box((-half, back + 0.01, 0.35), (half, back + 0.04, 1.22))
    rail = box((-half, back + 0.005, 1.22), (half, back + 0.045, 1.25))
    parts += [Part("divider", screen, "felt"), Part("divider_rail", rail, "aluminium")]
    return parts + _drawers() + _computer(random) + _things(random)


def _drawers() -> list[Part]:
    parts = [Part("drawers", box((0.28, -0.34, 0.04), (0.68, 0.3, 0.64)), "white_lacquer")]
    for number in range(3):
        low = 0.06 + 0.19 * number
        parts.append(Part(f"drawer_{number}", box((0.29, -0.36, low), (0.67, -0.342, low + 0.175)), "grey_lacquer"))
        handle = box((0.42, -0.385, low + 0.13), (0.54, -0.36, low + 0.145))
        parts.append(Part(f"handle_{number}", handle, "aluminium"))
    return parts


def _computer(random: np.random.Generator) -> list[Part]:
    top, turn = DESK_HEIGHT, float(random.uniform(-12.0, 12.0))
    keys = [
        box((x, y, top + 0.015), (x + 0.024, y + 0.022, top + 0.024))
        for x in np.arange(-0.21, 0.19, 0.03)
        for y in (-0.24, -0.21, -0.18, -0.15)
    ]
    monitor = [
        Part("monitor", box((-0.31, 0.1, top + 0.14), (0.31, 0.13, top + 0.52)), "black_plastic"),
        Part("screen", box((-0.295, 0.097, top + 0.155), (0.295, 0.1, top + 0.505)), "screen"),
        Part("neck", box((-0.03, 0.13, top + 0.01), (0.03, 0.16, top + 0.34)), "aluminium"),
        Part("foot", box((-0.13, 0.02, top), (0.13, 0.24, top + 0.012)), "aluminium"),
    ]
    keyboard = [
        Part("keyboard", box((-0.22, -0.25, top), (0.22, -0.12, top + 0.015)), "black_plastic"),
        Part("keys", merged(*keys), "grey_lacquer"),
        Part("mouse", box((0.28, -0.23, top), (0.34, -0.13, top + 0.03)), "black_plastic"),
    ]
    return moved(monitor, (float(random.uniform(-0.15, 0.15)), 0.05, 0.0), turn) + keyboard


def _things(random: np.random.Generator) -> list[Part]:
    top = DESK_HEIGHT
    mug = lathe(MUG, LATHE_SEGMENTS).moved((float(random.uniform(-0.45, -0.35)), float(random.uniform(-0.2, 0.1)), top))
    parts = [Part("mug", mug, str(random.choice(MUGS)), flat=False)]
    for number in range(2):
        sheet = box((-0.105, -0.148, 0.0), (0.105, 0.148, 0.003)).turned(float(random.uniform(-30.0, 30.0)))
        parts.append(Part(f"paper_{number}", sheet.moved((-0.6 + 0.06 * number, -0.2, top + 0.003 * number)), "paper"))
    height = top
    for number in range(3):
        thick = float(random.uniform(0.02, 0.05))
        book = box((-0.11, -0.15, 0.0), (0.11, 0.15, thick)).turned(float(random.uniform(-25.0, 25.0)))
        parts.append(Part(f"book_{number}", book.moved((-0.6, 0.2, height)), str(random.choice(BOOKS))))
        height += thick
    base = lathe([(0.0, 0.0), (0.09, 0.0), (0.09, 0.015), (0.0, 0.02)], LATHE_SEGMENTS)
    arm = tube([(0, 0, 0.02), (0, 0, 0.3), (0, -0.03, 0.38), (0, -0.16, 0.42)], [0.008] * 4, (1, 0, 0), 8)
    shade = lathe([(0.08, 0.0), (0.055, 0.06), (0.015, 0.09), (0.0, 0.09)], LATHE_SEGMENTS).moved((0, -0.16, 0.34))
    lamp = [Part("lamp", merged(base, arm, shade), "copper", flat=False)]
    return parts + moved(lamp, (0.6, 0.22, top), float(random.uniform(-40.0, 40.0)))


def chair(random: np.random.Generator) -> list[Part]:
    """A swivel chair over the origin, its back on the side of low y."""
    fabric = str(random.choice(FABRICS))
    feet = [box((0.0, -0.02, 0.05), (0.3, 0.02, 0.08)).turned(72.0 * foot) for foot in range(5)]
    column = lathe([(0.03, 0.06), (0.03, 0.25), (0.02, 0.25), (0.02, 0.43)], LATHE_SEGMENTS)
    parts = [
        Part("seat", box((-0.25, -0.22, 0.43), (0.25, 0.26, 0.5)), fabric),
        Part("back", box((-0.22, -0.28, 0.56), (0.22, -0.23, 1.05)), fabric),
        Part("spine", box((-0.03, -0.31, 0.42), (0.03, -0.28, 0.9)), "black_plastic"),
        Part("feet", merged(*feet), "black_plastic"),
        Part("column", column, "chrome", flat=False),
    ]
    for side, x in (("left", -0.29), ("right", 0.25)):
        arm = merged(box((x, -0.15, 0.68), (x + 0.04, 0.15, 0.7)), box((x, -0.02, 0.46), (x + 0.04, 0.02, 0.68)))
        parts.append(Part(f"arm_{side}", arm, "black_plastic"))
    return parts


def bookcase(random: np.random.Generator) -> list[Part]:
    """A bookcase with its back at y = 0, open towards low y, its middle over the origin."""
    half, deep, high = BOOKCASE_WIDTH / 2, BOOKCASE_DEPTH, BOOKCASE_HEIGHT
    parts = [
        Part("side_left", box((-half, -deep, 0), (-half + BOARD, 0, high)), "birch"),
        Part("side_right", box((half - BOARD, -deep, 0), (half, 0, high)), "birch"),
        Part("back", box((-half + BOARD, -0.012, 0), (half - BOARD, -0.004, high)), "birch"),
    ]
    pitch = (high - BOARD) / SHELVES
    for shelf in range(SHELVES + 1):
        low = shelf * pitch
        parts.append(
            Part(f"board_{shelf}", box((-half + BOARD, -deep, low), (half - BOARD, -0.012, low + BOARD)), "birch")
        )
        if shelf == SHELVES:
            break
        x, number = -half + BOARD, 0
        while (x := x + float(random.uniform(0.002, 0.03))) < half - 0.25:
            thick = float(random.uniform(0.03, 0.1))
            tall, wide = float(random.uniform(0.22, 0.33)), float(random.uniform(0.18, 0.26))
            book = box((x, -0.03 - wide, low + BOARD), (x + thick, -0.03, low + BOARD + tall))
            parts.append(Part(f"book_{shelf}_{number}", book, str(random.choice(BOOKS))))
            x, number = x + thick, number + 1
    return parts


def plant(random: np.random.Generator) -> list[Part]:
    """A plant in its pot, over the origin."""
    leaves = []
    for number in range(14):
        turn = 137.5 * number + float(random.uniform(-20.0, 20.0))
        lean, tall = float(random.uniform(0.15, 0.55)), float(random.uniform(0.6, 1.1))
        spine = smooth([(0.0, 0.36), (0.25 * lean, 0.36 + 0.6 * tall), (lean, 0.36 + tall)], CURVE_STEPS)
        path = [(along, 0.0, up) for along, up in spine]
        widths = 0.07 * np.sin(np.linspace(0.15, np.pi, len(path))) + 0.003
        # A tube that is pressed flat is a leaf with two sides.
        leaf = tube(path, widths, (0, 1, 0), 8)
        pressed = Mesh(leaf.vertices * (1.0, 1.6, 1.0), leaf.faces)
        leaves.append(pressed.turned(turn))
    return [
        Part("pot", lathe(POT, LATHE_SEGMENTS), "terracotta", flat=False),
        Part("leaves", merged(*leaves), "leaf", flat=False),
    ]
