"""Files of Mitsuba 3.0 to 3.9: search paths, included parts, aliases, several cameras, skies, volumes."""

from __future__ import annotations

import gzip

from tests.corpus.entry import Entry, Loads, Refused
from tests.corpus.things import made, ply


def _camera(width: int = 16, height: int = 12, kind: str = "perspective", more: str = "") -> str:
    return f"""
    <sensor type="{kind}">
        {more}
        <transform name="to_world"><lookat origin="0, 0, 6" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="{width}"/><integer name="height" value="{height}"/></film>
    </sensor>"""


CAMERA = _camera()
LIGHT = '<emitter type="constant"/>'


def _scene(*parts: str, version: str = "3.0.0", camera: str = CAMERA) -> str:
    return f'<scene version="{version}">{camera}{"".join(parts)}\n</scene>\n'


BALL = """
    <default name="material" value="gold"/>
    <default name="illuminant" value="d65"/>
    <default name="spp" value="64"/>
    <path value="assets"/>
    <include filename="fragments/render.xml"/>
    <include filename="materials/$material.xml"/>
    <include filename="fragments/geometry.xml"/>
    <include filename="illuminants/$illuminant.xml"/>
"""
BALL_PARTS = {
    "fragments/render.xml": f"""<scene version="3.0.0">
        <integrator type="path"><integer name="max_depth" value="32"/></integrator>
        {_camera(more='<sampler type="multijitter"><integer name="sample_count" value="$spp"/></sampler>')}
    </scene>""".encode(),
    "materials/gold.xml": b"""<?xml version="1.0"?>
        <bsdf type="roughconductor" version="3.0.0" id="gold"><string name="material" value="Au"/></bsdf>""",
    "materials/glass.xml": b'<bsdf type="dielectric" version="3.0.0" id="glass"/>',
    "fragments/geometry.xml": b"""<scene version="3.0.0">
        <alias id="$material" as="shell"/>
        <shape type="ply"><string name="filename" value="ball.ply"/><ref id="shell"/></shape>
    </scene>""",
    "illuminants/d65.xml": b"""<scene version="3.0.0">
        <emitter type="constant">
            <spectrum type="d65" name="radiance"><float name="scale" value="2"/></spectrum>
        </emitter>
    </scene>""",
    "illuminants/a.xml": b'<scene version="3.0.0"><emitter type="constant"/></scene>',
}
BALL_FILES = {**made("assets/ball.ply"), **BALL_PARTS}
BALL_SAID = {"integrator": "path", "max_depth": 32, "samples": 64}
PLANTS = """
    <shape type="shapegroup" id="plant">
        <shape type="obj"><string name="filename" value="plant.obj"/></shape>
        <shape type="sphere"><transform name="to_world"><scale value="0.2"/></transform></shape>
    </shape>
    <shape type="instance"><ref id="plant"/><transform name="to_world"><translate x="-2"/></transform></shape>
    <shape type="instance"><ref id="plant"/><transform name="to_world"><rotate y="1" angle="40"/></transform></shape>
"""
SKY = """
    <emitter type="sunsky">
        <float name="turbidity" value="4"/>
        <rgb name="albedo" value="0.3, 0.3, 0.3"/>
        <integer name="year" value="2025"/> <integer name="month" value="6"/> <float name="hour" value="10.5"/>
        <transform name="to_world"><rotate x="1" angle="-90"/></transform>
    </emitter>
    <shape type="cube"/>
"""
CLOUD = """
    <integrator type="volpathmis">
        <integer name="max_depth" value="100"/><integer name="rr_depth" value="1000"/>
    </integrator>
    <medium type="heterogeneous" id="cloud">
        <volume name="sigma_t" type="gridvolume">
            <string name="filename" value="cloud.vol"/>
            <transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/></transform>
        </volume>
        <volume name="albedo" type="constvolume"><rgb name="value" value="0.9, 0.8, 0.7"/></volume>
        <float name="scale" value="20"/>
    </medium>
    <shape type="cube"><bsdf type="null"/><ref name="interior" id="cloud"/></shape>
"""
SPECTRA = """
    <shape type="cube"><bsdf type="diffuse"><spectrum name="reflectance" filename="paint.spd"/></bsdf></shape>
    <shape type="rectangle">
        <emitter type="area">
            <spectrum type="blackbody" name="radiance"><float name="temperature" value="5000"/></spectrum>
        </emitter>
        <bsdf type="principled">
            <rgb name="base_color" value="0.8, 0.2, 0.1"/>
            <texture type="checkerboard" name="roughness"><float name="color0" value="0.2"/></texture>
            <float name="clearcoat" value="1"/> <float name="spec_trans" value="0.2"/> <float name="eta" value="1.4"/>
        </bsdf>
    </shape>
    <shape type="sphere"><bsdf type="diffuse"><spectrum type="irregular" name="reflectance">
        <string name="wavelengths" value="400, 500, 600, 700"/><string name="values" value="0.1, 0.2, 0.3, 0.4"/>
    </spectrum></bsdf></shape>
"""
PROJECTOR = """
    <emitter type="projector">
        <texture type="bitmap" name="irradiance"><string name="filename" value="slide.bmp"/></texture>
        <float name="fov" value="30"/>
        <transform name="to_world"><lookat origin="0, 0, 5" target="0, 0, 0" up="0, 1, 0"/></transform>
    </emitter>
    <shape type="bsplinecurve"><string name="filename" value="hair.txt"/><bsdf type="hair"/></shape>
    <shape type="linearcurve"><string name="filename" value="hair.txt"/></shape>
"""
LENS = '<float name="aperture_radius" value="0.1"/><float name="focus_distance" value="6"/>'
FORMATS = """<film type="hdrfilm">
        <integer name="width" value="20"/> <integer name="height" value="10"/>
        <integer name="crop_offset_x" value="2"/> <integer name="crop_offset_y" value="3"/>
        <integer name="crop_width" value="16"/> <integer name="crop_height" value="6"/>
        <string name="pixel_format" value="rgba"/> <string name="component_format" value="float32"/>
        <rfilter type="mitchell"/>
    </film>"""
