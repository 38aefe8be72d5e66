"""What a context of the same surroundings knows for another camera: where light comes from.

Regions and the radiance in them do not depend on who looks. A camera that sees what another one has seen needs
importance, a pilot image and an adjoint image of its own, and no more.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from elps_core.context.lookup import RegionLookup
from elps_core.context.store import DirectionalParts
from elps_core.particles.classical import ClassicalSampler
from elps_core.particles.records import IMPORTON
from elps_core.sampling.direction import ENOUGH
from elps_core.sampling.lights import pieces
from elps_core.sampling.start import StartDensity
from elps_core.scene.sensors import Camera

PATHS = 1 << 14
"""By which it is found out what a camera sees."""
KNOWN = 0.95
"""Share of what eye paths meet that must lie in regions whose tables rest on enough records."""
SPREAD = 1.0 / 32.0
"""Share of the regions that eye paths must be spread over: if all meet a few, those are too large for this camera."""
SHARE = 1.0 / 8.0
"""Share of the usual paths that importance and the pilot image take, once radiance is known."""


def sees_enough(
    scene: mi.Scene, camera: Camera, lights: StartDensity, known: DirectionalParts, max_depth: int, key: tuple[int, ...]
) -> bool:
    """Whether eye paths of ``camera`` meet regions that ``known`` knows well, and many of them."""
    finder = RegionLookup(known.regions)
    visits = np.zeros(known.regions.count)
    for particles in ClassicalSampler(scene, camera, lights, paths=PATHS, max_depth=max_depth, first_hits=True).run(
        key
    ):
        met = particles.of(IMPORTON)
        if not len(met):
            continue
        side = dr.mulsign(mi.Vector3f(met.normal), dr.dot(met.normal, met.direction))
        region = np.array(finder(met.position, side))
        visits += np.bincount(region, minlength=len(visits))
    total = float(visits.sum())
    if total == 0.0:
        return False
    familiar = float(visits[known.radiance.evidence >= ENOUGH].sum()) / total
    spread = total**2 / float(np.square(visits).sum()) / len(visits)
    return familiar >= KNOWN and spread >= SPREAD


def with_pieces(known: DirectionalParts, lights: StartDensity) -> DirectionalParts:
    """Another camera's tables, of lights by the pieces that ``lights`` has: where it is flat it has one an emitter."""
    wanted, emitters = pieces(lights), lights.emission.count
    if known.lights.shape[1] == wanted:
        return replace(known, departures=None)
    by_emitter = known.lights.reshape(len(known.lights), emitters, -1).sum(axis=2) if wanted else known.lights[:, :0]
    each = max(1, wanted // emitters)
    return replace(known, lights=np.repeat(by_emitter / np.float32(each), each, axis=1), departures=None)
