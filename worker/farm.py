"""The door of the worker package: what the service and the command line may ask of a farm."""

from __future__ import annotations

import re
import secrets
import tempfile
import time
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from math import log2
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from redis.asyncio import Redis as AsyncRedis
from redis.exceptions import RedisError

from elps_core.context.store import load
from elps_core.errors import ElpsError, SceneRejected, SettingsRejected
from elps_core.io.exr import Part, read_exr
from elps_core.io.formats import shown, shown_error
from elps_core.io.result import ERROR_PART, IMAGE_PART
from elps_core.scene import reach
from elps_core.scene.bundle import is_archive
from elps_core.scene.digest import context_digest, render_digest
from elps_core.scene.inspect import SceneReport, inspect_in_child
from elps_core.scene.summary import SceneSummary
from elps_core.settings import (
    LONGEST,
    RenderSettings,
    StopCriterion,
    stop_or_default,
    suited,
    with_file_defaults,
    with_overrides,
)
from worker.errors import FarmUnavailable
from worker.leases import Work
from worker.models import FINAL_STATES, ContextRecord, Event, Job, SceneRecord, WorkerInfo
from worker.parts import Parts
from worker.settings import FarmSettings
from worker.state import JobEntry, events_key, missing_context, parse_event
from worker.store import name as key_name

FOLLOW_BLOCK_MILLISECONDS = 2000
"""A follower that heard nothing for this long looks whether its job is final; below Redis's socket timeout."""
_DIGEST = re.compile(r"sha256:[0-9a-f]{64}")


@dataclass(frozen=True)
class Image:
    """A published multi-part EXR file of a job: parts ``image`` and ``standard error``."""

    revision: int
    """1 for the first partial image of the job."""
    key: str
    """Content-addressed name: equal keys mean equal bytes (a strong entity tag)."""
    data: bytes
    samples: int
    """Samples per pixel in it; the job may have more by now."""


@contextmanager
def _answering() -> Iterator[None]:
    """Say in one line that Redis is gone."""
    try:
        yield
    except RedisError:
        raise FarmUnavailable("the farm's Redis does not answer: try again later") from None


