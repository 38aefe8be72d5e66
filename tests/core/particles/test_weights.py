"""The worked examples of figure 5.7: weights of single particles, from densities that are written out here.

Everything scatters diffusely, so that a walk goes on from x to y with an area density of G(x, y) / pi.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.core.particles.test_contract import half_mirror
from tests.core.particles.test_density import box
from tests.zoo import stage

Array = np.ndarray[Any, Any]

LONGEST = 3
LANES = 4096
PHOTON, IMPORTON = 0, 1
RADIANCE = 4.0
EYE, TARGET, FOV = np.array([0.8, 0.5, 0.7]), np.array([-0.6, -0.6, -0.3]), 60.0
"""The sensor's position, where it looks, and its field of view in degrees."""
ROUNDING, CLOSE = 2e-3, 0.15
"""Relative error of most weights, and of those whose vertices are close together: rays start a little off a surface."""
P_START = 1.0 / 1.8
"""Density of points on the lamp."""
Q = {1: 1.0, 2: 0.5, 3: 0.25}
"""Chance of a path of at least so many segments, 1 to 3 of them."""


@dataclass
class Paths:
    """Paths of one strategy and what was taken from them."""

    vertices: list[Array]  # From the light on, without the sensor, [n, 3] each
    albedo: list[Array]
    normals: list[Array]
    particles: dict[tuple[int, int, int], Array]  # Weights by kind, depth and number of the vertex

    def geometry(self, i: int, j: int) -> Array:
        """G of two vertices that see each other."""
        d = self.vertices[j] - self.vertices[i]
        squared = (d**2).sum(axis=1)
        cosines = [np.abs((d * self.normals[k]).sum(axis=1)) for k in (i, j)]
        return cosines[0] * cosines[1] / squared**2

    def p_film(self, i: int) -> Array:
        """Area density of vertex i as the first one from the sensor."""
        d = self.vertices[i] - EYE
        squared = (d**2).sum(axis=1)
        axis = (TARGET - EYE) / np.linalg.norm(TARGET - EYE)
        cosine = (d @ axis) / np.sqrt(squared)
        film = 4.0 * np.tan(np.radians(FOV / 2.0)) ** 2
        at_vertex = np.abs((d * self.normals[i]).sum(axis=1)) / np.sqrt(squared)
        return at_vertex / squared / (film * cosine**3)


def join(mi: Any, scene: Any, length: int) -> tuple[Any, Any, Any]:
    """Paths of ``length`` segments by all strategies, the stores of their vertices, and the rows there."""
    import drjit as dr

    from elps_core.particles.joining import PathJoiner
    from elps_core.particles.subpaths import StepStore
    from elps_core.paths.stream import Stream
    from elps_core.sampling.start import StartDensity, uniform_table
    from elps_core.scene.emission import Emission
    from elps_core.scene.sensors import Camera

    emission = Emission(scene)
    lights = StartDensity(emission, uniform_table(emission))
    joiner = PathJoiner(scene, Camera(scene.sensors()[0]), lights, max_depth=LONGEST)
    stores = (StepStore(LANES, LONGEST), StepStore(LANES, LONGEST))
    row = dr.arange(mi.UInt32, LANES)
    path = joiner.join((Stream.of(LANES, 1), Stream.of(LANES, 2)), dr.full(mi.UInt32, length, LANES), stores, row)
    dr.eval(path, stores[0].data, stores[1].data)
    return path, stores, row


def harvest(mi: Any, path: Any, stores: Any, row: Any, chosen: Array) -> Any:
    """The particles of the chosen paths, on the host."""
    from elps_core.particles.bidirectional import Harvest, chances
    from elps_core.particles.records import ParticleBuffer

    buffer = ParticleBuffer(LANES * LONGEST, ports=2)
    scale = mi.Float(chosen.astype(np.float32))
    Harvest(chances(LONGEST), first_hits=True).take(path, stores, row, scale, buffer)
    return buffer.take().arrays()


