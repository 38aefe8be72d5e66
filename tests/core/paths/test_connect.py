"""Connections to the sensor see what the sensor sees, and end where its rays started."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elps_core.scene.generate import door, write
from elps_core.scene.loader import load_scene

SIDE = 48
COLUMN, ROWS = 0.0, (24.0, 36.0)
"""Film region that looks past the hinge of the door: the sight lines graze an edge by fractions of a millimetre."""


def test_what_a_primary_ray_meets_is_not_shadowed(mi: Any, tmp_path: Path) -> None:
    import drjit as dr

    from elps_core.integrators.bdpt import Bdpt
    from elps_core.paths.mis import Partial
    from elps_core.paths.roulette import RouletteRule
    from elps_core.paths.stream import Stream
    from elps_core.paths.vertex import Vertex
    from elps_core.sampling.start import StartDensity, power_table
    from elps_core.scene.emission import Emission
    from elps_core.scene.sensors import Camera

    write(door(angle=30), tmp_path / "door.zip")
    loaded = load_scene(tmp_path / "door.zip", "llvm_ad_rgb", size=(SIDE, SIDE))
    camera, emission = Camera(loaded.sensor), Emission(loaded.scene)
    lights = StartDensity(emission, power_table(emission))
    bdpt = Bdpt(loaded.scene, camera, lights, max_depth=4, roulette=RouletteRule("none", 5))
    lanes = 1 << 18
    stream = Stream.of(lanes, 1)
    u = stream.next_2d()
    position = mi.Point2f(COLUMN + u.x, ROWS[0] + u.y * (ROWS[1] - ROWS[0]))
    primary = camera.sample_ray(position, mi.Float(0.5), mi.Point2f(0.5))
    si = loaded.scene.ray_intersect(primary.ray)
    front = si.is_valid() & (mi.Frame3f.cos_theta(si.wi) > 1e-3)
    # A vertex that light reached from above its surface, so that diffuse materials scatter it to the sensor.
    si.wi = mi.Vector3f(0, 0, 1)
    zero = dr.zeros(mi.Float, lanes)
    vertex = Vertex(si, mi.Spectrum(1.0), Partial(zero, [zero]), dr.full(mi.UInt32, 1, lanes))
    value, sample = bdpt.connector.connect_sensor(vertex, stream, front)
    seen, wanted = np.array(dr.max(value)) > 0.0, np.array(front)
    assert wanted.mean() > 0.5
    assert seen[wanted].mean() > 0.9999
    error = np.array(dr.norm(sample.position - position))[wanted]
    assert error.max() < 1e-3, "the connection lands where the ray started, in pixels"


@pytest.mark.parametrize("kind", ["perspective", "thinlens", "orthographic"])
@pytest.mark.parametrize("crop", [False, True])
def test_connections_invert_primary_rays(
    mi: Any, camera_dict: Callable[..., dict[str, Any]], kind: str, crop: bool
) -> None:
    """Position, density and, for a thin lens, the aperture point that a light path would meet."""
    import drjit as dr

    from elps_core.paths.stream import Stream
    from elps_core.scene.sensors import Camera

    window = {"crop_offset_x": 3, "crop_offset_y": 7, "crop_width": 12, "crop_height": 10} if crop else {}
    description = camera_dict([1, 2, 4], [0, 0.5, 0], **window) | {"type": kind}
    if kind == "thinlens":
        description |= {"aperture_radius": 0.2, "focus_distance": 3.0}
    if kind == "orthographic":
        del description["fov"]
    camera = Camera(mi.load_dict(description))
    stream = Stream.of(4096, 3)
    position = stream.next_2d() * mi.Point2f(mi.Float(camera.size.x), mi.Float(camera.size.y))
    aperture = stream.next_2d()
    primary = camera.sample_ray(position, mi.Float(0.5), aperture)
    si = dr.zeros(mi.SurfaceInteraction3f, 4096)
    si.p = primary.ray(1.0 + 3.0 * stream.next_1d())
    sample = camera.connect(si, aperture, mi.Bool(True))
    assert np.array(sample.valid).mean() > 0.999  # rounding at the film's border
    inside = np.array(sample.valid)
    assert np.abs(np.array(sample.position - position))[:, inside].max() < 5e-3
    assert np.array(dr.norm(sample.direction + primary.ray.d)).max() < 1e-4
    ratio = sample.pdf / primary.pdf + dr.zeros(mi.Float, 4096)
    assert np.allclose(np.array(ratio)[inside], 1.0, rtol=1e-3)
    if kind == "thinlens":
        backward = mi.Ray3f(si.p, -primary.ray.d)
        met = camera.meet(backward, mi.Bool(True))
        found = np.array(met.valid)
        assert found.mean() > 0.99  # what misses started at the very edge of the aperture
        assert np.abs(np.array(met.position - position))[:, found].max() < 2e-2
        away = camera.meet(mi.Ray3f(si.p, primary.ray.d), mi.Bool(True))
        assert not np.array(away.valid).any()


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_film_densities_integrate_to_one(mi: Any, camera_dict: Callable[..., dict[str, Any]], kind: str) -> None:
    """The density of primary rays over a plane that the whole film sees is one in all."""
    import drjit as dr

    from elps_core.paths.stream import Stream
    from elps_core.scene.sensors import Camera

    description = camera_dict([0, 0, 4], [0, 0, 0], size=(20, 12)) | {"type": kind}
    if kind == "orthographic":
        del description["fov"]
    camera = Camera(mi.load_dict(description))
    lanes, side = 1 << 18, 8.0
    si = dr.zeros(mi.SurfaceInteraction3f, lanes)
    u = Stream.of(lanes, 5).next_2d()
    si.p = mi.Point3f(side * (u.x - 0.5), side * (u.y - 0.5), 0)
    sample = camera.connect(si, mi.Point2f(0.5), mi.Bool(True))
    density = np.array(dr.select(sample.valid, sample.pdf * sample.cosine / sample.distance2, 0.0)) * side * side
    error = density.std() / np.sqrt(lanes)
    assert abs(density.mean() - 1.0) < 5 * error
    assert error < 0.01
