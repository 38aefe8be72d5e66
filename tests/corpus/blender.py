"""Files as Blender's add-on writes them: version 2.1.0 or 3.0.0, names on every object, meshes in a folder."""

from __future__ import annotations

from tests.corpus.entry import Entry, Loads, Refused
from tests.corpus.things import made, picture, ply

CAMERA = """
	<sensor type="perspective" id="Camera" name="Camera">
		<string name="fov_axis" value="x"/>
		<float name="fov" value="39.597755"/>
		<float name="principal_point_offset_x" value="0.000000"/>
		<float name="principal_point_offset_y" value="-0.000000"/>
		<float name="near_clip" value="0.100000"/>
		<float name="far_clip" value="100.000000"/>
		<transform name="to_world">
			<matrix value="-1 0 0 0 0 1 0 0 0 0 -1 6 0 0 0 1"/>
		</transform>
		<sampler type="independent" name="sampler">
			<integer name="sample_count" value="$spp"/>
		</sampler>
		<film type="hdrfilm" name="film">
			<integer name="width" value="$resx"/>
			<integer name="height" value="$resy"/>
			<rfilter type="box" name="rfilter"/>
		</film>
	</sensor>
"""
DEFAULTS = """
<!-- Defaults, these can be set via the command line: -Darg=value -->
	<default name="spp" value="128"/>
	<default name="resx" value="16"/>
	<default name="resy" value="12"/>
"""
ADVICE = """
<!-- Camera and Rendering Parameters -->
	<integrator type="path" id="elm__0" name="elm__0">
		<integer name="max_depth" value="12"/>
	</integrator>
"""
MATERIAL = """
	<bsdf type="twosided" id="mat-Material" name="mat-Material">
		<bsdf type="principled" name="bsdf">
			<rgb value="0.800000 0.800000 0.800000" name="base_color"/>
			<float name="spec_tint" value="0.000000"/>
			<float name="spec_trans" value="0.000000"/>
			<float name="metallic" value="0.000000"/>
			<float name="anisotropic" value="0.000000"/>
			<float name="roughness" value="0.400000"/>
			<float name="sheen" value="0.000000"/>
			<float name="sheen_tint" value="0.500000"/>
			<float name="clearcoat" value="0.000000"/>
			<float name="clearcoat_gloss" value="0.970000"/>
			<float name="specular" value="0.500000"/>
		</bsdf>
	</bsdf>
"""
CUBE = """
	<shape type="ply" id="mesh-Cube" name="mesh-Cube">
		<string name="filename" value="meshes/Cube.ply"/>
		<boolean name="face_normals" value="true"/>
		<ref id="mat-Material" name="bsdf"/>
	</shape>
"""
LAMP = """
	<emitter type="point" id="emit-Light" name="emit-Light">
		<point name="position" x="4.076245" y="1.005454" z="5.903862"/>
		<rgb value="79.577469 79.577469 79.577469" name="intensity"/>
	</emitter>
"""
MESH = made("meshes/Cube.ply")
SAID = {"integrator": "path", "max_depth": 12, "samples": 128}
SET = {"spp": "128", "resx": "16", "resy": "12"}


def _scene(body: str, version: str = "3.0.0") -> str:
    return f'<scene version="{version}">{DEFAULTS}{ADVICE}{CAMERA}{body}\n<!-- Volumes -->\n\n</scene>\n'


def _loads(triangles: int = 2, shapes: int = 1, **others: object) -> Loads:
    usual = {"emitters": "point", "bsdfs": "principled twosided", "defaults": SAID, "parameters": SET}
    return Loads(shapes, triangles, **{**usual, **others})  # type: ignore[arg-type]


