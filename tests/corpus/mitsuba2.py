"""Files of Mitsuba 2: today's names, and a few habits of before."""

from __future__ import annotations

from tests.corpus.entry import Entry, Loads, Refused
from tests.corpus.things import made

CAMERA = """
    <sensor type="perspective">
        <string name="fov_axis" value="smaller"/>
        <float name="near_clip" value="0.001"/>
        <float name="far_clip" value="100.0"/>
        <float name="focus_distance" value="1000"/>
        <float name="fov" value="39.3077"/>
        <transform name="to_world">
            <lookat origin="0, 0, 6"
                    target="0, 0, 0"
                    up    ="0, 1, 0"/>
        </transform>
        <sampler type="independent">  <!-- ldsampler -->
            <integer name="sample_count" value="16"/>
        </sampler>
        <film type="hdrfilm">
            <integer name="width" value="16"/>
            <integer name="height" value="12"/>
            <rfilter type="gaussian"/>
        </film>
    </sensor>
"""
INTEGRATOR = """
    <integrator type="path">
<!--    <integrator type="depth">-->
        <integer name="max_depth" value="6"/>
    </integrator>
"""
SAID = {"integrator": "path", "max_depth": 6, "samples": 16}


def _scene(*parts: str, version: str = "2.0.0", integrator: str = INTEGRATOR, camera: str = CAMERA) -> str:
    return f'<scene version="{version}">{integrator}{camera}{"".join(parts)}\n</scene>\n'


BOX = """
    <bsdf type="diffuse" id="white">
        <spectrum name="reflectance" value="400:0.343, 404:0.445, 500:0.74, 600:0.74, 700:0.737"/>
    </bsdf>
    <bsdf type="twosided" id="green">
        <bsdf type="diffuse"><rgb name="reflectance" value="0.105421, 0.37798, 0.076425"/></bsdf>
    </bsdf>
    <shape type="obj">
        <string name="filename" value="resources/luminaire.obj"/>
        <transform name="to_world"><translate x="0" y="-0.5" z="0"/></transform>
        <ref id="white"/>
        <emitter type="area"><spectrum name="radiance" value="400:0, 500:2, 600:3.9, 700:4.6"/></emitter>
    </shape>
    <shape type="ply" id="wall"><string name="filename" value="resources/wall.ply"/><ref id="green"/></shape>
"""
SHAPES = """
    <shape type="sphere">
        <point name="center" x="1" y="0" z="0"/>
        <float name="radius" value="0.5"/>
        <bsdf type="dielectric"><string name="int_ior" value="bk7"/><string name="ext_ior" value="air"/></bsdf>
    </shape>
    <shape type="cylinder">
        <point name="p0" value="0, 0, 0"/> <point name="p1" value="0, 1, 0"/>
        <float name="radius" value="0.1"/>
        <bsdf type="roughconductor">
            <string name="material" value="Au"/> <string name="distribution" value="ggx"/>
            <float name="alpha_u" value="0.05"/> <float name="alpha_v" value="0.3"/>
        </bsdf>
    </shape>
    <shape type="disk"><boolean name="flip_normals" value="true"/></shape>
    <emitter type="envmap"><string name="filename" value="museum.exr"/><float name="scale" value="1.5"/></emitter>
"""
TEXTURES = """
    <bsdf type="normalmap" id="bricks">
        <texture name="normalmap" type="bitmap">
            <boolean name="raw" value="true"/>
            <string name="filename" value="textures/normal.jpg"/>
        </texture>
        <bsdf type="roughplastic">
            <texture name="diffuse_reflectance" type="bitmap">
                <string name="filename" value="textures/bricks.jpg"/>
                <transform name="to_uv"><scale x="4" y="4"/></transform>
            </texture>
        </bsdf>
    </bsdf>
    <shape type="rectangle"><ref id="bricks"/></shape>
    <emitter type="spot">
        <transform name="to_world"><lookat origin="1, 1, 3" target="0, 0, 0"/></transform>
        <spectrum name="intensity" value="1.0"/>
        <float name="cutoff_angle" value="40"/>
        <texture type="bitmap" name="texture"><string name="filename" value="textures/bricks.jpg"/></texture>
    </emitter>
"""
STOKES = (
    '<integrator type="stokes"><integrator type="path"><integer name="max_depth" value="8"/></integrator></integrator>'
)
AOVS = """<integrator type="aov">
        <string name="aovs" value="dd.y:depth,nn:sh_normal"/>
        <integrator type="path" name="my_image"/>
    </integrator>"""
DIRECT = '<integrator type="direct"><integer name="emitter_samples" value="2"/></integrator>'
MOMENT = '<integrator type="moment"><integrator type="path" name="path"/></integrator>'
SMALL = '<shape type="cube"/><emitter type="constant"/>'
FOG = """
    <medium type="homogeneous" id="fog">
        <rgb name="albedo" value="0.99, 0.9, 0.96"/>
        <float name="sigma_t" value="0.5"/>
        <phase type="hg"><float name="g" value="0.7"/></phase>
    </medium>
    <shape type="cube"><bsdf type="null"/><ref name="interior" id="fog"/></shape>
    <emitter type="constant"/>
"""


def _advised(name: str, integrator: str, said: dict[str, object], *warnings: str) -> Entry:
    out = Loads(1, 12, "constant", warnings=warnings, defaults={**said, "samples": 16})
    return Entry(name, _scene(SMALL, integrator=integrator, version="2.2.1"), out)


ENTRIES = [
    Entry(
        "Cornell box",
        _scene(BOX),
        Loads(2, 4, "area", "diffuse twosided", defaults=SAID),
        made("resources/luminaire.obj", "resources/wall.ply"),
    ),
    Entry(
        "shapes without meshes",
        _scene(SHAPES, version="2.1.0"),
        Loads(3, 0, "envmap", "dielectric diffuse roughconductor", defaults=SAID),
        made("museum.exr"),
    ),
    Entry(
        "textures",
        _scene(TEXTURES, version="2.2.1"),
        Loads(1, 2, "spot", "normalmap roughplastic", defaults=SAID),
        made("textures/normal.jpg", "textures/bricks.jpg"),
    ),
    Entry(
        "fog",
        _scene(FOG),
        Loads(1, 12, "constant", "null", ("participating media",), defaults=SAID),
    ),
    Entry(
        "a film that names its file",
        _scene(SMALL, camera=CAMERA.replace('<rfilter type="gaussian"/>', '<string name="filename" value="out.jpg"/>')),
        Loads(1, 12, "constant", warnings=("left out",), defaults=SAID),
    ),
    Entry(
        "a film with a banner",
        _scene(SMALL, camera=CAMERA.replace("<rfilter", '<boolean name="banner" value="false"/><rfilter')),
        Loads(1, 12, "constant", warnings=("banner",), defaults=SAID),
    ),
    _advised("polarization", STOKES, {"integrator": "path", "max_depth": 8}, "'stokes'"),
    _advised("depth and normals", AOVS, {"integrator": "path"}, "'aov'"),
    _advised("moments", MOMENT, {"integrator": "path"}, "'moment'"),
    _advised("direct light", DIRECT, {"integrator": "direct"}),
    _advised(
        "strict normals",
        '<integrator type="path"><boolean name="strict_normals" value="true"/></integrator>',
        {"integrator": "path"},
    ),
    Entry(
        "a plugin's name in capitals",
        _scene(SMALL.replace('"cube"', '"Cube"')),
        Refused(('<shape type="Cube">', "line", "the plugin is not one that a scene may use")),
    ),
]
