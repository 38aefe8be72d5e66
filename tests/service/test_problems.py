"""Whatever is wrong with a request, the answer is a problem document, and the service goes on."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator

import anyio
import httpx
import pytest

from service.app import create_app
from service.settings import ServiceSettings
from tests.service.live import UPLOAD_LIMIT, assert_problem
from worker.farm import Farm

DIGEST = "sha256:" + "0" * 64
JSON = {"Content-Type": "application/json"}


@pytest.fixture(autouse=True)
def _still_answers(client: httpx.Client) -> Iterator[None]:
    yield
    assert client.get("/livez").json() == {"status": "ok"}


def job(**changes: object) -> dict[str, object]:
    return {"scene": DIGEST, "settings": {}, "stop": {"samples": 4}} | changes


def test_unknown_path(client: httpx.Client) -> None:
    assert "/openapi.json" in assert_problem(client.get("/v2/jobs"), 404, "not-found")
    assert_problem(client.get("/v1/jobs/"), 404, "not-found")


@pytest.mark.parametrize("path", ["/v1/jobs/nope", "/v1/jobs/%F0%9F%90%99", "/v1/jobs/" + "x" * 5000])
@pytest.mark.parametrize("what", ["", "/events", "/image.exr", "/image.png", "/error.exr", "/error.png"])
def test_unknown_job(client: httpx.Client, path: str, what: str) -> None:
    assert_problem(client.get(path + what), 404, "not-found")


@pytest.mark.parametrize("path", ["/v1/scenes/", "/v1/contexts/"])
@pytest.mark.parametrize("digest", [DIGEST, "sha256:..", "..%2f..%2fetc%2fpasswd", "%00"])
def test_unknown_digest(client: httpx.Client, path: str, digest: str) -> None:
    assert_problem(client.get(path + digest), 404, "not-found")


@pytest.mark.parametrize(
    ("method", "path", "allowed"),
    [("DELETE", "/v1/jobs", "GET, POST"), ("PUT", "/v1/scenes", "POST"), ("POST", "/livez", "GET")],
)
def test_wrong_method(client: httpx.Client, method: str, path: str, allowed: str) -> None:
    answer = client.request(method, path)
    assert_problem(answer, 405, "method-not-allowed")
    assert answer.headers["Allow"] == allowed


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"scene": "sha256:xyz"}, "body.scene"),
        ({"scene": None}, "body.scene"),
        ({"stop": {}}, "body.stop"),
        ({"stop": {"samples": -4}}, "body.stop.samples"),
        ({"stop": {"samples": True}}, "body.stop.samples"),
        ({"stop": {"seconds": "5"}}, "body.stop.seconds"),
        ({"stop": {"seconds": float("nan")}}, "body.stop.seconds"),
        ({"stop": {"error": float("inf")}}, "body.stop.error"),
        ({"settings": {"integrator": "magic"}}, "body.settings"),
        ({"settings": {"integrator": "auto", "context": {"adaptive": False}}}, "body.settings"),
        ({"settings": {"preset": "magic"}}, "body.settings"),
        ({"settings": {"heuristic": "best"}}, "body.settings.heuristic"),
        ({"settings": {"path": {"next_events": True}}}, "body.settings.path.next_events"),
        ({"settings": {"bdpt": {"strategies": "one"}}}, "body.settings.bdpt.strategies"),
        ({"settings": {"bdpt": {"weighted": False}}}, "body.settings.bdpt"),
        ({"settings": {"pssmlt": {"chains": 0}}}, "body.settings.pssmlt.chains"),
        ({"settings": {"light_sampling": "darkness"}}, "body.settings.light_sampling"),
        ({"settings": {"max_depth": 10**30}}, "body.settings.max_depth"),
        ({"settings": {"width": 16}}, "body.settings"),
        ({"settings": {"context": {"resolution": -1}}}, "body.settings.context.resolution"),
        ({"settings": {"speed": 11}}, "body.settings.speed"),
        ({"settings": []}, "body.settings"),
        ({"priority": 10}, "body.priority"),
        ({"\u0000\n" + "k" * 3000: 1}, None),
    ],
)
def test_invalid_job(client: httpx.Client, change: dict[str, object], field: str | None) -> None:
    answer = client.post("/v1/jobs", content=json.dumps(job(**change)), headers=JSON)
    assert_problem(answer, 422, "invalid-input")
    fields = [error["field"] for error in answer.json()["errors"]]
    assert field is None or field in fields
    assert client.get("/v1/jobs").json()["jobs"] == [] or "nope" not in client.get("/v1/jobs").text


def test_unknown_integrator_names_the_known(client: httpx.Client) -> None:
    detail = assert_problem(client.post("/v1/jobs", json=job(settings={"integrator": "x"})), 422, "invalid-input")
    assert "bdpt" in detail
    assert "mi_path" in detail


def test_thousand_errors_stay_short(client: httpx.Client) -> None:
    answer = client.post("/v1/jobs", json=job(**{f"field{i}": i for i in range(1000)}))
    assert_problem(answer, 422, "invalid-input")
    assert len(answer.json()["errors"]) == 20


def test_unknown_scene(client: httpx.Client) -> None:
    assert_problem(client.post("/v1/jobs", json=job()), 422, "scene-rejected")


@pytest.mark.parametrize(
    "body",
    [b"", b"{", b"\xff\xfe", b"[" * 60_000, b"[" * 5000 + b"]" * 5000, b"9" * 60_000, b'{"a": 1} {"b": 2}'],
    ids=["empty", "cut", "not UTF-8", "deep and cut", "deep", "long number", "two"],
)
def test_malformed_json(client: httpx.Client, body: bytes) -> None:
    kind = ("invalid-input", 422) if not body else ("bad-request", 400)
    assert_problem(client.post("/v1/jobs", content=body, headers=JSON), kind[1], kind[0])


def test_lone_surrogate_in_a_field_name(client: httpx.Client) -> None:
    body = b'{"scene": "%s", "stop": {"samples": 1}, "\\ud800": 1}' % DIGEST.encode()
    assert_problem(client.post("/v1/jobs", content=body, headers=JSON), 422, "invalid-input")


@pytest.mark.parametrize("media_type", ["text/plain", "application/x-www-form-urlencoded", "a/b/c", ""])
@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/scenes"])
def test_wrong_content_type(client: httpx.Client, path: str, media_type: str) -> None:
    answer = client.post(path, content=json.dumps(job()), headers={"Content-Type": media_type})
    assert_problem(answer, 415, "unsupported-media-type")


@pytest.mark.parametrize(("path", "limit"), [("/v1/jobs", 64 * 2**10), ("/v1/scenes", UPLOAD_LIMIT)])
@pytest.mark.parametrize("declared", [True, False])
def test_too_large(client: httpx.Client, path: str, limit: int, declared: bool) -> None:
    block = b" " * 2**14
    count = limit // len(block) + 1

    def stream() -> Iterator[bytes]:
        for _ in range(count):
            yield block

    media_type = "application/json" if path == "/v1/jobs" else "application/zip"
    body = block * count if declared else stream()
    answer = client.post(path, content=body, headers={"Content-Type": media_type})
    assert_problem(answer, 413, "too-large")


@pytest.mark.parametrize("query", ["limit=0", "limit=many", "limit=1e9", "limit=201"])
def test_invalid_query(client: httpx.Client, query: str) -> None:
    answer = client.get(f"/v1/jobs?{query}")
    assert_problem(answer, 422, "invalid-input")
    assert answer.json()["errors"][0]["field"] == "query.limit"


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "[::2]", "127.0.0.1.evil.example", "["])
def test_other_host_name(client: httpx.Client, host: str) -> None:
    assert_problem(client.get("/v1/jobs", headers={"Host": host}), 421, "wrong-host")


@pytest.mark.parametrize("origin", ["https://evil.example", "null", "http://localhost.evil.example"])
def test_other_web_site(client: httpx.Client, origin: str) -> None:
    assert_problem(client.post("/v1/scenes", headers={"Origin": origin}), 403, "foreign-origin")


def test_failure_is_not_described(farm: Farm) -> None:
    app = create_app(farm, ServiceSettings())

    def fail() -> None:
        raise RuntimeError("cannot parse /usr/lib/secret: root:x:0:0")

    app.add_api_route("/fail", fail)
    transport = httpx.ASGITransport(app, raise_app_exceptions=False)

    async def ask() -> httpx.Response:
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            return await client.get("/fail")

    answer = anyio.run(ask)
    assert_problem(answer, 500, "internal")
    assert "root" not in answer.text


def test_broken_http_does_not_stop_the_server(client: httpx.Client) -> None:
    with socket.create_connection((client.base_url.host, client.base_url.port or 0), timeout=10.0) as raw:
        raw.sendall(b"\x00\x01 garbage\r\n\r\n")
        assert raw.recv(64).startswith(b"HTTP/1.1 400")
