"""Unpacking uploads: what is taken, what is refused, and that a refusal leaves nothing behind."""

from __future__ import annotations

import io
import os
import stat
import struct
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from elps_core.errors import SceneRejected
from elps_core.scene.bundle import BundleLimits, unpack

from .conftest import OBJ, Reject, folder_of, listing, scene_xml, zip_of

XML = scene_xml()


def refused(upload: Path, tmp_path: Path, reject: Reject, limits: BundleLimits = BundleLimits()) -> str:  # noqa: B008
    """The message, after checking that neither the target nor its surroundings hold anything new."""
    into = tmp_path / "sub" / "into"
    into.mkdir(parents=True)
    before = listing(tmp_path)
    message = reject(unpack, upload, into, limits)
    assert listing(tmp_path) == before
    return message


def test_zip_xml_and_folder_are_taken(tmp_path: Path) -> None:
    files = {"scene.xml": XML, "models/a.obj": OBJ, "README.md": b"by me"}
    for index, upload in enumerate(
        [
            zip_of(tmp_path / "a.zip", files),
            zip_of(tmp_path / "stored.zip", files, packed=False),
            zip_of(tmp_path / "wrapped.zip", {f"my scene/{name}": content for name, content in files.items()}),
            folder_of(tmp_path / "folder", files),
        ]
    ):
        xml = unpack(upload, tmp_path / f"into{index}").xml
        assert xml.read_bytes() == XML
        assert (xml.parent / "models/a.obj").read_bytes() == OBJ
    single = tmp_path / "other.xml"
    single.write_bytes(XML)
    assert unpack(single, tmp_path / "into-xml").xml.read_bytes() == XML


def test_uploads_are_told_by_content_not_by_name(tmp_path: Path) -> None:
    zip_of(tmp_path / "upload.xml", {"scene.xml": XML})
    assert unpack(tmp_path / "upload.xml", tmp_path / "into").xml.read_bytes() == XML


def test_which_xml_is_the_scene(tmp_path: Path, reject: Reject) -> None:
    one = zip_of(tmp_path / "one.zip", {"room.xml": XML, "parts/lamp.xml": b"<scene/>"})
    assert unpack(one, tmp_path / "one").xml.name == "room.xml"
    named = zip_of(tmp_path / "named.zip", {"a.xml": b"<scene/>", "scene.xml": XML})
    assert unpack(named, tmp_path / "named").xml.name == "scene.xml"
    two = zip_of(tmp_path / "two.zip", {"a.xml": XML, "b.xml": XML})
    assert "2 XML files" in refused(two, tmp_path / "t1", reject)
    none = zip_of(tmp_path / "none.zip", {"a.obj": OBJ})
    assert "no XML" in refused(none, tmp_path / "t2", reject)
    deep = zip_of(tmp_path / "deep.zip", {"x/y/scene.xml": XML})
    assert "no XML" in refused(deep, tmp_path / "t3", reject)


SEEN = b'<scene version="3.0.0"><sensor type="perspective"/></scene>'


@pytest.mark.parametrize(
    ("files", "scene"),
    [
        ({"LICENSE": b"x", "kitchen/kitchen.xml": XML, "kitchen/wood.png": b"x"}, "kitchen/kitchen.xml"),
        ({"textures/wood.png": b"x", "scene/scene.xml": XML, "parts/lamp.xml": b"<scene/>"}, "scene/scene.xml"),
        ({"room.xml": b'<scene><include filename="parts\\lamp.xml"/></scene>', "lamp.xml": b"<scene/>"}, "room.xml"),
        ({"a.xml": SEEN, "materials.xml": b"<scene/>"}, "a.xml"),
        ({"__MACOSX/room.xml": b"x", "room/room.xml": XML}, "room/room.xml"),
    ],
)
def test_the_scene_is_found_beside_what_it_includes_or_one_folder_down(
    files: dict[str, bytes], scene: str, tmp_path: Path
) -> None:
    into = tmp_path / "into"
    assert unpack(zip_of(tmp_path / "a.zip", files), into).xml == into / scene


def test_what_no_scene_has_a_use_for_is_left_out_and_listed(tmp_path: Path) -> None:
    names = ["LICENSE", "README", "Makefile", "room.blend", "notes.md", "lamp.mtl", ".gitignore", "a/b/preview.webp"]
    upload = zip_of(tmp_path / "a.zip", {"scene.xml": XML, **dict.fromkeys(names, b"x"), "a/wood.png": b"x"})
    unpacked = unpack(upload, tmp_path / "into")
    assert sorted(unpacked.ignored) == sorted(names)
    assert listing(tmp_path / "into") == {"scene.xml", "a", "a/wood.png"}


