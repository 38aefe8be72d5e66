"""Buffers of particles: filled from kernels without gaps, never beyond their end."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from elps_core.particles.records import IMPORTON, PHOTON, ParticleBuffer
from tests.core.particles.test_contract import sphere

COUNT = 1000


def fill(mi: Any, buffer: ParticleBuffer, count: int, *, kind: int = PHOTON, port: int = 0) -> None:
    """Particles whose fields all tell their number; every third is not active."""
    import drjit as dr

    number = dr.arange(mi.UInt32, count)
    x = mi.Float(number)
    buffer.add(
        mi.Point3f(x, x + 0.25, x + 0.5), mi.Normal3f(0, 1, 0), mi.Vector3f(1, 0, -1), x + 1.0, number % 7, kind,
        number % 3 != 0, port=port,
    )  # fmt: skip
    dr.eval(buffer.state)


def test_what_goes_in_comes_out(mi: Any) -> None:
    buffer = ParticleBuffer(COUNT)
    fill(mi, buffer, COUNT)
    arrays = buffer.take().arrays()
    order = np.argsort(arrays.weight)
    number = np.array([n for n in range(COUNT) if n % 3], np.float32)
    assert np.array_equal(arrays.weight[order], number + 1.0)
    assert np.array_equal(arrays.position[order], number[:, None] + np.array([0.0, 0.25, 0.5], np.float32))
    assert np.array_equal(arrays.depth[order], number.astype(np.uint8) * 0 + (number % 7).astype(np.uint8))
    assert (arrays.normal == [0, 1, 0]).all()
    assert (arrays.direction == [1, 0, -1]).all()
    assert (arrays.kind == PHOTON).all()
    assert len(buffer.take()) == 0, "a buffer is empty after it was taken from"


def test_a_full_buffer_counts_what_it_leaves_out(mi: Any) -> None:
    buffer = ParticleBuffer(100)
    fill(mi, buffer, COUNT)
    kept = sum(1 for n in range(COUNT) if n % 3)
    assert buffer.counts == [100]
    assert buffer.lost == kept - 100
    arrays = buffer.take().arrays()
    assert len(np.unique(arrays.weight)) == 100
    assert buffer.lost == 0


def test_ports_share_a_buffer_and_kinds_come_apart(mi: Any) -> None:
    buffer = ParticleBuffer(COUNT, ports=2)
    fill(mi, buffer, 30, kind=PHOTON, port=0)
    fill(mi, buffer, 60, kind=IMPORTON, port=1)
    particles = buffer.take()
    assert len(particles) == 20 + 40
    assert len(particles.of(PHOTON)) == 20
    importons = particles.of(IMPORTON).arrays()
    assert sorted(importons.weight) == [n + 1.0 for n in range(60) if n % 3]
    assert (importons.kind == IMPORTON).all()
    assert len(particles.of(IMPORTON).of(PHOTON)) == 0
    assert particles.of(PHOTON).of(IMPORTON).arrays().position.shape == (0, 3)


@pytest.mark.parametrize("weight", [0.0, -1.0, np.nan, np.inf])
def test_particles_have_a_weight_that_counts(mi: Any, weight: float) -> None:
    import drjit as dr

    buffer = ParticleBuffer(10)
    zero = dr.zeros(mi.Float, 5)
    three = mi.Vector3f(zero)
    buffer.add(three, three, three, dr.full(mi.Float, weight, 5), dr.zeros(mi.UInt32, 5), PHOTON, mi.Bool(True))
    dr.eval(buffer.state)
    assert len(buffer.take()) == 0


def test_any_walk_can_leave_records(mi: Any) -> None:
    """Importons from the visits of a walk that is none of the samplers'."""
    import drjit as dr

    from elps_core.integrators.bdpt import Bdpt
    from elps_core.paths.roulette import RouletteRule
    from elps_core.paths.stream import Stream
    from elps_core.paths.walk import random_walk
    from elps_core.sampling.start import StartDensity, uniform_table
    from elps_core.scene.emission import Emission
    from elps_core.scene.sensors import Camera

    scene, lanes, depth = sphere(mi), 2000, 3
    emission = Emission(scene)
    bdpt = Bdpt(
        scene,
        Camera(scene.sensors()[0]),
        StartDensity(emission, uniform_table(emission)),
        max_depth=depth,
        roulette=RouletteRule("none", 1),
    )
    buffer = ParticleBuffer(lanes * depth)

    def visit(_: Any, vertex: Any, state: Any, active: Any) -> Any:
        buffer.record(vertex.si, mi.luminance(vertex.beta) / lanes, vertex.depth, IMPORTON, active)
        return state

    stream = Stream.of(lanes, 1)
    start = bdpt.eye_start(bdpt.primary(stream.next_2d() * mi.Point2f(bdpt.camera.size), stream), stream)
    random_walk(
        emission.rays, start, visit, dr.zeros(mi.Bool, lanes), side="eye", max_depth=depth, roulette=bdpt.roulette,
        heuristic=bdpt.heuristic, directions=bdpt.directions, label="test",
    )  # fmt: skip
    dr.eval(buffer.state)
    arrays = buffer.take().arrays()
    assert np.array_equal(np.bincount(arrays.depth), [0, lanes, lanes, lanes])
    assert np.allclose(np.bincount(arrays.depth, arrays.weight)[1:], 0.6 ** np.arange(depth), rtol=1e-3)
    # On the sphere, facing inwards, coming from the inside.
    assert np.allclose(arrays.position, -arrays.normal, atol=1e-3)
    assert ((arrays.direction * arrays.normal).sum(axis=1) > 0.0).all()
