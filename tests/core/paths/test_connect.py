"""Connections to the sensor see what the sensor sees."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from elps_core.scene.generate import door, write
from elps_core.scene.loader import load_scene

SIDE = 48
COLUMN, ROWS = 0.0, (24.0, 36.0)
"""Film region that looks past the hinge of the door: the sight lines graze an edge by fractions of a millimetre."""


def test_what_a_primary_ray_meets_is_not_shadowed(mi: Any, tmp_path: Path) -> None:
    import drjit as dr

    from elps_core.paths.connect import connect_sensor
    from elps_core.paths.mis import Partial
    from elps_core.paths.stream import Stream
    from elps_core.paths.surfaces import Surfaces
    from elps_core.paths.vertex import Vertex
    from elps_core.scene.sensors import Camera

    write(door(angle=30), tmp_path / "door.zip")
    loaded = load_scene(tmp_path / "door.zip", "llvm_ad_rgb", size=(SIDE, SIDE))
    camera = Camera(loaded.sensor)
    lanes = 1 << 18
    stream = Stream.of(lanes, 1)
    u = stream.next_2d()
    position = mi.Point2f(COLUMN + u.x, ROWS[0] + u.y * (ROWS[1] - ROWS[0]))
    ray, _, _ = camera.sample_ray(position, mi.Float(0.5), mi.Point2f(0.5))
    si = loaded.scene.ray_intersect(ray)
    front = si.is_valid() & (mi.Frame3f.cos_theta(si.wi) > 1e-3)
    # A vertex that light reached from above its surface, so that diffuse materials scatter it to the sensor.
    si.wi = mi.Vector3f(0, 0, 1)
    zero = dr.zeros(mi.Float, lanes)
    vertex = Vertex(si, mi.Spectrum(1.0), Partial(zero, zero), dr.full(mi.UInt32, 1, lanes))
    value, sample = connect_sensor(Surfaces(loaded.scene), vertex, camera, stream, front)
    seen, wanted = np.array(dr.max(value)) > 0.0, np.array(front)
    assert wanted.mean() > 0.5
    assert seen[wanted].mean() > 0.9999
    error = np.array(dr.norm(sample.position - position))[wanted]
    assert error.max() < 1e-3, "the connection lands where the ray started, in pixels"
