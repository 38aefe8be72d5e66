"""Uploads: what a good one gets, and what a hostile one leaves behind (nothing)."""

from __future__ import annotations

import io
import shutil
import subprocess
import threading
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from service.settings import ServiceSettings
from tests.service.live import ROOM, UPLOAD_LIMIT, assert_problem, serving
from worker.farm import Farm

ZIP = {"Content-Type": "application/zip"}
XML = {"Content-Type": "application/xml"}
NOTICE_SECONDS = 5.0
"""Time for the server to notice that a sender hung up."""


def bundle(files: dict[str, str | bytes]) -> bytes:
    """A zip with the given files."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def with_shape(shape: str) -> str:
    return ROOM.replace("</scene>", f"{shape}</scene>")


@pytest.fixture(autouse=True)
def _nothing_left_and_still_answering(client: httpx.Client, temporary: Path) -> Iterator[None]:
    yield
    end = time.monotonic() + NOTICE_SECONDS
    while left := sorted(temporary.rglob("*")):
        assert time.monotonic() < end, left
        time.sleep(0.02)
    assert client.get("/livez").json() == {"status": "ok"}


@pytest.fixture(scope="module")
def native_plugin(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, Path]:
    """A shared library that leaves a mark when it is loaded, and where the mark would appear."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("needs a C compiler")
    folder = tmp_path_factory.mktemp("native")
    mark = folder / "mark"
    source, library = folder / "evil.c", folder / "evil.so"
    source.write_text(
        "#include <stdio.h>\n"
        "__attribute__((constructor)) static void run(void) {\n"
        f'    FILE *mark = fopen("{mark}", "w"); if (mark) fclose(mark);\n'
        "}\n"
    )
    subprocess.run([compiler, "-shared", "-fPIC", "-o", library, source], check=True)
    return library.read_bytes(), mark


def test_raw_xml_form_and_zip_are_one_scene(client: httpx.Client) -> None:
    first = client.post("/v1/scenes", content=ROOM, headers=XML)
    assert first.status_code in (200, 201), first.text
    record = first.json()
    assert record["digest"].startswith("sha256:")
    assert first.headers["Location"] == f"/v1/scenes/{record['digest']}"
    form = client.post("/v1/scenes", files={"file": ("C:\\scenes\\room.xml", ROOM, "application/xml")})
    assert (form.status_code, form.json()["digest"]) == (200, record["digest"])
    zipped = client.post("/v1/scenes", content=bundle({"scene.xml": ROOM}), headers=ZIP)
    assert (zipped.status_code, zipped.json()["digest"]) == (200, record["digest"])
    assert client.get(f"/v1/scenes/{record['digest']}").json() == record


def test_new_scene_is_created(client: httpx.Client) -> None:
    other = ROOM.replace('value="5"', 'value="7"')
    answer = client.post("/v1/scenes", files={"file": ("../a/br\u00f6ad room.xml", other, "application/xml")})
    assert answer.status_code == 201, answer.text
    assert answer.json()["name"] == "br\u00f6ad room.xml"


@pytest.mark.parametrize(
    ("body", "headers"),
    [
        (b"PK\x03\x04 this is no archive", ZIP),
        (b"", ZIP),
        (b"<scene version='3.0.0'><shape", XML),
        (b"\x00" * 1000, XML),
        (b"<!DOCTYPE s [<!ENTITY a SYSTEM 'file:///etc/passwd'>]><scene version='3.0.0'>&a;</scene>", XML),
        (b"<a>" * 50_000, XML),
        (bundle({"readme.txt": "no scene here"}), ZIP),
        (bundle({"scene.xml": ROOM})[:-30], ZIP),
        (bundle({"scene.xml": ROOM, "inner.zip": bundle({"scene.xml": ROOM})}), ZIP),
        (bundle({"scene.xml": ROOM, "big.txt": b"\0" * 2**28}), ZIP),
        (bundle({"scene.xml": ROOM, "../evil.txt": "out"}), ZIP),
        (bundle({"scene.xml": ROOM, "/etc/cron.txt": "out"}), ZIP),
    ],
    ids=[
        *("garbage", "empty", "cut", "NUL", "DOCTYPE", "deep", "no scene", "truncated"),
        *("nested", "bomb", "dot dot", "absolute"),
    ],
)
def test_malformed_upload(client: httpx.Client, body: bytes, headers: dict[str, str]) -> None:
    assert len(body) < UPLOAD_LIMIT
    assert_problem(client.post("/v1/scenes", content=body, headers=headers), 422, "scene-rejected")


