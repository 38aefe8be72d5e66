"""Rays leave surfaces without meeting them, and pass what is close to them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

LANES = 1 << 16
GRAZING = 1e-4
"""Least cosine of a ray that leaves, log-uniform up to 1."""


def shapes(mi: Any, size: float) -> dict[str, Any]:
    """Convex shapes around the origin, none of which a ray that leaves it outwards meets again."""
    place = mi.ScalarTransform4f
    turned = place().rotate([0.6, 0.0, 0.8], 37.0).scale(size)
    return {
        "rectangle": {"type": "rectangle", "to_world": turned},
        "disk": {"type": "disk", "to_world": turned},
        "cube": {"type": "cube", "to_world": turned},
        "sphere": {"type": "sphere", "to_world": turned},
        "cylinder": {"type": "cylinder", "to_world": turned},
        "curve": {
            "type": "linearcurve",
            "filename": "set by the test",
            "to_world": place().rotate([0.6, 0.0, 0.8], 37.0),
        },
    }


@pytest.mark.parametrize("kind", ["rectangle", "disk", "cube", "sphere", "cylinder", "curve"])
@pytest.mark.parametrize("size", [0.1, 4.0, 1000.0])
def test_no_ray_meets_the_convex_surface_that_it_leaves(kind: str, size: float, mi: Any, tmp_path: Any) -> None:
    import drjit as dr

    from elps_core.paths.stream import Stream
    from elps_core.scene.leaving import Leaving

    shape = shapes(mi, size)[kind]
    if kind == "curve":
        (tmp_path / "a.txt").write_text("".join(f"{size * k} 0 0 {0.2 * size}\n" for k in range(-1, 2)))
        shape["filename"] = str(tmp_path / "a.txt")
    scene = mi.load_dict({"type": "scene", "shape": shape})
    stream = Stream.of(LANES, 1)
    u, v = stream.next_2d(), stream.next_2d()
    start = mi.Point3f(mi.warp.square_to_uniform_sphere(u) * (3.0 * size))
    end = mi.Point3f(mi.warp.square_to_uniform_sphere(v) * (0.9 * size))
    si = scene.ray_intersect(mi.Ray3f(start, dr.normalize(end - start)))
    # Through the open end of a cylinder rays meet it from within.
    met = si.is_valid() & (dr.dot(si.n, start - si.p) > 0.0)
    side = mi.Frame3f(si.n)
    w = stream.next_2d()
    cosine = dr.exp(w.x * np.log(GRAZING))
    sin, cos = dr.sincos(dr.two_pi * w.y)
    across = dr.sqrt(1.0 - dr.square(cosine))
    direction = side.to_world(mi.Vector3f(across * cos, across * sin, cosine))
    again = scene.ray_test(Leaving(size).ray(si, direction), met)
    assert np.count_nonzero(np.array(met)) > LANES / 50
    assert np.count_nonzero(np.array(again)) == 0


def test_a_ray_between_two_surfaces_meets_what_is_close_to_either(mi: Any) -> None:
    import drjit as dr

    from elps_core.scene.leaving import Leaving

    place, gap = mi.ScalarTransform4f, 5e-4

    def at(z: float) -> Any:
        return {"type": "rectangle", "to_world": place().translate([0, 0, z]).scale(5.0)}

    found = []
    for between in ((), (gap,), (10.0 - gap,)):
        walls = {f"wall {k}": at(z) for k, z in enumerate((0.0, 10.0, *between))}
        scene, leaving = mi.load_dict({"type": "scene", **walls}), Leaving(10.0)
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.p, si.n = mi.Point3f(0.1, 0.2, 0.0), mi.Normal3f(0, 0, 1)
        other = mi.SurfaceInteraction3f(si)
        other.p = mi.Point3f(0.3, -0.1, 10.0)
        ray = leaving.to(si, leaving.off(other, si.p - other.p))
        found.append(bool(scene.ray_test(ray)[0]))
    assert found == [False, True, True]
