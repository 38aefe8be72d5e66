"""How long a user of the service waits for the first partial image of a job, from the POST to its EXR."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import httpx

from tests.benchmarks.common import ELPS
from tests.benchmarks.first_job.measure import environment
from tests.benchmarks.first_job.results import Record

SIDE = 512
"""Width and height of the image, pixels."""
JOB_SECONDS = 60.0
"""Time that the job asks for; it is cancelled once there is an image."""
POLL_SECONDS = 0.02
"""Between two looks for the image: less than anyone notices, and no load."""
PATIENCE_SECONDS = 300.0
"""After which a worker, or an image, counts as not coming."""
STOP_SECONDS = 60.0
"""The service gets for its end; it lets its worker finish a chunk."""


def first_image(bundle: Path, data: Path, cache: Path, seed: int) -> Record:
    """Starts a service with nothing in its store, posts one ``auto`` job and takes the time to its first image.

    Args:
        bundle: the scene as it is uploaded.
        data: new folder of the service.
        cache: folder of compiled kernels.
        seed: of the job.
    """
    with _service(data, environment(cache)) as url, _client(url) as client:
        _await(lambda: bool(client.get("/v1/workers").raise_for_status().json()["workers"]), "no worker came up")
        with bundle.open("rb") as file:
            answer = client.post("/v1/scenes", files={"file": (bundle.name, file)}).raise_for_status()
        size = {"width": SIDE, "height": SIDE}
        body = {
            "scene": answer.json()["digest"],
            "settings": {"integrator": "auto", "seed": seed, **size},
            "stop": {"seconds": JOB_SECONDS},
        }
        begin = time.monotonic()
        job = client.post("/v1/jobs", json=body).raise_for_status().json()["id"]
        _await(lambda: client.get(f"/v1/jobs/{job}/image.exr").is_success, "no image came")
        taken = time.monotonic() - begin
        client.post(f"/v1/jobs/{job}:cancel").raise_for_status()
    return {"seconds_first_image": round(taken, 2)}


def _client(url: str) -> httpx.Client:
    # The proxies of the environment have no business between two ends of one machine.
    return httpx.Client(base_url=url, timeout=PATIENCE_SECONDS, trust_env=False)


def _await(there: Callable[[], bool], absent: str) -> None:
    """Looks again and again until something is there; ``absent`` says what was not."""
    end = time.monotonic() + PATIENCE_SECONDS
    while not there():
        if time.monotonic() > end:
            raise TimeoutError(f"{absent} in {PATIENCE_SECONDS:.0f} s: the lines above say why")
        time.sleep(POLL_SECONDS)


@contextmanager
def _service(data: Path, environment: Mapping[str, str]) -> Iterator[str]:
    """A service on a free port with one worker; the URL that it listens on."""
    command = [str(ELPS), "serve", "--port", "0", "--data", str(data)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            if not line:
                raise RuntimeError("the service did not start: the lines above say why")
            yield line.split()[-1]
        finally:
            process.terminate()
            try:
                process.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()
