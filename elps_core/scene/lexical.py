"""A scene file's bytes as text that a strict reader of XML takes. Imports no Mitsuba.

Mitsuba's own reader is lenient: it takes comments with two dashes inside, a declaration that is not at the very
beginning, and any bytes in comments. Files that were written by hand have all of that.
"""

from __future__ import annotations

import codecs
import re

ENCODINGS = frozenset(
    {"big5", "euc-jp", "euc-kr", "gb18030", "gb2312", "gbk", "shift_jis", "windows-1251", "windows-1252"}
    | {f"iso-8859-{part}" for part in range(1, 16) if part != 12}
)
"""Those in use beside Unicode that a declaration may name; what is not valid in the one that it names is no reason to
refuse a file."""
FALLBACK = "latin-1"
"""How bytes are read that are not what they are said to be: each is a character, none is refused."""
_BY_MARK = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
"""First bytes -> what they say of the encoding, whatever the declaration says."""

_DECLARED = re.compile(rb"""<\?xml\s[^>]{0,200}?encoding\s*=\s*["']([A-Za-z0-9._-]{1,40})["']""")
_DECLARATION = re.compile(r"\s*<\?xml\s[^>]{0,400}\?>")
_HEAD_BYTES = 1024
"""Where a declaration is looked for; comments may stand before it."""


def plain(content: bytes) -> str:
    """The text of a file without its declaration and comments, each line where it was."""
    text = _without_comments(_decoded(content))
    declaration = _DECLARATION.match(text)
    return text if declaration is None else _lines(declaration[0]) + text[declaration.end() :]


def _decoded(content: bytes) -> str:
    mark = next((name for begin, name in _BY_MARK if content.startswith(begin)), None)
    found = _DECLARED.search(content[:_HEAD_BYTES])
    declared = found[1].decode("ascii").lower() if found else ""
    # Many files say what they are not; what is no UTF-8 and reads as such is not met.
    for encoding in (mark, "utf-8", declared if declared in ENCODINGS else None):
        if encoding is not None:
            try:
                return content.decode(encoding)
            except UnicodeDecodeError:
                continue
    return content.decode(FALLBACK)


def _without_comments(text: str) -> str:
    # No quotes or sections of text are looked at: a strict reader takes no '<' in them, or is left with their end.
    kept: list[str] = []
    done = 0
    while (begin := text.find("<!--", done)) >= 0:
        end = text.find("-->", begin + 4)
        if end < 0:  # unfinished: for the reader to refuse
            break
        kept += [text[done:begin], _lines(text[begin:end])]
        done = end + 3
    return "".join([*kept, text[done:]])


def _lines(text: str) -> str:
    """The line ends of a text, which is left out."""
    return "\n" * text.count("\n")
