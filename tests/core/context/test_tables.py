"""Building a context with tables: by every kind of particle, in steps that can be taken anywhere, and as a file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from elps_core import device
from elps_core.context.aims import POINTS, Aims
from elps_core.context.encoding import DirectionalTables
from elps_core.context.store import DirectionalParts, GlobalContext, load, save
from elps_core.errors import ContextMismatch
from elps_core.scene.generate import cornell, door, write
from elps_core.scene.loader import LoadedScene, load_scene
from elps_core.settings import ContextSettings, ParticleSource

Array = np.ndarray[Any, Any]

KINDS: tuple[ParticleSource, ...] = get_args(ParticleSource)
ALBEDO = 0.5
DEPTH = 6
SMALL: dict[str, Any] = {
    "resolution": 8,
    "samples_per_cell": 16,
    "max_depth": DEPTH,
    "regions": 32,
    "rows": 8,
    "columns": 16,
    "paths": 1 << 15,
    "tolerance": 0.0,
    "adaptive": False,
}
NO_REGION = 0xFFFF


@pytest.fixture(autouse=True)
def _variant(mi: Any) -> None:
    """What is tested is a module of kernels."""


@cache
def built(kind: ParticleSource) -> Any:
    """A closed room of one albedo, with a shelf and a point light of unit intensity, by one kind of particle."""
    mi = device.use("llvm_ad_rgb")
    from elps_core.context.tables import TableBuilder
    from elps_core.sampling.start import StartDensity, power_table
    from elps_core.scene.emission import Emission
    from elps_core.scene.sensors import Camera

    place = mi.ScalarTransform4f
    grey = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": ALBEDO}}}
    shelf = place().translate([0.3, -0.3, -0.4]) @ place().scale([0.4, 0.05, 0.3])
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 60,
                "to_world": place().look_at([-0.7, 0.0, 0.9], [0.4, -0.2, -0.5], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 24, "height": 16, "rfilter": {"type": "box"}},
            },
            "box": {"type": "cube", "bsdf": grey},
            "shelf": {"type": "cube", "to_world": shelf, "bsdf": grey},
            "lamp": {"type": "point", "position": [0.1, 0.4, 0.2], "intensity": {"type": "rgb", "value": 1.0}},
        }
    )
    emission = Emission(scene)
    settings = ContextSettings(**SMALL | {"particles": kind, "encoding": "float32"})
    builder = TableBuilder(scene, Camera(scene.sensors()[0]), settings)
    while builder.done < builder.steps:
        builder.step(StartDensity(emission, power_table(emission)))
    return builder


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> ParticleSource:
    found: ParticleSource = request.param
    return found


def test_every_kind_of_particle_fills_tables(kind: ParticleSource) -> None:
    builder = built(kind)
    parts = builder.result()
    assert builder.done == builder.steps
    assert parts.regions.count == SMALL["regions"]
    for tables in (parts.radiance, parts.importance):
        assert tables.shape == (SMALL["regions"], SMALL["rows"], SMALL["columns"])
        assert tables.values.sum(axis=(1, 2)) == pytest.approx(np.ones(SMALL["regions"]), abs=1e-4)
        assert tables.values.min() > 0.0, "no direction is lost"
        assert (tables.irradiance >= 0.0).all()
    assert (parts.radiance.evidence > 0).all()
    assert (parts.importance.evidence > 0).all()
    assert parts.pilot.min() > 0.0
    assert parts.view.max() < SMALL["regions"], "the camera stands in a room"
    assert parts.density.sum(axis=(1, 2)) == pytest.approx(np.ones(2), rel=1e-4)
    # Eye paths alone tell what eye paths find; a single step of them has asked no table yet.
    assert (parts.prospects is not None) == (kind == "walks")
    assert parts.shares is None


def test_what_paths_are_paid_is_grey_in_a_grey_room_and_as_bright_as_records_say() -> None:
    prospects = built("walks").result().prospects
    by_eye, _ = irradiance("walks", "radiance")
    assert prospects.shape == (SMALL["regions"], 4)
    assert prospects[:, :3] == pytest.approx(np.repeat(by_eye[:, None], 3, axis=1), rel=1e-4)
    assert (prospects[:, 3] > 0.1).all()


def test_regions_learn_how_often_to_ask_their_tables(box: LoadedScene) -> None:
    from elps_core.context.shares import CHANCES

    builder = builder_of(box, paths=1 << 17)
    while builder.done < builder.steps:
        saved, builder = builder.to_bytes(), builder_of(box, paths=1 << 17)
        builder.restore(saved)
        builder.step()
    parts = builder.result().directions
    assert set(parts.shares.tolist()) <= set(np.float32(CHANCES).tolist())
    # One wall is red and one green: so is what comes from them.
    reddish = parts.prospects[:, 0] / parts.prospects[:, 1]
    assert reddish.max() > 1.2 * np.median(reddish) > 1.2 * 1.2 * reddish.min()


def test_all_steps_of_walks_are_the_same_two_kernels(box: LoadedScene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each is compiled for a second or more in a new scene; tables that know nothing are tables, too."""
    import drjit as dr

    kernels, history = [], dr.kernel_history

    def kept() -> Any:
        """Steps read the history themselves, and it can be read once."""
        found = history()
        kernels.extend(found)
        return found

    monkeypatch.setattr(dr, "kernel_history", kept)
    builder = builder_of(box, paths=1 << 18)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        while builder.done < builder.steps:
            builder.step()
        kept()
    walks = {entry["hash"] for entry in kernels if "ir" in entry and "elps training" in entry["ir"].getvalue()}
    assert len(walks) == 2