def test_an_archive_of_nothing_but_ignored_files_is_no_scene(tmp_path: Path, reject: Reject) -> None:
    upload = zip_of(tmp_path / "a.zip", {f"{number}.blend": b"x" for number in range(100)})
    assert "no XML" in refused(upload, tmp_path, reject)


def test_folders_packed_with_backslashes_are_folders(tmp_path: Path) -> None:
    upload = zip_of(tmp_path / "a.zip", {"scene.xml": XML, "a\\b\\wood.png": b"x"})
    unpack(upload, tmp_path / "into")
    assert listing(tmp_path / "into") == {"scene.xml", "a", "a/b", "a/b/wood.png"}


def test_litter_of_file_managers_is_left_out(tmp_path: Path) -> None:
    upload = zip_of(tmp_path / "a.zip", {"scene.xml": XML, "__MACOSX/._scene.xml": b"x", "models/.DS_Store": b"x"})
    unpack(upload, tmp_path / "into")
    assert listing(tmp_path / "into") == {"scene.xml"}


@pytest.mark.parametrize(
    "name",
    [
        "../evil.xml",
        "a/../../evil.xml",
        "..",
        "/etc/evil.xml",
        "//etc/evil.xml",
        "~/evil.xml",
        "C:/evil.xml",
        "C:evil.xml",
        "a\\..\\evil.xml",
        "./scene2.txt",
        "a//b.txt",
        "evil$HOME.txt",
        "a/ b.txt",
        "a./b.txt",
        "trailing.txt.",
        "new\nline.txt",
        "bell\x07.txt",
        "right\u202eto-left.txt",
        "zero\u200bwidth.txt",
        "nbsp\u00a0.txt",
        "/".join(["deep"] * 40) + "/a.txt",
        "x" * 300 + ".txt",
        "\u00fc" * 150 + ".txt",
    ],
)
def test_names_that_are_refused(name: str, tmp_path: Path, reject: Reject) -> None:
    refused(zip_of(tmp_path / "a.zip", {"scene.xml": XML, name: b"x"}), tmp_path, reject)


@pytest.mark.parametrize(
    "name",
    [
        "plugins/readme.txt",
        "a/PLUGINS/readme.txt",
        "\uff50\uff4c\uff55\uff47\uff49\uff4e\uff53/readme.txt",  # full-width letters
        "plugins/",
        "a.so",
        "libdiffuse.so.1",
        "a.DLL",
        "a.dylib",
        "a.py",
        "a.py.txt",
        "__MACOSX/a.so",
        "inner.zip",
        "inner.tar.gz",
        "inner.7z",
        "a.sh",
        "a.exe",
    ],
)
def test_kinds_that_are_refused(name: str, tmp_path: Path, reject: Reject) -> None:
    assert name.split("/")[0][:4] in refused(
        zip_of(tmp_path / "a.zip", {"scene.xml": XML, name: b"x" if not name.endswith("/") else b""}), tmp_path, reject
    )


def test_a_nul_byte_does_not_hide_an_ending(tmp_path: Path, reject: Reject) -> None:
    zip_of(tmp_path / "a.zip", {"scene.xml": XML, "abc.txtX.so": b"x"})
    data = (tmp_path / "a.zip").read_bytes().replace(b"abc.txtX.so", b"abc.txt\0.so")
    (tmp_path / "a.zip").write_bytes(data)
    refused(tmp_path / "a.zip", tmp_path, reject)


@pytest.mark.parametrize(
    "names",
    [
        ("a.txt", "a.txt"),
        ("a.txt", "A.TXT"),
        ("t/a.txt", "T/a.TXT"),
        ("caf\u00e9.txt", "cafe\u0301.txt"),
        ("stra\u00dfe.txt", "strasse.txt"),
        ("a.txt", "a.txt/b.txt"),
        ("a.txt/b.txt", "a.txt"),
    ],
)
def test_names_that_collide_are_refused(names: tuple[str, str], tmp_path: Path, reject: Reject) -> None:
    with warnings.catch_warnings(), zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        warnings.simplefilter("ignore")
        archive.writestr("scene.xml", XML)
        for name in names:
            archive.writestr(name, b"x")
    assert "twice" in refused(tmp_path / "a.zip", tmp_path, reject)


