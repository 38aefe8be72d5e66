"""Jobs on a real farm: one Valkey, one store, real workers that render with Mitsuba."""

from __future__ import annotations

import asyncio
import re
import subprocess
import time
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load as load_tensors

from elps_core.errors import SceneRejected, SettingsRejected
from elps_core.estimate.film import Chunk
from elps_core.io.exr import read_exr
from elps_core.settings import ContextSettings, LightSettings, RenderSettings, StopCriterion
from tests.worker.conftest import TINY, chunk_count, finished, wait_for
from worker.embedded import EmbeddedServer
from worker.errors import FarmUnavailable
from worker.farm import Farm
from worker.models import Event, SceneRecord
from worker.parts import Parts
from worker.settings import FarmSettings
from worker.store import chunk_key, name

Hire = Callable[[], subprocess.Popen[bytes]]

SMALL_CONTEXT = ContextSettings(resolution=8, samples_per_cell=8, max_depth=4)
GUIDED = RenderSettings(integrator="bdpt", width=32, height=32, max_depth=4, context=SMALL_CONTEXT)
SAMPLES = 2048
SHORT = StopCriterion(samples=SAMPLES)
CHUNKS = chunk_count(TINY, SAMPLES)


def test_a_scene_is_stored_once(farm: Farm, upload: Path) -> None:
    first, created = farm.add_scene(upload, "first.zip")
    again, created_again = farm.add_scene(upload, "second.zip")
    assert (created, created_again) == (True, False)
    assert again == first
    assert farm.scene(first.digest) == first
    assert first.name == "first.zip"
    assert first.summary["sensors"][0]["width"] == 64


def test_a_rejected_scene_leaves_nothing(farm: Farm, parts: Parts, tmp_path: Path) -> None:
    garbage = tmp_path / "scene.zip"
    garbage.write_bytes(b"PK\x03\x04 this is no archive")
    with pytest.raises(SceneRejected):
        farm.add_scene(garbage, "scene.zip")
    assert parts.store.keys("") == []
    assert parts.redis.dbsize() == 0


def test_what_cannot_be_rendered_is_refused_at_the_door(farm: Farm, scene: SceneRecord, settings: FarmSettings) -> None:
    with pytest.raises(SceneRejected, match="upload"):
        farm.submit("sha256:" + 64 * "0", TINY, SHORT)
    with pytest.raises(SceneRejected, match="upload"):
        farm.submit("../../etc/passwd", TINY, SHORT)
    with pytest.raises(SettingsRejected, match="sensor"):
        farm.submit(scene.digest, TINY.model_copy(update={"sensor": 5}), SHORT)
    tight = Farm.connect(settings.model_copy(update={"max_pixels": 100, "max_samples": 10, "max_seconds": 5.0}))
    with pytest.raises(SettingsRejected, match="100 pixels"):
        tight.submit(scene.digest, TINY, StopCriterion(samples=1))
    small = TINY.model_copy(update={"width": 8, "height": 8})
    with pytest.raises(SettingsRejected, match="at most 10"):
        tight.submit(scene.digest, small, SHORT)
    with pytest.raises(SettingsRejected, match="at most 5"):
        tight.submit(scene.digest, small, StopCriterion(seconds=6))
    assert farm.jobs() == []
    tight.close()


def test_an_error_alone_gets_a_time_limit(farm: Farm, scene: SceneRecord, settings: FarmSettings) -> None:
    job = farm.submit(scene.digest, TINY, StopCriterion(error=0.001))
    assert job.stop.seconds == settings.max_seconds


def test_jobs_wait_in_order_until_a_worker_comes(farm: Farm, scene: SceneRecord) -> None:
    first = farm.submit(scene.digest, TINY, SHORT)
    second = farm.submit(scene.digest, TINY, SHORT)
    urgent = farm.submit(scene.digest, TINY, SHORT, priority=5)
    assert [job.queue_position for job in farm.jobs()] == [1, 3, 2]
    assert [job.id for job in farm.jobs(2)] == [urgent.id, second.id]
    cancelled = farm.cancel(first.id)
    assert cancelled is not None
    assert (cancelled.state, cancelled.started) == ("cancelled", None)
    assert farm.cancel(first.id) == farm.job(first.id)
    assert farm.cancel("nobody") is None
    assert farm.image(first.id) is None
    assert farm.pixels(first.id) is None


