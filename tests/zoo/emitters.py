"""Scenes for every emitter, on every shape that may carry one, alone and together."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tests.zoo.entry import Dict, Entry, without_extent
from tests.zoo.stage import (
    area,
    ball,
    bitmap,
    camera,
    diffuse,
    facing_down,
    noise,
    rgb,
    scene,
    sphere_mesh,
)


def area_rectangle(mi: Any, folder: Path) -> Dict:
    return scene(mi)


def area_sphere(mi: Any, folder: Path) -> Dict:
    return scene(
        mi,
        ball=ball(center=(-0.5, 0.45, 0.0), radius=0.45),
        light={"type": "sphere", "center": [0.6, 0.7, 0.2], "radius": 0.4, "emitter": area(2.0, 2.0, 1.5)},
    )


def area_disk_and_cylinder(mi: Any, folder: Path) -> Dict:
    return scene(
        mi,
        light={"type": "disk", "to_world": facing_down(mi, 0.5), "emitter": area(2.0, 2.0, 2.0)},
        tube={"type": "cylinder", "p0": [-1.2, 1.2, -0.5], "p1": [0.8, 1.5, -0.3], "radius": 0.2, "emitter": area(1.5)},
    )


def area_mesh(mi: Any, folder: Path) -> Dict:
    """The mesh sphere glows from faces whose areas differ four to one, with interpolated normals."""
    vertices, normals, uv, faces = sphere_mesh(mi, radius=0.5)
    mesh = mi.Mesh("lamp", len(vertices), len(faces), has_vertex_normals=True, has_vertex_texcoords=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = (vertices * [1.0, 0.7, 1.0] + [-0.3, 0.4, 0.0]).ravel()
    params["vertex_normals"] = normals.ravel()
    params["vertex_texcoords"] = uv.ravel()
    params["faces"] = faces.ravel()
    params.update()
    mesh.write_ply(str(folder / "lamp.ply"))
    return scene(
        mi,
        ball=ball(center=(0.7, 0.35, 0.4), radius=0.35),
        light={"type": "ply", "filename": str(folder / "lamp.ply"), "emitter": area(2.0, 1.8, 1.5)},
    )


def area_textured(mi: Any, folder: Path) -> Dict:
    """A screen of coloured squares in view, and one above."""
    place = mi.ScalarTransform4f
    screen = bitmap(mi, noise(1, 6, 6, 3, low=0.0, high=1.0))
    above = bitmap(mi, noise(2, 4, 4, 3, low=0.0, high=1.0) ** 2)
    return scene(
        mi,
        screen={
            "type": "rectangle",
            "to_world": place().translate([0.4, 0.9, -1.1]) @ place().rotate([0, 1, 0], 10) @ place().scale(0.7),
            "emitter": {"type": "area", "radiance": screen},
        },
        light={"type": "rectangle", "to_world": facing_down(mi), "emitter": {"type": "area", "radiance": above}},
    )


def area_two_sided_surface(mi: Any, folder: Path) -> Dict:
    """A leaf that glows on its front; its back scatters, and neither side lets light through."""
    place = mi.ScalarTransform4f
    leaf = {
        "type": "rectangle",
        "to_world": place().translate([0.0, 0.9, 0.4])
        @ place().rotate([0, 1, 0], 115)
        @ place().scale([0.6, 0.8, 1.0]),
        "bsdf": diffuse(0.8, 0.4, 0.2),
        "emitter": area(2.5),
    }
    return scene(mi, ball=ball(center=(-0.8, 0.45, 0.1), radius=0.45), leaf=leaf)


def area_mirrored(mi: Any, folder: Path) -> Dict:
    """Mirrored shapes, as exporters write them: a rectangle with its front down, a disk made an ellipse."""
    mirrored = mi.ScalarTransform4f().scale([-1, 1, 1])
    above = {"type": "rectangle", "to_world": facing_down(mi, 0.0, 3.2, 0.4, 3.0), "bsdf": diffuse(0.8)}
    ellipse = mi.ScalarTransform4f().translate([-0.9, 0.5, 0.3]) @ mi.ScalarTransform4f().scale([-0.3, 0.4, 1.0])
    return scene(
        mi,
        light={"type": "rectangle", "to_world": facing_down(mi) @ mirrored, "emitter": area(3.0)},
        ellipse={"type": "disk", "to_world": ellipse, "bsdf": diffuse(0.5), "emitter": area(1.0)},
        above=above,
    )


def area_mirrored_cylinder(mi: Any, folder: Path) -> Dict:
    place = mi.ScalarTransform4f
    to_world = place().translate([0.7, 0.1, 0.2]) @ place().rotate([1, 0, 0], -70) @ place().scale([-0.3, 0.3, 0.9])
    lamp = {"type": "cylinder", "to_world": to_world, "emitter": area(2.0)}
    return scene(mi, ball=ball(center=(-0.5, 0.45, 0.0), radius=0.45), light=lamp)


def area_on_rough_glass(mi: Any, folder: Path) -> Dict:
    """A glass lamp that glows on its outside, and lets light through besides."""
    glass = {"type": "roughdielectric", "alpha": 0.3}
    lamp = {"type": "sphere", "center": [0.6, 0.7, 0.2], "radius": 0.4, "bsdf": glass, "emitter": area(2.0)}
    return scene(mi, ball=ball(center=(-0.5, 0.45, 0.0), radius=0.45), light=lamp)


def facing_away(mi: Any, folder: Path) -> Dict:
    """Of three lights, one turns its back to the picture and lights it off the wall; one shines out of the scene."""
    place = mi.ScalarTransform4f
    return scene(
        mi,
        light={
            "type": "rectangle",
            "to_world": place().translate([0.3, 1.0, -0.5]) @ place().rotate([0, 1, 0], 180) @ place().scale(0.5),
            "bsdf": diffuse(0.5),
            "emitter": area(4.0, 3.0, 2.0),
        },
        outward={
            "type": "disk",
            "to_world": place().translate([0, 2.5, 0]) @ place().rotate([1, 0, 0], -90) @ place().scale(0.5),
            "emitter": area(4.0),
        },
        dim={"type": "rectangle", "to_world": facing_down(mi), "emitter": area(0.6)},
    )


def point(mi: Any, folder: Path) -> Dict:
    return scene(mi, light={"type": "point", "position": [0.5, 2.4, 1.6], "intensity": rgb(9.0, 8.0, 7.0)})


def spot(mi: Any, folder: Path) -> Dict:
    return scene(
        mi,
        light={
            "type": "spot",
            "to_world": mi.ScalarTransform4f().look_at([0.8, 3.0, 1.8], [0, 0.3, -0.2], [0, 1, 0]),
            "cutoff_angle": 40.0,
            "beam_width": 25.0,
            "intensity": rgb(20.0, 18.0, 15.0),
        },
    )


def spot_textured(mi: Any, folder: Path) -> Dict:
    return scene(
        mi,
        light={
            "type": "spot",
            "to_world": mi.ScalarTransform4f().look_at([0.5, 3.2, 2.0], [0, 0.2, -0.1], [0, 1, 0]),
            "cutoff_angle": 35.0,
            "beam_width": 30.0,
            "intensity": rgb(30.0),
            "texture": bitmap(mi, noise(3, 8, 8, 3), raw=True),
        },
    )


def spot_narrow(mi: Any, folder: Path) -> Dict:
    """Four degrees wide; the rest of the picture is lit by what the spot throws off the wall."""
    return scene(
        mi,
        light={
            "type": "spot",
            "to_world": mi.ScalarTransform4f().look_at([1.2, 2.0, 2.0], [0.3, 1.0, -1.2], [0, 1, 0]),
            "cutoff_angle": 4.0,
            "beam_width": 2.0,
            "intensity": rgb(400.0),
        },
        dim={"type": "rectangle", "to_world": facing_down(mi), "emitter": area(0.4)},
    )


def projector(mi: Any, folder: Path) -> Dict:
    """A slide of coloured squares, thrown across the ball."""
    return scene(
        mi,
        light={
            "type": "projector",
            "irradiance": bitmap(mi, noise(5, 6, 6, 3)),
            "fov": 55.0,
            "scale": 8.0,
            "to_world": mi.ScalarTransform4f().look_at([0.6, 2.4, 2.4], [0, 0.3, -0.2], [0, 1, 0]),
        },
    )


def directional(mi: Any, folder: Path) -> Dict:
    return scene(mi, light={"type": "directional", "direction": [-0.4, -1.0, -0.7], "irradiance": rgb(2.0, 1.8, 1.5)})


def constant(mi: Any, folder: Path) -> Dict:
    return scene(mi, light={"type": "constant", "radiance": rgb(0.8, 0.9, 1.0)})


def sky_pixels() -> Any:
    """Radiance around the scene, [16, 32, 3]: a gradient, noise, and a bright patch."""
    pixels = noise(4, 16, 32, 3, low=0.2, high=1.0) * np.linspace(1.5, 0.3, 16)[:, None, None]
    pixels[3:5, 9:12] = [6.0, 5.0, 3.0]
    return pixels


def envmap(mi: Any, folder: Path) -> Dict:
    place = mi.ScalarTransform4f
    light = {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(sky_pixels(), np.float32)),
        "to_world": place().rotate([0, 1, 0], 70) @ place().rotate([1, 0, 0], 15),
    }
    # A low camera sees the environment over the edge of the wall.
    return scene(mi, sensor=camera(mi, (0.0, 0.7, 3.4), (0.0, 1.1, 0.0), fov=60.0), light=light)


def environment_alone(mi: Any, folder: Path) -> Dict:
    """No surface at all."""
    return scene(mi, floor=None, wall=None, ball=None, light=envmap(mi, folder)["light"])


def sunsky(mi: Any, folder: Path) -> Dict:
    """A wide dim sun: the real one is 60,000 times as bright as the sky."""
    light = {
        "type": "sunsky",
        "sun_direction": [0.4, 0.8, 0.6],
        "turbidity": 4.0,
        "sky_scale": 4.0,
        "sun_scale": 0.002,
        "sun_aperture": 15.0,
        "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90),
    }
    return scene(mi, light=light)


def sky_of_a_moment(mi: Any, folder: Path) -> Dict:
    light = {
        "type": "timed_sunsky",
        "window_start_time": 10.0,
        "sky_scale": 4.0,
        "sun_scale": 0.002,
        "sun_aperture": 15.0,
        "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90),
    }
    return scene(mi, light=light)


def mixed(mi: Any, folder: Path) -> Dict:
    """Every kind of light at once, none of which outshines the others."""
    return scene(
        mi,
        light={"type": "rectangle", "to_world": facing_down(mi, 0.6), "emitter": area(1.0, 0.5, 0.3)},
        globe={"type": "sphere", "center": [-0.9, 0.6, 0.2], "radius": 0.2, "emitter": area(1.5)},
        bulb={"type": "point", "position": [-1.0, 2.2, 1.5], "intensity": rgb(1.0, 2.0, 1.0)},
        spot={
            "type": "spot",
            "to_world": mi.ScalarTransform4f().look_at([1.0, 3.0, 1.5], [0.3, 0.3, 0], [0, 1, 0]),
            "cutoff_angle": 30.0,
            "intensity": rgb(5.0, 3.0, 6.0),
        },
        sun={"type": "directional", "direction": [0.5, -1.0, -0.4], "irradiance": rgb(0.4)},
        sky={"type": "constant", "radiance": rgb(0.2, 0.3, 0.4)},
    )


ENTRIES = [
    Entry("area-rectangle", area_rectangle, "area emitter on a rectangle"),
    Entry("area-sphere", area_sphere, "area emitter on a sphere, in view"),
    Entry("area-disk-cylinder", area_disk_and_cylinder, "area emitters on a disk and on a cylinder, in view"),
    # Mitsuba's path takes the interpolated normal for the surface's in next event estimation: 5% off in places.
    Entry(
        "area-mesh",
        area_mesh,
        "area emitter on a mesh with interpolated normals, in view",
        reference="naive",
        effort=2.0,
    ),
    Entry("area-textured", area_textured, "textured area emitters, in view and above"),
    Entry("area-two-sided-surface", area_two_sided_surface, "a two-sided surface that glows on one side"),
    Entry("area-mirrored", area_mirrored, "area emitters on a rectangle and a disk that are mirrored"),
    # Mitsuba's samples of a mirrored cylinder have their normals inside, its rays meet them outside.
    Entry("area-mirrored-cylinder", area_mirrored_cylinder, "area emitter on a mirrored cylinder", reference="naive"),
    Entry("area-on-rough-glass", area_on_rough_glass, "area emitter on a roughdielectric sphere", reference="naive"),
    Entry("facing-away", facing_away, "emitters that face away from the picture, or from everything", effort=2.0),
    Entry("point", point, "point emitter", without_extent()),
    Entry("spot", spot, "spot emitter", without_extent()),
    Entry("spot-textured", spot_textured, "textured spot emitter", without_extent()),
    Entry("spot-narrow", spot_narrow, "spot emitter four degrees wide", without_extent(), reference="mi_ptracer"),
    Entry("projector", projector, "projector", without_extent()),
    Entry("directional", directional, "directional emitter", without_extent()),
    Entry("constant", constant, "constant environment"),
    Entry("envmap", envmap, "image-based environment, turned, in view"),
    Entry("environment-alone", environment_alone, "an environment without any shape"),
    Entry("sunsky", sunsky, "sun and sky"),
    # Mitsuba evaluates in the middle of tracing when path samples this emitter, and fails.
    Entry("timed-sunsky", sky_of_a_moment, "sun and sky at a moment", reference="naive"),
    Entry("mixed", mixed, "area, point, spot, directional and constant emitters together", without_extent()),
]
