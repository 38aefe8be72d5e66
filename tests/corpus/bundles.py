"""Archives as people pack them: one folder down, with files that no scene needs, names that are written differently."""

from __future__ import annotations

import unicodedata

from tests.corpus.entry import Entry, Loads, Refused
from tests.corpus.things import made, ply

CAMERA = """
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, 0, 6" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="12"/></film>
    </sensor>"""
TEXTURED = f"""<scene version="3.0.0">{CAMERA}
    <bsdf type="diffuse" id="wood">
        <texture type="bitmap" name="reflectance"><string name="filename" value="textures/wood.png"/></texture>
    </bsdf>
    <shape type="obj"><string name="filename" value="models/Mesh000.obj"/><ref id="wood"/></shape>
    <emitter type="envmap"><string name="filename" value="textures/sky.hdr"/></emitter>
</scene>
"""
FILES = made("textures/wood.png", "textures/sky.hdr", "models/Mesh000.obj")
OUT = Loads(1, 2, "envmap")
ALIKE = "which is written differently"


def _in(folder: str, files: dict[str, bytes]) -> dict[str, bytes]:
    return {folder + name: content for name, content in files.items()}


def _bundle(
    name: str, out: Loads | Refused, files: dict[str, bytes], text: str = TEXTURED, xml: str = "scene.xml"
) -> Entry:
    return Entry(name, text, out, files, xml=xml, bundle=True)


def _told(*warnings: str) -> Loads:
    return Loads(1, 2, "envmap", warnings=warnings)


EXTRAS = {
    "LICENSE": b"CC0",
    "README.md": b"# A room",
    "scene.blend": b"BLENDER-v306",
    "models/Mesh000.mtl": b"newmtl None\n",
    "preview.psd": b"8BPS",
    ".DS_Store": b"\0\0\0\1Bud1",
    "__MACOSX/._scene.xml": b"\0\5\26\7",
    "textures/Thumbs.db": b"\0",
    "NOTES.txt": b"as in the film",
}
IGNORED = ("LICENSE", "README.md", "scene.blend", "models/Mesh000.mtl", "preview.psd")
ACCENTED = TEXTURED.replace("wood.png", "chêne.png")
PARTS = '<scene version="3.0.0"><include filename="parts/all.xml"/><include filename="camera.xml"/></scene>'

ENTRIES = [
    _bundle("plain", OUT, FILES),
    _bundle("one folder down", OUT, _in("my-room/", FILES), xml="my-room/scene.xml"),
    _bundle("another name", OUT, FILES, xml="living-room.xml"),
    _bundle("with what no scene needs", Loads(1, 2, "envmap", ignored=IGNORED), {**EXTRAS, **FILES}),
    _bundle("folders by backslashes", OUT, {name.replace("/", "\\"): data for name, data in FILES.items()}),
    _bundle(
        "backslashes in the scene", OUT, FILES, TEXTURED.replace("/Mesh", "\\Mesh").replace("textures/", "textures\\")
    ),
    _bundle(
        "other case",
        _told("'textures/Wood.PNG'", ALIKE, "'models/mesh000.OBJ'"),
        made("textures/sky.hdr", "textures/Wood.PNG", "models/mesh000.OBJ"),
    ),
    _bundle(
        "accents in two parts",
        _told(ALIKE),
        {**FILES, unicodedata.normalize("NFD", "textures/chêne.png"): FILES["textures/wood.png"]},
        ACCENTED,
    ),
    _bundle(
        "scene beside its parts",
        Loads(1, 2, "envmap"),
        {
            **_in("parts/", FILES),
            "parts/all.xml": TEXTURED.replace(CAMERA, "<path value='parts'/>").encode(),
            "camera.xml": f'<scene version="3.0.0">{CAMERA}</scene>'.encode(),
        },
        PARTS,
    ),
    _bundle(
        "a mesh of big endian",
        OUT,
        {**FILES, "models/Mesh000.ply": ply(">")},
        TEXTURED.replace('"obj"', '"ply"').replace("000.obj", "000.ply"),
    ),
    _bundle(
        "a scan with its notes",
        OUT,
        {**FILES, "models/Mesh000.ply": ply(extra="obj_info num_cols 512\n")},
        TEXTURED.replace('"obj"', '"ply"').replace("000.obj", "000.ply"),
    ),
    _bundle(
        "two scenes",
        Refused(("2 XML files", "scene.xml"), on_purpose=True),
        {**FILES, "b.xml": TEXTURED.encode()},
        xml="a.xml",
    ),
    _bundle("no scene", Refused(("no XML file",), on_purpose=True), FILES, xml="scene.xml.bak"),
    _bundle(
        "an image of another program",
        Refused(('<texture type="bitmap">', "line", "'textures/wood.webp'", "convert it")),
        {**FILES, "textures/wood.webp": b"RIFF"},
        TEXTURED.replace("wood.png", "wood.webp"),
    ),
    _bundle(
        "a texture forgotten",
        Refused(('<texture type="bitmap">', "line", "'textures/wood.png'", "not in the bundle")),
        made("textures/sky.hdr", "models/Mesh000.obj"),
    ),
    _bundle(
        "an archive inside",
        Refused(("'models.zip'", "put its files into the bundle"), on_purpose=True),
        {**FILES, "models.zip": b"PK\5\6" + bytes(18)},
    ),
    _bundle(
        "a file above the scene",
        Refused(('<shape type="obj">', "line", "outside the bundle")),
        FILES,
        TEXTURED.replace("models/", "../models/"),
    ),
]
