"""Files of Mitsuba 0.x: capitals inside names, plugins that have gone, parameters that nobody takes today."""

from __future__ import annotations

from tests.corpus.entry import Entry, Loads, Refused
from tests.corpus.things import made

HEAD = '<?xml version="1.0" encoding="utf-8"?>\n\n'
PATH = '<integrator type="path"><integer name="maxDepth" value="-1"/></integrator>'
CAMERA = """
	<sensor type="perspective">
		<string name="fovAxis" value="smaller"/>
		<float name="nearClip" value="0.1"/>
		<float name="farClip" value="100"/>
		<float name="focusDistance" value="6"/>
		<transform name="toWorld">
			<lookAt origin="0, 0, 6" target="0, 0, 0" up="0, 1, 0"/>
		</transform>
		<float name="fov" value="39.3077"/>
		<sampler type="ldsampler">
			<integer name="sampleCount" value="64"/>
		</sampler>
		<film type="hdrfilm">
			<integer name="width" value="16"/>
			<integer name="height" value="12"/>
			<boolean name="banner" value="false"/>
			<rfilter type="gaussian"/>
		</film>
	</sensor>
"""
SAID = {"integrator": "path", "samples": 64}
BANNER = ("banner",)
WHITE = "<rgb> for neutral white"


def _scene(*parts: str, version: str = "0.6.0", integrator: str = PATH, camera: str = CAMERA) -> str:
    return f'{HEAD}<scene version="{version}">{integrator}{camera}{"".join(parts)}</scene>\n'


