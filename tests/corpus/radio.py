"""Files for simulations of radio waves: exported from Blender or written by scripts, with materials named for their
permittivity and without a camera."""

from __future__ import annotations

from tests.corpus.entry import Entry, Loads, Refused
from tests.corpus.things import made

MATERIALS = """
<!-- Materials -->
	<bsdf type="twosided" id="mat-itu_concrete" name="mat-itu_concrete">
		<bsdf type="diffuse" name="bsdf">
			<rgb value="0.539479 0.539479 0.539480" name="reflectance"/>
		</bsdf>
	</bsdf>
	<bsdf type="diffuse" id="mat-itu_metal" name="mat-itu_metal">
		<rgb value="0.219526 0.219526 0.254152" name="reflectance"/>
	</bsdf>
"""
WORLD = """
<!-- Emitters -->
	<emitter type="constant" id="World" name="World">
		<rgb value="1.000000 1.000000 1.000000" name="radiance"/>
	</emitter>
"""
SHAPES = """
<!-- Shapes -->
	<shape type="ply" id="mesh-ground" name="mesh-ground">
		<string name="filename" value="meshes/ground.ply"/>
		<ref id="mat-itu_concrete" name="bsdf"/>
	</shape>
	<shape type="ply" id="mesh-Tour_Saint-Jacques.012" name="mesh-Tour_Saint-Jacques.012">
		<string name="filename" value="meshes/tower.ply"/>
		<boolean name="face_normals" value="true"/>
		<transform name="to_world"><translate x="3" y="1" z="2"/></transform>
		<ref id="mat-itu_metal" name="bsdf"/>
	</shape>
"""
PATH = """
	<integrator type="path" id="elm__0" name="elm__0">
		<integer name="max_depth" value="12"/>
	</integrator>
"""
MESHES = made("meshes/ground.ply", "meshes/tower.ply")
SAID = {"integrator": "path", "max_depth": 12}
MITSUBAS_OWN = ((768, 576),)
"""The image that is made where a file has no camera."""
NO_CAMERA = "no <sensor>"


def _scene(*parts: str, version: str = "2.1.0") -> str:
    return f'<scene version="{version}">\n{"".join(parts)}\n<!-- Volumes -->\n\n</scene>'


RADIO_ONLY = """
	<bsdf type="itu-radio-material" id="concrete">
		<string name="type" value="concrete"/>
		<float name="thickness" value="0.3"/>
	</bsdf>
	<shape type="ply" id="mesh-ground">
		<string name="filename" value="meshes/ground.ply"/>
		<ref id="concrete" name="bsdf"/>
	</shape>
"""

ENTRIES = [
    Entry(
        "street without a camera",
        _scene(PATH, MATERIALS, WORLD, SHAPES),
        Loads(2, 4, "constant", "diffuse twosided", (NO_CAMERA,), MITSUBAS_OWN, SAID),
        MESHES,
    ),
    Entry(
        "meshes and nothing else",
        _scene(
            SHAPES.replace('<ref id="mat-itu_concrete" name="bsdf"/>', "").replace("mat-itu_metal", "m"), MATERIALS
        ).replace('id="mat-itu_metal"', 'id="m"'),
        Loads(2, 4, "", "diffuse", (NO_CAMERA, "no emitters"), MITSUBAS_OWN),
        MESHES,
    ),
    Entry(
        "materials of radio waves",
        _scene(RADIO_ONLY, version="3.0.0"),
        Refused(('<bsdf type="itu-radio-material">', "line", "the plugin is not one that a scene may use")),
        MESHES,
    ),
]
