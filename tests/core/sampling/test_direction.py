"""Guided directions: what is drawn is what is evaluated, from both sides, whatever the tables say."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
from scipy import stats

from tests import adversaries

Array = np.ndarray[Any, Any]
Side = Literal["eye", "light"]

SIDES: list[Side] = ["eye", "light"]
SHARES: dict[Side, float] = {"eye": 0.5, "light": 0.3}
KINDS: list[adversaries.Kind] = ["random", "spiked"]
DRAWS = 1 << 18
FINE = 24
"""Each cell of a histogram is the mean of this many densities squared."""
ROWS, COLUMNS = 2 * adversaries.GRID[0], 2 * adversaries.GRID[1]
LEVEL = 1e-4
"""Probability with which a test of a correct density fails; seeds are fixed, so it fails never or always."""
DIFFUSE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.8}}
MATERIALS: dict[str, dict[str, Any]] = {
    "diffuse": DIFFUSE,
    "rough metal and paint": {
        "type": "blendbsdf",
        "weight": 0.6,
        "metal": {"type": "roughconductor", "alpha": 0.4},
        "paint": DIFFUSE,
    },
    "rough glass": {"type": "roughdielectric", "alpha": 0.5},
    "paint with a mirror": {"type": "blendbsdf", "weight": 0.4, "paint": DIFFUSE, "mirror": {"type": "conductor"}},
    "mirror": {"type": "conductor"},
}
INCIDENT = [0.6, 0.2, 0.775]
"""Local, about 39 degrees off the normal."""


@pytest.fixture(autouse=True)
def _variant(mi: Any) -> None:
    """What is tested is a module of kernels."""


def place(material: str) -> Any:
    """A scene of one tilted sheet, and the interaction at its middle."""
    import mitsuba as mi

    turn = mi.ScalarTransform4f().rotate([0.6, 0.0, 0.8], 70)
    sheet = {"type": "rectangle", "to_world": turn, "bsdf": MATERIALS[material]}
    scene = mi.load_dict({"type": "scene", "sheet": sheet, "lamp": {"type": "point", "position": [1.0, 2.0, 3.0]}})
    normal = mi.Vector3f(np.array(turn.matrix)[:3, 2])
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0.1, 0.05, 0.02) + normal, -normal))
    si.wi = mi.Vector3f(INCIDENT) * (1.0 / np.linalg.norm(INCIDENT))
    return scene, si


def guided(scene: Any, kind: adversaries.Kind) -> Any:
    from elps_core.paths.scattering import Materials
    from elps_core.sampling.context import guided

    return guided(Materials(scene), adversaries.parts(scene, kind), eye=SHARES["eye"], light=SHARES["light"])


def draws(directions: Any, si: Any, side: Side) -> Any:
    """Many events; and directions in world space as an array [n, 3]."""
    import drjit as dr
    import mitsuba as mi

    from elps_core.paths.stream import Stream

    stream = Stream.of(DRAWS, 9, SIDES.index(side))
    event = directions.sample(si, stream, side, dr.full(mi.Bool, True, DRAWS))
    world = si.to_world(event.wo)
    dr.eval(event, world)
    return event, world


def seen(directions: Any, si: Any, direction: Any, side: Side) -> Any:
    """Scattering into directions of world space."""
    import drjit as dr
    import mitsuba as mi

    event = directions.seen(si, si.to_local(direction), dr.abs(dr.dot(si.n, direction)), side, mi.Bool(True))
    dr.eval(event)
    return event


def cell_probabilities(directions: Any, si: Any, side: Side) -> tuple[Array, Array]:
    """Integrals of the density over :data:`ROWS` x :data:`COLUMNS` cells: of all, and of what is scattered."""
    import drjit as dr
    import mitsuba as mi

    from elps_core.context.directional import EqualAreaMap

    fine = EqualAreaMap(ROWS * FINE, COLUMNS * FINE)
    index = dr.arange(mi.UInt32, fine.cells)
    direction = fine.direction(index // fine.columns, index % fine.columns, mi.Point2f(0.5))
    event = seen(directions, si, direction, side)

    def integrals(density: Any) -> Array:
        each = np.array(density, np.float64).reshape(ROWS, FINE, COLUMNS, FINE)
        return np.asarray(each.sum(axis=(1, 3)) * 4.0 * np.pi / fine.cells)

    return integrals(event.pdf), integrals(dr.select(dr.max(event.value) > 0.0, event.pdf, 0.0))


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(
    ("material", "kind"),
    [("rough metal and paint", "random"), ("rough glass", "spiked"), ("paint with a mirror", "random")],
)
def test_what_is_drawn_is_what_is_evaluated(material: str, kind: adversaries.Kind, side: Side) -> None:
    import drjit as dr

    from elps_core.context.directional import EqualAreaMap

    scene, si = place(material)
    directions = guided(scene, kind)
    event, world = draws(directions, si, side)
    whole, wanted = cell_probabilities(directions, si, side)
    # What is missing is what materials reject, and their mirrors.
    assert SHARES[side] <= whole.sum() < 1.0 + 1e-3
    row, column, _ = EqualAreaMap(ROWS, COLUMNS).locate(world)
    some = np.array(~event.delta & (event.pdf > 0.0) & (dr.max(event.weight) > 0.0))
    counts = np.bincount(np.array(row * COLUMNS + column)[some], minlength=ROWS * COLUMNS)
    chance = wanted.ravel()
    frequent = chance * DRAWS > 25.0
    assert frequent.sum() > 100
    z = (counts - chance * DRAWS)[frequent] / np.sqrt(DRAWS * (chance * (1.0 - chance))[frequent])
    assert stats.chi2.sf((z**2).sum(), len(z)) > LEVEL, np.abs(z).max()


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("material", ["rough metal and paint", "rough glass", "paint with a mirror"])
def test_what_is_drawn_is_told_as_it_is_seen(material: str, side: Side) -> None:
    """Densities both ways, and the weight: what the material scatters over the density of the mixture."""
    import drjit as dr

    scene, si = place(material)
    directions = guided(scene, "random")
    event, world = draws(directions, si, side)
    again = seen(directions, si, world, side)
    some = np.array(~event.delta & (event.pdf > 0.0) & (dr.max(event.weight) > 0.0))
    assert some.mean() > 0.3
    # Where a direction lies on the edge of two cells, rounding decides which of them it is in.
    for ours, theirs in (
        (event.pdf, again.pdf),
        (event.pdf_rev, again.pdf_rev),
        (event.weight.x * event.pdf, again.value.x),
    ):
        same = np.isclose(np.array(ours), np.array(theirs), rtol=2e-3, atol=1e-6)[some]
        assert same.mean() > 0.999


@pytest.mark.parametrize("material", ["diffuse", "rough metal and paint", "rough glass"])
def test_densities_of_both_sides_are_each_others_reverse(material: str) -> None:
    """Of a way there and back: each enters the weights of the other's paths."""
    import mitsuba as mi

    scene, si = place(material)
    directions = guided(scene, "random")
    _, world = draws(directions, si, "eye")
    there = {side: seen(directions, si, world, side) for side in SIDES}
    arrived = mi.Vector3f(si.wi)
    si.wi = si.to_local(world)
    back = {side: seen(directions, si, si.to_world(arrived), side) for side in SIDES}
    differ = False
    for side, other in (("eye", "light"), ("light", "eye")):
        pairs = [(there[side].pdf, back[other].pdf_rev), (there[side].pdf_rev, back[other].pdf)]
        for ours, theirs in pairs:
            assert np.isclose(np.array(ours), np.array(theirs), rtol=2e-3, atol=1e-6).mean() > 0.999
        differ |= not np.allclose(there[side].pdf, there[other].pdf, rtol=0.1)
    assert differ, "the sides have tables and shares of their own"


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("material", ["mirror", "paint with a mirror"])
def test_mirrors_keep_their_weight_over_the_share_of_scattering(material: str, side: Side) -> None:
    import mitsuba as mi

    from elps_core.paths.scattering import Materials
    from elps_core.sampling.direction import Directions

    scene, si = place(material)
    plain, _ = draws(Directions(Materials(scene)), si, side)
    event, _ = draws(guided(scene, "random"), si, side)
    # Where nothing is scattered nothing is guided.
    share = 0.0 if material == "mirror" else SHARES[side]
    delta, plain_delta = np.array(event.delta), np.array(plain.delta)
    expected = (1.0 - share) * plain_delta.mean()
    assert abs(delta.mean() - expected) <= 5.0 * np.sqrt(expected * (1.0 - expected) / DRAWS)
    for ours, theirs in zip(event.weight, plain.weight, strict=True):
        assert np.allclose(np.array(ours)[delta], np.array(theirs)[plain_delta][0] / (1.0 - share), rtol=1e-5)
    reflected = mi.Vector3f(-si.wi.x, -si.wi.y, si.wi.z)
    assert np.abs(np.array(event.wo - reflected))[:, delta].max() < 1e-6