def irradiance(kind: ParticleSource, source: str) -> tuple[Array, Array]:
    """Of every region, and the regions' areas, as the builder's own state says."""
    state = built(kind).arrays()
    sums, exposure = state[f"{source}.sums"].sum(axis=(0, 2, 3)), state[f"{source}.exposure"].sum(axis=0)
    return sums / np.maximum(exposure, 1e-9), state["areas"]


def reflected(bounces: int) -> float:
    """Of a unit of flux."""
    return sum(ALBEDO**k for k in range(1, bounces + 1))


@pytest.mark.parametrize("particles", KINDS)
def test_photons_bring_the_flux_that_walls_reflect(particles: ParticleSource) -> None:
    """In a closed room each bounce has ALBEDO of the light before; the first hit belongs to light sampling."""
    found, areas = irradiance(particles, "photons")
    expected = 4.0 * np.pi * reflected(DEPTH - 2 if particles == "walks" else DEPTH - 1)
    assert found @ areas == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("particles", [kind for kind in KINDS if kind != "walks"])
def test_importons_bring_what_albedo_leaves(particles: ParticleSource) -> None:
    """In a closed room, whatever the pixel; the first hit belongs to the connection with the sensor."""
    found, areas = irradiance(particles, "importance")
    worth = np.mean(1.0 / built(particles).result().pilot)
    assert worth > 2.0
    assert found @ areas == pytest.approx(worth * reflected(DEPTH - 1), rel=0.05)


def test_eye_paths_and_light_paths_find_the_same_irradiance() -> None:
    """But for the bounces that are cut off: light paths make DEPTH - 2 of them, eye paths fewer the later they ask."""
    by_eye, _ = irradiance("walks", "radiance")
    by_light, _ = irradiance("walks", "photons")
    expected = np.mean([reflected(DEPTH - 1 - vertex) for vertex in range(1, DEPTH)]) / reflected(DEPTH - 2)
    assert by_eye.sum() / by_light.sum() == pytest.approx(expected, rel=0.05)


@pytest.fixture(scope="session")
def box(tmp_path_factory: pytest.TempPathFactory) -> LoadedScene:
    path = tmp_path_factory.mktemp("scene") / "box.zip"
    write(cornell(), path)
    return load_scene(path, "llvm_ad_rgb", size=(24, 24))


def builder_of(box: LoadedScene, **options: Any) -> Any:
    from elps_core.context.build import ContextBuilder

    return ContextBuilder(box, ContextSettings(**SMALL | options))


