"""Scene files as they are written down: what a strict reader of XML is given, line by line."""

from __future__ import annotations

import codecs

import pytest

from elps_core.scene.lexical import ENCODINGS, plain

BODY = '<scene version="3.0.0">\n<shape/>\n</scene>'


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("a<!-- -- b -- -->c", "ac"),
        ("a<!----->b<!--->c-->d", "abd"),
        ("a<!-- 1\n2\n -->\nb", "a\n\n\nb"),
        ("a<!-- <!-- b --> c", "a c"),
        ("a<!-- never ends", "a<!-- never ends"),
        ('<?xml version="1.0"?>a', "a"),
        ('\n\n<?xml version="1.0"\n?>\na', "\n\n\n\na"),
        ("<!-- by\nhand --> <?xml encoding='utf8'?>a", "\na"),
        ("<?xml-stylesheet href='a'?>a", "<?xml-stylesheet href='a'?>a"),
        ("a <?xml version='1.0'?>", "a <?xml version='1.0'?>"),
    ],
)
def test_comments_and_declarations_leave_their_lines(content: str, expected: str) -> None:
    assert plain(content.encode()) == expected


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (codecs.BOM_UTF8 + "é".encode(), "é"),
        ("é".encode("utf-16"), "é"),
        (codecs.BOM_UTF16_BE + "é".encode("utf-16-be"), "é"),
        ('<?xml encoding="gb2312"?>场'.encode("gb2312"), "场"),
        ('<?xml encoding="windows-1252"?>€'.encode("cp1252"), "€"),
        ('<?xml encoding="gbk"?>é'.encode(), "é"),
        ('<?xml encoding="UTF-16"?>é'.encode(), "é"),
        (b'<?xml encoding="rot13"?>a', "a"),
        ('<?xml encoding="utf-8"?>é'.encode("latin-1"), "é"),
        ("é".encode("latin-1"), "é"),
        (codecs.BOM_UTF8 + b"\xe9", "ï»¿é"),
    ],
)
def test_bytes_are_what_they_are_and_not_what_is_said_of_them(content: bytes, expected: str) -> None:
    assert plain(content) == expected


def test_what_is_fine_stays_as_it_is() -> None:
    assert plain(BODY.encode()) == BODY


@pytest.mark.parametrize("encoding", sorted(ENCODINGS))
def test_every_encoding_is_known(encoding: str) -> None:
    assert plain(f'<?xml encoding="{encoding}"?>a'.encode(encoding)) == "a"
    assert len(plain(f'<?xml encoding="{encoding}"?>'.encode() + b"\xb1\xc1")) <= 2
