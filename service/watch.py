"""Following a job in a terminal: bars where there is one, lines where the output is a file or a pipe."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from service.client import Client
from worker.models import FINAL_STATES, Job

Show = Callable[[Job], None]


def watch(client: Client, job_id: str, console: Console, on_image: Callable[[], None] | None = None) -> Job:
    """Shows the job until it has ended, and returns it.

    ``on_image`` is called whenever a new image can be fetched.

    Raises:
        ServiceError: no such job, or the service stopped answering.
    """
    job = client.job(job_id)
    with (_bars if console.is_terminal else _lines)(console) as show:
        show(job)
        for event in client.follow(job_id):
            # The event says that something changed; the record says how everything stands by now.
            job = client.job(job_id)
            show(job)
            if event.type == "image" and on_image is not None:
                on_image()
    return client.job(job_id)


def share_done(job: Job) -> float:
    """How far the job is towards the stop criterion that it is nearest to, 0 to 1."""
    if job.state in FINAL_STATES:
        return 1.0
    shares = [0.0]
    if job.stop.samples is not None:
        shares.append(job.samples_done / job.stop.samples)
    if job.stop.seconds is not None and job.started is not None:
        shares.append((time.time() - job.started) / job.stop.seconds)
    if job.stop.error is not None and job.relative_error:
        # The error falls with the square root of the samples.
        shares.append(min(1.0, job.stop.error / job.relative_error) ** 2)
    return min(1.0, max(shares))


def describe(job: Job) -> str:
    """One line on what has come of the job so far."""
    parts = [f"{job.samples_done} samples per pixel"]
    if job.relative_error is not None:
        parts.append(f"relative error {job.relative_error:.2%}")
    if job.context_hit:
        parts.append("context found")
    if job.message:
        parts.append(job.message)
    return ", ".join(parts)


@contextmanager
def _bars(console: Console) -> Iterator[Show]:
    columns = (
        TextColumn("{task.description:>10}"),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=console) as progress:
        context = progress.add_task("context", total=1.0, visible=False, start=False, note="")
        render = progress.add_task("queued", total=1.0, note="")

        def show(job: Job) -> None:
            if job.context_digest is not None and not job.context_hit:
                progress.start_task(context)
                progress.update(context, visible=True, completed=job.context_progress)
            progress.update(render, description=job.state, completed=share_done(job), note=describe(job))

        yield show


@contextmanager
def _lines(console: Console) -> Iterator[Show]:
    shown: tuple[str, int] | None = None

    def show(job: Job) -> None:
        nonlocal shown
        if shown != (job.state, job.image_revision):
            shown = (job.state, job.image_revision)
            console.print(f"{job.state}: {describe(job)}", highlight=False, soft_wrap=True, markup=False)

    yield show
