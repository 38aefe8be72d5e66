"""Files as Tungsten's converter to Mitsuba writes them, and as they were converted again to version 3."""

from __future__ import annotations

from tests.corpus.entry import Entry, Loads, Refused
from tests.corpus.things import made

OLD_HEAD = """<?xml version="1.0" encoding="utf-8"?>

<scene version="0.5.0" >
	<integrator type="path" >
		<integer name="maxDepth" value="65" />
		<boolean name="strictNormals" value="true" />
	</integrator>
	<sensor type="perspective" >
		<float name="fov" value="35" />
		<transform name="toWorld" >
			<matrix value="-1 -7.54979e-008 -8.74228e-008 0 0 1 0 0.5 8.74228e-008 0 -1 6 0 0 0 1"/>
		</transform>
		<sampler type="sobol" >
			<integer name="sampleCount" value="64" />
		</sampler>
		<film type="ldrfilm" >
			<integer name="width" value="16" />
			<integer name="height" value="12" />
			<string name="fileFormat" value="png" />
			<string name="pixelFormat" value="rgb" />
			<float name="gamma" value="2.2" />
			<boolean name="banner" value="false" />
			<rfilter type="tent" />
		</film>
	</sensor>
"""
NEW_HEAD = """<scene version="3.0.0">
	<default name="integrator" value="path" />
	<default name="spp" value="64" />
	<default name="resx" value="16" />
	<default name="resy" value="12" />
	<default name="max_depth" value="65" />
	<integrator type='$integrator'>
		<integer name="max_depth" value="$max_depth" />
	</integrator>
	<sensor type="perspective">
		<float name="fov" value="35" />
		<transform name="to_world">
			<matrix value="-1 -7.54979e-008 -8.74228e-008 0 0 1 0 0.5 8.74228e-008 0 -1 6 0 0 0 1" />
		</transform>
		<sampler type="independent">
			<integer name="sample_count" value="$spp" />
		</sampler>
		<film type="hdrfilm">
			<integer name="width" value="$resx" />
			<integer name="height" value="$resy" />
			<string name="file_format" value="openexr" />
			<string name="pixel_format" value="rgb" />
			<rfilter type="tent" />
		</film>
	</sensor>
"""
FLOOR = """
	<bsdf type="twosided" id="Floor" >
		<bsdf type="diffuse" >
			<texture name="reflectance" type="checkerboard" >
				<rgb name="color1" value="0.325, 0.31, 0.25"/>
				<rgb name="color0" value="0.725, 0.71, 0.68"/>
				<float name="uoffset" value="0" />
				<float name="voffset" value="0" />
				<float name="uscale" value="10" />
				<float name="vscale" value="10" />
			</texture>
		</bsdf>
	</bsdf>
	<shape type="rectangle" >
		<transform name="toWorld" >
			<matrix value="-4.37114e-008 1 4.37114e-008 0 0 -8.74228e-008 2 0 1 4.37114e-008 1.91069e-015 0 0 0 0 1"/>
		</transform>
		<ref id="Floor" />
	</shape>
"""
MODEL = """
	<shape type="obj" >
		<string name="filename" value="models/Mesh001.obj" />
		<transform name="toWorld" >
			<matrix value="0.482906 0 0 0.0571719 0 0.482906 0 0.213656 0 0 0.482906 0.0682078 0 0 0 1"/>
		</transform>
		<ref id="Paint" />
	</shape>
"""
LAMP = """
	<shape type="rectangle" >
		<transform name="toWorld" >
			<matrix value="0.235 -1.66103e-008 -7.80685e-009 -0.005 -2.05444e-008 3.90343e-009 -0.0893
					1.98 2.05444e-008 0.19 8.30516e-009 -0.03 0 0 0 1"/>
		</transform>
		<bsdf type="twosided" ><bsdf type="diffuse" ><rgb name="reflectance" value="0, 0, 0"/></bsdf></bsdf>
		<emitter type="area" >
			<rgb name="radiance" value="17, 12, 4"/>
		</emitter>
	</shape>
"""
GOLD = """
	<bsdf type="twosided" id="Paint" >
		<bsdf type="roughconductor" >
			<float name="alpha" value="0.1" />
			<string name="distribution" value="ggx" />
			<float name="extEta" value="1" />
			<rgb name="specularReflectance" value="1, 1, 1"/>
			<rgb name="eta" value="0.143119, 0.374957, 1.44248"/>
			<rgb name="k" value="3.98316, 2.38572, 1.60322"/>
		</bsdf>
	</bsdf>
"""
PLASTIC = """
	<bsdf type="twosided" id="Paint" >
		<bsdf type="roughplastic" >
			<float name="alpha" value="0.1" />
			<string name="distribution" value="ggx" />
			<float name="intIOR" value="1.5" />
			<float name="extIOR" value="1" />
			<boolean name="nonlinear" value="true" />
			<texture name="diffuseReflectance" type="bitmap" >
				<string name="filename" value="textures/wood.tga" />
				<string name="filterType" value="trilinear" />
			</texture>
		</bsdf>
	</bsdf>
"""
COAT = """
	<bsdf type="twosided" id="Paint" >
		<bsdf type="coating" >
			<float name="intIOR" value="1.7" />
			<float name="extIOR" value="1" />
			<float name="thickness" value="5" />
			<rgb name="sigmaA" value="{absorbed}"/>
			<bsdf type="roughconductor" ><float name="alpha" value="0" /></bsdf>
		</bsdf>
	</bsdf>
"""
BUMPS = """
	<bsdf type="bumpmap" id="Paint" >
		<texture name="map" type="bitmap" >
			<string name="filename" value="textures/bump.png" />
		</texture>
		<bsdf type="mask" >
			<texture name="opacity" type="bitmap" ><string name="filename" value="textures/leaf.png" /></texture>
			<bsdf type="twosided" ><bsdf type="diffuse" ><rgb name="reflectance" value="0.1, 0.4, 0.1"/></bsdf></bsdf>
		</bsdf>
	</bsdf>
"""
ENVMAP = """
	<emitter type="envmap" >
		<transform name="toWorld" >
			<matrix value="-0.922278 0 0.386527 0 0 1 0 0 -0.386527 0 -0.922278 1.17369 0 0 0 1"/>
		</transform>
		<string name="filename" value="textures/envmap.hdr" />
	</emitter>
"""
KITCHEN = """
	<emitter type="sunsky" >
		<transform name="toWorld" ><rotate y="1" angle="90" /></transform>
		<float name="hour" value="9" />
		<float name="turbidity" value="5" />
		<float name="sunRadiusScale" value="4" />
	</emitter>
"""
OLD_WORDS = ("'sobol'", "'ldrfilm'", "left out")
OLD_SAID = {"integrator": "path", "max_depth": 65, "samples": 64}
NEW_SET = {"integrator": "path", "spp": "64", "resx": "16", "resy": "12", "max_depth": "65"}
WOOD = made("models/Mesh001.obj", "textures/wood.tga", "textures/envmap.hdr", "textures/bump.png", "textures/leaf.png")


