"""From training to slits: photons are kept evenly, and a door that is ajar is found."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load as load_tensors

from elps_core.scene.generate import cornell, door, write
from elps_core.scene.generate.door import NEAR, OPENING
from elps_core.scene.loader import load_scene
from elps_core.settings import ContextSettings

Array = np.ndarray[Any, Any]
SMALL: dict[str, Any] = {"resolution": 8, "samples_per_cell": 16, "tolerance": 0.0, "adaptive": False}


def trained(path: Path, **options: Any) -> tuple[Any, Any]:
    """What a build of a context makes, and its last checkpoint; each step by another builder."""
    from elps_core.context.build import ContextBuilder

    scene = load_scene(path, "llvm_ad_rgb", size=(24, 18))
    settings = ContextSettings(**SMALL, **options)
    builder = ContextBuilder(scene, settings)
    while builder.done < builder.steps:
        saved, builder = builder.to_bytes(), ContextBuilder(scene, settings)
        builder.restore(saved)
        builder.step()
    return builder.result().directions, load_tensors(builder.to_bytes())


def test_the_gap_beside_a_door_is_found(mi: Any, tmp_path: Path) -> None:
    write(door(angle=3.0), tmp_path / "scene.zip")
    parts, saved = trained(tmp_path / "scene.zip", regions=1024, paths=1 << 19)
    assert parts.slits is not None
    assert np.array_equal(saved["tables.slits.ends"], parts.slits.ends)
    edge = np.array([OPENING.end, NEAR.high[1]])
    off = np.linalg.norm(parts.slits.ends[..., :2] - edge, axis=-1).max(axis=1)
    nearest = int(off.argmin())
    assert off[nearest] < 0.05
    assert np.ptp(parts.slits.ends[nearest, :, 2]) == pytest.approx(OPENING.top, rel=0.2)
    near = parts.regions.centres[:, 1] < NEAR.high[1]
    # Light comes through it from the far room, and importance from the near one.
    for chances, there in zip(parts.slits.chances, (near, ~near), strict=True):
        aimed = chances[:, nearest] > 0.1
        assert there[aimed].mean() > 0.85
        assert 0.3 < aimed[there].mean() < 0.9


def test_a_room_without_gaps_has_none(mi: Any, tmp_path: Path) -> None:
    write(cornell(), tmp_path / "scene.zip")
    parts, saved = trained(tmp_path / "scene.zip", regions=256, rows=16, columns=32, paths=1 << 18)
    assert parts.slits is None
    assert not any(name.startswith("tables.slits") for name in saved)


def test_photons_are_kept_by_the_chances_of_their_regions(mi: Any) -> None:
    """What is kept stands for all of them: over its chance it brings as much to every region."""
    from elps_core.context.directional import DirectionalAccumulator
    from elps_core.context.gaps import KEPT, thinned
    from elps_core.paths.stream import Stream
    from tests.core.context.test_walks import LANES, PATHS, recorder, sphere

    walks, count = recorder(sphere(mi, "point"), None, 6)
    evidence = np.geomspace(1.0, 1e4, count)
    kept, photons = thinned(evidence, now=True), DirectionalAccumulator(count, 4, 8)
    chances = np.array(kept.chances)
    assert chances == pytest.approx(np.minimum(1.0, KEPT / evidence), rel=1e-6)
    walks.light_paths(PATHS, Stream.of(LANES, 2), photons, kept=kept)
    photons.close_batch(1.0)
    assert kept.buffer.lost == 0
    some = kept.buffer.take()
    region = np.array(
        walks._regions(some.position, some.normal * mi.Float(np.sign(np.array(some.normal @ some.direction))))
    )
    later = np.array(some.depth) > 1  # The others come straight from the lamp
    assert 0.0 < later.mean() < 1.0
    number = np.bincount(region[later], minlength=count)
    expected = photons.evidence * chances
    assert number[chances == 1.0] == pytest.approx(expected[chances == 1.0])
    assert (np.abs(number - expected) <= 5.0 * np.sqrt(expected) + 5.0).all()
    none = thinned(evidence, now=False)
    walks.light_paths(PATHS, Stream.of(LANES, 2), photons, kept=none)
    assert len(none.buffer.take()) == 0