def test_a_job_from_submit_to_the_final_image(farm: Farm, scene: SceneRecord, hire: Hire, tmp_path: Path) -> None:
    hire()
    job = farm.submit(scene.digest, TINY, SHORT)

    async def listen() -> list[Event]:
        return [event async for event in farm.follow(job.id)]

    events = asyncio.run(asyncio.wait_for(listen(), 60))
    assert [event.id for event in events] == list(range(1, len(events) + 1))
    assert [event.data["state"] for event in events if event.type == "state"] == ["queued", "rendering", "completed"]
    revisions = [event.data["revision"] for event in events if event.type == "image"]
    assert revisions == list(range(1, len(revisions) + 1))
    assert len(revisions) >= 2
    ended = finished(farm, job.id)
    assert (ended.state, ended.samples_done, ended.chunks_done) == ("completed", SAMPLES, CHUNKS)
    assert ended.image_revision == len(revisions)
    assert ended.relative_error is not None
    assert ended.relative_error > 0
    assert ended.finished is not None

    image = farm.image(job.id)
    assert image is not None
    assert image.revision == len(revisions)
    path = tmp_path / "image.exr"
    path.write_bytes(image.data)
    parts, attributes = read_exr(path)
    assert set(parts) == {"image", "standard error"}
    assert attributes["samples"] == SAMPLES
    assert attributes["chunks"] == f"0-{CHUNKS - 1}"
    assert attributes["integrator"] == "mi_path"
    assert attributes["renderDigest"] == job.digest
    assert attributes["version:mitsuba"] == "3.9.1"
    pixels = farm.pixels(job.id)
    assert pixels is not None
    assert pixels[0] == len(revisions)
    np.testing.assert_array_equal(pixels[1], parts["image"])
    assert pixels[1].mean() > 0
    assert pixels[2].max() > 0

    async def listen_late() -> list[Event]:
        return [event async for event in farm.follow(job.id, events[-2].id)]

    assert asyncio.run(asyncio.wait_for(listen_late(), 10)) == events[-1:]
    assert farm.events(job.id, events[-2].id) == events[-1:]

    # The same digest again: every chunk is there, nothing is rendered, the image is the same one.
    again = finished(farm, farm.submit(scene.digest, TINY, SHORT).id, 10)
    same = farm.image(again.id)
    assert again.digest == job.digest
    assert same is not None
    assert (same.key, same.data) == (image.key, image.data)
    more = finished(farm, farm.submit(scene.digest, TINY, StopCriterion(samples=2 * SAMPLES)).id)
    assert more.chunks_done == chunk_count(TINY, 2 * SAMPLES) > CHUNKS


def test_cancel_keeps_all_that_was_rendered(farm: Farm, scene: SceneRecord, hire: Hire) -> None:
    hire()
    job = farm.submit(scene.digest, TINY, StopCriterion(samples=2**20))
    wait_for(lambda: (seen := farm.job(job.id)) is not None and seen.chunks_done >= 2, 60)
    cancelled = farm.cancel(job.id)
    assert cancelled is not None
    assert cancelled.state == "cancelled"
    assert farm.cancel(job.id) is not None

    def published() -> bool:
        image, seen = farm.image(job.id), farm.job(job.id)
        events = farm.events(job.id)
        shown = [event.data["samples"] for event in events if event.type == "image"]
        return image is not None and seen is not None and shown[-1] == seen.samples_done

    wait_for(published, 20)
    time.sleep(1.0)
    ended = farm.job(job.id)
    assert ended is not None
    assert (ended.state, ended.chunks_running) == ("cancelled", 0)
    assert ended.chunks_done >= cancelled.chunks_done


@pytest.mark.parametrize("thorough", [True, False])
def test_tables_filled_to_the_end_serve_all(farm: Farm, parts: Parts, scene: SceneRecord, thorough: bool) -> None:
    tables = SMALL_CONTEXT.model_copy(update={"regions": 16, "paths": 4096})
    auto = RenderSettings(integrator="auto", width=32, height=32, max_depth=4, context=tables)
    path = auto.model_copy(update={"integrator": "path", "direction_sampling": "context"})
    first = farm.submit(scene.digest, auto, SHORT)
    waiting = farm.submit(scene.digest, path, SHORT)
    assert waiting.context_digest != first.context_digest  # Nobody knows yet whether that one will be filled
    farm.cancel(waiting.id)
    record = farm.context(first.context_digest or "")
    assert record is not None
    built = record.model_copy(update={"state": "ready", "statistics": {"thorough": thorough, "table_paths": 9}})
    parts.store.put(f"contexts/{name(built.digest)}.json", built.model_dump_json().encode())
    named = [
        farm.submit(scene.digest, path.model_copy(update={"seed": 1, "max_depth": depth}), SHORT) for depth in (3, 4)
    ]
    assert [job.context_hit for job in named] == 2 * [thorough]
    assert {job.context_digest == first.context_digest for job in named} == {thorough}
    assert {job.settings.context.thorough for job in named} == {not thorough}