def _old(*parts: str) -> str:
    return OLD_HEAD + "".join(parts) + "</scene>\n"


def _new(*parts: str) -> str:
    names = {"toWorld": "to_world", "specularReflectance": "specular_reflectance", "intIOR": "int_ior"}
    names |= {"extIOR": "ext_ior", "diffuseReflectance": "diffuse_reflectance", "filterType": "filter_type"}
    names |= {"trilinear": "bilinear", '<float name="extEta" value="1" />': ""}
    text = "".join(parts)
    for old, new in names.items():
        text = text.replace(old, new)
    return NEW_HEAD + text + "</scene>\n"


ENTRIES = [
    Entry(
        "0.5, gold",
        _old(GOLD, MODEL, LAMP, FLOOR),
        Loads(3, 6, "area", "diffuse roughconductor twosided", OLD_WORDS, defaults=OLD_SAID),
        WOOD,
    ),
    Entry(
        "0.5, plastic and a sky",
        _old(PLASTIC, MODEL, ENVMAP),
        Loads(1, 2, "envmap", "roughplastic twosided", OLD_WORDS, defaults=OLD_SAID),
        WOOD,
    ),
    Entry(
        "0.5, bumps and leaves",
        _old(BUMPS, MODEL, LAMP),
        Loads(2, 4, "area", "bumpmap diffuse mask twosided", OLD_WORDS, defaults=OLD_SAID),
        WOOD,
    ),
    Entry(
        "0.5, a clear coat",
        _old(COAT.format(absorbed="0, 0, 0"), MODEL, LAMP),
        Loads(
            2,
            4,
            "area",
            "blendbsdf conductor diffuse roughconductor twosided",
            (*OLD_WORDS, "'coating'"),
            defaults=OLD_SAID,
        ),
        WOOD,
    ),
    Entry(
        "0.5, a coat that absorbs",
        _old(COAT.format(absorbed="0.1, 0.2, 0.5"), MODEL, LAMP),
        Refused(('<bsdf type="coating">', "line", "absorbs", "'plastic'")),
        WOOD,
    ),
    Entry(
        "0.5, sun and sky",
        _old(GOLD, MODEL, KITCHEN),
        Loads(1, 2, "sunsky", "roughconductor twosided", (*OLD_WORDS, "'sunsky'"), defaults=OLD_SAID),
        WOOD,
    ),
    Entry(
        "3.0, gold",
        _new(GOLD, MODEL, LAMP),
        Loads(2, 4, "area", "diffuse roughconductor twosided", defaults=OLD_SAID, parameters=NEW_SET),
        WOOD,
    ),
    Entry(
        "3.0, plastic and a sky",
        _new(PLASTIC, MODEL, ENVMAP),
        Loads(1, 2, "envmap", "roughplastic twosided", defaults=OLD_SAID, parameters=NEW_SET),
        WOOD,
    ),
    Entry(
        "3.0, another integrator set",
        _new(GOLD, MODEL, LAMP),
        Loads(
            2,
            4,
            "area",
            "diffuse roughconductor twosided",
            ("not known",),
            defaults={"samples": 64},
            parameters={**NEW_SET, "integrator": "guided"},
        ),
        WOOD,
        defines={"integrator": "guided"},
    ),
]