@pytest.mark.parametrize(
    "shape",
    [
        '<shape type="obj"><string name="filename" value="missing.obj"/></shape>',
        '<shape type="obj"><string name="filename" value="/etc/passwd"/></shape>',
        '<shape type="ply"><string name="filename" value="../../../../etc/passwd"/></shape>',
        '<include filename="/etc/passwd"/>',
        '<shape type="sphere"><bsdf type="evil"/></shape>',
        '<shape type="sphere"><bsdf type="../../evil"/></shape>',
        '<sensor type="perspective"><float name="fov" value="nan"/></sensor>',
        '<sensor type="perspective"><transform name="to_world">'
        '<lookat origin="nan, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform></sensor>',
    ],
    ids=["missing-mesh", "host-file", "dotdot-file", "include", "plugin", "plugin-path", "nan-fov", "nan-camera"],
)
def test_hostile_scene(client: httpx.Client, shape: str) -> None:
    detail = assert_problem(client.post("/v1/scenes", content=with_shape(shape), headers=XML), 422, "scene-rejected")
    assert "root:" not in detail


@pytest.mark.parametrize("name", ["plugins/diffuse.so", "diffuse.so", "plugins/sphere.so"])
def test_native_code_is_not_loaded(client: httpx.Client, native_plugin: tuple[bytes, Path], name: str) -> None:
    library, mark = native_plugin
    answer = client.post("/v1/scenes", content=bundle({"scene.xml": ROOM, name: library}), headers=ZIP)
    assert_problem(answer, 422, "scene-rejected")
    assert not mark.exists()


@pytest.mark.parametrize(
    "arguments",
    [
        {"files": {"other": ("a.zip", b"PK")}},
        {"files": [("file", ("a.zip", b"PK")), ("file", ("b.zip", b"PK"))]},
        {"data": {"file": "text"}, "files": {"x": ("a.zip", b"PK")}},
        {"content": b"no parts", "headers": {"Content-Type": "multipart/form-data"}},
        {"content": b"no parts", "headers": {"Content-Type": "multipart/form-data; boundary=x"}},
    ],
)
def test_malformed_form(client: httpx.Client, arguments: dict[str, object]) -> None:
    assert_problem(client.post("/v1/scenes", **arguments), 400, "bad-request")  # type: ignore[arg-type]


def test_sender_that_hangs_up_leaves_nothing(client: httpx.Client) -> None:
    def stream() -> Iterator[bytes]:
        yield b"PK" + b" " * 2**20
        raise InterruptedError

    with pytest.raises(InterruptedError):
        client.post("/v1/scenes", content=stream(), headers=ZIP)


def test_too_many_uploads_are_told_to_come_back(farm: Farm) -> None:
    with serving(farm, ServiceSettings(scene_uploads=1)) as client:
        started, release = threading.Event(), threading.Event()

        def slowly() -> Iterator[bytes]:
            yield ROOM[:100].encode()
            started.set()
            release.wait(30.0)
            yield ROOM[100:].encode()

        answers: list[httpx.Response] = []
        first = threading.Thread(
            target=lambda: answers.append(client.post("/v1/scenes", content=slowly(), headers=XML))
        )
        first.start()
        started.wait(30.0)
        refused = client.post("/v1/scenes", content=ROOM, headers=XML)
        release.set()
        first.join()
        assert_problem(refused, 503, "busy")
        assert int(refused.headers["Retry-After"]) > 0
        assert answers[0].is_success
        assert client.post("/v1/scenes", content=ROOM, headers=XML).status_code == 200
