"""Materials at the edges of what their parameters may be: ours and Mitsuba's own paths show the same of every class.

All stand in one scene, so that few kernels are compiled: balls in rows, of which each fills a block of pixels, under
light that comes from everywhere and a lamp beside the camera.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from elps_core import device
from elps_core.scene.plugins import PLUGINS
from tests.agreement import compare
from tests.rendering import render

Dict = dict[str, Any]

CELL = 4
"""Pixels of a block, each way."""
COLUMNS = 10
SPACING = 2.0
"""Distance of the balls' centres, whose radius is 0.8."""
MAX_DEPTH = 6
IMAGES, SPP = 16, 64
TINY = 1e-4
"""Roughness of a surface that is nearly a mirror, and the least that Mitsuba tells from one."""


def rgb(*value: float) -> Dict:
    return {"type": "rgb", "value": list(value * 3 if len(value) == 1 else value)}


def diffuse(albedo: float) -> Dict:
    return {"type": "diffuse", "reflectance": rgb(albedo)}


def flat_map(*value: float) -> Dict:
    """A texture that is the same everywhere."""
    import mitsuba as mi

    pixels = np.full((4, 4, len(value)), value, np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}


def plain() -> dict[str, Dict]:
    """Surfaces with no roughness to choose."""
    paint = diffuse(0.5)
    found = {f"diffuse {albedo:g}": diffuse(albedo) for albedo in (0.0, 1.0)}
    found["null"] = {"type": "null"}
    for weight in (0.0, 1.0):
        parts = {"first": paint, "second": {"type": "roughconductor", "alpha": 0.2}}
        found[f"blendbsdf {weight:g}"] = {"type": "blendbsdf", "weight": weight, **parts}
        found[f"mask {weight:g}"] = {"type": "mask", "opacity": weight, "inner": paint}
    found["mask texture 0"] = {"type": "mask", "opacity": flat_map(0.0), "inner": paint}
    found["bumpmap flat"] = {"type": "bumpmap", "map": flat_map(0.5), "inner": {"type": "roughconductor"}}
    found["normalmap flat"] = {"type": "normalmap", "normalmap": flat_map(0.5, 0.5, 1.0), "inner": paint}
    found["normalmap of nothing"] = {"type": "normalmap", "normalmap": flat_map(0.5, 0.5, 0.5), "inner": paint}
    found["normalmap backwards"] = {"type": "normalmap", "normalmap": flat_map(0.5, 0.5, 0.0), "inner": paint}
    for share in (0.0, 1.0):
        found[f"polarizer {share:g}"] = {"type": "polarizer", "transmittance": share}
        found[f"retarder {share:g}"] = {"type": "retarder", "transmittance": share}
        found[f"circular {share:g}"] = {"type": "circular", "transmittance": share}
    found["hair of no pigment"] = {"type": "hair", "eumelanin": 0.0, "pheomelanin": 0.0}
    found["hair smooth"] = {"type": "hair", "longitudinal_roughness": 0.01, "azimuthal_roughness": 0.01}
    return found


def metals() -> dict[str, Dict]:
    """Conductors without light that they reflect, and without loss."""
    found: dict[str, Dict] = {}
    for kind, rough in (("conductor", {}), ("roughconductor", {"alpha": 0.2})):
        found[f"{kind} none"] = {"type": kind, "material": "none", **rough}
        found[f"{kind} 0"] = {"type": kind, "specular_reflectance": rgb(0.0), **rough}
        found[f"{kind} eta 0 k 0"] = {"type": kind, "eta": rgb(0.0), "k": rgb(0.0), **rough}
        found[f"{kind} eta 1 k 0"] = {"type": kind, "eta": rgb(1.0), "k": rgb(0.0), **rough}
    for alpha in (0.0, TINY, 1.0):
        for distribution in ("beckmann", "ggx"):
            kind = {"type": "roughconductor", "alpha": alpha, "distribution": distribution}
            found[f"roughconductor {distribution} {alpha:g}"] = kind
    found["roughconductor anisotropic"] = {"type": "roughconductor", "alpha_u": TINY, "alpha_v": 1.0}
    found["roughconductor whole"] = {"type": "roughconductor", "alpha": 0.3, "sample_visible": False}
    return {name: {"type": "twosided", "inner": bsdf} for name, bsdf in found.items()}


def glasses() -> dict[str, Dict]:
    """Interfaces."""
    found: dict[str, Dict] = {}
    for kind, rough in (("dielectric", {}), ("thindielectric", {}), ("roughdielectric", {"alpha": 0.2})):
        found[f"{kind} eta 0.7"] = {"type": kind, "int_ior": 1.0, "ext_ior": 1.4, **rough}
        for reflectance, transmittance in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)):
            both = {"specular_reflectance": reflectance, "specular_transmittance": transmittance}
            found[f"{kind} {reflectance:g} {transmittance:g}"] = {"type": kind, **both, **rough}
    for kind in ("dielectric", "thindielectric"):
        found[f"{kind} eta 1"] = {"type": kind, "int_ior": 1.3, "ext_ior": 1.3}
    for alpha in (0.0, TINY, 1.0):
        found[f"roughdielectric {alpha:g}"] = {"type": "roughdielectric", "alpha": alpha}
    return found


def plastics() -> dict[str, Dict]:
    """Paint under a coat."""
    found: dict[str, Dict] = {}
    kinds = (("plastic", {}), ("roughplastic", {"alpha": 0.2}), ("pplastic", {"alpha": 0.2}))
    for kind, rough in kinds:
        for paint, coat in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)):
            both = {"diffuse_reflectance": rgb(paint), "specular_reflectance": coat}
            found[f"{kind} {paint:g} {coat:g}"] = {"type": kind, **both, **rough}
        if kind != "pplastic":
            found[f"{kind} nonlinear"] = {"type": kind, "nonlinear": True, "diffuse_reflectance": rgb(1.0), **rough}
    found["plastic eta 1"] = {"type": "plastic", "int_ior": 1.3, "ext_ior": 1.3}
    for alpha in (0.0, TINY, 1.0):
        found[f"roughplastic {alpha:g}"] = {"type": "roughplastic", "alpha": alpha}
        found[f"pplastic {alpha:g}"] = {"type": "pplastic", "alpha": alpha}
    return found


def principled() -> dict[str, Dict]:
    """Disney's materials."""
    found: dict[str, Dict] = {}
    both: tuple[Dict, ...] = (
        {"base_color": rgb(0.0)},
        {"base_color": rgb(1.0)},
        {"roughness": 0.0},
        {"roughness": TINY},
        {"roughness": 1.0},
        {"anisotropic": 1.0, "roughness": 0.3},
        {"sheen": 1.0, "sheen_tint": 1.0},
        {"sheen": 1.0, "base_color": rgb(0.0), "sheen_tint": 1.0},
        {"flatness": 1.0},
        {"spec_trans": 1.0},
        {"spec_trans": 1.0, "roughness": 0.0},
        {"spec_trans": 1.0, "base_color": rgb(0.0)},
        {"spec_trans": 1.0, "eta": 1.0},
        {"eta": 1.0},
        {"spec_tint": 1.0, "base_color": rgb(0.0)},
    )
    thick: tuple[Dict, ...] = (
        {"metallic": 1.0, "specular": 0.0},
        {"metallic": 1.0, "specular": 0.0, "base_color": rgb(0.0)},
        {"metallic": 1.0, "roughness": 0.0},
        {"metallic": 1.0, "spec_trans": 1.0},
        {"specular": 0.0},
        {"specular": 1.0},
        {"clearcoat": 1.0, "clearcoat_gloss": 0.0},
        {"clearcoat": 1.0, "clearcoat_gloss": 1.0},
        {"clearcoat": 1.0, "base_color": rgb(0.0), "specular": 0.0},
        {"spec_trans": 1.0, "specular": 0.0},
    )
    thin: tuple[Dict, ...] = ({"diff_trans": 0.0}, {"diff_trans": 2.0}, {"diff_trans": 2.0, "spec_trans": 1.0})
    for kind, cases in (("principled", both + thick), ("principledthin", both + thin)):
        for case in cases:
            said = " ".join(f"{k} {v['value'][0] if isinstance(v, dict) else v:g}" for k, v in case.items())
            found[f"{kind} {said}"] = {"type": kind, **case}
    return found


def both_sides() -> dict[str, Dict]:
    """Opaque surfaces of each class, seen from the side that Mitsuba turns over."""
    tinted = {"type": "roughplastic", "alpha": TINY, "diffuse_reflectance": rgb(1.0)}
    inner: dict[str, Dict] = {
        "diffuse": diffuse(1.0),
        "plastic": {"type": "plastic", "diffuse_reflectance": rgb(0.0), "specular_reflectance": 0.0},
        "roughplastic": {"type": "roughplastic", "diffuse_reflectance": rgb(0.0), "specular_reflectance": 0.0},
        "roughplastic smooth": tinted,
        "pplastic": {"type": "pplastic", "diffuse_reflectance": rgb(0.0), "alpha": TINY},
        "conductor": {"type": "conductor", "material": "none"},
        "roughconductor": {"type": "roughconductor", "material": "none", "alpha": TINY},
        "blendbsdf": {"type": "blendbsdf", "weight": 1.0, "first": diffuse(0.0), "second": tinted},
        "bumpmap": {"type": "bumpmap", "map": flat_map(0.0), "inner": tinted},
        "normalmap": {"type": "normalmap", "normalmap": flat_map(0.5, 0.5, 1.0), "inner": tinted},
    }
    return {f"twosided {name}": {"type": "twosided", "inner": bsdf} for name, bsdf in inner.items()}


def row(materials: dict[str, Dict]) -> Dict:
    """A scene with one ball of each material, seen in the order of a text."""
    import mitsuba as mi

    place = mi.ScalarTransform4f
    rows = -(-len(materials) // COLUMNS)
    width, height = COLUMNS * SPACING, rows * SPACING
    film = {
        "type": "hdrfilm",
        "width": COLUMNS * CELL,
        "height": rows * CELL,
        "rfilter": {"type": "box"},
        "component_format": "float32",
    }
    view = place().look_at(origin=[0, 0, 10], target=[0, 0, 0], up=[0, 1, 0]) @ place().scale([width / 2, width / 2, 1])
    scene: Dict = {
        "type": "scene",
        "camera": {"type": "orthographic", "to_world": view, "film": film},
        "sky": {"type": "constant", "radiance": rgb(0.5, 0.6, 0.7)},
        "lamp": {
            "type": "rectangle",
            "to_world": place().look_at(origin=[width, height, 15], target=[0, 0, 0], up=[0, 1, 0])
            @ place().scale(4.0),
            "emitter": {"type": "area", "radiance": rgb(6.0, 5.0, 4.0)},
        },
    }
    for number, bsdf in enumerate(materials.values()):
        x = (number % COLUMNS + 0.5) * SPACING - width / 2
        y = height / 2 - (number // COLUMNS + 0.5) * SPACING
        # Those of two sides are seen from within: normals of every other class point outwards.
        turned = bsdf["type"] == "twosided"
        ball = {"type": "sphere", "center": [x, y, 0], "radius": 0.9, "flip_normals": turned, "bsdf": bsdf}
        scene[f"ball{number}"] = ball
    return scene


@pytest.fixture(scope="module")
def materials() -> dict[str, Dict]:
    """All of them, by a name that says what is at an edge."""
    device.use("llvm_ad_rgb")
    found: dict[str, Dict] = {}
    for kinds in (plain, metals, glasses, plastics, principled, both_sides):
        found |= kinds()
    return found


def test_every_class_that_a_scene_may_name_is_here(materials: dict[str, Dict]) -> None:
    named = {part["type"] for bsdf in materials.values() for part in (bsdf, *bsdf.values()) if isinstance(part, dict)}
    assert PLUGINS["bsdf"] - {"measured"} <= named  # which has no parameters, and an entry in the zoo


def test_materials_at_their_edges_look_as_in_mitsuba(materials: dict[str, Dict]) -> None:
    """Finds 0.4% of the mean, and 3% of what one material shows."""
    import mitsuba as mi

    scene = mi.load_dict(row(materials))
    images, reference = (
        render(scene, algorithm, images=IMAGES, spp=SPP, max_depth=MAX_DEPTH) for algorithm in ("path", "mi_path")
    )
    assert np.isfinite(images).all()
    found = compare(images, reference, block=CELL)
    assert found.agrees, f"{_material(found.where, list(materials))}: {found}"
    assert found.detectable < 0.004


def _material(where: str, names: list[str]) -> str:
    """What stands in a block; the name of a test of the whole image as it is."""
    if not where.startswith("block"):
        return where
    line, column = (int(number) for number in where.removeprefix("block ").split(","))
    return (names[line * COLUMNS + column :] or ["background"])[0]
