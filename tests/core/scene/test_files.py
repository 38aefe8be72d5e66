"""Which file a name means: exactly that one, else the only one that is written differently, and none outside."""

from __future__ import annotations

import unicodedata
from pathlib import Path

import pytest

from elps_core.scene.files import MAX_FOLDERS, Files

from .conftest import Reject, folder_of

LABEL = "<shape>"


@pytest.mark.parametrize(
    ("there", "name"),
    [
        ("models/Lamp.obj", "models/lamp.OBJ"),
        ("Models/lamp.obj", "models\\lamp.obj"),
        (unicodedata.normalize("NFD", "caf\u00e9.png"), unicodedata.normalize("NFC", "caf\u00e9.png")),
        (unicodedata.normalize("NFC", "\u00dcbung/a.png"), unicodedata.normalize("NFD", "\u00fcbung/A.png")),
    ],
)
def test_the_only_file_that_fits_is_taken_with_a_warning(there: str, name: str, tmp_path: Path) -> None:
    folder_of(tmp_path, {there: b"x"})
    files = Files(tmp_path)
    assert files.find(name, LABEL) == tmp_path / there
    assert len(files.warnings) == 1
    assert files.find(there, LABEL) == tmp_path / there
    assert len(files.warnings) == 1


def test_the_exact_name_wins_and_two_that_fit_are_none(tmp_path: Path, reject: Reject) -> None:
    folder_of(tmp_path, {"a.png": b"x", "A.png": b"x"})
    files = Files(tmp_path)
    assert files.find("A.png", LABEL).name == "A.png"
    assert not files.warnings
    folder_of(tmp_path, {"b.PNG": b"x", "B.png": b"x"})
    assert "not in the bundle" in reject(files.find, "b.png", LABEL)


def test_folders_are_searched_as_mitsuba_does_the_last_one_first(tmp_path: Path, reject: Reject) -> None:
    folder_of(tmp_path, {"a.obj": b"0", "one/a.obj": b"1", "two/a.obj": b"2", "one/b.obj": b"1"})
    files = Files(tmp_path)
    for folder in ("one", "two/", "none"):
        files.search(folder, "<path>")
    assert files.find("a.obj", LABEL).read_bytes() == b"2"
    assert files.find("b.obj", LABEL).read_bytes() == b"1"
    assert [warning for warning in files.warnings if "'none'" in warning] == files.warnings
    for outside in ("..", "/etc", "one/../..", "C:\\x"):
        assert "outside" in reject(files.search, outside, "<path>")


def test_a_root_above_is_as_far_as_names_lead(tmp_path: Path, reject: Reject) -> None:
    folder_of(tmp_path, {"all/scene/s.xml": b"", "all/textures/a.png": b"x", "secret.png": b"x"})
    home = tmp_path / "all" / "scene"
    assert "--root" in reject(Files(home, local=True).find, "../textures/a.png", LABEL)
    files = Files(home, tmp_path / "all", local=True)
    assert files.find("../textures/a.png", LABEL).read_bytes() == b"x"
    assert "--root" in reject(files.find, "../../secret.png", LABEL)
    assert "--root" in reject(Files, home, tmp_path / "other", local=True)


def test_an_answer_does_not_tell_what_lies_outside(tmp_path: Path, reject: Reject) -> None:
    folder_of(tmp_path, {"there.png": b"x", "in/scene.xml": b""})
    files = Files(tmp_path / "in")
    answers = {reject(files.find, f"../{name}.png", LABEL).replace(name, "") for name in ("there", "gone!")}
    assert len(answers) == 1


def test_folders_that_are_named_again_are_searched_once_and_many_are_refused(tmp_path: Path, reject: Reject) -> None:
    folder_of(tmp_path, {"a.obj": b"0", "one/a.obj": b"1", "two/a.obj": b"2"})
    files = Files(tmp_path)
    for folder in ("one", "two", "one", ".", "one/../two"):
        files.search(folder, "<path>")
    assert files.find("a.obj", LABEL).read_bytes() == b"2"
    for number in range(MAX_FOLDERS - 3):
        (tmp_path / str(number)).mkdir()
        files.search(str(number), "<path>")
    (tmp_path / "last").mkdir()
    files.search("one", "<path>")
    assert "name fewer" in reject(files.search, "last", "<path>")


def test_a_folder_is_gone_through_once_for_all_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder_of(tmp_path, {f"Mesh{number}.obj": b"x" for number in range(5)})
    gone_through: list[Path] = []
    iterdir = Path.iterdir
    monkeypatch.setattr(Path, "iterdir", lambda self: gone_through.append(self) or iterdir(self))
    files = Files(tmp_path)
    for number in range(5):
        assert files.find(f"mesh{number}.OBJ", LABEL).name == f"Mesh{number}.obj"
    assert gone_through == [tmp_path]
    assert len(files.warnings) == 5
