"""Files written by hand and by scripts of lessons: what is not needed is left out, white space is where it likes."""

from __future__ import annotations

from tests.corpus.entry import Entry, Loads, Refused
from tests.corpus.things import made, obj

MITSUBAS_OWN = ((768, 576),)
NO_CAMERA = "no <sensor>"


def _scene(body: str, version: str = "3.0.0") -> str:
    return f'<scene version="{version}">\n{body}\n</scene>'


CAMERA = """
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0 0 6" target="0 0 0" up="0 1 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="12"/></film>
  </sensor>"""
NO_COMMAS = """
  <integrator type="path"> <integer name="max_depth" value=" 8 "/> </integrator>
  <shape type="sphere">
    <point   name = "center"   value = "0  0.5   0" />
    <float name="radius" value=" .5"/>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.2  0.25   0.7"/></bsdf>
  </shape>
  <emitter type="point"><point name="position" value="1.0, 2, +3."/><rgb name="intensity" value="5e0"/></emitter>
"""
TRANSFORMS = """
  <shape type="cube">
    <transform name="to_world">
      <scale value="0.5"/> <scale x="2"/> <scale value="1, 2, 3"/>
      <rotate y="1" angle="45"/> <rotate value="0, 0, 1" angle="-30"/>
      <translate x="1"/> <translate value="0 0 -1"/>
      <matrix value="1 0 0  0 1 0  0 0 1"/>
    </transform>
  </shape>
  <shape type="rectangle"><transform name="to_world"/></shape>
  <emitter type="constant"/>
"""
EVERYWHERE = """
  Here is my camera:
  <!-- <sensor type="thinlens"> -->
  <bsdf type='diffuse' id='a'/>
  <shape type='rectangle'
         id="it's mine &amp; &quot;yours&quot;"
  ><ref id='a'/></shape
  ><emitter type="constant"></emitter>
"""
STRINGS = """
  <shape type="obj">
    <string name="filename" value="bunny.obj"/>
    <boolean name="face_normals" value="True"/>
    <boolean name="flip_tex_coords" value="false"/>
  </shape>
  <emitter type="area" id="lamp"><rgb name="radiance" value="1"/></emitter>
  <shape type="rectangle"><ref id="lamp"/></shape>
"""
NUMBERS = """
  <default name="radius" value="0.25"/>
  <default name="radius_of_the_big_one" value="2"/>
  <shape type="sphere"><float name="radius" value="$radius"/></shape>
  <shape type="sphere"><float name="radius" value="$radius_of_the_big_one"/></shape>
  <emitter type="constant"><float name="radiance" value="0.5"/></emitter>
"""
SHARED = """
  <bsdf type="diffuse" id="wall"/>
  <shape type="rectangle"><bsdf type="diffuse" id="wall"/></shape>
  <emitter type="constant"/>
"""
FIRST = '<shape type="obj">\n  <string name="filename" value="dragon.obj"/>\n</shape>'
FLAT = """
  <shape type="obj"><string name="filename" value="bunny.obj"/>
    <transform name="to_world"><scale x="1" y="1" z="0"/></transform></shape>
  <emitter type="constant"/>
"""
SQUARE = '<shape type="rectangle"/><emitter type="constant"/>'

ENTRIES = [
    Entry(
        "the manual's first scene",
        _scene(FIRST),
        Loads(1, 2, "", warnings=(NO_CAMERA, "no emitters"), sizes=MITSUBAS_OWN),
        made("dragon.obj"),
    ),
    Entry(
        "a sphere and nothing else",
        _scene('<shape type="sphere"><float name="radius" value="10"/></shape>', "2.0.0"),
        Loads(1, 0, "", warnings=(NO_CAMERA, "no emitters"), sizes=MITSUBAS_OWN),
    ),
    Entry(
        "points without commas",
        _scene(CAMERA + NO_COMMAS),
        Loads(1, 0, "point", defaults={"integrator": "path", "max_depth": 8}),
    ),
    Entry("transformations", _scene(CAMERA + TRANSFORMS), Loads(2, 14, "constant")),
    Entry("text, quotes and comments", _scene(CAMERA + EVERYWHERE), Loads(1, 2, "constant")),
    Entry("words and shared lamps", _scene(CAMERA + STRINGS), Loads(2, 4, "area"), made("bunny.obj")),
    Entry(
        "parameters whose names begin alike",
        _scene(CAMERA + NUMBERS),
        Loads(2, 0, "constant", parameters={"radius": "0.25", "radius_of_the_big_one": "2"}),
    ),
    Entry("no emitter", _scene(CAMERA + '<shape type="cube"/>'), Loads(1, 12, "", warnings=("no emitters",))),
    Entry("no shape", _scene(CAMERA + '<emitter type="constant"/>'), Loads(0, 0, "constant", "", ("no shapes",))),
    Entry(
        "polygons in a mesh",
        _scene(CAMERA + STRINGS),
        Loads(2, 4, "area"),
        {"bunny.obj": obj("f 1/1 2/2 3/3 4/4\n")},
    ),
    Entry(
        "the same id twice",
        _scene(CAMERA + SHARED),
        Refused(('<bsdf type="diffuse">', "line 8", "'wall'", "rename one")),
    ),
    Entry(
        "a parameter without a value",
        _scene(CAMERA + '<shape type="sphere"><float name="radius" value="$size"/></shape>'),
        Refused(("<float>", "line", "'$size'", "<default>")),
    ),
    Entry(
        "a parameter that is not there",
        _scene(CAMERA + NUMBERS),
        Refused(("no parameter 'spp'", "radius")),
        defines={"spp": "16"},
    ),
    Entry(
        "nothing has this id",
        _scene(CAMERA + '<shape type="cube"><ref id="gold"/></shape>'),
        Refused(("<ref>", "line", "'gold'", "does not exist")),
    ),
    Entry(
        "a word for a number",
        _scene(
            CAMERA + SQUARE.replace("<shape", '<shape type="sphere"><float name="radius" value="big"/></shape><shape')
        ),
        Refused(("<float>", "line", "not a number")),
    ),
    Entry(
        "an element of another format",
        _scene(CAMERA + SQUARE + "<camera/>"),
        Refused(("<camera>", "line", "not an element")),
    ),
    Entry("no version", f"<scene>{CAMERA}{SQUARE}</scene>", Refused(("<scene>", 'version="3.0.0"'))),
    Entry(
        "a mesh scaled flat",
        _scene(CAMERA + FLAT),
        Refused(('<shape type="obj">', "line", "'to_world'")),
        made("bunny.obj"),
    ),
    Entry(
        "a file of the whole machine",
        _scene(CAMERA + STRINGS.replace("bunny.obj", "/home/me/bunny.obj")),
        Refused(('<shape type="obj">', "line", "outside", "--root")),
    ),
]