def spread(scene: LoadedScene, parts: DirectionalParts) -> tuple[float, float]:
    """Among how many regions caustics are spread, and the mean of 1 / density where their light comes from."""
    import drjit as dr
    import mitsuba as mi

    from elps_core.context.gather import KNOWING, caustics
    from elps_core.context.lookup import RegionLookup
    from elps_core.paths.scattering import Materials
    from elps_core.sampling.context import guided
    from elps_core.sampling.start import StartDensity, power_table
    from elps_core.scene.emission import Emission

    emission = Emission(scene.scene)
    lights = StartDensity(emission, power_table(emission))
    (photons,) = caustics(scene.scene, ContextSettings(**SMALL, seed=9), lights, KNOWING)
    lookup = RegionLookup(parts.regions)
    side = dr.mulsign(mi.Vector3f(photons.normal), dr.dot(photons.normal, photons.direction))
    region = lookup(photons.position, side, mi.Bool(True))
    guide = guided(Materials(scene.scene), parts, eye=0.5, light=None).guides["eye"]
    pdf = np.array(guide.pdf(photons.position, region, photons.direction, mi.Bool(True)), np.float64)
    weight = np.array(photons.weight, np.float64)
    share = np.bincount(np.array(region)) / len(photons)
    return float(1.0 / np.square(share).sum()), float(np.average(1.0 / pdf, weights=weight))


def test_caustics_have_small_regions_and_tables_that_know_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from elps_core.context import gather, tables

    monkeypatch.setattr(gather, "CAUSTIC_PATHS", 1 << 16)
    write(cornell("spheres"), tmp_path / "scene.zip")
    scene = load_scene(tmp_path / "scene.zip", "llvm_ad_rgb", size=(24, 24))
    options = {"regions": 256, "rows": 16, "columns": 32}
    builder = builder_of(scene, **options)
    while builder.done < builder.steps:
        saved, builder = builder.to_bytes(), builder_of(scene, **options)
        builder.restore(saved)
        builder.step()
    state = load_tensors(builder.to_bytes())
    assert state["tables.caustics.evidence"].sum() > 1000
    assert (state["tables.aims.roots"] > 0.0).mean() > 0.3
    many, near = spread(scene, builder.result().directions)
    for module in (gather, tables):
        monkeypatch.setattr(module, "caustics", lambda *_: iter(()))
    without = builder_of(scene, **options)
    while without.done < without.steps:
        without.step()
    monkeypatch.undo()
    monkeypatch.setattr(gather, "CAUSTIC_PATHS", 1 << 16)
    few, far = spread(scene, without.result().directions)
    assert many > 1.2 * few
    assert near < 0.55 * far


def test_few_caustics_get_more_light_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from elps_core.context import gather
    from elps_core.sampling.start import StartDensity, power_table
    from elps_core.scene.emission import Emission

    write(door(angle=3.0), tmp_path / "scene.zip")
    scene = load_scene(tmp_path / "scene.zip", "llvm_ad_rgb", size=(24, 18))
    emission = Emission(scene.scene)
    lights = StartDensity(emission, power_table(emission))
    found, flux = [], []
    for most in (1, gather.MORE_PATHS):
        monkeypatch.setattr(gather, "MORE_PATHS", most)
        batches = [
            photons.arrays() for photons in gather.caustics(scene.scene, ContextSettings(), lights, gather.KNOWING)
        ]
        found.append(sum(len(photons.weight) for photons in batches))
        flux.append(sum(photons.weight.sum(dtype=np.float64) for photons in batches))
    assert found[1] == pytest.approx(gather.MORE_PATHS * found[0], rel=0.1)
    assert flux[1] == pytest.approx(flux[0], rel=0.2)


def test_without_mirrors_and_glass_there_are_no_caustics(state: dict[str, Array]) -> None:
    assert not any(name.startswith("tables.caustics") for name in state)


def test_regions_that_hardly_know_light_get_more_photons(box: LoadedScene, monkeypatch: pytest.MonkeyPatch) -> None:
    from elps_core.context import training

    exposure = []
    for fed in (0.0, float("inf")):
        monkeypatch.setattr(training, "FED", fed)
        builder = builder_of(box, paths=1 << 15)
        while builder.done < builder.steps:
            builder.step()
        state = load_tensors(builder.to_bytes())
        traced = state["tables.photons.exposure"].sum(axis=0) / state["tables.areas"]
        exposure.append(np.median(traced[np.isfinite(traced)]))
    # Light paths times areas, over the areas: in each region all paths that were traced.
    assert exposure[1] == pytest.approx(training.LIGHT_PART * exposure[0], rel=1e-3)


