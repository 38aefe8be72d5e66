"""What can be wrong in the benchmark of the first job: its statistics, its page, its scenes, and Mitsuba's side."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elps_core.estimate.stats import rel_mse
from tests.benchmarks.common import TRIM
from tests.benchmarks.first_job import page, results
from tests.benchmarks.first_job.measure import SCRIPT, Reference, environment
from tests.benchmarks.first_job.ratios import BLOCK, Ratio, block_sums, geometric_mean, ratio
from tests.benchmarks.first_job.scenes import JUDGED_ON, SCENES, TUNED_ON, LeftOut, film_size, fitted, resized, stage

BLOCKS = 80
TIMES = {"seconds_process": 10.0, "seconds_total": 9.5, "seconds_compile": 1.5, "overshoot": -0.5}
RUN = {"run": 0, "spp": 64, **TIMES, "overshoot_process": 0.25, "choice": None, "against": "a"}


def generator(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def products(mean: float, runs: int, seed: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Error x seconds of runs whose blocks scatter by half."""
    scatter = np.random.default_rng(seed).uniform(0.5, 1.5, (runs, BLOCKS))
    return mean * scatter / BLOCKS


def known(found: Ratio | None) -> Ratio:
    assert found is not None
    return found


def test_a_ratio_is_of_means_and_never_a_mean_of_ratios() -> None:
    peer, other = np.array([[1.0], [9.0]]), np.array([[1.0], [1.0 / 9.0]])
    found = known(ratio(peer, other, generator()))
    assert found.value == pytest.approx(10.0 / (10.0 / 9.0))
    assert found.low == pytest.approx(1.0)
    assert found.high == pytest.approx(81.0)


def test_the_interval_covers_the_truth_about_as_often_as_it_says() -> None:
    """Errors scatter between runs as a whole, so that only the runs can tell how much."""
    truth, rounds, runs, blocks = 2.0, 200, 6, 10
    covered = 0
    for number in range(rounds):
        drawn = generator(number)
        peer, other = (drawn.normal(1.0, 0.1, (runs, 1)) * drawn.uniform(0.9, 1.1, (runs, blocks)) for _ in range(2))
        found = known(ratio(truth * peer, other, drawn))
        covered += found.low <= truth <= found.high
    assert 0.88 <= covered / rounds <= 0.99


def test_blocks_that_are_hard_for_both_do_not_widen_the_interval() -> None:
    hard = np.where(np.arange(BLOCKS) < 4, 50.0, 1.0) / BLOCKS
    alike = known(ratio(3.0 * hard[None], hard[None], generator()))
    assert [alike.low, alike.high] == pytest.approx([3.0, 3.0])
    apart = known(ratio(3.0 * hard[None], hard[None, ::-1], generator()))
    assert apart.low < 1.5 < 6.0 < apart.high


def test_what_is_below_the_noise_of_the_reference_has_no_ratio() -> None:
    assert ratio(products(1.0, 2, 1), -products(1.0, 2, 2), generator()) is None
    nearly = products(1.0, 1, 2)
    nearly -= 0.99 * nearly.mean()
    found = known(ratio(products(1.0, 1, 1), nearly, generator()))
    assert np.isinf(found.high)
    assert not np.isnan(found.replicates).any()


def test_verdicts_are_by_the_whole_interval() -> None:
    assert known(ratio(products(3.0, 2, 1), products(1.0, 2, 2), generator())).verdict == "wins"
    assert known(ratio(products(1.0, 2, 1), products(3.0, 2, 2), generator())).verdict == "loses"
    assert known(ratio(products(1.0, 2, 1), products(1.0, 2, 2), generator())).verdict == "undecided"


def test_a_win_and_an_equal_loss_have_the_geometric_mean_one() -> None:
    win = known(ratio(products(4.0, 2, 1), products(1.0, 2, 2), generator()))
    loss = Ratio(1.0 / win.value, 1.0 / win.replicates[::-1])
    mean = known(geometric_mean([win, loss]))
    assert mean.value == pytest.approx(1.0)
    assert mean.low < 1.0 < mean.high
    assert mean.high / mean.low < win.high / win.low
    assert geometric_mean([]) is None