@pytest.mark.parametrize(
    ("made_for", "asked", "shared"),
    [(40.0, 12.0, True), (40.0, None, True), (12.0, 40.0, False), (40.0, 33.0, True)],
)
def test_what_was_made_for_longer_jobs_serves_shorter_ones(
    farm: Farm, parts: Parts, scene: SceneRecord, made_for: float, asked: float | None, shared: bool
) -> None:
    auto = RenderSettings(width=32, height=32, max_depth=4, context=ContextSettings(max_depth=4, regions=16))
    first = farm.submit(scene.digest, auto, StopCriterion(seconds=made_for))
    record = farm.context(first.context_digest or "")
    assert record is not None
    for tables in ({}, {"table_paths": 9}):  # Without tables it serves nobody who might have some
        built = record.model_copy(update={"state": "ready", "statistics": {"trials": [], **tables}})
        path = f"contexts/{name(built.digest)}.json"
        parts.store.delete(path)
        parts.store.put(path, built.model_dump_json().encode())
        seed = 5 + len(tables)
        stop = StopCriterion(seconds=asked) if asked else StopCriterion(samples=4)
        other = farm.submit(scene.digest, auto.model_copy(update={"seed": seed}), stop)
        same = first.settings.context.seconds == other.settings.context.seconds
        assert (other.context_digest == first.context_digest) is (same or (shared and bool(tables)))


def test_tables_that_will_be_filled_serve_those_who_do_not_ask(farm: Farm, scene: SceneRecord) -> None:
    tables = SMALL_CONTEXT.model_copy(update={"regions": 16, "paths": 4096})
    path = RenderSettings(
        integrator="path", direction_sampling="context", width=32, height=32, max_depth=4, context=tables
    )
    first = farm.submit(scene.digest, path, SHORT)
    auto = farm.submit(scene.digest, RenderSettings(width=32, height=32, max_depth=4, context=tables), SHORT)
    assert auto.context_digest == first.context_digest
    assert auto.context_hit is False
    assert first.settings.context.thorough


def test_seconds_end_a_job_near_its_time(farm: Farm, scene: SceneRecord, hire: Hire) -> None:
    hire()
    ended = finished(farm, farm.submit(scene.digest, TINY, StopCriterion(seconds=4)).id)
    assert ended.state == "completed"
    assert ended.image_revision >= 1
    assert ended.started is not None
    assert ended.finished is not None
    assert ended.finished - ended.started < 12  # a loaded machine may be late, a forgotten limit never ends


def test_jobs_at_once_share_one_context_and_the_chunks(
    farm: Farm, parts: Parts, scene: SceneRecord, hire: Hire
) -> None:
    hire()
    with ThreadPoolExecutor(3) as pool:
        jobs = list(pool.map(lambda _: farm.submit(scene.digest, GUIDED, StopCriterion(samples=256)), range(3)))
    other = farm.submit(scene.digest, GUIDED.model_copy(update={"seed": 1}), StopCriterion(samples=256))
    assert {job.context_digest for job in [*jobs, other]} == {jobs[0].context_digest}
    assert len({job.digest for job in [*jobs, other]}) == 2
    ended = [finished(farm, job.id) for job in [*jobs, other]]
    assert [job.state for job in ended] == 4 * ["completed"]
    assert [job.context_hit for job in ended] == 4 * [False]
    assert len({image.key for job in jobs if (image := farm.image(job.id))}) == 1
    tokens = parts.redis.get("elps:token")  # one for each start of a piece of work
    record = farm.context(jobs[0].context_digest or "")
    assert record is not None
    assert (record.state, record.progress) == ("ready", 1.0)
    chunks = len(parts.store.keys("chunks"))
    assert int(str(tokens)) <= 8 + chunks + 2  # eight steps; a spare for what shares were offered and not needed
    assert "preparing" in [event.data.get("state") for event in farm.events(jobs[0].id)]
    assert {event.data["state"] for event in farm.events(other.id) if event.type == "context"} >= {"ready"}

    late = farm.submit(scene.digest, GUIDED.model_copy(update={"seed": 2}), StopCriterion(samples=256))
    assert late.context_hit is True
    assert finished(farm, late.id).seconds_context == 0.0
    adjoint = farm.adjoint(late.context_digest or "")
    assert adjoint is not None
    assert adjoint.ndim == 2
    assert adjoint.sum() > 0
    assert not [key for key in parts.store.keys("contexts") if key.count("/") > 1]  # no checkpoint is left


