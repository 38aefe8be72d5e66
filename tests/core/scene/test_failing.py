"""What Mitsuba raises while it renders is told in one line, and faults of our own are not."""

from __future__ import annotations

import gc
from pathlib import Path

import pytest

from elps_core.errors import RenderFailed, SceneRejected
from elps_core.scene.failing import told
from elps_core.scene.loader import load_scene
from elps_core.settings import RenderSettings

from .conftest import OBJ, mesh, scene_xml


def fail(*texts: str) -> None:
    """Raise errors of which each comes from the next one, as Dr.Jit does."""
    if len(texts) == 1:
        raise RuntimeError(texts[0])
    try:
        fail(*texts[1:])
    except RuntimeError as error:
        raise RuntimeError(texts[0]) from error


DRJIT = "drjit.custom(<_RenderOp>): error while performing a custom differentiable operation. (see above)."


@pytest.mark.parametrize(
    ("integrator", "texts", "words"),
    [
        ("mi_path", (DRJIT, "[Mesh] eval_parameterization(): mesh does not have UV coordinates!"), "needs texture"),
        ("mi_path", (DRJIT, "[Secret] /home/someone: unheard of"), "mi_path cannot render this scene: choose path"),
        ("mi_path", (DRJIT,), "mi_path cannot render this scene: choose path"),
        ("path", (DRJIT, "[Texture] Texture::eval_1_grad(): not implemented!"), "'bumpmap'"),
        ("path", ("dr.while_loop(): (see above)", "[Secret] /home/someone: unheard of"), "Mitsuba fails"),
        ("path", ("jit_malloc(): out of memory! Could not allocate 8 bytes",), "not enough memory"),
    ],
)  # fmt: skip
def test_what_mitsuba_raises_is_one_line(integrator: str, texts: tuple[str, ...], words: str) -> None:
    with pytest.raises(RenderFailed, match=words) as caught, told(integrator):
        fail(*texts)
    assert "\n" not in str(caught.value)
    assert "someone" not in str(caught.value)


def test_our_own_faults_are_raised_as_they_are() -> None:
    with pytest.raises(RuntimeError, match=r"^a fault$"), told("bdpt"):
        fail("a fault")
    with pytest.raises(SceneRejected, match="no"), told("mi_path"):
        raise SceneRejected("no")


def test_the_user_may_end_what_runs_inside() -> None:
    def interrupted() -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as stopped:
            raise RuntimeError(DRJIT) from stopped

    with pytest.raises(KeyboardInterrupt), told("mi_path"):
        interrupted()


SQUARE = '<shape type="rectangle">{}</shape>'
CHECKS = '<texture type="checkerboard" name="{}"/>'
ATTRIBUTE = '<texture type="mesh_attribute" name="radiance"><string name="name" value="vertex_color"/></texture>'
BENT = '<bsdf type="{}">{}<bsdf type="diffuse"/></bsdf>'
CASES = {
    "a textured lamp on a mesh without UV": (
        mesh("obj", "a.obj").replace("</shape>", f'<emitter type="area">{CHECKS.format("radiance")}</emitter></shape>'),
        "mi_path",
        "texture coordinates",
    ),
    "a bump map that is no bitmap": (SQUARE.format(BENT.format("bumpmap", CHECKS.format("any"))), "path", "'bumpmap'"),
    "a normal map that is no bitmap": (
        SQUARE.format(BENT.format("normalmap", CHECKS.format("normalmap"))),
        "mi_volpath",
        "'normalmap'",
    ),
    "light paths from a texture that cannot be drawn from": (
        SQUARE.format(f'<emitter type="area">{ATTRIBUTE}</emitter>'),
        "mi_ptracer",
        "cannot be drawn from",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_scenes_that_mitsuba_fails_at_end_in_one_line(tmp_path: Path, case: str) -> None:
    body, integrator, words = CASES[case]
    (tmp_path / "scene.xml").write_bytes(scene_xml(body))
    (tmp_path / "a.obj").write_bytes(OBJ)
    loaded = load_scene(tmp_path / "scene.xml", "llvm_ad_rgb", size=(4, 4))
    from elps_core.renderer import Renderer  # Needs a variant to be set

    settings = RenderSettings.model_validate({"integrator": integrator, "light_sampling": "uniform"})
    with pytest.raises(RenderFailed, match=words) as caught:
        Renderer(loaded, settings).render_chunk(0, 1)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) not in str(caught.value)
    # Dr.Jit asks the materials of all scenes that are in memory: this one must not be there when the next one renders.
    del caught, loaded
    gc.collect()
