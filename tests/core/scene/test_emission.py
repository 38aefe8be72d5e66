"""Every kind of emitter: F and its inverse, densities, and three estimates of one irradiance that must agree.

The receiver of :func:`irradiances` is a square of side 2 at the origin that looks up; emitters are anywhere.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from elps_core import device
from elps_core.errors import SceneRejected

Array = np.ndarray[Any, Any]

LANES = 1 << 18
DEVIATIONS = 4.5
"""Standard errors that two unbiased estimates may lie apart: one in 1e5 pairs."""


def image(mi: Any, height: int = 12, width: int = 24) -> Any:
    """A picture with black, dim and very bright texels."""
    pixels = np.random.default_rng(5).random((height, width, 3)).astype(np.float32) ** 6
    pixels[2:5, 3:9] = 0.0
    pixels[3, width // 2] = [90.0, 120.0, 60.0]
    return mi.Bitmap(pixels)


def picture(mi: Any) -> dict[str, Any]:
    """A picture without extremes, so that estimates by area stay sharp."""
    pixels = np.random.default_rng(6).random((8, 8, 3)).astype(np.float32) + 0.2
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels)}


def environments(mi: Any) -> dict[str, dict[str, Any]]:
    place = mi.ScalarTransform4f
    turn = place().rotate([0.6, 0.0, 0.8], 133)
    return {
        "constant": {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 2.0, 0.5]}},
        "envmap": {"type": "envmap", "bitmap": image(mi), "scale": 2.0, "to_world": turn},
        "mirrored envmap": {"type": "envmap", "bitmap": image(mi), "to_world": place().scale([-1, 1, 1]) @ turn},
        "sunsky": {"type": "sunsky", "sun_direction": [0.5, 0.3, 0.6]},
        "sun at the zenith": {"type": "sunsky", "sun_direction": [0.001, 0.0, 1.0]},
        "wide sun": {"type": "sunsky", "sun_aperture": 9.0, "hour": 10.0},
        "sky of a moment": {"type": "timed_sunsky", "window_start_time": 11.0},
    }


def others(mi: Any) -> dict[str, dict[str, Any]]:
    """Emitters at a finite distance and directional ones, all above the receiver."""
    place = mi.ScalarTransform4f
    down = place().look_at([0.5, -0.4, 2.5], [0.1, 0.1, 0], [0, 1, 0])
    tilt = place().translate([0.3, -0.2, 2.0]) @ place().rotate([0.6, 0.0, 0.8], 133)
    glow = {"type": "area", "radiance": picture(mi)}
    return {
        "point": {"type": "point", "position": [0.3, -0.4, 1.5], "intensity": {"type": "rgb", "value": [1, 2, 3]}},
        "spot": {
            "type": "spot",
            "to_world": down,
            "cutoff_angle": 35,
            "intensity": {"type": "rgb", "value": [1, 2, 3]},
        },
        "textured spot": {
            "type": "spot",
            "to_world": down,
            "cutoff_angle": 30,
            "beam_width": 5,
            "texture": picture(mi),
        },
        "squeezed spot": {"type": "spot", "to_world": down @ place().scale([2, 1, 0.5]), "cutoff_angle": 10},
        "projector": {"type": "projector", "to_world": down, "fov": 40, "irradiance": picture(mi)},
        "directional": {
            "type": "directional",
            "direction": [0.3, 0.2, -0.8],
            "irradiance": {"type": "rgb", "value": [3, 2, 1]},
        },
        "rectangle": {"type": "rectangle", "to_world": down @ place().scale([0.7, 0.2, 1]), "emitter": glow},
        "sphere": {"type": "sphere", "to_world": tilt @ place().scale(0.6), "emitter": glow},
        "inside of a sphere": {"type": "sphere", "radius": 4, "flip_normals": True, "emitter": glow},
        "disk": {"type": "disk", "to_world": down @ place().scale([0.7, 0.3, 1]), "emitter": glow},
        "cylinder": {"type": "cylinder", "p0": [-1, 0.3, 1.5], "p1": [1, -0.2, 2.5], "radius": 0.4, "emitter": glow},
        "cube": {"type": "cube", "to_world": tilt @ place().scale([0.5, 0.2, 0.3]), "emitter": glow},
    }


def ball(mi: Any, folder: Path, **options: Any) -> dict[str, Any]:
    """A coarse ball of triangles with interpolated normals and texture coordinates, as a file."""
    rows, columns = 5, 8
    lines = []
    for i in range(rows + 1):
        for j in range(columns + 1):
            theta, phi = np.pi * (0.05 + 0.9 * i / rows), 2 * np.pi * j / columns
            p = (np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta))
            lines += ["v {:.6f} {:.6f} {:.6f}".format(*p), "vn {:.6f} {:.6f} {:.6f}".format(*p)]
            lines.append(f"vt {j / columns:.6f} {i / rows:.6f}")
    for i in range(rows):
        for j in range(columns):
            a = i * (columns + 1) + j + 1
            b = a + columns + 1
            corners = [(a, b, a + 1), (a + 1, b, b + 1)]
            lines += ["f " + " ".join(f"{k}/{k}/{k}" for k in corner) for corner in corners]
    path = folder / "ball.obj"
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    place = mi.ScalarTransform4f().translate([0.2, 0.1, 1.6]) @ mi.ScalarTransform4f().scale([0.8, 0.5, 0.6])
    glow = {"type": "area", "radiance": picture(mi)}
    return {"type": "obj", "filename": str(path), "to_world": place, "emitter": glow, **options}


def emission_of(mi: Any, **lights: dict[str, Any]) -> tuple[Any, Any]:
    """A receiver under the given lights, and its emission."""
    from elps_core.scene.emission import Emission

    scene = mi.load_dict({"type": "scene", "receiver": {"type": "rectangle"}, **lights})
    return scene, Emission(scene)


def drawn(emission: Any, table: Array | None = None, lanes: int = LANES, seed: int = 1) -> tuple[Any, Any, Any, Any]:
    """Light points from a start density: (density, starts, weight of the wavelengths, stream)."""
    import drjit as dr
    import mitsuba as mi

    from elps_core.paths.stream import Stream
    from elps_core.sampling.start import StartDensity, power_table
    from elps_core.scene.spectrum import sample_wavelengths

    lights = StartDensity(emission, power_table(emission) if table is None else table)
    stream = Stream.of(lanes, seed)
    wavelengths, weight = sample_wavelengths(stream.next_1d())
    start = lights.sample(stream.next_2d(), stream.next_2d(), wavelengths, dr.full(mi.Bool, True, lanes))
    return lights, start, weight, stream


def escaped(direction: Any) -> Any:
    """What a ray into ``direction`` leaves behind that leaves the scene."""
    import drjit as dr
    import mitsuba as mi

    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(direction))
    si.t, si.wi = dr.inf, -direction
    return si


def uneven(emission: Any, rows: int = 7, columns: int = 5) -> Array:
    """A start density unlike anything that is emitted."""
    return np.random.default_rng(3).random((rows, columns * emission.count)) + 0.3


# -- F, its inverse, and its density -----------------------------------------------------------------


@pytest.mark.parametrize("name", ["constant", "envmap", "mirrored envmap", "sunsky", "sun at the zenith", "wide sun"])
def test_f_of_an_environment_has_an_inverse_and_a_density(mi: Any, name: str) -> None:
    import drjit as dr

    _, emission = emission_of(mi, sky=environments(mi)[name])
    lights, start, _, _ = drawn(emission, uneven(emission))
    direction = -mi.Vector3f(start.point.si.n)
    assert np.allclose(np.array(dr.norm(direction)), 1.0, atol=1e-5)
    met = escaped(direction)
    active = dr.full(mi.Bool, True, LANES)
    u = emission.inverse(start.point.index, met, active)
    again = emission.point(start.point.index, u, start.point.si.wavelengths, active)
    distance = np.array(dr.norm(again.si.n - start.point.si.n))
    assert np.quantile(distance, 0.999) < 1e-4
    assert np.median(distance) < 1e-6
    # The density of the draw is that of the direction, but for roundings across the edges of cells.
    pdf, _, cell = lights.pdf(start.point.emitter, met, active)
    same = np.isclose(np.array(pdf), np.array(start.pdf), rtol=1e-4)
    assert same.mean() > 0.999
    assert (np.array(cell) == np.array(start.cell)).mean() > 0.999


@pytest.mark.parametrize("name", ["envmap", "wide sun"])
def test_directions_follow_their_density(mi: Any, name: str) -> None:
    """A chi-squared test on cells of the sphere that have nothing to do with those of the table."""
    import drjit as dr

    _, emission = emission_of(mi, sky=environments(mi)[name])
    samples = 1 << 20
    lights, start, _, _ = drawn(emission, uneven(emission), samples)
    rows, columns, fine = 21, 34, 80

    def bins(d: Array) -> Array:
        row = np.minimum((0.5 * rows * (1.0 - d[2])).astype(int), rows - 1)
        column = np.minimum(((np.arctan2(d[1], d[0]) / (2 * np.pi) + 0.5) * columns).astype(int), columns - 1)
        return row * columns + column

    counts = np.bincount(bins(-np.array(start.point.si.n)), minlength=rows * columns)
    z, phi = np.meshgrid(
        1.0 - (np.arange(rows * fine) + 0.5) * 2.0 / (rows * fine),
        (np.arange(columns * fine) + 0.5) * 2 * np.pi / (columns * fine) - np.pi,
        indexing="ij",
    )
    r = np.sqrt(1.0 - z * z)
    grid = np.stack([r * np.cos(phi), r * np.sin(phi), z]).reshape(3, -1).astype(np.float32)
    met = escaped(mi.Vector3f(grid))
    emitter = dr.gather(mi.EmitterPtr, start.point.emitter, dr.zeros(mi.UInt32, grid.shape[1]))
    pdf = np.array(lights.pdf(emitter, met, dr.full(mi.Bool, True, grid.shape[1]))[0], np.float64)
    total = pdf.mean() * 4 * np.pi
    assert total == pytest.approx(1.0, abs=4e-3)
    wanted = np.bincount(bins(grid), weights=pdf, minlength=rows * columns)
    wanted *= samples / wanted.sum()
    frequent = wanted >= 5
    p = stats.chisquare(
        [*counts[frequent], counts[~frequent].sum()], [*wanted[frequent], max(wanted[~frequent].sum(), 1e-9)]
    ).pvalue
    assert p > 1e-3


@pytest.mark.parametrize("name", ["envmap", "sunsky", "sun at the zenith", "wide sun", "sky of a moment"])
def test_the_table_follows_radiance(mi: Any, name: str) -> None:
    """Radiance over density varies little: texels and suns are where the table has its mass."""
    _, emission = emission_of(mi, sky=environments(mi)[name])
    _, start, _, _ = drawn(emission)
    value, cosine = emission.radiance(start.point, mi.Vector3f(start.point.si.n), mi.Bool(True))
    weight = np.array(mi.luminance(value) / start.pdf, np.float64)
    assert np.all(np.array(cosine) == 1.0)
    # Within a cell an image is interpolated: alone, a bright texel has 0.88.
    assert weight.std() < (0.9 if name == "envmap" else 0.6) * weight.mean()
    radius = 1.001 * np.sqrt(2)
    assert emission.power[0] == pytest.approx(weight.mean() * np.pi * radius**2, rel=0.03)


def test_a_mesh_light_has_an_inverse_and_the_normals_of_its_triangles(mi: Any, tmp_path: Path) -> None:
    import drjit as dr

    for flip in (False, True):
        scene, emission = emission_of(mi, ball=ball(mi, tmp_path, flip_normals=flip))
        lights, start, _, _ = drawn(emission, uneven(emission), 1 << 15)
        point = start.point
        si = scene.ray_intersect(mi.Ray3f(point.si.p + 1e-3 * point.si.n, -point.si.n))
        assert bool(dr.all(si.is_valid()))
        same = np.array(si.prim_index == point.si.prim_index)
        assert same.mean() > 0.999
        for ours, theirs in ((point.si.n, si.n), (point.si.sh_frame.n, si.sh_frame.n), (point.si.uv, si.uv)):
            assert np.abs(np.array(ours) - np.array(theirs))[:, same].max() < 2e-3
        pdf, index, _ = lights.pdf(si.emitter(scene), si, dr.full(mi.Bool, True, 1 << 15))
        assert np.isclose(np.array(pdf), np.array(start.pdf), rtol=1e-4).mean() > 0.998
        assert bool(dr.all(index == point.index))


# -- Three estimates of one irradiance -----------------------------------------------------------------


def irradiances(mi: Any, scene: Any, emission: Any) -> dict[str, tuple[float, float]]:
    """Irradiance of the receiver in luminance: next event estimation, light paths, and rays that meet emitters.

    Returns (mean, standard error) of each; the last only where no emitter lacks extent.
    """
    import drjit as dr

    from elps_core.scene.spectrum import luminance

    def entry(value: Any, wavelengths: Any) -> tuple[float, float]:
        amount = np.array(luminance(value, wavelengths), np.float64)
        return amount.mean(), amount.std() / np.sqrt(LANES)

    _, start, weight, stream = drawn(emission, uneven(emission))
    active = dr.full(mi.Bool, True, LANES)
    point, wavelengths = start.point, start.point.si.wavelengths

    here = 2.0 * stream.next_2d() - 1.0
    on_receiver = mi.Point3f(here.x, here.y, 0.0)
    direction, distance2, target = emission.towards(point, on_receiver)
    value, cosine = emission.radiance(point, -direction, active)
    ray = mi.Ray3f(on_receiver + mi.Vector3f(0, 0, 1e-4), dr.normalize(target - on_receiver))
    ray.maxt = dr.norm(target - on_receiver) * (1.0 - 1e-3)
    seen = ~scene.ray_test(ray) & (direction.z > 0.0) & (cosine > 0.0)
    found = {
        "next event": entry(
            dr.select(seen, value * weight * (direction.z * cosine / (distance2 * start.pdf)), 0.0), wavelengths
        )
    }

    ray = emission.first_ray(point, stream.next_2d(), active)
    value, cosine = emission.radiance(point, ray.d, active)
    delta, infinite = point.delta, point.infinite
    pdf = start.pdf * emission.pdf_direction(
        point.index, point.si.p, ray.d, cosine, active, delta=delta, infinite=infinite
    )
    si = scene.ray_intersect(ray)
    receiver = mi.ShapePtr([s for s in scene.shapes() if not s.is_emitter()])
    landed = si.is_valid() & (si.shape == dr.gather(mi.ShapePtr, receiver, 0)) & (ray.d.z < 0.0) & (pdf > 0.0)
    area = 4.0
    found["light paths"] = entry(dr.select(landed, value * weight * (cosine / (pdf * area)), 0.0), wavelengths)

    if not bool(dr.any(point.delta)):
        local = mi.warp.square_to_cosine_hemisphere(stream.next_2d())
        ray = mi.Ray3f(on_receiver + mi.Vector3f(0, 0, 1e-4), local)
        ray.time, ray.wavelengths = emission.time, wavelengths
        si = scene.ray_intersect(ray)
        emitter = si.emitter(scene)
        lit = emitter != None  # noqa: E711 (a comparison of arrays of pointers)
        value, cosine = emission.met(emitter, si, lit)
        assert bool(dr.all((cosine >= 0.0) | ~lit))
        found["rays"] = entry(value * weight * dr.pi, wavelengths)
    return found


def agree(found: dict[str, tuple[float, float]], smallest: float = 0.02) -> None:
    """All estimates are one number, and each is sharp enough to say so."""
    reference, error = found["next event"]
    assert reference > 0.0
    for name, (mean, own) in found.items():
        assert abs(mean - reference) < DEVIATIONS * np.hypot(own, error) + 1e-5 * reference, (name, found)
        if name != "rays":
            assert own < smallest * reference, (name, found)


@pytest.mark.parametrize("name", ["constant", "envmap", "mirrored envmap", "sunsky", "wide sun", "sky of a moment"])
def test_irradiance_from_an_environment(mi: Any, name: str) -> None:
    scene, emission = emission_of(mi, sky=environments(mi)[name])
    assert emission.has_environment
    assert emission.has_infinite
    found = irradiances(mi, scene, emission)
    agree(found)
    if name == "constant":
        radiance = np.dot([0.212671, 0.715160, 0.072169], [1.0, 2.0, 0.5])
        assert abs(found["next event"][0] - np.pi * radiance) < DEVIATIONS * found["next event"][1]
        assert found["rays"][0] == pytest.approx(np.pi * radiance, rel=1e-5)


EMITTERS = (
    "point", "spot", "textured spot", "squeezed spot", "projector", "directional",
    "rectangle", "sphere", "inside of a sphere", "disk", "cylinder", "cube",
)  # fmt: skip


@pytest.mark.parametrize("name", EMITTERS)
def test_irradiance_from_other_emitters(mi: Any, name: str) -> None:
    scene, emission = emission_of(mi, light=others(mi)[name])
    assert not emission.has_environment
    assert emission.has_infinite == (name == "directional")
    found = irradiances(mi, scene, emission)
    agree(found, 0.03)
    if name == "directional":
        axis = np.array([0.3, 0.2, -0.8])
        cosine = -axis[2] / np.linalg.norm(axis)
        wanted = cosine * np.dot([0.212671, 0.715160, 0.072169], [3, 2, 1])
        assert abs(found["next event"][0] - wanted) < DEVIATIONS * found["next event"][1]


@pytest.mark.parametrize("flip", [False, True])
def test_irradiance_from_a_mesh_with_interpolated_normals(mi: Any, tmp_path: Path, flip: bool) -> None:
    lamp = ball(mi, tmp_path, flip_normals=flip)
    if flip:  # Its inside emits: around the receiver.
        place = mi.ScalarTransform4f()
        lamp["to_world"] = place.scale([4, 3, 2])
    scene, emission = emission_of(mi, lamp=lamp)
    agree(irradiances(mi, scene, emission), 0.03)


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral"])
def test_irradiance_from_a_mixture_of_everything(variant: str) -> None:
    mi = device.use(variant)
    try:
        chosen = {key: others(mi)[key] for key in ("spot", "directional", "rectangle", "cube", "sphere")}
        lights = {key.replace(" ", "-"): value for key, value in chosen.items()}
        scene, emission = emission_of(mi, sky=environments(mi)["envmap"], **lights)
        assert emission.count == 6
        assert (emission.power > 0.0).all()
        agree(irradiances(mi, scene, emission), 0.03)
    finally:
        device.use("llvm_ad_rgb")


def test_power_of_a_spot_is_that_of_its_whole_cone(mi: Any) -> None:
    """Full intensity up to the beam width, then a linear fall to the cutoff angle."""
    beam, cutoff = np.radians([34.0, 36.0])
    glow = {"type": "rgb", "value": 3.0}
    view = mi.ScalarTransform4f().look_at([1, 2, 3], [0, 0, 1], [0, 1, 0])
    spot = {"type": "spot", "to_world": view, "intensity": glow, "beam_width": 34.0, "cutoff_angle": 36.0}
    _, emission = emission_of(mi, spot=spot)
    theta = np.linspace(0, cutoff, 100001)
    fall = np.clip((cutoff - theta) / (cutoff - beam), 0.0, 1.0)
    wanted = 3.0 * 2 * np.pi * np.trapezoid(fall * np.sin(theta), theta)
    assert emission.power == pytest.approx([wanted], rel=3e-3)


def test_only_directional_light(mi: Any) -> None:
    lamps = {
        f"d{k}": {"type": "directional", "direction": [k, 1, -3], "irradiance": {"type": "rgb", "value": 1.0 + k}}
        for k in range(3)
    }
    scene, emission = emission_of(mi, **lamps)
    assert emission.has_infinite
    assert not emission.has_environment
    agree(irradiances(mi, scene, emission))
    radius = 1.001 * np.sqrt(2)
    assert sorted(emission.power) == pytest.approx([np.pi * radius**2 * (1.0 + k) for k in range(3)], rel=1e-4)


# -- Order, time, and what is refused ------------------------------------------------------------------


def test_order_does_not_depend_on_how_a_scene_lists_its_lights(mi: Any) -> None:
    place = mi.ScalarTransform4f
    lamps: dict[str, dict[str, Any]] = {
        f"d{k}": {"type": "directional", "direction": [k, 0, -1], "irradiance": {"type": "rgb", "value": 1.0}}
        for k in range(3)
    }
    lamps["strong"] = {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "rgb", "value": 7.0}}
    for k in range(3):
        view = place().look_at([0, 0, 2], [k, 1, 0], [0, 1, 0])
        lamps[f"s{k}"] = {"type": "spot", "to_world": view}
    lamps["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": 0.5}}
    lamps["bulb"] = {"type": "sphere", "center": [0, 0, 2], "radius": 0.1, "emitter": {"type": "area"}}
    names = list(lamps)
    keys = []
    for seed in range(3):
        shuffled = [names[i] for i in np.random.default_rng(seed).permutation(len(names))]
        keys.append(emission_of(mi, **{name: lamps[name] for name in shuffled})[1].keys)
    assert np.array_equal(keys[0], keys[1])
    assert np.array_equal(keys[0], keys[2])
    assert np.allclose(keys[0], keys[1] * np.float32(1 + 1e-5), rtol=1e-4, atol=1e-4), "infinities compare as equal"
    assert len(np.unique(keys[0], axis=0)) == len(lamps)
    brighter = {**lamps, "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.6}}}
    assert not np.allclose(emission_of(mi, **brighter)[1].keys, keys[0], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("light", "message"),
    [
        ({"type": "rectangle", "emitter": {"type": "directionalarea"}}, "'directionalarea' light is not supported"),
        ({"type": "bsplinecurve", "emitter": {"type": "area"}}, "area light on a 'bsplinecurve'"),
        (None, "no light"),
    ],
)
def test_what_is_not_supported_is_refused_by_name(
    mi: Any, tmp_path: Path, light: dict[str, Any] | None, message: str
) -> None:
    if light and light["type"] == "bsplinecurve":
        (tmp_path / "curve.txt").write_text("\n".join(f"{k} 0 1 0.1" for k in range(5)) + "\n", encoding="ascii")
        light = {**light, "filename": str(tmp_path / "curve.txt")}
    with pytest.raises(SceneRejected, match=message) as caught:
        emission_of(mi, **({"light": light} if light else {}))
    assert "\n" not in str(caught.value)


def test_a_sky_that_moves_needs_one_moment(mi: Any) -> None:
    sky = environments(mi)["sky of a moment"]
    still = {"type": "perspective", "shutter_open": 0.25, "shutter_close": 0.25}
    _, emission = emission_of(mi, sky=sky, camera=still)
    assert emission.time == 0.25
    with pytest.raises(SceneRejected, match="timed_sunsky"):
        emission_of(mi, sky=sky, camera={**still, "shutter_close": 0.5})
    with pytest.raises(SceneRejected, match="timed_sunsky"):
        emission_of(mi, sky=sky, camera=still, other={**still, "shutter_open": 0.0, "shutter_close": 0.0})