BEAM = """<scene version="3.0.0">
<sensor type="perspective"><film type="hdrfilm">
<integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>
<shape type="sphere"/><shape type="rectangle"><emitter type="directionalarea"/></shape>
</scene>"""
"""Lit in a way that our own algorithms refuse and Mitsuba's take."""


def test_what_the_renderer_refuses_reaches_the_user(farm: Farm, tmp_path: Path, hire: Hire) -> None:
    hire()
    upload = tmp_path / "beam.xml"
    upload.write_text(BEAM)
    beam, _ = farm.add_scene(upload, "beam.xml")
    wrong = TINY.model_copy(update={"integrator": "bdpt", "light_sampling": "power"})
    job = finished(farm, farm.submit(beam.digest, wrong, SHORT).id)
    assert job.state == "failed"
    assert job.message is not None
    assert "directionalarea" in job.message
    assert "\n" not in job.message
    assert finished(farm, farm.submit(beam.digest, TINY, SHORT).id).state == "completed"


BUMPY = (
    BEAM[: BEAM.index("<shape")]
    + """<emitter type="point"/><shape type="rectangle"><bsdf type="bumpmap">
<texture type="checkerboard"/><bsdf type="diffuse"/></bsdf></shape></scene>"""
)


def test_what_mitsuba_fails_at_reaches_the_user_and_no_other_scene(farm: Farm, tmp_path: Path, hire: Hire) -> None:
    hire()
    records = {}
    for what, content in (("bumpy", BUMPY), ("beam", BEAM)):
        upload = tmp_path / f"{what}.xml"
        upload.write_text(content)
        records[what], _ = farm.add_scene(upload, upload.name)
    for integrator in ("path", "mi_path"):
        chosen = TINY.model_copy(update={"integrator": integrator, "light_sampling": "power"})
        job = finished(farm, farm.submit(records["bumpy"].digest, chosen, SHORT).id)
        assert (job.state, job.samples_done) == ("failed", 0)
        assert (
            job.message
            == f"{integrator} cannot render this scene: a 'bumpmap' has a texture without slopes: make it a bitmap"
        )
    other = TINY.model_copy(update={"seed": 1})
    assert finished(farm, farm.submit(records["beam"].digest, other, SHORT).id).state == "completed"


GLASS = """<scene version="3.0.0">
<sensor type="perspective"><film type="hdrfilm">
<integer name="width" value="32"/><integer name="height" value="32"/></film></sensor>
<shape type="sphere"><bsdf type="dielectric"/></shape><shape type="rectangle"/><emitter type="point"/>
</scene>"""


def test_a_job_tells_what_its_image_lacks_and_what_its_algorithm_says(
    farm: Farm, parts: Parts, tmp_path: Path, hire: Hire
) -> None:
    upload = tmp_path / "glass.xml"
    upload.write_text(GLASS)
    glass, _ = farm.add_scene(upload, "glass.xml")
    asked = RenderSettings(integrator="path", light_sampling="power", width=32, height=32, max_depth=8)
    first = farm.submit(glass.digest, asked, StopCriterion(samples=2))
    assert len(first.warnings) == 1
    assert "'point' that comes by way of 'dielectric'" in first.warnings[0]
    # Chunks as another worker leaves them: the job merges them and renders nothing.
    grey = np.full((32, 32, 3), 0.5, np.float32)
    for index, brightness in enumerate((0.4, 0.6)):
        chunk = Chunk(index, 1, 0.1, grey, grey[..., 0], {"brightness": brightness}, left_out={"'ball'": 3})
        parts.store.put(chunk_key(first.digest, index), chunk.to_bytes())
    again = farm.submit(glass.digest, asked, StopCriterion(samples=2))
    hire()
    for job in (finished(farm, first.id), finished(farm, again.id)):
        assert (job.state, job.chunks_done, job.warnings) == ("completed", 2, first.warnings)
        assert len(job.image_warnings) == 1
        assert job.image_warnings[0].startswith("6 samples that are not finite are left out (the image has 2,048)")
        assert job.statistics["brightness"].mean == pytest.approx(0.5)
        assert job.statistics["brightness"].standard_error == pytest.approx(0.1)
    image = farm.image(again.id)
    assert image is not None
    path = tmp_path / "image.exr"
    path.write_bytes(image.data)
    _, attributes = read_exr(path)
    assert attributes["unreachable"] == first.warnings[0]
    assert "their pixels show 'ball'" in str(attributes["warnings"])
    assert attributes["statistic:brightness"] == pytest.approx(0.5)
    assert attributes["statistic:brightness:standardError"] == pytest.approx(0.1)
    assert RenderSettings.model_validate_json(str(attributes["settings"])) == asked