CROPPED = CAMERA[: CAMERA.index("<film")] + FORMATS + "</sensor>"
SHARED_FILM = CAMERA[: CAMERA.index("<film")] + '<ref id="film"/></sensor>'
FILM = '<film type="hdrfilm" id="film"><integer name="width" value="8"/><integer name="height" value="4"/></film>'
CUBE = '<shape type="cube"/>'
MERGED = """
    <shape type="merge"><shape type="cube"/><shape type="rectangle"/></shape>
"""

MEASURED = """
    <shape type="cube">
        <bsdf type="twosided">
            <bsdf type="measured"><string name="filename" value="materials/vinyl_rgb.bsdf"/></bsdf>
        </bsdf>
    </shape>
"""

ENTRIES = [
    Entry(
        "in parts",
        f'<scene version="3.0.0">{BALL}</scene>',
        Loads(
            1,
            2,
            "constant",
            "roughconductor",
            defaults=BALL_SAID,
            parameters={"material": "gold", "illuminant": "d65", "spp": "64"},
        ),
        BALL_FILES,
    ),
    Entry(
        "in parts, others set",
        f'<scene version="3.0.0">{BALL}</scene>',
        Loads(
            1,
            2,
            "constant",
            "dielectric",
            defaults=BALL_SAID,
            parameters={"material": "glass", "illuminant": "a", "spp": "64"},
        ),
        BALL_FILES,
        defines={"material": "glass", "illuminant": "a"},
    ),
    Entry(
        "in parts, one missing",
        f'<scene version="3.0.0">{BALL}</scene>',
        Refused(("<include>", "line", "'materials/tin.xml'", "not there")),
        BALL_FILES,
        defines={"material": "tin"},
    ),
    Entry("instances", _scene(PLANTS, LIGHT, version="3.5.2"), Loads(5, 2, "constant"), made("plant.obj")),
    Entry("sun and sky", _scene(SKY, version="3.6.0"), Loads(1, 12, "sunsky")),
    Entry(
        "cloud",
        _scene(CLOUD, LIGHT),
        Loads(
            1,
            12,
            "constant",
            "null",
            ("participating media",),
            defaults={"integrator": "volpathmis", "max_depth": 100, "rr_depth": 256},
        ),
        made("cloud.vol"),
    ),
    Entry(
        "a measured material",
        _scene(MEASURED, LIGHT),
        Loads(1, 12, "constant", "measured twosided"),
        made("materials/vinyl_rgb.bsdf"),
    ),
    Entry(
        "a mesh that is packed",
        _scene('<shape type="ply"><string name="filename" value="lucy.ply.gz"/></shape>', LIGHT),
        Refused(('<shape type="ply">', "line", "'lucy.ply.gz' is packed by gzip", "unpack it")),
        {"lucy.ply.gz": gzip.compress(ply())},
    ),
    Entry("spectra", _scene(SPECTRA), Loads(3, 14, "area", "diffuse principled"), made("paint.spd")),
    Entry(
        "projector and hair", _scene(PROJECTOR), Loads(2, 0, "projector", "diffuse hair"), made("slide.bmp", "hair.txt")
    ),
    Entry(
        "three cameras",
        _scene(CUBE, LIGHT, camera=CAMERA + _camera(8, 8, "thinlens", LENS) + _camera(4, 6, "orthographic")),
        Loads(1, 12, "constant", sizes=((16, 12), (8, 8), (4, 6))),
    ),
    Entry("a window of a film", _scene(CUBE, LIGHT, camera=CROPPED), Loads(1, 12, "constant", sizes=((16, 6),))),
    Entry(
        "a film that two cameras share",
        _scene(FILM, CUBE, LIGHT, camera=SHARED_FILM * 2),
        Loads(1, 12, "constant", sizes=((8, 4), (8, 4))),
    ),
    Entry(
        "a camera without a film",
        _scene(CUBE, LIGHT, camera='<sensor type="perspective"/>'),
        Loads(1, 12, "constant", sizes=((768, 576),)),
    ),
    Entry(
        "shapes merged in the file",
        _scene(MERGED, LIGHT),
        Loads(2, 14, "constant"),
    ),
    Entry(
        "a parameter that is wrong",
        _scene('<shape type="sphere"><float name="raduis" value="2"/></shape>', LIGHT),
        Refused(('<shape type="sphere">', "line", "'raduis'")),
    ),
    Entry(
        "a number for a text",
        _scene('<shape type="sphere"><string name="radius" value="2"/></shape>', LIGHT),
        Refused(('<shape type="sphere">', "line", "'radius'", "float", "not string")),
    ),
    Entry(
        "two skies",
        _scene(CUBE, LIGHT, LIGHT),
        Refused(("<scene>", "line")),
    ),
    Entry(
        "motion",
        _scene(CUBE, LIGHT, '<shape type="cube"><animation name="to_world"><transform time="0"/></animation></shape>'),
        Refused(("<animation>", "line", "not an element")),
    ),
]
