"""Every algorithm has the expected image of Mitsuba's path tracer on every scene of the zoo that it can render.

The validation run (tests/benchmarks/validation.py) compares all scenes with all algorithms at a power that
the test suite has no time for. Here bdpt renders most, and the others a choice; every emitter, sensor, filter and
kind of material still occurs. Each test finds a bias of the mean of :data:`BOUND` with a
chance of 95%; a test that could not is no proof, and fails.
"""

from __future__ import annotations

import pytest

from tests.core.integrators.conftest import Agree
from tests.zoo import ALGORITHMS, ZOO

COVERED = {
    *("area-rectangle", "area-sphere", "spot", "directional", "roughconductor", "closed-room", "cornell", "door"),
    *("crop", "far-clip", "filter-tent", "vertex-normals", "roughconductor, spectral", "area-textured, spectral"),
    *("room-far-away", "room-tiny", "room-camera-far", "room-lamp-far", "filter-catmullrom"),
}
"""What bdpt leaves to the validation run, because the suite has ten minutes: other tests of it cover that as well."""
CHOICE = {
    "path": [
        *("area-textured", "area-mesh", "projector", "mixed", "envmap", "sunsky", "timed-sunsky", "hair", "mask"),
        *("filter-mitchell", "filter-catmullrom", "filter-tent"),
    ],
    "path pure": ["area-disk-cylinder", "envmap", "dielectric"],
    "light": ["area-textured", "area-two-sided-surface", "envmap", "principled", "twosided", "thinlens-wide"],
    "light pure": ["thinlens-wide"],
    "bdpt": [name for name in ZOO if name not in {"maze", "hair", *COVERED}],
    "pssmlt": ["envmap"],
}
MORE = {"path": 2.0, "path pure": 4.0, "light": 6.0, "light pure": 70.0, "bdpt": 1.0, "pssmlt": 5.0}
"""Samples of an algorithm, as a multiple of those of bdpt."""
NOISY = {"point-through-glass": 1.6}
"""Scenes that need more samples than others, and how many times more."""
BOUND = 0.02
CASES = [(name, algorithm) for name in ZOO for algorithm in ALGORITHMS if name in CHOICE[algorithm]]


@pytest.mark.parametrize(("name", "algorithm"), CASES, ids=[f"{name} by {algorithm}" for name, algorithm in CASES])
def test_agrees_with_the_reference(agree: Agree, name: str, algorithm: str) -> None:
    assert ZOO[name].reason_without(algorithm) is None, "the choice names what the zoo leaves out"
    agreement = agree(name, algorithm, more=MORE[algorithm] * NOISY.get(name, 1.0))
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement
