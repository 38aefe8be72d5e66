"""Scenes for every BSDF class of Mitsuba that a scene file may name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.tensors import material, written
from tests.zoo.entry import ONE_WAY, Dict, Entry, specular
from tests.zoo.stage import ball, bitmap, camera, diffuse, noise, rgb, scene


def on_the_ball(bsdf: Dict) -> Callable[[Any, Path], Dict]:
    """The stage with a ball of a material that needs no texture."""

    def make(mi: Any, folder: Path) -> Dict:
        return scene(mi, ball=ball(bsdf))

    return make


def diffuse_textured(mi: Any, folder: Path) -> Dict:
    picture = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": bitmap(mi, noise(11, 8, 8, 3))}}
    checks = {"type": "checkerboard", "color0": rgb(0.1, 0.2, 0.6), "color1": rgb(0.8)}
    return scene(
        mi,
        floor={
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90) @ mi.ScalarTransform4f().scale(2.2),
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": checks}},
        },
        ball=ball(picture),
    )


def blend(mi: Any, folder: Path) -> Dict:
    """A texture decides between a rough metal and a plastic."""
    parts = {"first": {"type": "roughconductor", "alpha": 0.3, "material": "Au"}, "second": {"type": "plastic"}}
    return scene(mi, ball=ball({"type": "blendbsdf", "weight": bitmap(mi, noise(12, 6, 6, 1), raw=True), **parts}))


def bumpy(bsdf: Dict) -> Callable[[Any, Path], Dict]:
    """The stage with a ball of a material under a bump map."""

    def make(mi: Any, folder: Path) -> Dict:
        waves = 0.5 + 0.2 * np.sin(np.arange(64) / 3.0)[:, None] * np.cos(np.arange(64) / 4.0)[None, :]
        map_ = bitmap(mi, waves[..., None], raw=True)
        return scene(mi, ball=ball({"type": "bumpmap", "map": map_, "scale": 0.5, "bsdf": bsdf}))

    return make


def bent(mi: Any) -> Dict:
    """A normal map that tilts by up to half a radian."""
    pixels = np.concatenate([noise(13, 8, 8, 2, low=0.35, high=0.65), np.full((8, 8, 1), 0.95)], axis=-1)
    return bitmap(mi, pixels, raw=True)


def normal_mapped(mi: Any, folder: Path) -> Dict:
    metal = {"type": "roughconductor", "alpha": 0.3}
    return scene(mi, ball=ball({"type": "normalmap", "normalmap": bent(mi), "bsdf": metal}))


def mask(mi: Any, folder: Path) -> Dict:
    opacity = bitmap(mi, noise(14, 6, 6, 1), raw=True)
    return scene(mi, ball=ball({"type": "mask", "opacity": opacity, "bsdf": diffuse(0.8, 0.5, 0.3)}))


def nulls(mi: Any, folder: Path) -> Dict:
    """The ball stands in a shell that does nothing, and so does the light's ray through it."""
    return scene(
        mi,
        ball=ball(center=(0.0, 0.4, 0.0), radius=0.35),
        shell={"type": "sphere", "center": [0, 0.55, 0], "radius": 0.54, "bsdf": {"type": "null"}},
    )


def pane(mi: Any, bsdf: Dict, x: float) -> Dict:
    """An upright pane that hides a part of the ball."""
    place = mi.ScalarTransform4f
    return {
        "type": "rectangle",
        "to_world": place().translate([x, 0.6, 0.9]) @ place().rotate([0, 1, 0], 20) @ place().scale([0.25, 0.6, 1.0]),
        "bsdf": bsdf,
    }


def polarizers(mi: Any, folder: Path) -> Dict:
    """Panes of the three classes, which absorb or do nothing where light is not polarized, and polarized plastic."""
    return scene(
        mi,
        ball=ball({"type": "pplastic", "diffuse_reflectance": rgb(0.6, 0.3, 0.2), "alpha": 0.2}),
        first=pane(mi, {"type": "polarizer", "theta": 30.0}, -0.5),
        second=pane(mi, {"type": "retarder", "theta": 10.0}, 0.0),
        third=pane(mi, {"type": "circular", "transmittance": 0.8}, 0.5),
    )


def thin_glass(mi: Any, folder: Path) -> Dict:
    return scene(mi, pane=pane(mi, {"type": "thindielectric"}, 0.2))


def principled_thin(mi: Any, folder: Path) -> Dict:
    bsdf = {
        "type": "principledthin",
        "base_color": rgb(0.7, 0.8, 0.5),
        "roughness": 0.4,
        "spec_trans": 0.4,
        "diff_trans": 0.8,
        "eta": 1.4,
    }
    return scene(mi, pane=pane(mi, bsdf, 0.1))


def two_sides(mi: Any, folder: Path) -> Dict:
    """An open cylinder: rough metal outside, coloured paint inside."""
    sides = {
        "type": "twosided",
        "outside": {"type": "roughconductor", "alpha": 0.4},
        "inside": {"type": "diffuse", "reflectance": rgb(0.2, 0.7, 0.3)},
    }
    cup = {"type": "cylinder", "p0": [0, 0, 0], "p1": [0, 0.8, 0], "radius": 0.6, "bsdf": sides}
    return scene(mi, sensor=camera(mi, (0.0, 2.2, 2.8), (0.0, 0.4, 0.0)), ball=cup)


def hair(mi: Any, folder: Path) -> Dict:
    """A few thick strands, B-splines and straight ones."""
    lines = []
    rng = np.random.default_rng(15)
    for strand in range(12):
        x, z = (strand % 4) * 0.45 - 0.7, (strand // 4) * 0.35 - 0.4
        lean = rng.uniform(-0.2, 0.2, 2)
        for step in range(5):
            t = step / 4.0
            lines.append(f"{x + lean[0] * t * t:.4f} {-0.1 + 1.3 * t:.4f} {z + lean[1] * t:.4f} {0.12 - 0.05 * t:.4f}")
        lines.append("")
    (folder / "strands.txt").write_text("\n".join(lines) + "\n")
    lines = []
    for strand in range(5):
        x = strand * 0.4 - 0.8
        lines += [f"{x:.4f} -0.05 0.7 0.07", f"{x + 0.1:.4f} 0.5 0.6 0.05", f"{x:.4f} 0.8 0.7 0.03", ""]
    (folder / "straight.txt").write_text("\n".join(lines) + "\n")
    fur = {
        "type": "hair",
        "eumelanin": 0.15,
        "pheomelanin": 0.3,
        "longitudinal_roughness": 0.4,
        "azimuthal_roughness": 0.5,
        "scale_tilt": 3.0,
    }
    return scene(
        mi,
        ball={"type": "bsplinecurve", "filename": str(folder / "strands.txt"), "bsdf": fur},
        straight={"type": "linearcurve", "filename": str(folder / "straight.txt"), "bsdf": diffuse(0.5, 0.5, 0.2)},
    )


def measured(mi: Any, folder: Path) -> Dict:
    """A ball of a measured material that is not the same from both ends of a path, as measurements never are."""
    varied = {
        "jacobian": np.ones(1, np.uint8),
        "ndf": noise(21, 6, 6),
        "sigma": noise(22, 6, 6, low=0.3),
        "vndf": noise(23, 1, 3, 6, 6),
        "luminance": noise(24, 1, 3, 6, 6, low=0.3),
        "rgb": noise(25, 1, 3, 3, 6, 6, high=0.4),
    }
    fields = {
        name: np.asarray(values, np.uint8 if name == "jacobian" else np.float32) for name, values in varied.items()
    }
    (folder / "varied.bsdf").write_bytes(written(material(**fields)))
    return scene(mi, ball=ball({"type": "measured", "filename": str(folder / "varied.bsdf")}))


PRINCIPLED = {
    "type": "principled",
    "base_color": {"type": "rgb", "value": [0.7, 0.5, 0.3]},
    "roughness": 0.4,
    "metallic": 0.3,
    "spec_trans": 0.4,
    "eta": 1.4,
    "anisotropic": 0.5,
    "clearcoat": 0.6,
    "clearcoat_gloss": 0.3,
    "sheen": 0.5,
}
ANISOTROPIC = {"type": "roughconductor", "alpha_u": 0.08, "alpha_v": 0.4, "distribution": "beckmann", "material": "Cu"}

ENTRIES = [
    Entry("diffuse-textured", diffuse_textured, "diffuse with a bitmap and with a checkerboard"),
    Entry("blendbsdf", blend, "blendbsdf by a texture: rough metal and plastic", specular()),
    Entry("bumpmap", bumpy({"type": "diffuse"}), "bumpmap over diffuse"),
    Entry("bumpmap-conductor", bumpy({"type": "conductor"}), "bumpmap over a smooth conductor", specular(), effort=6.0),
    Entry("bumpmap-dielectric", bumpy({"type": "dielectric"}), "bumpmap over smooth glass", specular(), max_depth=7),
    Entry("normalmap", normal_mapped, "normalmap over a rough conductor"),
    Entry("mask", mask, "mask with a texture over a two-sided surface", specular()),
    Entry("null", nulls, "null interfaces", specular()),
    Entry("conductor", on_the_ball({"type": "conductor", "material": "Cu"}), "conductor", specular()),
    Entry("roughconductor", on_the_ball({"type": "roughconductor", "alpha": 0.2, "material": "Au"}), "roughconductor"),
    Entry("roughconductor-anisotropic", on_the_ball(ANISOTROPIC), "roughconductor, anisotropic, Beckmann"),
    Entry("dielectric", on_the_ball({"type": "dielectric"}), "dielectric ball", specular(), max_depth=7),
    Entry(
        "roughdielectric", on_the_ball({"type": "roughdielectric", "alpha": 0.3}), "roughdielectric ball", max_depth=7
    ),
    Entry("thindielectric", thin_glass, "thindielectric pane", specular()),
    Entry(
        "plastic", on_the_ball({"type": "plastic", "diffuse_reflectance": rgb(0.2, 0.4, 0.7)}), "plastic", specular()
    ),
    Entry("roughplastic", on_the_ball({"type": "roughplastic", "alpha": 0.2}), "roughplastic"),
    Entry("polarizers", polarizers, "polarizer, retarder, circular and pplastic, unpolarized", specular()),
    Entry("principled", on_the_ball(PRINCIPLED), "principled with every lobe", max_depth=7),
    Entry("principledthin", principled_thin, "principledthin pane with every lobe"),
    Entry("measured", measured, "measured, not reciprocal"),
    Entry("twosided", two_sides, "twosided with two different sides"),
    Entry(
        "hair",
        hair,
        "hair on B-spline curves, diffuse on linear curves",
        {"light": ONE_WAY, "bdpt": ONE_WAY, "pssmlt": ONE_WAY},
    ),
]
