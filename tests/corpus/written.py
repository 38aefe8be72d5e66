"""How files are written down: encodings, line ends, declarations, and what strict readers of XML do not take."""

from __future__ import annotations

from tests.corpus.entry import Entry, Loads, Refused

BODY = """<scene version="3.0.0">
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, 0, 6" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="12"/></film>
    </sensor>
    <shape type="cube" id="box"/>
    <emitter type="constant"/>
</scene>
"""
UTF_8 = '<?xml version="1.0" encoding="utf-8"?>\n'
SAME = Loads(1, 12, "constant")


def _loads(name: str, text: str | bytes) -> Entry:
    return Entry(name, text, SAME)


def _refused(name: str, text: str, *words: str) -> Entry:
    """Mitsuba's reader takes it, and no other one does."""
    return Entry(name, text, Refused(words, on_purpose=True))


def _with(comment: str, text: str = BODY) -> str:
    return text.replace("<shape", f"{comment}\n    <shape")


ENTRIES = [
    _loads("line ends of Windows", (UTF_8 + BODY).replace("\n", "\r\n")),
    _loads("byte order mark", b"\xef\xbb\xbf" + (UTF_8 + BODY).encode()),
    _loads("blank line first", "\n" + UTF_8 + BODY),
    _loads("comment first", "<!-- made by hand -->\n" + UTF_8 + BODY),
    _loads("rule of dashes in a comment", _with("<!-- ------ Objects ------ -->")),
    _loads("comment that ends in three dashes", _with("<!-- Objects --->")),
    _loads("comment inside a comment", _with('<!-- <!-- a sphere --> <!-- <shape type="sphere"/> -->')),
    _loads("UTF-16", (UTF_8.replace("utf-8", "utf-16") + BODY).encode("utf-16")),
    _loads("says UTF-16 and is not", UTF_8.replace("utf-8", "utf-16") + BODY),
    _loads("Latin-1, said", (UTF_8.replace("utf-8", "iso-8859-1") + _with("<!-- Benoît -->")).encode("latin-1")),
    _loads("Latin-1, not said", _with("<!-- Benoît -->").encode("latin-1")),
    _loads("Chinese, said", (UTF_8.replace("utf-8", "gb2312") + _with("<!-- 场景 -->")).encode("gb2312")),
    _loads("declaration without a version", '<?xml encoding="utf-8"?>' + BODY),
    _loads("style sheet", UTF_8 + '<?xml-stylesheet href="scene.xsl"?>\n' + BODY),
    _loads("section of text", _with("<![CDATA[ a < b ]]>")),
    _refused("document type", "<!DOCTYPE scene>\n" + BODY, "DOCTYPE or entities", "remove them"),
    _refused("bare ampersand", BODY.replace('id="box"', 'id="salt & pepper"'), "not well-formed", "line 6"),
    _refused("attribute twice", BODY.replace('id="box"', 'id="box" id="box"'), "duplicate attribute", "line 6"),
    _refused("text after the scene", BODY + "\n-- end --\n", "junk after", "line 10"),
    Entry("end tag missing", BODY.replace("</sensor>", ""), Refused(("not well-formed", "line"))),
    Entry("quote missing", BODY.replace('id="box"', 'id="box'), Refused(("not well-formed", "line"))),
    Entry("empty", "", Refused(("the scene file",))),
    _refused(
        "entities",
        '<!DOCTYPE scene [<!ENTITY a "box">]>\n' + BODY.replace('"box"', '"&a;"'),
        "DOCTYPE or entities",
        "remove them",
    ),
]