@pytest.mark.parametrize("side", SIDES)
def test_without_a_table_directions_are_those_of_scattering(side: Side) -> None:
    """The other side's table, and a table that serves roulette, move no draw; yet they enter the reverse density."""
    from elps_core.paths.scattering import Materials
    from elps_core.sampling.context import guided as made
    from elps_core.sampling.direction import Directions

    scene, si = place("rough metal and paint")
    parts = adversaries.parts(scene, "random")
    for own in (None, 0.0):
        shares = {"eye": own, "light": 0.3} if side == "eye" else {"eye": 0.3, "light": own}
        event, _ = draws(made(Materials(scene), parts, **shares), si, side)
        plain, _ = draws(Directions(Materials(scene)), si, side)
        some = np.array(plain.pdf) > 0.0
        for ours, theirs in ((event.wo, plain.wo), (event.weight, plain.weight), (event.pdf, plain.pdf)):
            assert np.array_equal(np.array(ours)[..., some], np.array(theirs)[..., some])
        assert not np.allclose(np.array(event.pdf_rev)[some], np.array(plain.pdf_rev)[some], rtol=0.05)


@pytest.mark.parametrize("side", SIDES)
def test_what_a_path_can_expect_is_asked_of_tables_that_know(side: Side) -> None:
    """Twice the throughput is worth twice as much; regions with few records know nothing, nor does scattering."""
    import mitsuba as mi

    from elps_core.paths.scattering import Materials
    from elps_core.paths.stream import Stream
    from elps_core.sampling.direction import Directions

    scene, si = place("diffuse")
    directions = guided(scene, "random")
    parts = adversaries.parts(scene, "random")
    evidence = (parts.radiance if side == "eye" else parts.importance).evidence
    points = mi.Point3f(np.random.default_rng(1).uniform(-1.0, 1.0, (3, 4096)).astype(np.float32))
    si.p = points
    active = mi.Bool(True)
    up, cosine = mi.Vector3f(si.sh_frame.n), mi.Float(1.0)
    event = directions.sample(si, Stream.of(4096, 3), side, active)
    event.delta = mi.Bool(False)
    once = directions.expected(si, event, up, cosine, mi.Spectrum(0.2), side, active)
    twice = directions.expected(si, event, up, cosine, mi.Spectrum(0.4), side, active)
    region = np.array(directions.region(si, si.wi, active))
    assert np.array_equal(np.array(once.known), evidence[region] >= 64)
    assert 0 < np.count_nonzero(once.known) < 4096
    assert np.allclose(twice.value, 2.0 * np.array(once.value))
    assert np.allclose(twice.light, 2.0 * np.array(once.light))
    assert np.array(once.light).any() == (side == "eye")
    unguided = Directions(Materials(scene))
    assert not np.array(unguided.expected(si, event, up, cosine, mi.Spectrum(0.2), side, active).known).any()
    event.delta = mi.Bool(True)
    assert not np.array(directions.expected(si, event, up, cosine, mi.Spectrum(0.2), side, active).known).any()


