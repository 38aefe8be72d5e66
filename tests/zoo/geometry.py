"""Scenes for sensors, films and shapes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from elps_core.scene.generate import SceneDescription, cornell, door, maze, write
from elps_core.scene.loader import load_scene
from tests.zoo.entry import TOO_NOISY, Dict, Entry, specular, without_extent
from tests.zoo.stage import SIZE, area, ball, bitmap, camera, diffuse, facing_down, film, noise, rgb, scene, sphere_mesh

METAL = {"type": "roughconductor", "alpha": 0.3}


def thin_lens(mi: Any, folder: Path) -> Dict:
    lens = {"type": "thinlens", "aperture_radius": 0.15, "focus_distance": 3.0}
    return scene(mi, sensor=camera(mi, **lens), ball=ball(METAL))


def wide_lens(mi: Any, folder: Path) -> Dict:
    """A lens so wide that light paths meet it by chance."""
    lens = {"type": "thinlens", "aperture_radius": 0.7, "focus_distance": 2.5}
    return scene(mi, sensor=camera(mi, (0.0, 1.4, 2.2), (0.0, 0.4, 0.0), fov=60.0, **lens))


def orthographic(mi: Any, folder: Path) -> Dict:
    place = mi.ScalarTransform4f
    to_world = place().look_at([0.0, 1.4, 3.0], [0, 0.5, 0], [0, 1, 0]) @ place().scale([1.1, 1.1, 1.0])
    return scene(mi, sensor=camera(mi, type="orthographic", to_world=to_world), ball=ball(METAL))


def principal_point(mi: Any, folder: Path) -> Dict:
    """A lens that is shifted against the film."""
    return scene(mi, sensor=camera(mi, principal_point_offset_x=0.15, principal_point_offset_y=-0.1))


def far_clip(mi: Any, folder: Path) -> Dict:
    """The far plane cuts the ball and leaves the wall out; what it hides lights the rest all the same."""
    return scene(mi, sensor=camera(mi, far_clip=3.6))


def orthographic_clips(mi: Any, folder: Path) -> Dict:
    place = mi.ScalarTransform4f
    to_world = place().look_at([0.0, 1.4, 3.0], [0, 0.5, 0], [0, 1, 0]) @ place().scale([1.1, 1.1, 1.0])
    return scene(mi, sensor=camera(mi, type="orthographic", to_world=to_world, near_clip=2.7, far_clip=3.6))


def near_clip(mi: Any, folder: Path) -> Dict:
    """The near plane opens a ball with a lamp inside; a board before it stays unseen, and hides nothing."""
    place = mi.ScalarTransform4f
    board = {
        "type": "rectangle",
        "to_world": place().translate([-0.5, 0.9, 1.5]) @ place().scale(0.3),
        "bsdf": diffuse(0.8, 0.1, 0.1),
    }
    lamp = {"type": "sphere", "center": [0, 0.4, -0.1], "radius": 0.2, "emitter": area(1.0)}
    return scene(mi, sensor=camera(mi, near_clip=3.1), ball=ball(), board=board, lamp=lamp)


def cropped(mi: Any, rfilter: Dict) -> Dict:
    """A crop window off the middle; what lies around it is bright."""
    window = film(width=40, height=36, crop_offset_x=5, crop_offset_y=9, crop_width=24, crop_height=20, rfilter=rfilter)
    lamp = {"type": "sphere", "center": [0.9, 1.2, 0.2], "radius": 0.3, "emitter": area(3.0)}
    return scene(mi, sensor=camera(mi, of_film=window), lamp=lamp)


def crop_box(mi: Any, folder: Path) -> Dict:
    return cropped(mi, {"type": "box"})


def crop_gaussian(mi: Any, folder: Path) -> Dict:
    return cropped(mi, {"type": "gaussian", "stddev": 0.6})


def filter_mitchell(mi: Any, folder: Path) -> Dict:
    return scene(mi, sensor=camera(mi, of_film=film(rfilter={"type": "mitchell"})), ball=ball(METAL))


def filter_lanczos(mi: Any, folder: Path) -> Dict:
    return scene(mi, sensor=camera(mi, of_film=film(rfilter={"type": "lanczos"})), ball=ball(METAL))


def filter_catmullrom(mi: Any, folder: Path) -> Dict:
    return scene(mi, sensor=camera(mi, of_film=film(rfilter={"type": "catmullrom"})), ball=ball(METAL))


def filter_tent(mi: Any, folder: Path) -> Dict:
    return scene(mi, sensor=camera(mi, of_film=film(rfilter={"type": "tent", "radius": 1.5})))


def vertex_normals(mi: Any, folder: Path) -> Dict:
    """A coarse sphere in the OBJ format: shading normals differ from geometric ones by up to 0.4 radian."""
    vertices, normals, uv, faces = sphere_mesh(mi)
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices]
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in uv]
    lines += [f"vn {x:.6f} {y:.6f} {z:.6f}" for x, y, z in normals]
    lines += ["f " + " ".join(f"{k + 1}/{k + 1}/{k + 1}" for k in face) for face in faces]
    (folder / "ball.obj").write_text("\n".join(lines) + "\n")
    mesh = {"type": "obj", "filename": str(folder / "ball.obj"), "bsdf": diffuse(0.7, 0.4, 0.3)}
    return scene(mi, ball=mesh)


def vertex_normals_glass(mi: Any, folder: Path) -> Dict:
    whole = vertex_normals(mi, folder)
    whole["ball"]["bsdf"] = {"type": "roughdielectric", "alpha": 0.3}
    return whole


def instances(mi: Any, folder: Path) -> Dict:
    """Three copies of a group, turned, stretched and mirrored."""
    place = mi.ScalarTransform4f

    def copy(x: float, z: float, degrees: float, size: list[float]) -> Dict:
        to_world = place().translate([x, 0, z]) @ place().rotate([0, 1, 0], degrees) @ place().scale(size)
        return {"type": "instance", "to_world": to_world, "group": {"type": "ref", "id": "group"}}

    group = {
        "type": "shapegroup",
        "block": {
            "type": "cube",
            "to_world": place().translate([0, 0.25, 0]) @ place().rotate([0, 1, 0], 30) @ place().scale(0.25),
            "bsdf": diffuse(0.3, 0.6, 0.3),
        },
        "top": {"type": "sphere", "center": [0, 0.7, 0], "radius": 0.2, "bsdf": METAL},
    }
    return scene(
        mi,
        ball=None,
        group=group,
        first=copy(-0.7, 0.0, 0.0, [1.0, 1.0, 1.0]),
        second=copy(0.0, -0.3, 40.0, [1.2, 1.4, 0.8]),
        third=copy(0.7, 0.2, 10.0, [-1.0, 0.9, 1.0]),
    )


def cubes_and_sdf(mi: Any, folder: Path) -> Dict:
    """A cube, and a ball given by distances on a grid."""
    axis = np.linspace(-0.5, 0.5, 12)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    distance = np.sqrt(x * x + y * y + z * z) - 0.4
    place = mi.ScalarTransform4f
    sdf = {
        "type": "sdfgrid",
        "grid": mi.TensorXf(distance[..., None].astype(np.float32)),
        "normals": "smooth",
        "to_world": place().translate([-0.2, 0.3, -0.3]) @ place().scale(0.9),
        "bsdf": diffuse(0.7, 0.3, 0.3),
    }
    block = {
        "type": "cube",
        "to_world": place().translate([-0.75, 0.3, 0.1]) @ place().rotate([0, 1, 0], 25) @ place().scale(0.3),
        "bsdf": {"type": "roughplastic", "alpha": 0.3},
    }
    return scene(mi, ball=sdf, block=block)


def caustic(mi: Any, folder: Path) -> Dict:
    """A glass ball above the picture focuses a light of finite size onto the floor in view."""
    lamp = {"type": "disk", "to_world": facing_down(mi, 0.0, 3.2, 0.0, 0.6), "emitter": area(8.0)}
    glass = ball({"type": "dielectric"}, center=(0.0, 1.6, 0.0), radius=0.5)
    return scene(mi, sensor=camera(mi, (0.0, 1.6, 2.4), (0.0, 0.0, 0.0), fov=35.0), ball=glass, light=lamp)


def point_through_glass(mi: Any, folder: Path) -> Dict:
    """A point light in a glass ball above the picture: only light paths leave it."""
    return scene(
        mi,
        sensor=camera(mi, (0.0, 1.6, 2.4), (0.0, 0.0, 0.0), fov=35.0),
        ball=ball({"type": "dielectric"}, center=(0.0, 1.8, 0.0), radius=0.4),
        light={"type": "point", "position": [0.05, 1.75, 0.0], "intensity": rgb(4.0)},
    )


def directional_through_null(mi: Any, folder: Path) -> Dict:
    """A sun behind a pane that does nothing: next event estimation takes the pane for a wall."""
    place = mi.ScalarTransform4f
    return scene(
        mi,
        pane={
            "type": "rectangle",
            "to_world": place().translate([0.3, 2.4, 0.4]) @ place().rotate([1, 0, 0], 90),
            "bsdf": {"type": "null"},
        },
        light={"type": "directional", "direction": [-0.2, -1.0, -0.4], "irradiance": rgb(2.0)},
    )


def generated(description: SceneDescription) -> Callable[[Any, Path], Any]:
    """A scene of our own generators, read by the loader as a user's upload is."""

    def make(mi: Any, folder: Path) -> Any:
        write(description, folder / "scene.zip")
        return load_scene(folder / "scene.zip", mi.variant(), size=SIZE).scene

    return make