@pytest.mark.parametrize("shape", [(2 * BLOCK, 3 * BLOCK), (2 * BLOCK + 1, 3 * BLOCK - 1)])
def test_blocks_hold_every_pixel_once(shape: tuple[int, int]) -> None:
    errors = generator().uniform(size=shape)
    sums = block_sums(errors)
    assert sums.sum() == pytest.approx(errors.sum())
    assert sums[0] == pytest.approx(errors[:BLOCK, :BLOCK].sum())
    assert len(sums) == -(-shape[0] // BLOCK) * -(-shape[1] // BLOCK)


def test_errors_are_without_the_noise_of_the_reference() -> None:
    """An image as noisy as the reference has half the squared difference for itself."""
    size, drawn = (6 * BLOCK, 8 * BLOCK), generator()
    noise = 0.05
    truth = np.ones((*size, 3))
    own = np.full(size, noise**2 / (1 + 0.1**2))
    converged = Reference((truth + noise * drawn.normal(size=truth.shape)).astype(np.float32), own, "a")
    image = (truth + noise * drawn.normal(size=truth.shape)).astype(np.float32)
    told = converged.errors(image)
    assert told["relmse"] == pytest.approx(noise**2, rel=0.1)
    assert sum(told["blocks"]) == pytest.approx(told["relmse"], rel=0.01)
    assert told["trimmed"] < rel_mse(image, converged.image, trim=TRIM)


def record(scene: str, way: str, temperature: str, asked: float, error: float, **more: object) -> results.Record:
    blocks = [error / BLOCKS] * BLOCKS
    what = {"scene": scene, "way": way, "temperature": temperature, "asked": asked}
    return {**what, **RUN, "relmse": error, "trimmed": error / 2, "blocks": blocks, **more}


def rows(text: str, title: str) -> dict[str, list[str]]:
    """Cells of the table under a title, by the first cell."""
    section = text.split(f"## {title}\n")[1].split("\n## ")[0]
    lines = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("|")]
    return {cells[0]: cells[1:] for cells in lines}


@pytest.fixture
def written(tmp_path: Path) -> str:
    """The page of made-up results: a win, a loss, a failure and a scene left out."""
    out = tmp_path / "first-job.json"
    series = [
        record("cornell", "mitsuba", "cold", 15.0, 0.4),
        record("cornell", "auto", "cold", 15.0, 0.1, choice="path, enlightened"),
        record("cornell", "mitsuba", "warm", 15.0, 0.4),
        record("cornell", "auto", "warm", 15.0, 0.05),
        record("cornell", "bdpt", "cold", 15.0, 80.0),
        record("maze", "mitsuba", "cold", 15.0, 0.1),
        record("maze", "auto", "cold", 15.0, 0.2, seconds_process=20.0),
        record("door 3", "mitsuba", "cold", 15.0, 0.1),
        {"scene": "door 3", "way": "auto", "temperature": "cold", "asked": 15.0, "run": 0, "failed": 1},
        record("door 9", "mitsuba", "cold", 15.0, 0.1),
        record("door 9", "auto", "cold", 15.0, 0.1, against="b"),
    ]
    results.enter(out, "runs", series)
    results.enter(out, "clock", [record("maze", "auto", "cold", 5.0, 0.0)])
    waits = [{"scene": "maze", "temperature": "warm", "run": run, "seconds_first_image": 2.0 + run} for run in (0, 1)]
    results.enter(out, "first_image", waits)
    results.enter(out, "left_out", [{"scene": "office", "why": "it is not here"}])
    page.write(out)
    return out.with_suffix(".md").read_text()


def test_the_page_shows_wins_losses_and_failures(written: str) -> None:
    table = rows(written, "Efficiency ratios of `auto` to Mitsuba at equal time")
    assert table["scene"] == ["half", "15 s cold", "15 s warm"]
    assert table["cornell"] == ["tuned on", "4.00 (4.00 to 4.00), wins", "8.00 (8.00 to 8.00), wins"]
    assert table["maze"] == ["judged on", "**0.25 (0.25 to 0.25), loses**", "-"]
    assert table["door 3"] == ["judged on", "auto failed", "-"]
    assert table["door 9"] == ["tuned on", "against another reference", "-"]
    assert table["**geometric mean, all**"][1].startswith("1.00 (1.00 to 1.00), undecided, 2 scenes")
    assert table["**geometric mean, judged on**"][1] == "**0.25 (0.25 to 0.25), loses**, 1 scene"
    forced = rows(written, "Efficiency ratios of `bdpt` to Mitsuba at equal time")
    assert forced["cornell"][1] == "**0.005 (0.005 to 0.005), loses**"
    assert table["**wins, loses, undecided**"][1] == "1, 1, 0"


