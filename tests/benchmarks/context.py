"""The global context: particles a second, and what its regions and tables take in time and in memory.

``python -m tests.benchmarks.context`` prints tables and writes docs/context.md; it takes several minutes on two cores.
Run it on a machine that does nothing else. ``--quick`` tries everything on a small scale and writes nothing.
"""

from __future__ import annotations

import tempfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import drjit as dr
import mitsuba as mi
import numpy as np
import typer

from elps_core import device
from elps_core.context.clustering import build_regions, groups_of
from elps_core.context.directional import DirectionalAccumulator, finish
from elps_core.context.encoding import DirectionalTables
from elps_core.context.field import DirectionalField
from elps_core.context.lookup import RegionLookup
from elps_core.context.regions import Regions
from elps_core.context.store import DirectionalParts, GlobalContext, load, save
from elps_core.particles.bidirectional import BidirectionalSampler
from elps_core.particles.classical import ClassicalSampler
from elps_core.particles.metropolis import MetropolisSampler
from elps_core.particles.records import PHOTON, Particles, ParticleSampler
from elps_core.renderer import Renderer
from elps_core.sampling.lights import MOST_PIECES
from elps_core.sampling.start import StartDensity, power_table
from elps_core.scene.emission import Emission
from elps_core.scene.generate import door, write
from elps_core.scene.loader import LoadedScene, load_scene
from elps_core.scene.sensors import Camera
from elps_core.settings import ContextSettings, RenderSettings
from tests.benchmarks.common import in_turns, processor

REPORT = Path("docs/context.md")
SIZE = (256, 192)
DEPTH = 16
THESIS = 170e6 / 121.0
"""Particles a second of the thesis [table 5.1]."""
RESOLUTIONS = ((16, 32), (32, 64))
"""Rows and columns: the thesis's, and our default."""
GROUP = 16
"""Regions of a group, from which tables of little evidence borrow."""
STORED = 4000
"""Regions of the context whose loading is timed."""
PILOT, DENSITY = (192, 256), (2, 256, 256)
"""Shapes of the pictures that are stored with it."""
SMALLEST = 1e-3
"""Of a made-up table's values, relative to the largest."""
MIB = float(1 << 20)

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Effort:
    """How much is done of everything."""

    turns: int
    paths: int  # Walks of each kind, or whole paths, in a run
    iterations: int  # Mutations of a chain in a run
    spp: int  # Samples per pixel of the path tracer beside them
    points: int  # Particles that are clustered
    regions: tuple[int, ...]
    loads: int


FULL = Effort(turns=5, paths=1 << 20, iterations=64, spp=16, points=1_000_000, regions=(1024, 4096, 16384), loads=20)
QUICK = Effort(turns=1, paths=1 << 14, iterations=2, spp=1, points=20_000, regions=(256,), loads=3)


def main(quick: Annotated[bool, typer.Option(help="Try it on a small scale; writes nothing.")] = False) -> None:
    """Run the benchmarks and write the report."""
    effort = QUICK if quick else FULL
    device.use("llvm_ad_rgb")
    with tempfile.TemporaryDirectory(prefix="elps-bench-") as name:
        folder = Path(name)
        write(door(), folder / "scene.zip")
        scene = load_scene(folder / "scene.zip", "llvm_ad_rgb", size=SIZE)
        samplers = make_samplers(scene, effort)
        text = [
            "# The global context",
            "",
            f"Made by `python -m tests.benchmarks.context` on {processor()}, two cores, on the scene `door`, 9 degrees",
            f"ajar; `llvm_ad_rgb`, kernels warm, medians of {effort.turns} turns with their range. Ratios are between",
            "peers of the same run; times of one machine vary by about 10%.",
            "",
            *rates(scene, samplers, effort),
            *frustum(scene, samplers),
            *tables(samplers["metropolis"], effort),
            *loading(folder, effort),
        ]
    print("\n".join(text))
    if not quick:
        REPORT.write_text("\n".join(text) + "\n")


def make_samplers(scene: LoadedScene, effort: Effort) -> dict[str, ParticleSampler]:
    """The three kinds, and Metropolis without uniform samples."""
    emission = Emission(scene.scene)
    where = (scene.scene, Camera(scene.sensor), StartDensity(emission, power_table(emission)))
    return {
        "classical": ClassicalSampler(*where, max_depth=DEPTH, paths=effort.paths),
        "bidirectional": BidirectionalSampler(*where, max_depth=DEPTH, paths=effort.paths),
        "metropolis": MetropolisSampler(*where, max_depth=DEPTH, iterations=effort.iterations),
        "metropolis, chains alone": MetropolisSampler(
            *where, max_depth=DEPTH, iterations=effort.iterations, uniform=False
        ),
    }