@pytest.mark.parametrize("kind", [stat.S_IFLNK, stat.S_IFIFO, stat.S_IFCHR, stat.S_IFBLK, stat.S_IFSOCK, stat.S_IFDIR])
def test_links_and_devices_in_an_archive_are_refused(kind: int, tmp_path: Path, reject: Reject) -> None:
    info = zipfile.ZipInfo("mesh.obj")
    info.create_system = 3
    info.external_attr = (kind | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("scene.xml", XML)
        archive.writestr(info, "/etc/passwd")
    assert "mesh.obj" in refused(tmp_path / "a.zip", tmp_path, reject)


def test_links_and_devices_in_a_folder_are_refused(tmp_path: Path, reject: Reject) -> None:
    secret = tmp_path / "secret.obj"
    secret.write_bytes(OBJ)
    makers: list[Callable[[Path], None]] = [
        lambda path: path.symlink_to(secret),
        lambda path: path.symlink_to(tmp_path),
        lambda path: os.link(secret, path),
        lambda path: os.mkfifo(path),
    ]
    for index, make in enumerate(makers):
        folder = folder_of(tmp_path / f"folder{index}", {"scene.xml": XML})
        make(folder / "mesh.obj")
        refused(folder, tmp_path / f"t{index}", reject)


def test_an_encrypted_entry_is_refused(tmp_path: Path, reject: Reject) -> None:
    data = bytearray(zip_of(tmp_path / "a.zip", {"scene.xml": XML}).read_bytes())
    data[6] |= 1
    data[data.index(b"PK\x01\x02") + 8] |= 1
    (tmp_path / "a.zip").write_bytes(data)
    assert "encrypted" in refused(tmp_path / "a.zip", tmp_path, reject)


def test_other_packing_methods_are_refused(tmp_path: Path, reject: Reject) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("scene.xml", XML)
    assert "deflate" in refused(tmp_path / "a.zip", tmp_path, reject)


def test_a_bomb_is_stopped_while_it_unpacks(tmp_path: Path, reject: Reject) -> None:
    upload = zip_of(tmp_path / "a.zip", {"scene.xml": XML, "a.obj": bytes(64 * 2**20)})
    assert upload.stat().st_size < 100_000
    assert "more than it may" in refused(upload, tmp_path, reject)


def test_a_bomb_of_many_small_files_is_stopped(tmp_path: Path, reject: Reject) -> None:
    upload = zip_of(tmp_path / "a.zip", {"scene.xml": XML, **{f"{i}.obj": bytes(2**19) for i in range(60)}})
    assert "more than it may" in refused(upload, tmp_path, reject)


def test_sizes_in_headers_are_not_believed(tmp_path: Path, reject: Reject) -> None:
    """An entry that says it holds ten bytes and holds a megabyte is damaged, whatever its checksum says."""
    data = bytearray(zip_of(tmp_path / "a.zip", {"scene.xml": XML, "a.obj": bytes(2**20)}).read_bytes())
    for signature, offset in ((b"PK\x03\x04", 22), (b"PK\x01\x02", 24)):
        at = data.rindex(signature)
        assert struct.unpack_from("<I", data, at + offset)[0] == 2**20
        struct.pack_into("<I", data, at + offset, 10)
    (tmp_path / "a.zip").write_bytes(data)
    assert "damaged" in refused(tmp_path / "a.zip", tmp_path, reject)


def test_limits_hold(tmp_path: Path, reject: Reject) -> None:
    upload = zip_of(tmp_path / "a.zip", {"scene.xml": XML, **{f"{i}.txt": bytes([i]) * 1000 for i in range(9)}})
    for index, (limits, word) in enumerate(
        [
            (BundleLimits(entries=9), "entries"),
            (BundleLimits(total_bytes=5000), "more than it may"),
            (BundleLimits(file_bytes=900), "MiB"),
            (BundleLimits(xml_bytes=100), "MiB"),
            (BundleLimits(upload_bytes=500), "MiB"),
        ]
    ):
        assert word in refused(upload, tmp_path / f"t{index}", reject, limits)
        assert unpack(upload, tmp_path / f"ok{index}").xml.exists()


def test_a_million_entries_are_refused_before_they_are_read(
    tmp_path: Path, reject: Reject, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The zip reader makes an object of a kilobyte of each: it must not be asked."""
    monkeypatch.setattr(zipfile, "ZipFile", lambda *_: pytest.fail("the directory was read"))
    entry = b"PK\x01\x02" + bytes(42)
    count = 300_000
    end = struct.pack("<4s4H2IH", b"PK\x05\x06", 0, 0, count & 0xFFFF, count & 0xFFFF, len(entry) * count, 0, 0)
    (tmp_path / "a.zip").write_bytes(b"PK\x03\x04" + entry * count + end)
    assert "entries" in refused(tmp_path / "a.zip", tmp_path, reject)


def test_overlapping_entries_are_refused(tmp_path: Path, reject: Reject) -> None:
    """The second entry of the directory points at the first one's bytes: one block, unpacked many times."""
    zip_of(tmp_path / "a.zip", {"scene.xml": XML, "aa.obj": bytes(5000)})
    data = (tmp_path / "a.zip").read_bytes()
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        start, block = archive.start_dir, archive.getinfo("aa.obj")
    directory = data[start : data.index(b"PK\x05\x06")]
    kernel = directory[directory.index(b"aa.obj") - 46 :]
    count = 100
    entries = directory + kernel.replace(b"aa.obj", b"ab.obj") * count
    total = 2 + count
    end = struct.pack("<4s4H2IH", b"PK\x05\x06", 0, 0, total, total, len(entries), start, 0)
    (tmp_path / "a.zip").write_bytes(data[:start] + entries + end)
    assert block.header_offset > 0
    assert "overlapping" in refused(tmp_path / "a.zip", tmp_path, reject)


def test_an_entry_before_the_start_of_the_file_is_refused(tmp_path: Path, reject: Reject) -> None:
    data = bytearray(zip_of(tmp_path / "a.zip", {"scene.xml": XML}).read_bytes())
    at = data.index(b"PK\x05\x06") + 16
    struct.pack_into("<I", data, at, struct.unpack_from("<I", data, at)[0] + 10)
    (tmp_path / "a.zip").write_bytes(data)
    assert "damaged" in refused(tmp_path / "a.zip", tmp_path, reject)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PK",
        b"PK\x03\x04",
        b"PK\x03\x04" + bytes(1000),
        b"PK\x05\x06" + bytes(18),
        b"\x7fELF",
        b"hello",
        bytes(100),
    ],
)
def test_garbage_is_refused(content: bytes, tmp_path: Path, reject: Reject) -> None:
    (tmp_path / "a.zip").write_bytes(content)
    refused(tmp_path / "a.zip", tmp_path, reject)