CORNELL = """
	<bsdf type="diffuse" id="red">
		<spectrum name="reflectance" value="400:0.04, 500:0.06, 600:0.29, 700:0.64"/>
	</bsdf>
	<bsdf type="diffuse" id="light">
		<spectrum name="reflectance" value="400:0.78, 500:0.78, 600:0.78, 700:0.78"/>
	</bsdf>
	<shape type="obj">
		<string name="filename" value="meshes/cbox_luminaire.obj"/>
		<transform name="toWorld">
			<rotate x="1" angle="180"/>
			<translate x="0" y="1" z="5.5"/>
		</transform>
		<ref id="light"/>
		<emitter type="area">
			<spectrum name="radiance" value="400:0, 500:8, 600:15.6, 700:18.4"/>
		</emitter>
	</shape>
	<shape type="obj">
		<string name="filename" value="meshes/cbox_redwall.obj"/>
		<ref id="red"/>
	</shape>
"""
POINTS = """
	<bsdf type="roughplastic" id="surfaceMaterial">
		<string name="distribution" value="ggx"/>
		<float name="alpha" value="0.05"/>
		<float name="intIOR" value="1.46"/>
		<rgb name="diffuseReflectance" value="1,1,1"/> <!-- default 0.5 -->
	</bsdf>
	<shape type="sphere">
		<float name="radius" value="0.025"/>
		<transform name="toWorld"><translate x="0.1" y="0.2" z="0.3"/></transform>
		<bsdf type="diffuse"><rgb name="reflectance" value="0.3,0.2,0.8"/></bsdf>
	</shape>
	<shape type="rectangle">
		<ref name="bsdf" id="surfaceMaterial"/>
		<transform name="toWorld"><scale x="10" y="10" z="1"/><translate x="0" y="0" z="-0.5"/></transform>
	</shape>
	<shape type="rectangle">
		<transform name="toWorld">
			<scale x="10" y="10" z="1"/>
			<lookat origin="-4,4,20" target="0,0,0" up="0,0,1"/>
		</transform>
		<emitter type="area"><rgb name="radiance" value="6,6,6"/></emitter>
	</shape>
"""
LDR = CAMERA.replace(
    '<film type="hdrfilm">',
    '<film type="ldrfilm"><string name="fileFormat" value="jpeg"/><string name="tonemapMethod" value="reinhard"/>'
    '<float name="gamma" value="-1"/><boolean name="highQualityEdges" value="true"/>',
).replace("ldsampler", "halton")
PREVIEW = """
	<emitter type="envmap" id="Area_002-light">
		<string name="filename" value="envmap.exr"/>
		<transform name="toWorld">
			<rotate y="1" angle="-180"/>
			<matrix value="-0.224951 -0.000001 -0.974370 0.0 -0.974370 0.0 0.224951 0.0 0.0 1.0 -0.000001
					8.87 0.0 0.0 0.0 1.0 "/>
		</transform>
		<float name="scale" value="3"/>
		<float name="samplingWeight" value="2"/>
	</emitter>
	<bsdf type="diffuse" id="__diffmat"><rgb name="reflectance" value="0.18 0.18 0.18"/></bsdf>
	<texture type="checkerboard" id="__planetex">
		<rgb name="color0" value="0.4"/><rgb name="color1" value="0.2"/>
		<float name="uscale" value="8.0"/><float name="vscale" value="8.0"/>
	</texture>
	<bsdf type="diffuse" id="__planemat"><ref name="reflectance" id="__planetex"/></bsdf>
	<shape type="serialized" id="Plane-mesh_0">
		<string name="filename" value="matpreview.serialized"/>
		<integer name="shapeIndex" value="0"/>
		<ref name="bsdf" id="__planemat"/>
	</shape>
	<shape type="serialized" id="Interior-mesh_0">
		<string name="filename" value="matpreview.serialized"/>
		<integer name="shapeIndex" value="1"/>
		<ref name="bsdf" id="__diffmat"/>
	</shape>
"""
OLD_MATERIALS = """
	<shape type="sphere">
		<bsdf type="roughdiffuse"><srgb name="reflectance" value="#6d7185"/><float name="alpha" value="0.7"/></bsdf>
	</shape>
	<shape type="sphere">
		<bsdf type="phong"><float name="exponent" value="200"/><rgb name="specularReflectance" value="0.3"/></bsdf>
	</shape>
	<shape type="sphere">
		<bsdf type="ward">
			<string name="variant" value="balanced"/> <float name="alphaU" value="0.003"/>
			<float name="alphaV" value="0.3"/>
		</bsdf>
	</shape>
	<shape type="sphere">
		<bsdf type="mixturebsdf">
			<string name="weights" value="0.7, 0.3"/><bsdf type="dielectric"/><bsdf type="conductor"/>
		</bsdf>
	</shape>
	<shape type="sphere">
		<bsdf type="bump">
			<texture type="scale">
				<float name="scale" value="10"/>
					<texture type="bitmap"><string name="filename" value="bump.png"/>
				</texture>
			</texture>
			<bsdf type="roughconductor">
				<string name="material" value="Al"/><string name="distribution" value="as"/>
			</bsdf>
		</bsdf>
	</shape>
	<emitter type="constant"><spectrum name="radiance" value="1"/></emitter>
"""
BITMAP = """
	<texture type="bitmap" id="wood">
		<string name="filename" value="wood.jpg"/>
		<float name="gamma" value="2.2"/>
		<string name="filterType" value="ewa"/>
		<float name="maxAnisotropy" value="10"/>
		<boolean name="cache" value="false"/>
		<string name="wrapMode" value="mirror"/>
		<float name="uscale" value="2"/>
	</texture>
	<shape type="cube"><bsdf type="diffuse"><ref name="reflectance" id="wood"/></bsdf></shape>
	<emitter type="point"><point name="position" x="3" y="3" z="3"/><rgb name="intensity" value="#ff8000"/></emitter>
"""
SKY = """
	<emitter type="sunsky">
		<float name="turbidity" value="3"/>
		<vector name="sunDirection" x="0.3" y="0.8" z="0.4"/>
		<float name="sunScale" value="2"/>
		<float name="skyScale" value="0.5"/>
	</emitter>
	<shape type="cube"/>
"""
SMOKE = """
	<medium type="heterogeneous" id="smoke">
		<string name="method" value="woodcock"/>
		<volume name="density" type="gridvolume"><string name="filename" value="smoke.vol"/></volume>
		<volume name="albedo" type="constvolume"><spectrum name="value" value="0.9"/></volume>
		<phase type="isotropic"/>
		<float name="scale" value="100"/>
	</medium>
	<shape type="cube"><ref name="interior" id="smoke"/></shape>
	<emitter type="point"><spectrum name="intensity" value="400:1, 700:2"/></emitter>
"""
FOREST = """
	<shape type="shapegroup" id="tree"><shape type="obj"><string name="filename" value="tree.obj"/></shape></shape>
	<shape type="instance"><ref id="tree"/></shape>
	<shape type="instance">
		<ref id="tree"/><transform name="toWorld"><scale value="2"/><translate x="3"/></transform>
	</shape>
	<emitter type="directional"><vector name="direction" x="0" y="0" z="-1"/></emitter>
"""
GUIDED = """<integrator type="guided_path">
		<integer name="sppPerPass" value="1"/>
		<string name="nee" value="never"/>
		<float name="budget" value="127"/>
		<boolean name="strictNormals" value="true"/>
	</integrator>"""
