"""How the tests of the integrators compare a scene of the zoo with its reference."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pytest

from tests import adversaries
from tests.agreement import Agreement, compare
from tests.rendering import render
from tests.zoo import ZOO, Entry

Array = np.ndarray[Any, Any]

IMAGES = 16
"""Independent images of each estimator: enough for Welch's test to know both variances."""
SPP, REFERENCE_SPP = 40, 128
"""Samples per pixel and image of bdpt, and of the references, which are cheaper."""
BLOCK = 8
LEVEL = 1e-4
"""Chance of a false alarm of one comparison: about 1% for all that the suite makes."""


class Agree(Protocol):
    """Compares an algorithm's image of a scene with the reference of the zoo."""

    def __call__(
        self,
        name: str,
        algorithm: str,
        *,
        more: float = 1.0,
        crop: Callable[[Array], Array] = ...,
        wrong: adversaries.Kind | None = None,
        **options: Any,
    ) -> Agreement:
        """``more`` times the usual samples; ``crop`` takes a part of all images; ``options`` as for ``render``.

        ``wrong`` is a kind of context that knows nothing of the scene, by which the algorithm goes.
        """
        ...


@pytest.fixture(autouse=True)
def _forget_scenes() -> Iterator[None]:
    """Free a test's scene before the next one, and what other files have left: a kernel handles all that is alive."""
    gc.collect()
    yield
    gc.collect()


@pytest.fixture(scope="session")
def references() -> dict[str, Array]:
    """Images of the references that this run has rendered, by the names of their scenes."""
    return {}


@pytest.fixture
def agree(tmp_path: Path, references: dict[str, Array]) -> Agree:
    """See :class:`Agree`."""

    def compared(
        name: str,
        algorithm: str,
        *,
        more: float = 1.0,
        crop: Callable[[Array], Array] = lambda images: images,
        wrong: adversaries.Kind | None = None,
        **options: Any,
    ) -> Agreement:
        entry: Entry = ZOO[name]
        scene = entry.load(tmp_path)
        if wrong:
            options["parts"] = adversaries.parts(scene, wrong)
        common: dict[str, Any] = {"images": IMAGES, "max_depth": entry.max_depth, "seed": entry.seed}
        if name not in references:
            references[name] = render(scene, entry.reference, spp=round(REFERENCE_SPP * entry.effort), **common)
        images = render(scene, algorithm, spp=round(SPP * entry.effort * more), **common, **options)
        return compare(crop(images), crop(references[name]), block=BLOCK, level=LEVEL)

    return compared