def test_a_job_that_no_light_can_reach_is_refused(farm: Farm, scene: SceneRecord) -> None:
    with pytest.raises(SettingsRejected, match="thinlens"):
        farm.submit(scene.digest, RenderSettings(integrator="light", light=LightSettings(connect=False)), SHORT)


def test_a_lost_redis_is_rebuilt_from_the_store(farm: Farm, parts: Parts, scene: SceneRecord, hire: Hire) -> None:
    hire()
    done = finished(farm, farm.submit(scene.digest, TINY, SHORT).id)
    image = farm.image(done.id)
    running = farm.submit(scene.digest, TINY, StopCriterion(samples=2**20))
    wait_for(lambda: len(parts.store.keys("chunks")) >= 3, 60)
    parts.redis.flushall()
    wait_for(lambda: farm.job(running.id) is not None and farm.job(done.id) is not None, 20)
    assert farm.image(done.id) == image
    back = farm.job(done.id)
    assert back is not None
    assert (back.state, back.samples_done) == ("completed", SAMPLES)
    wait_for(lambda: (seen := farm.job(running.id)) is not None and seen.chunks_done >= 3, 30)
    farm.cancel(running.id)


def test_without_redis_everything_says_so(tmp_path: Path) -> None:
    with EmbeddedServer() as gone:
        settings = FarmSettings(redis_url=gone.url, store_url=(tmp_path / "store").as_uri())
    farm = Farm.connect(settings)
    assert not farm.ready()
    for call in (lambda: farm.job("x"), farm.jobs, farm.workers, lambda: farm.cancel("x"), lambda: farm.image("x")):
        with pytest.raises(FarmUnavailable, match="Redis"):
            call()
    farm.close()
    with pytest.raises(SettingsRejected, match="REDIS_URL"):
        Farm.connect(FarmSettings(redis_url="", store_url="memory:///"))
    with pytest.raises(SettingsRejected, match="STORE_URL"):
        Farm.connect(FarmSettings(redis_url=gone.url, store_url=""))


def test_another_camera_begins_with_what_the_first_has_learnt(
    farm: Farm, hire: Hire, upload: Path, tmp_path: Path
) -> None:
    """The tables of radiance are the first one's, the pilot images are their own."""
    hire()
    tables = {"regions": 16, "rows": 8, "columns": 16, "paths": 1 << 15, "adaptive": False}
    settings = RenderSettings(
        integrator="path",
        direction_sampling="context",
        width=32,
        height=32,
        max_depth=4,
        context=SMALL_CONTEXT.model_copy(update=tables),
    )
    found = []
    for angle in (70, 60):
        path = tmp_path / f"{angle}.zip"
        with zipfile.ZipFile(upload) as source, zipfile.ZipFile(path, "w") as other:
            for entry in source.namelist():
                data = source.read(entry)
                if entry == "scene.xml":
                    text, count = re.subn(r'(name="fov" value=")[0-9.]+', rf"\g<1>{angle}", data.decode())
                    assert count == 1
                    data = text.encode()
                other.writestr(entry, data)
        record, created = farm.add_scene(path, path.name)
        assert created
        job = finished(farm, farm.submit(record.digest, settings, StopCriterion(samples=4)).id)
        assert (job.state, job.context_hit) == ("completed", False)
        file = farm.context_file(job.context_digest or "")
        assert file is not None
        found.append(load_tensors(file))
    first, second = found
    np.testing.assert_array_equal(first["radiance.values"], second["radiance.values"])
    assert not np.array_equal(first["pilot"], second["pilot"])
    assert not np.array_equal(first["importance.values"], second["importance.values"])