CACHED = '<integrator type="irrcache"><float name="quality" value="1"/><integrator type="path"/></integrator>'
CHANNELS = """<integrator type="multichannel">
		<integrator type="path"/><integrator type="field"><string name="field" value="shNormal"/></integrator>
	</integrator>"""
VERY_OLD = """<scene version="0.2.0">
	<integrator type="path"/>
	<camera type="perspective">
		<transform name="toWorld"><lookAt ox="0" oy="0" oz="6" tx="0" ty="0" tz="0" ux="0" uy="1" uz="0"/></transform>
		<float name="fov" value="30"/>
		<film type="exrfilm"><integer name="width" value="16"/><integer name="height" value="12"/></film>
		<sampler type="independent"><integer name="sampleCount" value="8"/></sampler>
	</camera>
	<luminaire type="constant"><spectrum name="intensity" value="1"/></luminaire>
	<shape type="sphere"><bsdf type="lambertian"/></shape>
</scene>"""
CUBE = '<shape type="cube"/><emitter type="constant"/>'
MESHES = made("meshes/cbox_luminaire.obj", "meshes/cbox_redwall.obj")
CLOUD = Loads(3, 4, "area", "diffuse roughplastic", defaults=SAID)
BLEND = "blendbsdf bumpmap conductor dielectric diffuse roughconductor"


def _gone(name: str, parts: str, *words: str, camera: str = CAMERA, files: str = "") -> Entry:
    return Entry(name, _scene(parts, camera=camera), Refused(("line", *words)), made(*files.split()))


MASKED = """
	<shape type="cube"><bsdf type="mask">
		<texture type="bitmap" name="opacity">
			<string name="filename" value="a.png"/><string name="channel" value="a"/>
		</texture>
		<bsdf type="diffuse"/>
	</bsdf></shape>
"""
MILK = """
	<shape type="cube">
		<medium type="homogeneous" name="interior"><string name="material" value="skimmilk"/></medium>
	</shape>
"""
HIDDEN = """<integrator type="volpath">
		<integer name="rrDepth" value="7"/>
		<boolean name="hideEmitters" value="true"/>
	</integrator>"""


def _advised(name: str, integrator: str, said: dict[str, object], *warnings: str) -> Entry:
    out = Loads(1, 12, "constant", warnings=(*BANNER, *warnings), defaults={**said, "samples": 64})
    return Entry(name, _scene(CUBE, integrator=integrator), out)