def furnace(mi: Any, folder: Path) -> Dict:
    """A white convex body in a white environment is invisible."""
    body = ball({"type": "diffuse", "reflectance": rgb(1.0)}, center=(0.0, 0.5, 0.0), radius=0.9)
    return scene(mi, floor=None, wall=None, ball=body, light={"type": "constant", "radiance": rgb(1.0)})


def closed_room(mi: Any, folder: Path) -> Dict:
    """A closed box that the environment, as bright as what is inside, cannot get into."""
    place = mi.ScalarTransform4f
    box = {
        "type": "cube",
        "to_world": place().translate([0, 1.2, 0]) @ place().scale([2.0, 1.2, 4.0]),
        "bsdf": diffuse(0.5),
    }
    return scene(
        mi,
        floor=None,
        wall=None,
        box=box,
        light={"type": "rectangle", "to_world": facing_down(mi, 0.0, 2.3, 0.4, 1.0), "emitter": area(2.0)},
        outside={"type": "constant", "radiance": rgb(0.2)},
    )


def point_at_the_wall(mi: Any, folder: Path) -> Dict:
    """A point light two centimetres off the wall: what it lights there is a thousand times as bright."""
    return scene(
        mi,
        light={"type": "point", "position": [0.3, 1.0, -1.18], "intensity": rgb(0.4)},
        dim={"type": "rectangle", "to_world": facing_down(mi), "emitter": area(1.0)},
    )