def rates(scene: LoadedScene, samplers: Mapping[str, ParticleSampler], effort: Effort) -> list[str]:
    """Particles a second, photons and importons together, beside the segments of Mitsuba's path tracer."""
    made: dict[str, list[int]] = {name: [] for name in samplers}

    def run(name: str) -> Callable[[int], object]:
        def way(turn: int) -> None:
            made[name].append(sum(len(batch) for batch in samplers[name].run((turn,))))
            dr.sync_thread()

        return way

    peer = Renderer(scene, RenderSettings(integrator="mi_path", max_depth=DEPTH, roulette="none"))
    ways: dict[str, Callable[[int], object]] = {name: run(name) for name in samplers}
    ways["mi_path"] = lambda turn: peer.render_chunk(turn, effort.spp)
    taken = in_turns(ways, effort.turns)
    segments = SIZE[0] * SIZE[1] * effort.spp * DEPTH / taken["mi_path"]
    lines = [
        "## Particles",
        "",
        f"Photons and importons together, at most {DEPTH} segments, all of a run counted: pilots apart, bootstraps",
        f"included. The thesis traced 170 million in 121 s, {THESIS / 1e6:.2f} million a second. `mi_path`, without",
        f"roulette in closed rooms, takes nearly {DEPTH} segments a sample, and samples a light after each:",
        f"{spread(segments / 1e6)} million segments a second.",
        "",
        "| | million particles a second | to the thesis | to `mi_path`'s segments | particles of a run |",
        "|---|---|---|---|---|",
    ]
    for name, counts in made.items():
        rate = np.array(counts[1:]) / taken[name]
        lines.append(
            f"| {name} | {spread(rate / 1e6)} | {np.median(rate) / THESIS:.1f} | {spread(rate / segments)} "
            f"| {np.median(counts):,.0f} |"
        )
    return [*lines, ""]


def frustum(scene: LoadedScene, samplers: Mapping[str, ParticleSampler]) -> list[str]:
    """Where photons lie: the share of them that the camera has in its frustum, and that it sees."""
    camera = Camera(scene.sensor)
    shares: dict[str, Array] = {}
    for name, sampler in samplers.items():
        counts = np.sum([_in_view(scene.scene, camera, photons) for photons in _photons(sampler, 0)], axis=0)
        shares[name] = counts[:2] / counts[2]
    base = shares["classical"]
    lines = [
        "## Photons in the camera's frustum",
        "",
        "Photons counted, whatever their weight. The frustum goes on behind the wall, into the room with the light;",
        "*seen* are those with nothing between them and the camera.",
        "",
        "| | share in the frustum | to classical | share seen | to classical |",
        "|---|---|---|---|---|",
        *(
            f"| {name} | {share[0]:.3g} | {share[0] / base[0]:.2f} | {share[1]:.3g} | {share[1] / base[1]:.2f} |"
            for name, share in shares.items()
        ),
    ]
    return [*lines, ""]