ENTRIES = [
    Entry(
        "Cornell box", _scene(CORNELL, version="0.5.0"), Loads(2, 4, "area", "diffuse", BANNER, defaults=SAID), MESHES
    ),
    Entry(
        "cloud of points",
        _scene(
            POINTS,
            camera=CAMERA.replace("ldsampler", "independent")
            .replace('<boolean name="banner" value="false"/>', "")
            .replace("lookAt", "lookat"),
        ),
        CLOUD,
    ),
    Entry(
        "picture of 8 bits",
        _scene(POINTS, version="0.5.0", camera=LDR),
        Loads(3, 4, "area", "diffuse roughplastic", ("'ldrfilm'", "'halton'", "left out"), defaults=SAID),
    ),
    Entry(
        "preview of materials",
        _scene(PREVIEW),
        Loads(2, 3, "envmap", "diffuse", (*BANNER, "no texture coordinates"), defaults=SAID),
        made("envmap.exr", "matpreview.serialized"),
    ),
    Entry(
        "preview of a part that its file does not have",
        _scene(PREVIEW.replace('name="shapeIndex" value="1"', 'name="shapeIndex" value="2"')),
        Refused(('<shape type="serialized">', "line", "'matpreview.serialized' has 2 meshes", "'shape_index' 2")),
        made("envmap.exr", "matpreview.serialized"),
    ),
    Entry(
        "materials that have gone",
        _scene(OLD_MATERIALS),
        Loads(
            5,
            0,
            "constant",
            BLEND,
            ("'roughdiffuse'", "'phong'", "'ward'", "in place of 'as'", WHITE, "banner"),
            defaults=SAID,
        ),
        made("bump.png"),
    ),
    Entry(
        "image with its gamma",
        _scene(BITMAP),
        Loads(1, 12, "point", warnings=("gamma", "filter_type", "banner"), defaults=SAID),
        made("wood.jpg"),
    ),
    Entry("sun and sky", _scene(SKY), Loads(1, 12, "sunsky", warnings=("'sunsky'", "banner"), defaults=SAID)),
    Entry(
        "smoke",
        _scene(SMOKE),
        Loads(1, 12, "point", "null", ("participating media", "method"), defaults=SAID),
        made("smoke.vol"),
    ),
    Entry("forest", _scene(FOREST), Loads(4, 2, "directional", warnings=BANNER, defaults=SAID), made("tree.obj")),
    _advised("integrator of a paper", GUIDED, {}, "not known"),
    _advised("integrator with a cache", CACHED, {}, "not known"),
    _advised("several channels", CHANNELS, {}, "not known"),
    _advised("bidirectional", '<integrator type="bdpt"/>', {}, "not known"),
    _advised(
        "volumes and hidden lamps",
        HIDDEN,
        {"integrator": "volpath", "rr_depth": 7, "hide_emitters": True},
    ),
    Entry(
        "version 0.2",
        VERY_OLD,
        Loads(1, 0, "constant", warnings=("'exrfilm'", WHITE), defaults={"integrator": "path", "samples": 8}),
    ),
    _gone(
        "subsurface scattering",
        '<shape type="cube"><subsurface type="dipole"/></shape>',
        '<subsurface type="dipole">',
        "medium",
    ),
    _gone("woven cloth", '<shape type="cube"><bsdf type="irawan"/></shape>', '<bsdf type="irawan">', "replace"),
    _gone(
        "height field",
        '<shape type="heightfield"><string name="filename" value="h.png"/></shape>',
        '<shape type="heightfield">',
        "mesh",
    ),
    _gone(
        "grid of lines",
        '<shape type="cube"><bsdf type="diffuse"><texture type="gridtexture" name="reflectance"/></bsdf></shape>',
        '<texture type="gridtexture">',
        "bitmap",
    ),
    _gone(
        "medium of a preset",
        MILK,
        '<medium type="homogeneous">',
        "sigma_t and albedo",
    ),
    _gone(
        "panorama",
        CUBE,
        '<sensor type="spherical">',
        "perspective",
        camera=CAMERA.replace('"perspective"', '"spherical"'),
    ),
    _gone(
        "one channel of an image",
        MASKED,
        '<texture type="bitmap">',
        "'channel'",
        files="a.png",
    ),
]