def paths(mi: Any, length: int, s: int, *, joined: bool) -> Paths:
    """Paths of ``length`` segments with ``s`` light vertices, whose ends see each other or do not."""
    path, stores, row = join(mi, box(mi), length)
    t = length + 1 - s
    whole = (np.array(path.light.steps) + 1 >= s) & (np.array(path.eye.steps) + 1 >= t)
    chosen = (np.array(path.light.vertices) == s) & whole & (np.array(path.joined) == joined)
    if joined:
        chosen &= np.array(path.target) > 0.0  # Ends that face each other.
    steps = [path.origin] if s else []
    there = mi.Bool(whole)  # Nobody wrote what other paths have in memory: any bits, even those of signaling NaNs.
    steps += [stores[0].read(mi.UInt32(k), row, there) for k in range(s - 1)]
    steps += [stores[1].read(mi.UInt32(k), row, there) for k in reversed(range(t - 1))]
    places, normals = ([np.array(getattr(v, name)).T for v in steps] for name in "pn")
    # Lamps hang in the box, the block is darker; what the eye meets first may be the lamp itself.
    block = [(np.abs((p - [-0.3, -0.6, -0.2]) / [0.25, 0.4, 0.3]) < 1.001).all(axis=1) for p in places]
    lamp = [np.abs(p[:, 1] - 0.99) < 1e-4 for p in places]
    albedo = [np.where(b, 0.3, np.where(m, 0.5, 0.7)) for b, m in zip(block, lamp, strict=True)]

    arrays = harvest(mi, path, stores, row, chosen)
    index = np.flatnonzero(chosen)
    # Particles come in any order: they are known by their place.
    found: dict[tuple[int, int, int], Array] = {}
    for kind, depth in {(k, d) for k, d in zip(arrays.kind, arrays.depth, strict=True)}:
        of = (arrays.kind == kind) & (arrays.depth == depth)
        weights = dict(zip(map(tuple, arrays.position[of]), arrays.weight[of], strict=True))
        for number, place in enumerate(places):
            here = [weights.get(tuple(p)) for p in place[index]]
            if any(w is not None for w in here):
                found[int(kind), int(depth), number] = np.array([np.nan if w is None else w for w in here])
    return Paths(
        [p[index].astype(float) for p in places],
        [a[index] for a in albedo],
        [n[index].astype(float) for n in normals],
        found,
    )


def share(this: Array, *others: Array) -> Array:
    """The power heuristic."""
    return this**2 / (this**2 + sum(other**2 for other in others))


def agree(paths: Paths, expected: dict[tuple[int, int, int], Array]) -> None:
    """All particles are there and no others, with these weights."""
    assert set(paths.particles) == set(expected)
    for name, weights in expected.items():
        found = paths.particles[name]
        assert len(found) > 20
        off = np.abs(found / weights - 1.0)
        assert np.quantile(off, 0.9) < ROUNDING, (name, off.max())
        assert off.max() < CLOSE, (name, off.max())


def test_a_whole_path_has_three_photons_and_three_importons(mi: Any) -> None:
    """z = y_0 y_1 x_1 x_0 by (2, 2). The photon at the sensor has no surface to lie on."""
    z = paths(mi, 3, 2, joined=True)
    g01, g12, p0, film = z.geometry(0, 1), z.geometry(1, 2), P_START, z.p_film(2)
    forth01 = back01 = g01 / np.pi  # From y_0 to y_1, and from y_1 to y_0
    forth12 = back12 = g12 / np.pi
    f1 = RADIANCE * g01
    f2 = f1 * z.albedo[1] / np.pi * g12
    w1 = film
    w2 = w1 * z.albedo[2] / np.pi * g12
    w3 = w2 * z.albedo[1] / np.pi * g01

    first = p0 * forth01
    second = p0 * forth01 * film
    near, far = film * forth01, film * forth01 * p0
    agree(
        z,
        {
            # Given x_1: y_0 y_1 by (2, .), (1, .), (0, .).
            (PHOTON, 1, 1): 3.0 * share(first, p0 * back12, back12 * back01) * f1 / (first * Q[1]),
            # Given x_0: the thesis's alpha_2, less the strategy that leaves x_0 to the light's walk.
            (PHOTON, 2, 2): 4.0
            * share(second, p0 * forth01 * forth12, p0 * film * back12, film * back12 * back01)
            * f2
            / (second * Q[2]),
            (IMPORTON, 1, 2): 3.0 * share(film, forth12) * w1 / (film * Q[1]),
            (IMPORTON, 2, 1): 4.0 * share(near, film * back12, forth01 * forth12) * w2 / (near * Q[2]),
            (IMPORTON, 3, 0): 5.0
            * share(far, film * back12 * p0, p0 * forth01 * forth12, film * back12 * back01)
            * w3
            / (far * Q[3]),
        },
    )