@pytest.mark.parametrize("own", [0.5, 0.0], ids=["guided", "by scattering"])
def test_what_paths_are_paid_is_what_tables_expect_of_all_directions(own: float) -> None:
    """Over the density of the draw its mean is scattering times irradiance; less where that is drawn too seldom."""
    import mitsuba as mi

    from elps_core.paths.scattering import Materials
    from elps_core.paths.stream import Stream
    from elps_core.sampling.context import guided as made
    from elps_core.sampling.direction import LIKELIER

    scene, si = place("diffuse")
    # Half of all points and slits lie below the surface.
    parts = replace(adversaries.parts(scene, "random"), aims=None, slits=None)
    directions = made(Materials(scene), parts, eye=own, light=None)
    active, count = mi.Bool(True), 1 << 18
    region = int(np.array(directions.region(si, si.wi, active)).ravel()[0])
    event = directions.sample(si, Stream.of(count, 5), "eye", active)
    direction = si.to_world(event.wo)
    cosine = mi.Float(np.abs(np.array(mi.Frame3f.cos_theta(event.wo))))
    light = np.array(directions.expected(si, event, direction, cosine, event.weight, "eye", active).light)
    drawn = np.array(event.pdf) > 0.0
    albedo = np.array(event.albedo)[:, drawn].max(axis=1)
    assert parts.prospects is not None
    most = albedo / np.pi * parts.prospects[region, :3]
    mean, error = light[:, drawn].sum(axis=1) / count, light[:, drawn].std(axis=1) / np.sqrt(count)
    assert (mean <= most * 1.001 + 4.0 * error).all()
    assert (mean > 0.4 * most).all()
    bound = LIKELIER * albedo[:, None] * parts.prospects[region, :3, None] / np.pi
    assert (light[:, drawn] <= bound * 1.001).all()
