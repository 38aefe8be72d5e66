"""A service to talk to, and what its answers are held to."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import httpx
import uvicorn

from service.app import create_app
from service.settings import ServiceSettings
from worker.farm import Farm

UPLOAD_LIMIT = 4 * 2**20
"""Small enough to be exceeded in a test, large enough for every scene that is to be accepted."""

ROOM = """<scene version="3.0.0">
  <integrator type="path"/>
  <sensor type="perspective">
    <float name="fov" value="60"/>
    <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="12"/></film>
    <sampler type="independent"/>
  </sensor>
  <shape type="sphere"><bsdf type="diffuse"/></shape>
  <shape type="rectangle">
    <transform name="to_world"><lookat origin="0, 3, 0" target="0, 0, 0" up="0, 0, 1"/></transform>
    <emitter type="area"><rgb name="radiance" value="5"/></emitter>
  </shape>
</scene>
"""


@contextmanager
def serving(farm: Farm, settings: ServiceSettings) -> Iterator[httpx.Client]:
    """A client of a server that runs in a thread until the end of the block."""
    server = uvicorn.Server(uvicorn.Config(create_app(farm, settings), port=0, log_level="critical"))
    thread = threading.Thread(target=server.run, name="uvicorn")
    thread.start()
    try:
        while not server.started:
            assert thread.is_alive()
            time.sleep(0.01)
        port = server.servers[0].sockets[0].getsockname()[1]
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=60.0, trust_env=False) as client:
            yield client
    finally:
        server.should_exit = True
        thread.join()


def assert_problem(answer: httpx.Response, status: int, kind: str) -> str:
    """Checks the form that every problem has, and returns its detail."""
    assert answer.headers["Content-Type"] == "application/problem+json", answer.text
    problem = answer.json()
    assert (answer.status_code, problem["type"]) == (status, f"urn:elps:problem:{kind}"), answer.text
    assert problem["status"] == status
    assert problem["title"]
    detail = problem["detail"]
    assert detail
    assert "\n" not in detail
    for secret in ("Traceback", "/tmp", "/usr", "/home", "/work", "site-packages", tempfile.gettempdir()):
        assert secret not in answer.text
    assert len(answer.content) < 8192
    return str(detail)
