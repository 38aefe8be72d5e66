"""Showing what came with an upload: names printable, short, on one line; warnings in a number that is read."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence

SHOWN_CHARACTERS = 80
"""Longest name that an error message repeats; enough to recognise a file, too short to flood a log."""

MAX_WARNINGS = 50
"""Lines of warnings of one kind that one scene may cause."""


def is_plain(text: str) -> bool:
    """Whether ``text`` has no control, formatting, surrogate or unassigned characters and no odd spaces."""
    return all(c == " " or unicodedata.category(c)[0] not in "CZ" for c in text)


def shown(text: str) -> str:
    """``text`` as an error message may repeat it: odd characters become ``?``, a long middle is left out."""
    plain = "".join(c if is_plain(c) else "?" for c in text[: 4 * SHOWN_CHARACTERS])
    if len(plain) <= SHOWN_CHARACTERS:
        return plain
    half = SHOWN_CHARACTERS // 2
    return f"{plain[:half]}...{plain[-half:]}"


def few(lines: Sequence[str]) -> list[str]:
    """The first of many warnings, and how many more there are."""
    if len(lines) <= MAX_WARNINGS:
        return list(lines)
    return [*lines[: MAX_WARNINGS - 1], f"and {len(lines) - MAX_WARNINGS + 1} other warnings"]
