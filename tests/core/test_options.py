"""Outputs that cannot be written are refused before anything is computed."""

from __future__ import annotations

from pathlib import Path

import pytest

from elps_core.errors import SettingsRejected
from elps_core.options import check_output


@pytest.mark.parametrize("name", ["a.exr", "a.PNG", "é ü.exr", "x" * 251 + ".exr"])
def test_names_that_can_be_written_are_taken_and_nothing_is_left(tmp_path: Path, name: str) -> None:
    try:
        (tmp_path / name).touch()
        (tmp_path / name).unlink()
    except OSError:
        pytest.skip("the file system has no such names")
    check_output(tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("a.jpg", ".exr or .png"),
        ("a", ".exr or .png"),
        (".exr", ".exr or .png"),
        ("x" * 300 + ".exr", "name"),
        ("nowhere/a.exr", "does not exist"),
        ("file/a.exr", "does not exist"),
        ("folder.exr", "is a folder"),
    ],
)
def test_others_are_refused(tmp_path: Path, name: str, word: str) -> None:
    (tmp_path / "folder.exr").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(SettingsRejected, match=word) as caught:
        check_output(tmp_path / name)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) not in str(caught.value)


def test_a_folder_that_takes_no_files_is_found_out() -> None:
    if not Path("/proc").is_dir():
        pytest.skip("there is no folder here that nobody may write to")
    with pytest.raises(SettingsRejected, match="permissions"):
        check_output(Path("/proc/a.exr"))
