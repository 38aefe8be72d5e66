"""``python -m tests.corpus [STYLE]``: what becomes of each scene of the corpus, here and in Mitsuba, as a table."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tests.corpus import STYLES
from tests.corpus.entry import Entry, Refused
from tests.corpus.outcome import differences, here, in_mitsuba

PLAIN = 160
"""Columns where the output is no terminal."""


def _row(entry: Entry, folder: Path) -> tuple[str, str, str]:
    """(here, Mitsuba, what is said of it)."""
    mine, theirs = here(entry, folder / "here"), in_mitsuba(entry, folder / "there")
    there = "refused" if isinstance(theirs, str) else "loads"
    if isinstance(mine, str):
        right = isinstance(entry.out, Refused) and all(word in mine for word in entry.out.words)
        return "refused" if right else "WRONG", there, mine
    wrong = ["it must be refused"] if isinstance(entry.out, Refused) else entry.out.differences(mine)
    wrong += [] if isinstance(theirs, str) else differences(mine, theirs)
    return "WRONG" if wrong else "loads", there, "; ".join(wrong or mine.summary.warnings)


def main(styles: list[str]) -> None:
    """Print the table of some styles, or of all."""
    console = Console()
    console = console if console.is_terminal else Console(width=PLAIN)
    table = Table("style", "scene", "here", "Mitsuba", "warnings, or why not")
    counts = dict.fromkeys(("loads", "refused", "WRONG"), 0)
    both = mitsuba = 0
    for style, entries in STYLES.items():
        for entry in entries if not styles or style in styles else ():
            with tempfile.TemporaryDirectory() as folder:
                mine, theirs, told = _row(entry, Path(folder))
            table.add_row(style, entry.name, mine, theirs, told)
            counts[mine] += 1
            mitsuba += theirs == "loads"
            both += mine == theirs == "loads"
    console.print(table)
    console.print(", ".join(f"{number} {name}" for name, number in counts.items()), "of", sum(counts.values()))
    console.print(f"Mitsuba loads {mitsuba}, and {both} of these load here")


if __name__ == "__main__":
    main(sys.argv[1:])