def test_the_page_shows_times_and_what_was_left_out(written: str) -> None:
    assert "- office: it is not here" in written
    assert rows(written, "Does `auto` keep its time?")["maze"] == ["+0.25; -0.50; 64"]
    assert rows(written, "First partial image of the service")["maze"] == ["-", "2.5 (2.0 to 3.0)"]
    assert rows(written, "Efficiency ratios of `auto` without the worst pixels")["cornell"] == ["4.00", "8.00"]
    assert "path, enlightened" in written
    assert rows(written, "Where the time goes")["cornell"][1:] == ["1.50"]


def test_a_series_takes_the_place_of_the_same_one_only(tmp_path: Path) -> None:
    out = tmp_path / "first-job.json"
    results.enter(out, "runs", [record("maze", "auto", "cold", 15.0, error, run=error) for error in (1.0, 2.0)])
    results.enter(out, "runs", [record("maze", "auto", "warm", 15.0, 3.0)])
    results.enter(out, "runs", [record("maze", "auto", "cold", 15.0, 4.0)])
    held = results.load(out)["runs"]
    assert [(found["temperature"], found["relmse"]) for found in held] == [("warm", 3.0), ("cold", 4.0)]
    assert all(found["commit"] and found["date"] and found["processor"] for found in held)


def test_a_page_without_measurements_is_one(tmp_path: Path) -> None:
    page.write(tmp_path / "first-job.json")
    assert "no measurements" in (tmp_path / "first-job.md").read_text()


def test_there_are_two_halves_and_eleven_scenes() -> None:
    assert len(SCENES) == len(TUNED_ON) + len(JUDGED_ON) == 11


def test_a_scene_that_is_not_here_is_left_out_by_name(tmp_path: Path) -> None:
    with pytest.raises(LeftOut, match="--shared"):
        stage(SCENES["classroom"], tmp_path, tmp_path, (16, 12))


def test_the_film_of_a_copy_is_resized_and_the_original_left_alone(tmp_path: Path) -> None:
    original = tmp_path / "original"
    (original / "models").mkdir(parents=True)
    xml = original / "scene.xml"
    xml.write_text(
        '<scene version="3.0.0"><default name="w" value="320"/><sensor type="perspective"><film type="hdrfilm">'
        '<integer name="width" value="$w"/><integer name="height" value="180"/>'
        '<integer name="crop_width" value="5"/><rfilter type="tent"/></film></sensor></scene>'
    )
    before = xml.read_text()
    assert film_size(xml) == (320, 180)
    copy = resized(xml, tmp_path / "peer", fitted(film_size(xml), (160, 120)))
    assert film_size(copy) == (160, 90)
    assert "crop" not in copy.read_text()
    assert "tent" in copy.read_text()
    assert (copy.parent / "models").is_dir()
    assert xml.read_text() == before


def test_an_image_fits_and_keeps_the_proportions_of_the_film() -> None:
    assert fitted((1280, 720), (160, 120)) == (160, 90)
    assert fitted((1024, 1024), (160, 120)) == (120, 120)


def test_the_peer_renders_at_the_asked_size_until_its_time_is_over(tmp_path: Path) -> None:
    """It also keeps its kernels where it is told, and prints what it did."""
    (tmp_path / "scene").mkdir()
    staged = stage(SCENES["cornell"], tmp_path / "scene", tmp_path, (20, 12))
    image, cache = tmp_path / "image.npy", tmp_path / "kernels"
    cache.mkdir()
    command = [sys.executable, str(SCRIPT), str(staged.peer), str(image), "--seconds", "3"]
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment(cache))
    told = json.loads(done.stdout.splitlines()[-1])
    pixels = np.load(image)
    assert pixels.shape == (12, 20, 3)
    assert pixels.dtype == np.float32
    assert np.isfinite(pixels).all()
    assert pixels.mean() > 0
    assert told["spp"] >= told["passes"] >= 2
    assert list(cache.glob("*.bin"))