class Farm:
    """Scenes, jobs, contexts and workers behind one Redis and one store. Safe between threads.

    Every method raises FarmUnavailable where Redis or the store does not answer.
    """

    def __init__(self, parts: Parts) -> None:
        self._parts = parts

    @classmethod
    def connect(cls, settings: FarmSettings) -> Farm:
        """A farm on ``settings``; opens no connection yet, so it succeeds where Redis is down.

        Raises:
            SettingsRejected: ``redis_url`` or ``store_url`` is absent.
        """
        return cls(Parts(settings))

    def close(self) -> None:
        """Give the connections back."""
        self._parts.close()

    # Scenes

    def add_scene(self, upload: Path, name: str, defines: Mapping[str, str] | None = None) -> tuple[SceneRecord, bool]:
        """Check ``upload`` (a .zip or an .xml file) in a sandboxed child and store it; (record, created).

        With other values of the scene's parameters (``defines``) it is another scene, where they matter.

        Raises:
            SceneRejected: what is wrong, in one line; nothing is left behind.
        """
        return self._keep(upload, name, defines, inspect_in_child(upload, defines=defines))

    def _keep(
        self, upload: Path, name: str, defines: Mapping[str, str] | None, report: SceneReport
    ) -> tuple[SceneRecord, bool]:
        """Store a scene that was checked, unless it is there; (record, created)."""
        present = self.scene(report.digest)
        if present is not None:
            return present, False
        summary = report.summary.model_dump(mode="json")
        record = SceneRecord(
            digest=report.digest, name=name, summary=summary, created=time.time(), defines=dict(defines or {})
        )
        stem = f"scenes/{key_name(report.digest)}"
        self._parts.store.put(stem + (".zip" if is_archive(upload) else ".xml"), upload.read_bytes())
        created = self._parts.store.put(f"{stem}.json", record.model_dump_json().encode())
        return self.scene(report.digest) or record, created

    def scene(self, digest: str) -> SceneRecord | None:
        """The record of a stored scene."""
        data = self._json("scenes", digest)
        return None if data is None else SceneRecord.model_validate_json(data)

    def _defined(self, record: SceneRecord, defines: Mapping[str, str]) -> SceneReport:
        """What the check of a stored scene says of it with other values of its parameters; that scene is stored, too.

        Its digest is the same where they change nothing but what the file says of its render.
        """
        values = {**record.defines, **defines}
        with tempfile.TemporaryDirectory() as folder:
            for suffix in (".zip", ".xml"):
                upload = self._parts.store.fetch(f"scenes/{key_name(record.digest)}{suffix}", Path(folder))
                if upload is not None:
                    report = inspect_in_child(upload, defines=values)
                    self._keep(upload, record.name, values, report)
                    return report
        raise SceneRejected("the scene is no longer in the store: upload it again")

    # Jobs

    @_answering()
    def submit(
        self,
        scene: str,
        settings: RenderSettings,
        stop: StopCriterion | None,
        *,
        priority: int = 0,
        defines: Mapping[str, str] | None = None,
    ) -> Job:
        """Create a job in state queued. A job with neither samples nor seconds gets the farm's most seconds.

        What neither ``settings`` nor ``stop`` say, the scene file may say
        (:class:`elps_core.scene.summary.FileDefaults`).

        Raises:
            SceneRejected: no such scene, or ``defines`` names a parameter that it does not have.
            SettingsRejected: sensor out of range, over the farm's limits, no light can reach the image, or nothing says
                when to stop.
        """
        record = self.scene(scene)
        if record is None:
            raise SceneRejected("no such scene: upload it first")
        summary = SceneSummary.model_validate(record.summary)
        if defines:
            report = self._defined(record, defines)
            scene, summary = report.digest, report.summary
        stop = stop_or_default(stop, summary.defaults.samples)
        settings = suited(with_file_defaults(settings, summary.defaults.settings()), stop)
        size = self._checked_size(summary, settings)
        reach.check(summary, settings)
        settings = self._sharing(scene, settings, size)
        context = _context_of(scene, settings, size) if settings.needs_context else None
        known = None if context is None else self.context(context)
        hit = None if context is None else known is not None and known.state == "ready"
        job = Job(
            id=secrets.token_hex(8),
            revision=1,
            state="queued",
            scene=scene,
            settings=settings,
            stop=self._checked_stop(stop),
            priority=priority,
            created=time.time(),
            width=size[0],
            height=size[1],
            warnings=reach.unreachable(summary, settings),
            context_digest=context,
            context_hit=hit,
            context_state=None if context is None else "missing" if known is None else known.state,
            context_progress=0.0 if known is None else known.progress,
            digest=render_digest(scene, settings, size),
        )
        entry = JobEntry(job=job, touched=job.created)
        self._parts.record(entry)
        self._parts.list_chunks(job.digest)
        if hit is False:
            self._parts.state.name_context(missing_context(job))
        self._parts.state.create(entry)
        self._parts.queue.settle(job)
        return self.job(job.id) or job

    def _sharing(self, scene: str, settings: RenderSettings, size: tuple[int, int]) -> RenderSettings:
        """The settings with the context of others that serves as well, where their own is not there.

        Tables that are filled to the end serve all, and those that need not be may have been; and what was made for
        longer jobs serves shorter ones, and those without a limit of time whatever it was made for.
        """
        if not settings.needs_tables:
            return settings

        def found(changes: dict[str, Any]) -> tuple[RenderSettings, ContextRecord | None]:
            other = with_overrides(settings, changes)
            return other, self.context(_context_of(scene, other, size))

        _, own = found({})
        if own and own.state == "ready":
            return settings
        given, thorough = settings.context.seconds, settings.context.thorough
        lengths = [None, *(2.0**k for k in range(int(log2(LONGEST)), -1, -1))]
        for seconds in [given, *(each for each in lengths if each is None or given is None or each > given)]:
            for filled in (thorough, not thorough):
                other, record = found({"context.seconds": seconds, "context.thorough": filled})
                if record is None:
                    continue
                tables = record.state == "ready" and "table_paths" in record.statistics
                if tables and (filled == thorough or record.statistics.get("thorough")):
                    return other
                if own is None and seconds == given and filled and record.state != "failed":
                    return other  # Being filled to the end
        return settings

    @_answering()
    def job(self, id: str) -> Job | None:  # noqa: A002
        """Where a job stands now. ``queue_position`` and ``chunks_running`` do not count as changes of its revision."""
        entry = self._parts.state.entry(id)
        return None if entry is None else self._shown([entry])[0]

    @_answering()
    def jobs(self, limit: int = 50) -> list[Job]:
        """Jobs, newest first."""
        return self._shown(self._parts.state.newest(limit))

    @_answering()
    def cancel(self, id: str) -> Job | None:  # noqa: A002
        """Make a job final; idempotent. Chunks that it has and are not yet published follow as one last image."""
        entry = self._parts.state.entry(id)
        if entry is None or entry.job.state in FINAL_STATES:
            return None if entry is None else entry.job
        entry = self._parts.state.enter(id, "cancelled")
        if entry is None:
            return None
        self._parts.record(entry)
        self._parts.queue.settle(entry.job)
        return entry.job

    @_answering()
    def events(self, id: str, after: int = 0) -> list[Event]:  # noqa: A002
        """Events of a job numbered above ``after``, oldest first; the last thousand are kept.

        Data: ``state`` has state and message; ``context`` state and progress; ``progress`` samples_done,
        chunks_done, relative_error, seconds_rendering and eta_seconds; ``image`` revision and samples.
        """
        return self._parts.state.events(id, after)

    async def follow(self, id: str, after: int = 0) -> AsyncIterator[Event]:  # noqa: A002
        """Events as they come; ends after the event of a final state, or where the job is final or unknown."""
        client = AsyncRedis.from_url(self._parts.redis_url, decode_responses=True)
        try:
            while True:
                with _answering():
                    streams = {events_key(id): f"{after}-0"}
                    reply: Any = await client.xread(streams, block=FOLLOW_BLOCK_MILLISECONDS)  # type: ignore[arg-type]
                entries = [entry for _, entries in reply for entry in entries]
                for number, fields in entries:
                    event = parse_event(number, fields)
                    after = event.id
                    yield event
                    if event.type == "state" and event.data["state"] in FINAL_STATES:
                        return
                if not entries:
                    job = self.job(id)
                    if job is None or job.state in FINAL_STATES:
                        return
        finally:
            await client.aclose()

    @_answering()
    def image(self, id: str) -> Image | None:  # noqa: A002
        """The newest published image of a job."""
        entry = self._parts.state.entry(id)
        if entry is None or entry.image_key is None:
            return None
        data = self._parts.store.get(entry.image_key)
        return None if data is None else Image(entry.job.image_revision, entry.image_key, data, entry.image_samples)

    def pixels(self, id: str) -> tuple[int, NDArray[np.float32], NDArray[np.float32]] | None:  # noqa: A002
        """(revision, mean [H, W, 3], standard error [H, W, 3]) of the newest image, linear RGB, to look at."""
        published = self._parts_of_image(id)
        if published is None:
            return None
        revision, mean, error = published
        return revision, np.asarray(shown(mean), np.float32), np.asarray(shown_error(error), np.float32)

    def error_of_image(self, id: str) -> tuple[int, Part] | None:  # noqa: A002
        """(revision, standard error) of the newest published image, in its own channels."""
        published = self._parts_of_image(id)
        return None if published is None else (published[0], published[2])

    def _parts_of_image(self, id: str) -> tuple[int, Part, Part] | None:  # noqa: A002
        """(revision, mean, standard error) of the newest published image."""
        image = self.image(id)
        if image is None:
            return None
        with tempfile.TemporaryDirectory(prefix="elps-image-") as folder:
            path = Path(folder) / "image.exr"
            path.write_bytes(image.data)
            parts, attributes = read_exr(path)
        channels = tuple(str(attributes["channels"]).split(","))
        return image.revision, Part(parts[IMAGE_PART], channels), Part(parts[ERROR_PART], channels)

    # Contexts

    @_answering()
    def context(self, digest: str) -> ContextRecord | None:
        """A context that some job named. Ready means that its file is in the store."""
        data = self._json("contexts", digest)
        if data is not None:
            return ContextRecord.model_validate_json(data)
        record = self._parts.state.context(digest)
        return None if record is None or record.state == "ready" else record

    def context_file(self, digest: str) -> bytes | None:
        """The file of a ready context (safetensors)."""
        if not _DIGEST.fullmatch(digest):
            return None
        return self._parts.store.get(f"contexts/{key_name(digest)}.safetensors")

    def adjoint(self, digest: str) -> NDArray[np.float32] | None:
        """The adjoint image [rows, columns] of a ready context."""
        data = self.context_file(digest)
        if data is None:
            return None
        with tempfile.TemporaryDirectory(prefix="elps-context-") as folder:
            path = Path(folder) / "context.safetensors"
            path.write_bytes(data)
            return np.array(load(path).adjoint)

    # The farm itself

    @_answering()
    def workers(self) -> list[WorkerInfo]:
        """Workers heard of in the last seconds, by name."""
        busy = set(self._parts.board.running().values())
        infos = sorted(self._parts.state.workers(), key=lambda info: info.name)
        return [info.model_copy(update={"busy": info.name in busy}) for info in infos]

    def ready(self) -> bool:
        """Whether Redis and the store answer."""
        try:
            self._parts.store.check()
            return bool(self._parts.redis.ping())
        except (RedisError, ElpsError):
            return False

    def _json(self, kind: str, digest: str) -> bytes | None:
        """The record of an artefact; a digest from outside is no part of a key unless it is one."""
        return self._parts.store.get(f"{kind}/{key_name(digest)}.json") if _DIGEST.fullmatch(digest) else None

    def _shown(self, entries: list[JobEntry]) -> list[Job]:
        """Jobs with what is true at this moment only."""
        running: list[Work] = []
        queued: list[str] = []
        if any(entry.job.state not in FINAL_STATES for entry in entries):
            running = list(self._parts.board.running())
        if any(entry.job.state == "queued" for entry in entries):
            waiting = [entry.job for entry in self._parts.state.active() if entry.job.state == "queued"]
            queued = [job.id for job in sorted(waiting, key=lambda job: (-job.priority, job.created))]
        jobs = []
        for job in (entry.job for entry in entries):
            fields: dict[str, int] = {}
            if job.state not in FINAL_STATES:
                fields["chunks_running"] = sum(work[:2] == ("chunk", job.digest) for work in running)
            if job.id in queued:
                fields["queue_position"] = queued.index(job.id) + 1
            jobs.append(job.model_copy(update=fields))
        return jobs

    def _checked_size(self, summary: SceneSummary, settings: RenderSettings) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        if settings.sensor >= len(summary.sensors):
            raise SettingsRejected(f"sensor: the scene has {len(summary.sensors)}, counted from 0")
        sensor = summary.sensors[settings.sensor]
        width = sensor.width if settings.width is None else settings.width
        height = sensor.height if settings.height is None else settings.height
        if width * height > self._parts.settings.max_pixels:
            raise SettingsRejected(f"width, height: at most {self._parts.settings.max_pixels} pixels are allowed here")
        return width, height

    def _checked_stop(self, stop: StopCriterion) -> StopCriterion:
        limits = self._parts.settings
        if stop.samples is not None and stop.samples > limits.max_samples:
            raise SettingsRejected(f"samples: at most {limits.max_samples} are allowed here")
        if stop.seconds is not None and stop.seconds > limits.max_seconds:
            raise SettingsRejected(f"seconds: at most {limits.max_seconds:g} are allowed here")
        if stop.samples is None and stop.seconds is None:
            return stop.model_copy(update={"seconds": limits.max_seconds})
        return stop


def _context_of(scene: str, settings: RenderSettings, size: tuple[int, int]) -> str:
    """Digest of the context that a job's settings ask for."""
    return context_digest(scene, settings.sensor, size, settings.measured, settings.variant)