def test_a_blocked_path_has_what_its_light_walk_brings(mi: Any) -> None:
    """y_0 y_1 | x_0 by (2, 1): the classical photon, for (1, 2) and (0, 3) too, which bring none."""
    z = paths(mi, 2, 2, joined=False)
    brings = RADIANCE * np.pi / P_START
    agree(z, {(PHOTON, 1, 1): 3.0 * brings / Q[1]})


def test_a_path_that_misses_the_sensor_has_classical_photons(mi: Any) -> None:
    """y_0 y_1 y_2 by (3, 0): no light walk meets a pinhole."""
    z = paths(mi, 2, 3, joined=False)
    brings = RADIANCE * np.pi / P_START
    # At y_2 the other three strategies have the sensor, which is no surface: one in four stands for all.
    agree(z, {(PHOTON, 1, 1): brings / Q[1], (PHOTON, 2, 2): 4.0 * brings * z.albedo[1] / Q[2]})


def test_an_eye_path_that_misses_the_lamp_has_classical_importons(mi: Any) -> None:
    """x_2 x_1 x_0 by (0, 3)."""
    z = paths(mi, 2, 0, joined=False)
    agree(z, {(IMPORTON, 1, 1): np.ones(len(z.albedo[0])), (IMPORTON, 2, 0): 4.0 * z.albedo[1] / Q[2]})


def test_an_eye_path_that_meets_the_lamp_has_a_photon_besides(mi: Any) -> None:
    """z_0 x_1 x_0 by (0, 3)."""
    z = paths(mi, 2, 0, joined=True)
    g, film = z.geometry(0, 1), z.p_film(1)
    here, one, two = film * g / np.pi, film * P_START, P_START * g / np.pi
    agree(
        z,
        {
            (PHOTON, 1, 1): 3.0 * share(here, one, two) * RADIANCE * g / (here * Q[1]),
            (IMPORTON, 1, 1): np.ones(len(film)),
            (IMPORTON, 2, 0): 4.0 * share(here, one, two) * z.albedo[1] / Q[2],
        },
    )


def test_no_particle_comes_along_a_mirrored_ray(mi: Any) -> None:
    """(0, 3) over a floor that mirrors every other ray: all of its light is that of one direction."""
    whole = mi.load_dict(
        stage.scene(
            mi,
            floor=stage.room(mi=mi, floor=half_mirror())["floor"],
            light={"type": "constant", "radiance": stage.rgb(1.0)},
            ball=None,
            wall=None,
        )
    )
    path, stores, row = join(mi, whole, 2)
    first, sky = (stores[1].read(mi.UInt32(k), row, mi.Bool(True)) for k in range(2))
    of_eye = (np.array(path.light.vertices) == 0) & np.array(path.joined)
    on_floor = of_eye & (np.abs(np.array(first.p)[1]) < 1e-4)
    scattered = np.array(sky.reached.smooth)
    assert (on_floor & ~scattered).sum() > 50
    arrays = harvest(mi, path, stores, row, on_floor)
    assert (arrays.kind == PHOTON).sum() == (on_floor & scattered).sum()
    assert (arrays.kind == IMPORTON).sum() == on_floor.sum()