def bumps_close_together(mi: Any, folder: Path) -> Dict:
    """Two bump-mapped walls a hand apart: most connections between them are short."""
    map_ = {**bitmap(mi, noise(21, 16, 16, 1), raw=True), "to_uv": mi.ScalarTransform3f().scale(2.0)}
    bumpy = {"type": "twosided", "bsdf": {"type": "bumpmap", "map": map_, "scale": 0.3, "bsdf": {"type": "diffuse"}}}
    place = mi.ScalarTransform4f

    def board(x: float, degrees: float) -> Dict:
        to_world = (
            place().translate([x, 0.4, 0.0]) @ place().rotate([0, 1, 0], degrees) @ place().scale([0.6, 0.4, 1.0])
        )
        return {"type": "rectangle", "to_world": to_world, "bsdf": bumpy}

    sensor = camera(mi, (0.0, 1.3, 1.5), (0.0, 0.35, 0.0))
    return scene(mi, sensor=sensor, ball=None, left=board(-0.25, 75.0), right=board(0.25, 105.0))


PTRACER = "mi_ptracer"
ENTRIES = [
    Entry("thinlens", thin_lens, "thin lens"),
    Entry("thinlens-wide", wide_lens, "thin lens that light paths meet by chance", lens=True),
    Entry("orthographic", orthographic, "orthographic sensor"),
    Entry("orthographic-clips", orthographic_clips, "near and far clip planes of an orthographic sensor", effort=3.0),
    Entry("principal-point", principal_point, "perspective with a shifted principal point"),
    Entry("far-clip", far_clip, "far clip plane that cuts geometry"),
    Entry("near-clip", near_clip, "near clip plane that cuts geometry"),
    Entry("crop", crop_box, "crop window with bright surroundings"),
    Entry("crop-gaussian", crop_gaussian, "crop window with a Gaussian filter"),
    Entry("filter-mitchell", filter_mitchell, "Mitchell filter, whose lobes are negative"),
    Entry("filter-lanczos", filter_lanczos, "Lanczos filter of three lobes"),
    Entry("filter-catmullrom", filter_catmullrom, "Catmull-Rom filter, whose lobes are negative"),
    Entry("filter-tent", filter_tent, "wide tent filter"),
    Entry("vertex-normals", vertex_normals, "interpolated vertex normals, two-sided diffuse"),
    Entry("vertex-normals-glass", vertex_normals_glass, "interpolated vertex normals, rough glass", max_depth=7),
    Entry("instances", instances, "shape groups and instances, one mirrored"),
    Entry("cube-sdfgrid", cubes_and_sdf, "cube and signed distance grid"),
    Entry("caustic", caustic, "caustic through glass from a light of finite size", reference=PTRACER, effort=3.0),
    Entry(
        "point-through-glass",
        point_through_glass,
        "point light inside glass, off the picture",
        {"path": "next event estimation does not pass glass", **without_extent()},
        reference=PTRACER,
        effort=6.0,
    ),
    Entry(
        "directional-through-null",
        directional_through_null,
        "directional light through a null interface, off the picture",
        {"path": "next event estimation does not pass null interfaces", **without_extent()},
        reference=PTRACER,
        effort=2.0,
    ),
    Entry(
        "cornell",
        generated(cornell(objects="spheres", light_shape="sphere")),
        "Cornell box: glass and rough gold",
        specular(),
        effort=4.0,
    ),
    Entry("maze", generated(maze(rooms=2)), "maze: glass and rough gold, one light a room", specular(), effort=2.0),
    Entry("door", generated(door(angle=60)), "door ajar: light from the next room", specular(), effort=4.0),
    Entry("furnace", furnace, "white body in a white environment", max_depth=3),
    Entry("closed-room", closed_room, "closed room in an environment", effort=2.0),
    Entry(
        "point-at-the-wall",
        point_at_the_wall,
        "point light close to a surface",
        {"path": TOO_NOISY, **without_extent()},
        reference=PTRACER,
    ),
    Entry("bumps-close", bumps_close_together, "short connections between bump-mapped surfaces"),
]