WORLD = """
	<emitter type="envmap" id="World" name="World">
		<string name="filename" value="textures/studio.exr"/>
		<float name="scale" value="1.000000"/>
		<transform name="to_world">
			<matrix value="0 0 1 0 1 0 0 0 0 1 0 0 0 0 0 1"/>
		</transform>
	</emitter>
"""
AREA = """
	<shape type="rectangle" id="emit-Area" name="emit-Area">
		<transform name="to_world">
			<matrix value="0.5 0 0 0 0 -0.5 0 0 0 0 -0.5 3 0 0 0 1"/>
		</transform>
		<emitter type="area" name="emitter">
			<rgb value="31.830988 31.830988 31.830988" name="radiance"/>
		</emitter>
		<bsdf type="null" name="bsdf"/>
	</shape>
"""
SUN = """
	<emitter type="directional" id="emit-Sun" name="emit-Sun">
		<rgb value="3.141593 3.141593 3.141593" name="irradiance"/>
		<transform name="to_world">
			<rotate x="1" angle="10.5"/>
			<rotate y="1" angle="-170.0"/>
			<translate value="1.0 2.0 3.0"/>
		</transform>
	</emitter>
	<emitter type="spot" id="emit-Spot" name="emit-Spot">
		<rgb value="10 10 10" name="intensity"/>
		<float name="cutoff_angle" value="22.5"/>
		<float name="beam_width" value="19.1"/>
		<transform name="to_world"><lookat origin="0 0 4" target="0 0 0" up="0 1 0"/></transform>
	</emitter>
"""
TEXTURED = """
	<bsdf type="twosided" id="mat-Wood.001" name="mat-Wood.001">
		<bsdf type="principled" name="bsdf">
			<texture type="bitmap" name="base_color">
				<string name="filename" value="textures/wood floor.png"/>
				<string name="filter_type" value="bilinear"/>
				<string name="wrap_mode" value="repeat"/>
				<transform name="to_uv"><scale x="2" y="2" z="1"/></transform>
			</texture>
			<texture type="bitmap" name="roughness">
				<string name="filename" value="textures/rough.jpg"/>
				<boolean name="raw" value="true"/>
			</texture>
		</bsdf>
	</bsdf>
	<shape type="ply" id="mesh-Cube" name="mesh-Cube">
		<string name="filename" value="meshes/Cube.ply"/>
		<ref id="mat-Wood.001" name="bsdf"/>
	</shape>
"""
KINDS = """
	<bsdf type="dielectric" id="mat-Glass" name="mat-Glass"><float name="int_ior" value="1.450000"/></bsdf>
	<bsdf type="mask" id="mat-Leaf" name="mat-Leaf">
		<float name="opacity" value="0.700000"/>
		<bsdf type="twosided" name="bsdf"><bsdf type="diffuse" name="bsdf"/></bsdf>
	</bsdf>
	<bsdf type="blendbsdf" id="mat-Mix" name="mat-Mix">
		<float name="weight" value="0.500000"/>
		<ref id="mat-Glass" name="bsdf1"/>
		<bsdf type="roughconductor" name="bsdf2">
			<string name="distribution" value="ggx"/>
			<float name="alpha" value="0.040000"/>
			<rgb value="0.9 0.8 0.7" name="specular_reflectance"/>
		</bsdf>
	</bsdf>
	<shape type="sphere" id="a" name="a"><ref id="mat-Glass" name="bsdf"/></shape>
	<shape type="cube" id="b" name="b"><ref id="mat-Leaf" name="bsdf"/></shape>
	<shape type="disk" id="c" name="c"><ref id="mat-Mix" name="bsdf"/></shape>
"""
PARTS = """<scene version="2.1.0">
	<default name="spp" value="128"/>
	<default name="resx" value="16"/>
	<default name="resy" value="12"/>
	<path value="."/>
	<include filename="fragments/untitled-render.xml"/>
	<include filename="fragments/untitled-geometry.xml"/>
</scene>
"""
FRAGMENTS = {
    "fragments/untitled-render.xml": f'<scene version="2.1.0">{ADVICE}{CAMERA}</scene>'.encode(),
    "fragments/untitled-geometry.xml": f'<scene version="2.1.0">{MATERIAL}{LAMP}{CUBE}</scene>'.encode(),
}
UNSUPPORTED = """
	<!-- The exporter puts this where it cannot convert a material -->
	<bsdf type="diffuse" id="empty-emitter-bsdf" name="empty-emitter-bsdf">
		<rgb value="0 0 0" name="reflectance"/>
	</bsdf>
	<shape type="ply" id="mesh-Lamp" name="mesh-Lamp">
		<string name="filename" value="meshes/Cube.ply"/>
		<emitter type="area" name="emitter"><rgb value="5 5 5" name="radiance"/></emitter>
		<ref id="empty-emitter-bsdf" name="bsdf"/>
	</shape>
"""

ENTRIES = [
    Entry("default cube, 3.0.0", _scene(MATERIAL + LAMP + CUBE), _loads(), MESH),
    Entry("default cube, 2.1.0", _scene(MATERIAL + LAMP + CUBE, "2.1.0"), _loads(), MESH),
    Entry(
        "parameters set",
        _scene(MATERIAL + LAMP + CUBE),
        _loads(
            sizes=((32, 24),),
            defaults={**SAID, "samples": 4},
            parameters={"spp": "4", "resx": "32", "resy": "24"},
        ),
        MESH,
        defines={"spp": "4", "resx": "32", "resy": "24"},
    ),
    Entry(
        "world and area lamp",
        _scene(MATERIAL + WORLD + AREA + CUBE),
        _loads(4, 2, emitters="area envmap", bsdfs="null principled twosided"),
        {**MESH, **made("textures/studio.exr")},
    ),
    Entry("sun and spot", _scene(MATERIAL + SUN + CUBE, "2.1.0"), _loads(emitters="directional spot"), MESH),
    Entry(
        "textured, with a space in the name",
        _scene(TEXTURED + LAMP),
        _loads(),
        {**MESH, "textures/wood floor.png": picture("PNG"), "textures/rough.jpg": picture("JPEG")},
    ),
    Entry(
        "kinds of materials",
        _scene(KINDS + LAMP),
        _loads(12, 3, bsdfs="blendbsdf dielectric diffuse mask roughconductor twosided"),
    ),
    Entry("emitter mesh", _scene(UNSUPPORTED), _loads(emitters="area", bsdfs="diffuse"), MESH),
    Entry("in fragments", PARTS, _loads(), {**MESH, **FRAGMENTS}),
    Entry(
        "names with spaces and accents",
        _scene(
            MATERIAL + LAMP + CUBE.replace("mesh-Cube", "mesh-Élan vital.001").replace("Cube.ply", "Élan vital.ply")
        ),
        _loads(),
        {"meshes/Élan vital.ply": ply()},
    ),
    Entry(
        "quads left in a mesh",
        _scene(MATERIAL + LAMP + CUBE),
        _loads(warnings=("cut into triangles",)),
        {"meshes/Cube.ply": ply(faces=((0, 1, 2, 3),))},
    ),
    Entry(
        "a mesh that was not exported",
        _scene(MATERIAL + LAMP + CUBE),
        Refused(('<shape type="ply">', "line", "'meshes/Cube.ply'", "not there")),
    ),
    Entry(
        "a material of another add-on",
        _scene('<bsdf type="toon" id="mat-Material" name="mat-Material"/>' + LAMP + CUBE),
        Refused(('<bsdf type="toon">', "line", "the plugin is not one that a scene may use")),
        MESH,
    ),
]
