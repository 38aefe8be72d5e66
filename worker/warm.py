"""What a rendering process keeps between tasks, so that a job's second chunk costs no set-up.

Only the child that Celery forks uses this: it is the one place of the package that loads Mitsuba.
"""

from __future__ import annotations

import gc
import tempfile
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

from elps_core.context.store import GlobalContext, load
from elps_core.errors import ContextMismatch, RenderFailed
from elps_core.estimate.film import Accumulation, Chunk
from elps_core.estimate.schedule import MEANTIME
from worker.models import Job, SceneRecord
from worker.store import Store, name

if TYPE_CHECKING:
    from elps_core.context.build import ContextBuilder
    from elps_core.renderer import Renderer
    from elps_core.scene.loader import LoadedScene
    from elps_core.timing import KernelClock

SCENES_KEPT = 2
"""Loaded scenes, renderers and builders kept: fair shares make two jobs alternate on one worker."""
SPENT = ("seconds_loading", "seconds_compiling", "seconds_tracing")
"""Fields of a job that tell what its time was spent on besides running kernels."""
TOLD = 0.05
"""Seconds below which that is kept back: each telling is a change of the job."""
SURROUNDINGS_TRIED = 4
"""Contexts of other cameras that a new one looks at, a third of a second each."""
ACCUMULATIONS_KEPT = 4
"""Merged images kept; one of 4096 x 4096 pixels takes 0.9 GB, the usual one 15 MB."""

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class Recent(Generic[K, V]):
    """The values used last, made when they are first asked for."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._values: OrderedDict[K, V] = OrderedDict()

    def get(self, key: K, make: Callable[[], V]) -> V:
        """The value of ``key``; another one makes room before a new one is made."""
        if key in self._values:
            self._values.move_to_end(key)
        else:
            while len(self._values) >= self._capacity:
                self._values.popitem(last=False)
            self._values[key] = make()
        return self._values[key]

    def forget(self, key: K) -> None:
        """Drop one value."""
        self._values.pop(key, None)

    def clear(self) -> None:
        """Drop all values."""
        self._values.clear()


class Warm:
    """Scenes, renderers, context builders and merged images of one rendering process."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self.compiling = 0.0
        """Seconds that the kernel of plain paths took to compile for the job that was begun last."""
        self._spent = dict.fromkeys(SPENT, 0.0)
        self._scenes: Recent[tuple[object, ...], LoadedScene] = Recent(SCENES_KEPT)
        self._renderers: Recent[str, Renderer] = Recent(SCENES_KEPT)
        self._builders: Recent[str, ContextBuilder] = Recent(SCENES_KEPT)
        self._accumulations: Recent[str, tuple[float, Accumulation]] = Recent(ACCUMULATIONS_KEPT)

    @contextmanager
    def timed(self) -> Iterator[KernelClock]:
        """Adds up what is done inside it besides running kernels, for :meth:`spent`."""
        from elps_core.timing import KernelClock

        begin, loading = time.perf_counter(), self._spent["seconds_loading"]
        with KernelClock() as kernels:
            yield kernels
        loading = self._spent["seconds_loading"] - loading
        whole = time.perf_counter() - begin
        self._spent["seconds_compiling"] += kernels.compiling
        self._spent["seconds_tracing"] += max(0.0, whole - loading - kernels.compiling - kernels.running)

    def spent(self) -> dict[str, float]:
        """Seconds by the names of a job's fields since the last call; empty while they are not worth telling."""
        if sum(self._spent.values()) < TOLD:
            return {}
        spent, self._spent = self._spent, dict.fromkeys(SPENT, 0.0)
        return spent

    def prepare(self, variant: str) -> None:
        """Load Mitsuba and what renders with it, before the first job asks. Raises DeviceUnavailable."""
        from elps_core import device

        device.use(variant)
        import elps_core.io.exr
        import elps_core.renderer  # noqa: F401

    def chunk(self, job: Job, index: int) -> Chunk:
        """Render a chunk of a job."""
        meantime = index >= MEANTIME
        with self.timed():
            renderer = self.renderer(job, meantime=meantime)
        with self.timed() as kernels:
            chunk = renderer.render_chunk(index)
        if meantime:
            self.compiling = kernels.compiling
        return chunk

    def renderer(self, job: Job, *, meantime: bool = False) -> Renderer:
        """The renderer of a job's chunks, its context loaded; or of those before there is one, in the ``meantime``.

        Raises:
            ElpsError: the scene or its context does not load.
        """
        from elps_core import device
        from elps_core.renderer import Renderer

        device.use(job.settings.variant)  # another job may have set another one
        if meantime:
            return self._renderers.get(f"{job.digest} plain", lambda: Renderer(self._scene(job), job.settings))
        return self._renderers.get(
            job.digest, lambda: Renderer(self._scene(job), job.settings, self._context(job.context_digest))
        )

    def builder(self, job: Job, done: int) -> ContextBuilder:
        """The builder of a job's context after ``done`` steps, or after as many as are saved."""
        from elps_core import device
        from elps_core.context.build import ContextBuilder

        device.use(job.settings.variant)
        digest = job.context_digest or ""

        def begun() -> ContextBuilder:
            builder = ContextBuilder(self._scene(job), job.settings.measured)
            saved = self._store.get(checkpoint_key(digest, done)) if done else None
            if saved is not None:
                builder.restore(saved)
            elif job.settings.needs_tables:
                self._begin(builder, job)
            return builder

        builder = self._builders.get(digest, begun)
        if builder.done != done:
            self._builders.forget(digest)
            builder = self._builders.get(digest, begun)
        return builder

    def _begin(self, builder: ContextBuilder, job: Job) -> None:
        """Let a builder begin with what another camera's context knows, where one has seen the same."""
        for key in self._store.keys(f"surroundings/{name(self._scene(job).surroundings)}")[:SURROUNDINGS_TRIED]:
            path = self._store.fetch(f"contexts/{key.rpartition('/')[2]}.safetensors", Path(tempfile.gettempdir()))
            with suppress(ContextMismatch):  # of another version
                if path is not None and builder.begin_from(load(path)):
                    return

    def forget_builder(self, digest: str) -> None:
        """Give back the memory of a context that is finished."""
        self._builders.forget(digest)

    def forget_scenes(self) -> None:
        """Take all scenes out of memory, and what renders them.

        Dr.Jit asks the materials and lamps of every scene in memory whenever it makes a kernel: one that Mitsuba has
        failed at would fail in the kernels of other scenes.
        """
        self._scenes.clear()
        self._renderers.clear()
        self._builders.clear()
        gc.collect()

    def accumulation(self, job: Job, meantime: float) -> Accumulation:
        """What this process has merged of a job so far; begun anew where the weight of the ``meantime`` is another."""

        def empty() -> tuple[float, Accumulation]:
            return meantime, Accumulation.empty(job.width, job.height)

        if self._accumulations.get(job.id, empty)[0] != meantime:
            self._accumulations.forget(job.id)
        return self._accumulations.get(job.id, empty)[1]

    def forget_accumulation(self, job: Job) -> None:
        """Give back the memory of a job's merged image."""
        self._accumulations.forget(job.id)

    def _scene(self, job: Job) -> LoadedScene:
        size = (job.width, job.height)
        key = (job.scene, job.settings.variant, job.settings.sensor, size)
        return self._scenes.get(key, lambda: self._load(job, size))

    def _load(self, job: Job, size: tuple[int, int]) -> LoadedScene:
        from elps_core.scene.bundle import unpack
        from elps_core.scene.loader import load_scene

        own = job.settings.width is None
        record = self._store.get(f"scenes/{name(job.scene)}.json")
        defines = SceneRecord.model_validate_json(record).defines if record else {}
        begin = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            for suffix in (".zip", ".xml"):
                upload = self._store.fetch(f"scenes/{name(job.scene)}{suffix}", Path(folder))
                if upload is not None:
                    bundle = Path(folder) / "bundle"
                    unpack(upload, bundle)
                    loaded = load_scene(
                        bundle,
                        job.settings.variant,
                        sensor=job.settings.sensor,
                        size=None if own else size,
                        defines=defines,
                    )
                    self._spent["seconds_loading"] += time.perf_counter() - begin
                    return loaded
        raise RenderFailed("the scene is no longer in the store: upload it again")

    def _context(self, digest: str | None) -> GlobalContext | None:
        if digest is None:
            return None
        path = self._store.fetch(f"contexts/{name(digest)}.safetensors", Path(tempfile.gettempdir()))
        if path is None:
            raise RenderFailed("the context is no longer in the store: submit the job again")
        return load(path)


def checkpoint_key(digest: str, done: int) -> str:
    """Key of a context's state after ``done`` steps."""
    return f"contexts/{name(digest)}/{done}"