def test_steps_go_on_where_they_were_saved(box: LoadedScene) -> None:
    """Each step from a saved state makes the same of it, but for the order of sums."""
    ours = builder_of(box, paths=1 << 16)
    saved = ours.to_bytes()
    while ours.done < ours.steps:
        theirs = builder_of(box, paths=1 << 16)
        theirs.restore(saved)
        assert theirs.done == ours.done
        ours.step()
        theirs.step()
        before, saved = saved, ours.to_bytes()
        first, second = load_tensors(saved), load_tensors(theirs.to_bytes())
        assert first.keys() == second.keys()
        first.pop("seconds"), second.pop("seconds")
        # Which particles come first is chance, and with them which regions are made.
        if theirs.done - 1 != first_of_tables():
            for name, array in first.items():
                scale = np.abs(array).max(initial=0.0)
                assert np.allclose(array, second[name], rtol=2e-3, atol=1e-6 * scale), name
        assert saved != before
    theirs = builder_of(box, paths=1 << 16)
    theirs.restore(saved)
    assert theirs.done == theirs.steps
    result, again = ours.result(), theirs.result()
    assert np.array_equal(result.adjoint, again.adjoint)
    for name, array in result.directions.arrays().items():
        assert np.allclose(array, again.directions.arrays()[name], rtol=1e-5, atol=1e-6), name


def first_of_tables() -> int:
    from elps_core.context.adjoint import STEPS

    return STEPS


@pytest.fixture(scope="session")
def state(box: LoadedScene) -> dict[str, Array]:
    """Arrays of a build that is done."""
    builder = builder_of(box)
    while builder.done < builder.steps:
        builder.step()
    return dict(load_tensors(builder.to_bytes()))


CHECKED = (
    "tables.counts",
    "tables.pilot",
    "tables.density",
    "tables.lights",
    "tables.colours",
    "tables.moments",
    "tables.chances",
    "tables.clustering.position",
    "tables.clustering.centres",
    "tables.radiance.sums",
    "tables.importance.visits",
    "tables.photons.exposure",
)


@pytest.mark.parametrize("name", CHECKED)
def test_a_state_that_lacks_something_is_refused(box: LoadedScene, state: dict[str, Array], name: str) -> None:
    builder = builder_of(box)
    with pytest.raises(ContextMismatch):
        builder.restore(save_tensors({other: array for other, array in state.items() if other != name}))