def _in_view(scene: mi.Scene, camera: Camera, photons: Particles) -> Array:
    """How many are in the frustum, how many are seen, and how many there are."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(photons))
    si.p, si.n = photons.position, photons.normal
    sample = camera.connect(si, mi.Point2f(0.5), dr.full(mi.Bool, True, len(photons)))
    eye = si.p + sample.direction * (sample.distance - sample.near)
    seen = sample.valid & ~scene.ray_test(si.spawn_ray_to(eye), sample.valid)
    return np.array([float(dr.count(sample.valid)[0]), float(dr.count(seen)[0]), float(len(photons))])


def tables(sampler: ParticleSampler, effort: Effort) -> list[str]:
    """Table 5.1 of the thesis again: regions and tables of every size, filled with the photons of two runs."""
    runs = [_photons(sampler, key) for key in (1, 2)]
    count = sum(len(photons) for run in runs for photons in run)
    position, normal = _some(runs, effort.points)
    regions: dict[int, Regions] = {}

    def cluster(wanted: int) -> Callable[[int], object]:
        def way(turn: int) -> None:
            regions[wanted] = build_regions(position, normal, wanted, turn)

        return way

    clustering = in_turns({str(wanted): cluster(wanted) for wanted in effort.regions}, effort.turns)
    lines = [
        "## Regions and tables",
        "",
        f"Regions by k-means from {len(position):,} Metropolis photons, their look-up table included. Tables of one",
        f"quantity, filled with {count:,} photons that are in memory already, and finished (blur, groups, floor).",
        "*In memory* is what sampling needs on the device, *stored* the file's part in the 8-bit encoding,",
        "*compressed* the same by zlib.",
        "",
        "| regions | rows x columns | k-means, s | filling, s | in memory, MiB | stored, MiB | compressed, MiB |",
        "|---|---|---|---|---|---|---|",
    ]
    for wanted in effort.regions:
        for shape in RESOLUTIONS:
            filled, seconds = _filled(regions[wanted], runs, shape, effort.turns)
            stored = filled.encoded("log8")
            packed = len(zlib.compress(b"".join(array.tobytes() for array in stored.arrays().values())))
            field = DirectionalField(RegionLookup(regions[wanted]), stored)
            lines.append(
                f"| {regions[wanted].count} | {shape[0]} x {shape[1]} | {spread(clustering[str(wanted)])} "
                f"| {spread(seconds)} | {field.nbytes / MIB:.1f} | {stored.nbytes / MIB:.1f} | {packed / MIB:.1f} |"
            )
    return [*lines, ""]


def _photons(sampler: ParticleSampler, key: int) -> list[Particles]:
    """Those of a run, in memory, with normals to the side from which they come."""
    found = [photons for batch in sampler.run((key,)) if len(photons := batch.of(PHOTON))]
    for photons in found:
        away = dr.dot(photons.normal, photons.direction) < 0.0
        photons.normal = dr.select(away, -photons.normal, photons.normal)
        dr.eval(photons)
    return found


def _some(runs: list[list[Particles]], most: int) -> tuple[Array, Array]:
    """Positions and normals of at most so many, drawn at random."""
    arrays = [photons.arrays() for run in runs for photons in run]
    position = np.concatenate([part.position for part in arrays])
    normal = np.concatenate([part.normal for part in arrays])
    chosen = np.random.default_rng(0).choice(len(position), min(most, len(position)), replace=False)
    return position[chosen], normal[chosen]


def _filled(
    regions: Regions, runs: list[list[Particles]], shape: tuple[int, int], turns: int
) -> tuple[DirectionalTables, Array]:
    """Tables of all photons, and the seconds that each turn took to fill and finish them."""
    lookup = RegionLookup(regions)
    filled: list[DirectionalTables] = []

    def fill(_: int) -> None:
        accumulator = DirectionalAccumulator(regions.count, *shape)
        for run in runs:
            for photons in run:
                accumulator.add(lookup(photons.position, photons.normal), photons.direction, photons.weight)
            accumulator.close_batch(1.0)  # Runs are what is independent of each other
        groups = groups_of(regions, max(1, regions.count // GROUP), 0)
        filled[:] = [finish([accumulator], groups, regions.normals)]

    seconds = in_turns({"fill": fill}, turns)["fill"]
    return filled[0], seconds


def loading(folder: Path, effort: Effort) -> list[str]:
    """Opening the file of a context with made-up tables of the default size."""
    rng = np.random.default_rng(0)
    position = rng.random((effort.points, 3))
    regions = build_regions(position, np.tile([0.0, 0.0, 1.0], (effort.points, 1)), STORED, 0)
    settings = ContextSettings(regions=STORED)

    def made_up() -> DirectionalTables:
        values = rng.uniform(SMALLEST, 1.0, (regions.count, settings.rows, settings.columns))
        records = np.full(regions.count, 1000)
        return DirectionalTables.of(values, np.ones(regions.count), records).encoded(settings.encoding)

    pilot = rng.random(PILOT).astype(np.float32)
    parts = DirectionalParts(
        regions,
        made_up(),
        made_up(),
        pilot,
        1.0,
        np.ones((regions.count, MOST_PIECES), np.float32),
        np.zeros(PILOT, np.uint16),
        np.zeros(DENSITY, np.float32),
    )
    context = GlobalContext(
        digest="", scene="", sensor=0, settings=settings, adjoint=pilot, emitters=np.zeros((1, 7), np.float32),
        statistics={}, directions=parts,
    )  # fmt: skip
    path = folder / "context.elps"
    save(context, path)
    seconds = in_turns({"load": lambda _: load(path)}, effort.loads)["load"]
    return [
        "## Loading",
        "",
        f"A context of {regions.count} regions with two quantities of {settings.rows} x {settings.columns}, a file of",
        f"{path.stat().st_size / MIB:.1f} MiB that the system has in its cache, is opened and checked in",
        f"{spread(1e3 * seconds)} ms.",
        "",
    ]


def spread(values: Array) -> str:
    """Median and range."""
    return f"{np.median(values):.3g} ({values.min():.3g} to {values.max():.3g})"


if __name__ == "__main__":
    typer.run(main)
