"""Materials: surfaces answer as Mitsuba's own calls do, and only those of the scene are compiled."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest


@pytest.fixture(autouse=True)
def _variant(mi: Any) -> None:
    """What is tested is a module of kernels."""


def painted(red: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [red, 0.5, 0.2]}}


def scene_of_groups() -> Any:
    """A sphere of its own, and a group of two that is met twice; both sides, one behind a mask, one of metal."""
    import mitsuba as mi

    move = mi.ScalarTransform4f().translate
    return mi.load_dict(
        {
            "type": "scene",
            "group": {
                "type": "shapegroup",
                "a": {"type": "sphere", "bsdf": {"type": "twosided", "inner": painted(0.8)}},
                "b": {
                    "type": "sphere",
                    "to_world": move([0, 4, 0]),
                    "bsdf": {"type": "roughconductor", "alpha": 0.3},
                },
            },
            "one": {"type": "instance", "group": {"type": "ref", "id": "group"}},
            "two": {"type": "instance", "to_world": move([4, 0, 0]), "group": {"type": "ref", "id": "group"}},
            "alone": {
                "type": "sphere",
                "to_world": move([8, 0, 0]),
                "bsdf": {"type": "mask", "opacity": 0.7, "inner": painted(0.3)},
            },
        }
    )


def seen(scene: Any) -> Any:
    """Points on all spheres, and one ray that meets nothing."""
    import mitsuba as mi

    origin = np.array([[0.3, 0.2, 5.0], [0.3, 4.2, 5.0], [4.3, 0.2, 5.0], [4.3, 4.2, 5.0], [8.3, 0.2, 5.0], [20, 0, 5]])
    return scene.ray_intersect(mi.Ray3f(mi.Point3f(origin.T.astype(np.float32)), mi.Vector3f(0.0, 0.0, -1.0)))


def test_a_group_is_made_of_the_shapes_that_rays_meet() -> None:
    from elps_core.scene.groups import every_shape

    scene = scene_of_groups()
    every = every_shape(scene)
    assert len(every) == len(set(every))
    met = [shape for shape in seen(scene).shape if shape is not None]
    assert len(met) == 5
    assert set(met) <= set(every)


def test_materials_answer_as_the_bsdf_of_each_surface() -> None:
    import mitsuba as mi

    from elps_core.paths.scattering import Materials

    scene, active = scene_of_groups(), mi.Bool(True)
    si = seen(scene)
    wo = mi.Vector3f(0.36, 0.48, 0.8)
    event = Materials(scene).seen_by_eye(si, wo, active)
    value, pdf = si.bsdf().eval_pdf(mi.BSDFContext(), si, wo, active)
    assert np.allclose(event.value, value, rtol=1e-5)
    assert np.allclose(event.pdf, pdf, rtol=1e-5)
    reverse = mi.SurfaceInteraction3f(si)
    reverse.wi = wo
    assert np.allclose(event.pdf_rev, si.bsdf().pdf(mi.BSDFContext(), reverse, si.wi, active), rtol=1e-5)
    assert (np.array(event.pdf)[:5] > 0.0).all()
    assert not np.array(event.value)[:, 5].any()


def test_nothing_else_that_mitsuba_holds_is_compiled() -> None:
    """BSDFs inside others, and another scene's, would be part of each kernel, which was then compiled anew."""
    import drjit as dr
    import mitsuba as mi

    from elps_core.paths.scattering import Materials

    scene = scene_of_groups()

    def kernel() -> str:
        si, materials = seen(scene), Materials(scene)
        dr.eval(si)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(materials.seen_by_eye(si, mi.Vector3f(0.36, 0.48, 0.8), mi.Bool(True)))
            (entry,) = dr.kernel_history((dr.KernelType.JIT,))
        return str(entry["ir"].getvalue())

    alone = kernel()
    other = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "bsdf": {"type": "roughplastic"}}})
    assert kernel() == alone
    assert other.shapes()
    # Paint on both sides, metal and paint behind a mask; and the instances' own, which is plain paint.
    assert alone.count("@func_") > 0
    assert alone.count("\ndefine fastcc") <= 4
