"""The shapes of a scene, those of its groups as well."""

from __future__ import annotations

from typing import Any

import mitsuba as mi


class _Parts(mi.TraversalCallback):
    """Shapes that an object is made of."""

    def __init__(self) -> None:
        super().__init__()
        self.shapes: list[mi.Shape] = []

    def put(self, _name: str, value: Any, _flags: int, *_: Any) -> None:
        if isinstance(value, mi.Shape):
            self.shapes.append(value)


def every_shape(scene: mi.Scene) -> list[mi.Shape]:
    """All shapes that rays can meet: ``scene.shapes()`` holds instances in place of what these repeat."""
    return list(dict.fromkeys([*scene.shapes(), *_parts(scene)]))


def _parts(whole: mi.Object) -> list[mi.Shape]:
    found = _Parts()
    whole.traverse(found)
    return [each for shape in found.shapes for each in (shape, *_parts(shape))]