@pytest.mark.parametrize("name", [name for name in CHECKED if name not in ("tables.lights", "tables.chances")])
def test_a_state_of_other_shapes_is_refused(box: LoadedScene, state: dict[str, Array], name: str) -> None:
    builder = builder_of(box)
    cut = np.ascontiguousarray(state[name].ravel()[: state[name].size // 2])
    with pytest.raises(ContextMismatch):
        builder.restore(save_tensors(state | {name: cut}))


@pytest.mark.parametrize("fault", ["empty", "cut short", "no batches", "areas", "lights", "regions", "unfinished"])
def test_damaged_states_are_refused(box: LoadedScene, state: dict[str, Array], fault: str) -> None:
    whole = save_tensors(state)
    data = {
        "empty": b"",
        "cut short": whole[: len(whole) // 2],
        "no batches": save_tensors({name: array for name, array in state.items() if name != "batches"}),
        "areas": save_tensors(state | {"tables.areas": np.ones(3)}),
        "lights": save_tensors(state | {"tables.lights": np.ones(3)}),
        "regions": save_tensors(state | {f"tables.radiance.{k}": v for k, v in fewer_regions(state).items()}),
        "unfinished": save_tensors({k: v for k, v in state.items() if not k.startswith("tables.clustering.")}),
    }[fault]
    builder = builder_of(box)
    with pytest.raises(ContextMismatch):
        builder.restore(data)


def fewer_regions(state: dict[str, Array]) -> dict[str, Array]:
    """The radiance so far, of all regions but the last."""
    found = {}
    for name in ("sums", "squares", "exposure", "visits", "evidence", "batches"):
        array = state[f"tables.radiance.{name}"]
        axis = 1 if name in ("sums", "exposure") else 0
        found[name] = array if name == "batches" else np.ascontiguousarray(np.delete(array, -1, axis))
    return found


def test_a_state_of_other_settings_is_refused(box: LoadedScene, state: dict[str, Array]) -> None:
    with pytest.raises(ContextMismatch):
        builder_of(box, resolution=9).restore(save_tensors(state))


def test_tables_that_are_good_enough_are_not_filled_further(box: LoadedScene) -> None:
    builder = builder_of(box, tolerance=1.0, paths=1 << 20)
    taken = 0
    while builder.done < builder.steps:
        builder.step()
        taken += 1
    assert taken < builder.steps
    result = builder.result()
    assert result.statistics["table_paths"] < 1 << 18
    assert result.statistics["table_error"] <= 1.0


@pytest.mark.parametrize(("tolerance", "stops"), [(1e-9, True), (0.0, False)])
def test_steps_that_win_nothing_are_the_last(
    box: LoadedScene, tolerance: float, stops: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    from elps_core.context import plan, tables

    monkeypatch.setattr(tables, "WORTHWHILE", 1e9)
    builder = builder_of(box, tolerance=tolerance, paths=1 << 20)
    while builder.done < builder.steps:
        builder.step()
    # The first two that are compared have roulette both.
    least = sum(plan.FIRST_PATHS << step for step in range(tables.BY_ALBEDO + 2))
    assert builder.result().statistics["table_paths"] == (least if stops else 1 << 20)


@pytest.fixture(scope="session")
def context(box: LoadedScene, state: dict[str, Array]) -> GlobalContext:
    builder = builder_of(box)
    builder.restore(save_tensors(state))
    found: GlobalContext = builder.result()
    return found


def test_directions_survive_the_file(context: GlobalContext, tmp_path: Path) -> None:
    save(context, tmp_path / "context.elps")
    again = load(tmp_path / "context.elps")
    assert context.directions is not None
    assert again.directions is not None
    arrays, read = context.directions.arrays(), again.directions.arrays()
    assert arrays.keys() == read.keys()
    for name, array in arrays.items():
        assert np.array_equal(array, read[name]), name
        assert array.dtype == read[name].dtype
    assert isinstance(again.directions.radiance.values, np.memmap)
    assert again.settings == context.settings


def without_rows(tables: DirectionalTables) -> DirectionalTables:
    return replace(tables, values=np.ascontiguousarray(tables.values[:, 1:]))


Change = Callable[[DirectionalParts], DirectionalParts]
CHANGES: dict[str, Change] = {
    "one picture from above": lambda parts: replace(parts, density=parts.density[:1]),
    "an oblong picture from above": lambda parts: replace(parts, density=parts.density[:, 1:]),
    "no picture from above": lambda parts: replace(parts, density=parts.density[:, :0, :0]),
    "pictures of doubles": lambda parts: replace(parts, density=parts.density.astype(np.float64)),
    "another view": lambda parts: replace(parts, view=parts.view[:, 1:]),
    "a wide view": lambda parts: replace(parts, view=parts.view.astype(np.uint32)),
    "a flat pilot": lambda parts: replace(parts, pilot=parts.pilot.ravel(), view=parts.view.ravel()),
    "no pilot": lambda parts: replace(parts, pilot=parts.pilot[:0], view=parts.view[:0]),
    "a pilot without a number": lambda parts: replace(parts, pilot=np.full_like(parts.pilot, np.nan)),
    "coarser importance": lambda parts: replace(parts, importance=without_rows(parts.importance)),
    "fewer lights": lambda parts: replace(parts, lights=parts.lights[1:]),
    "fewer prospects": lambda parts: replace(parts, prospects=parts.prospects[1:]),
    "prospects below nothing": lambda parts: replace(parts, prospects=parts.prospects - 100.0),
    "a chance of one": lambda parts: replace(parts, shares=np.ones(parts.regions.count, np.float32)),
    "fewer points": lambda parts: replace(
        parts, aims=Aims(np.ones((3, POINTS, 4), np.float32), np.ones((3, POINTS), np.float32))
    ),
    "fewer chances": lambda parts: replace(parts, shares=np.full(3, 0.5, np.float32)),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=list(CHANGES))
def test_parts_that_do_not_fit_are_refused(context: GlobalContext, tmp_path: Path, change: Change) -> None:
    assert context.directions is not None
    save(replace(context, directions=change(context.directions)), tmp_path / "damaged.elps")
    with pytest.raises(ContextMismatch):
        load(tmp_path / "damaged.elps")


@pytest.mark.parametrize("name", ["radiance.values", "importance.scale", "regions.cells", "view", "density", "lights"])
def test_parts_that_are_missing_are_refused(context: GlobalContext, name: str) -> None:
    assert context.directions is not None
    arrays = context.directions.arrays()
    del arrays[name]
    with pytest.raises(ContextMismatch):
        DirectionalParts.from_arrays(arrays)
