"""Scene files as people have them: what loads, what is said of it, and what is refused with which words."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.corpus import STYLES
from tests.corpus.entry import Entry, Refused
from tests.corpus.outcome import differences, here, in_mitsuba

ENTRIES = [pytest.param(entry, id=f"{style}-{entry.name}") for style, entries in STYLES.items() for entry in entries]
AT_LEAST = 60


def test_there_are_enough_of_them() -> None:
    assert len(ENTRIES) >= AT_LEAST


@pytest.mark.parametrize("entry", ENTRIES)
def test_a_scene_comes_out_as_it_must_and_as_in_mitsuba(entry: Entry, tmp_path: Path) -> None:
    mine = here(entry, tmp_path / "here")
    theirs = in_mitsuba(entry, tmp_path / "there")
    if isinstance(entry.out, Refused):
        assert isinstance(mine, str), "it loads"
        assert [word for word in entry.out.words if word not in mine] == [], mine
        assert isinstance(theirs, str) != entry.out.on_purpose, theirs
        return
    assert not isinstance(mine, str), mine
    assert entry.out.differences(mine) == []
    if not isinstance(theirs, str):
        assert differences(mine, theirs) == []
