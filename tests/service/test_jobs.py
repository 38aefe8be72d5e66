"""Jobs that no worker takes: creating, reading, cancelling, and the events of it all."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.service.live import assert_problem
from tests.service.test_scenes import with_shape

SETTINGS = {"integrator": "mi_path", "width": 8, "height": 8}


@pytest.fixture
def job(client: httpx.Client, scene: str) -> Iterator[dict[str, Any]]:
    answer = client.post("/v1/jobs", json={"scene": scene, "settings": SETTINGS, "stop": {"samples": 4}})
    assert answer.status_code == 202, answer.text
    assert answer.headers["Location"] == f"/v1/jobs/{answer.json()['id']}"
    assert answer.headers["ETag"] == f'"{answer.json()["revision"]}"'
    yield answer.json()
    client.post(f"/v1/jobs/{answer.json()['id']}:cancel")


def events(answer: httpx.Response) -> list[dict[str, str]]:
    """The events of a stream that has ended; fields without an id are put together as well."""
    assert answer.headers["Content-Type"].startswith("text/event-stream")
    blocks = [block for block in answer.text.split("\n\n") if block and not block.startswith(":")]
    return [dict(line.split(": ", 1) for line in block.splitlines()) for block in blocks]


def test_read(client: httpx.Client, job: dict[str, Any]) -> None:
    answer = client.get(f"/v1/jobs/{job['id']}")
    record = answer.json()
    assert record["state"] == "queued"
    assert (record["width"], record["height"]) == (8, 8)
    assert record["settings"]["integrator"] == "mi_path"
    assert client.get("/v1/jobs", params={"limit": 1}).json()["jobs"][0]["id"] == job["id"]


def test_not_modified_until_it_changes(client: httpx.Client, job: dict[str, Any]) -> None:
    url = f"/v1/jobs/{job['id']}"
    tag = client.get(url).headers["ETag"]
    same = client.get(url, headers={"If-None-Match": tag})
    assert (same.status_code, same.content, same.headers["ETag"]) == (304, b"", tag)
    assert client.post(f"{url}:cancel").json()["state"] == "cancelled"
    changed = client.get(url, headers={"If-None-Match": tag})
    assert changed.status_code == 200
    assert changed.headers["ETag"] != tag


def test_cancel_twice(client: httpx.Client, job: dict[str, Any]) -> None:
    first = client.post(f"/v1/jobs/{job['id']}:cancel").json()
    assert first["state"] == "cancelled"
    assert client.post(f"/v1/jobs/{job['id']}:cancel").json() == first
    assert_problem(client.post("/v1/jobs/nope:cancel"), 404, "not-found")


def test_no_image_yet(client: httpx.Client, job: dict[str, Any]) -> None:
    for name in ("image.exr", "image.png", "error.exr", "error.png"):
        assert_problem(client.get(f"/v1/jobs/{job['id']}/{name}"), 404, "no-image")


@pytest.mark.parametrize("query", ["exposure=nan", "exposure=21", "tone=sepia"])
def test_invalid_preview(client: httpx.Client, job: dict[str, Any], query: str) -> None:
    assert_problem(client.get(f"/v1/jobs/{job['id']}/image.png?{query}"), 422, "invalid-input")


def test_events_are_replayed_from_where_the_client_was(client: httpx.Client, job: dict[str, Any]) -> None:
    client.post(f"/v1/jobs/{job['id']}:cancel")
    url = f"/v1/jobs/{job['id']}/events"
    retry, *all_events = events(client.get(url))
    assert retry == {"retry": "1000"}
    numbers = [int(event["id"]) for event in all_events]
    assert numbers == list(range(1, len(numbers) + 1))
    assert all_events[0]["event"] == "state"
    assert "queued" in all_events[0]["data"]
    assert "cancelled" in all_events[-1]["data"]
    missed = events(client.get(url, headers={"Last-Event-ID": "1"}))[1:]
    assert missed == all_events[1:]
    # 204 is how a browser's EventSource is told that there is nothing to come back for.
    assert client.get(url, headers={"Last-Event-ID": str(numbers[-1])}).status_code == 204


def test_events_arrive_while_the_job_lives(client: httpx.Client, job: dict[str, Any]) -> None:
    seen = []
    with client.stream("GET", f"/v1/jobs/{job['id']}/events") as answer:
        for line in answer.iter_lines():
            if line.startswith("data: "):
                seen.append(line)
                if len(seen) == 1:
                    client.post(f"/v1/jobs/{job['id']}:cancel")
    assert "queued" in seen[0]
    assert "cancelled" in seen[-1]


def test_silent_stream_is_kept_alive(
    client: httpx.Client, job: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fastapi.routing._PING_INTERVAL", 0.1)
    with client.stream("GET", f"/v1/jobs/{job['id']}/events") as answer:
        lines = answer.iter_lines()
        assert [line for line, _ in zip((line for line in lines if line.startswith(":")), range(2), strict=False)]


@pytest.mark.parametrize("last", ["x", "-1", "1.5", "1e3", "9" * 400])
def test_invalid_last_event_id(client: httpx.Client, job: dict[str, Any], last: str) -> None:
    answer = client.get(f"/v1/jobs/{job['id']}/events", headers={"Last-Event-ID": last})
    assert_problem(answer, 422, "invalid-input")


@pytest.mark.parametrize(
    "change",
    [
        {"settings": SETTINGS | {"sensor": 7}},
        {"settings": SETTINGS | {"width": 16384, "height": 16384}},
        {"stop": {"samples": 2**24}},
        {"stop": {"seconds": 29 * 24 * 3600.0}},
    ],
)
def test_settings_that_do_not_fit(client: httpx.Client, scene: str, change: dict[str, Any]) -> None:
    body = {"scene": scene, "settings": SETTINGS, "stop": {"samples": 4}} | change
    assert_problem(client.post("/v1/jobs", json=body), 422, "settings-rejected")


ALGORITHMS = [
    {"integrator": "path", "path": {"next_event": False}},
    {"integrator": "light", "heuristic": "balance"},
    {"integrator": "bdpt", "bdpt": {"strategies": "0,4 2,2", "weighted": False}},
    {"integrator": "pssmlt", "pssmlt": {"multiplexed": True, "chains": 512}},
]


@pytest.mark.parametrize("settings", ALGORITHMS, ids=[str(given["integrator"]) for given in ALGORITHMS])
def test_every_algorithm_can_be_asked_for(client: httpx.Client, scene: str, settings: dict[str, Any]) -> None:
    answer = client.post("/v1/jobs", json={"scene": scene, "settings": settings, "stop": {"samples": 4}})
    assert answer.status_code == 202, answer.text
    record = answer.json()
    assert record["statistics"] == {}
    for name, value in settings.items():
        kept = record["settings"][name]
        assert value.items() <= kept.items() if isinstance(value, dict) else kept == value
    client.post(f"/v1/jobs/{record['id']}:cancel")


GLASS = """<scene version="3.0.0"><sensor type="perspective"/><emitter type="spot"/>
<shape type="sphere"><bsdf type="dielectric"/></shape><shape type="rectangle"/></scene>"""


def test_a_job_says_what_its_image_will_lack(client: httpx.Client) -> None:
    glass = client.post("/v1/scenes", content=GLASS, headers={"Content-Type": "application/xml"}).json()
    assert glass["summary"]["warnings"] == []  # it depends on the algorithm
    for integrator, words in (("bdpt", "both before and after"), ("path", "by way of"), ("mi_depth", None)):
        body = {"scene": glass["digest"], "settings": {"integrator": integrator}, "stop": {"samples": 4}}
        job = client.post("/v1/jobs", json=body).json()
        assert len(job["warnings"]) == (words is not None)
        assert all(words in line and "'spot'" in line and "'dielectric'" in line for line in job["warnings"])
        assert client.get(f"/v1/jobs/{job['id']}").json()["warnings"] == job["warnings"]
        client.post(f"/v1/jobs/{job['id']}:cancel")


def test_submit_tells_what_the_image_will_lack(client: httpx.Client, tmp_path: Path) -> None:
    scene = tmp_path / "glass.xml"
    scene.write_text(GLASS)
    command = [sys.executable, "-m", "elps_core.cli", "submit", str(scene), "--url", str(client.base_url)]
    options = ["--integrator", "path", "--heuristic", "maximum", "--set", "path.next_event=false", "--spp", "4"]
    done = subprocess.run([*command, *options], capture_output=True, text=True, timeout=60, check=True)
    job = client.get(f"/v1/jobs/{done.stdout.strip()}").json()
    assert (job["settings"]["heuristic"], job["settings"]["path"]) == ("maximum", {"next_event": False})
    assert done.stderr.splitlines() == [f"warning: {line}" for line in job["warnings"]]
    assert "finds no light of 'spot'" in done.stderr
    client.post(f"/v1/jobs/{job['id']}:cancel")


def test_an_image_that_nothing_reaches_is_refused(client: httpx.Client, scene: str) -> None:
    settings = {"integrator": "light", "light": {"connect": False}}
    answer = client.post("/v1/jobs", json={"scene": scene, "settings": settings, "stop": {"samples": 4}})
    assert "'thinlens'" in assert_problem(answer, 422, "settings-rejected")


def test_context_of_a_queued_job_is_not_there(client: httpx.Client, scene: str) -> None:
    body = {"scene": scene, "settings": {"light_sampling": "adjoint"}, "stop": {"samples": 4}}
    job = client.post("/v1/jobs", json=body).json()
    answer = client.get(f"/v1/contexts/{job['context_digest']}/adjoint.png")
    assert_problem(answer, 404, "no-image" if job["context_state"] == "building" else answer.json()["type"][17:])
    client.post(f"/v1/jobs/{job['id']}:cancel")


def test_service(client: httpx.Client) -> None:
    assert client.get("/readyz").json() == {"status": "ok"}
    assert client.get("/v1/workers").json() == {"workers": []}
    links = client.get("/").json()
    for path in links.values():
        assert client.get(path).status_code in (200, 405)


def test_what_the_job_leaves_open_the_scene_file_says(client: httpx.Client) -> None:
    """Depth and samples come from the file, parameters from the job; what the job says itself wins."""
    said = '<default name="r" value="0.5"/><shape type="sphere"><float name="radius" value="$r"/></shape>'
    sampler = '<sampler type="independent"><integer name="sample_count" value="24"/></sampler>'
    xml = with_shape(said).replace('<sampler type="independent"/>', sampler)
    depth = '<default name="k" value="5"/><integrator type="path"><integer name="max_depth" value="$k"/></integrator>'
    xml = xml.replace('<integrator type="path"/>', depth)
    record = client.post("/v1/scenes", content=xml, headers={"Content-Type": "application/xml"}).json()
    assert record["summary"]["parameters"] == [{"name": "k", "value": "5"}, {"name": "r", "value": "0.5"}]
    body = {"scene": record["digest"], "settings": SETTINGS}

    def posted(**more: Any) -> httpx.Response:
        answer = client.post("/v1/jobs", json={**body, **more})
        if answer.is_success:
            client.post(f"/v1/jobs/{answer.json()['id']}:cancel")
        return answer

    job = posted().json()
    assert (job["settings"]["max_depth"], job["stop"]["samples"]) == (5, 24)
    job = posted(settings={**SETTINGS, "max_depth": 3}, stop={"samples": 2}).json()
    assert (job["settings"]["max_depth"], job["stop"]["samples"]) == (3, 2)
    deeper = posted(defines={"k": "7"}).json()
    assert (deeper["settings"]["max_depth"], deeper["scene"]) == (7, record["digest"])
    assert posted(defines={"r": "0.25"}).json()["scene"] != record["digest"]
    assert "'radius'" in assert_problem(posted(defines={"radius": "1"}), 422, "scene-rejected")
    assert_problem(posted(defines={"r": "nan"}), 422, "scene-rejected")
    assert_problem(posted(defines={"../r": "1"}), 422, "invalid-input")


def test_a_job_that_says_no_end_is_refused_where_the_file_says_none(client: httpx.Client, scene: str) -> None:
    answer = client.post("/v1/jobs", json={"scene": scene, "settings": SETTINGS})
    assert "when to stop" in assert_problem(answer, 422, "settings-rejected")