def test_a_pipe_is_not_waited_for(tmp_path: Path, reject: Reject) -> None:
    folder = folder_of(tmp_path / "folder", {"a.txt": b""})
    os.mkfifo(folder / "scene.xml")
    refused(folder, tmp_path, reject)


def _sample_zip() -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("scene.xml", XML)
        archive.writestr("models/a.obj", OBJ * 20)
        archive.writestr("textures/", b"")
    return data.getvalue()


SAMPLE = _sample_zip()


@given(
    edits=st.lists(st.tuples(st.integers(0, len(SAMPLE) - 1), st.binary(min_size=1, max_size=4)), max_size=6),
    cut=st.integers(0, len(SAMPLE)) | st.none(),
    names=st.lists(st.sampled_from([b"../../a.ob", b"/etc/a.obj", b"models/..\0", b"plugins/a."]), max_size=1),
)
@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_mutated_archives_are_refused_or_unpacked(
    edits: list[tuple[int, bytes]], cut: int | None, names: list[bytes], tmp_path_factory: pytest.TempPathFactory
) -> None:
    data = bytearray(SAMPLE)
    for name in names:
        data = data.replace(b"models/a.o", name)
    for at, content in edits:
        data[at : at + len(content)] = content
    base = tmp_path_factory.mktemp("fuzz")
    upload = base / "upload"
    upload.write_bytes(data[:cut])
    into = base / "sub" / "into"
    into.mkdir(parents=True)
    try:
        assert unpack(upload, into).xml.is_relative_to(into)
    except SceneRejected:
        assert listing(into) == set()
    assert listing(base) - {f"sub/into/{name}" for name in listing(into)} == {"upload", "sub", "sub/into"}
    assert all(not path.is_symlink() for path in into.rglob("*"))
