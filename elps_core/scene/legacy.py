"""Names of Mitsuba 0.x that have changed or gone. Data only; imports no Mitsuba."""

from __future__ import annotations

TAGS = {"camera": "sensor", "luminaire": "emitter", "lookAt": "lookat"}
"""Elements of Mitsuba 0.x that have another name today."""

PLUGINS = {
    ("bsdf", "lambertian"): "diffuse",
    ("bsdf", "roughmetal"): "roughconductor",
    ("bsdf", "roughglass"): "roughdielectric",
    ("bsdf", "composite"): "mixturebsdf",
    ("bsdf", "bump"): "bumpmap",
    ("texture", "exrtexture"): "bitmap",
    ("texture", "ldrtexture"): "bitmap",
}
"""(element, plugin) that was only renamed, by 0.6 at the latest -> its last name."""

PARAMETERS = {
    ("bsdf", "diffuse"): {"diffuse_reflectance": "reflectance"},
    ("bsdf", "roughdiffuse"): {"diffuse_reflectance": "reflectance"},
    ("bsdf", "roughconductor"): {"alpha_b": "alpha", "ior": "eta"},
    ("bsdf", "roughdielectric"): {"alpha_b": "alpha"},
    ("bsdf", "ward"): {"alpha_x": "alpha_u", "alpha_y": "alpha_v"},
    ("shape", "sphere"): {"inverted": "flip_normals"},
    ("texture", "checkerboard"): {"bright_color": "color0", "dark_color": "color1"},
    ("emitter", "area"): {"intensity": "radiance"},
    ("emitter", "constant"): {"intensity": "radiance"},
    ("emitter", "directional"): {"intensity": "irradiance"},
    ("emitter", "envmap"): {"intensity_scale": "scale"},
    ("sensor", "thinlens"): {"focus_depth": "focus_distance"},
    ("medium", "heterogeneous"): {"density": "sigma_t", "density_multiplier": "scale"},
    ("medium", "homogeneous"): {"size_multiplier": "scale", "density_multiplier": "scale"},
}
"""(element, plugin) -> its parameters of another name today."""

NO_EFFECT = {
    "bsdf": frozenset(
        {"ensure_energy_conservation", "preserve_colors", "specular_sampling_weight", "verify_energy_conservation"}
    ),
    "emitter": frozenset({"cache", "gamma", "resolution"}),
    "medium": frozenset({"method", "step_size"}),
    "sensor": frozenset({"autofocus", "blades", "kc"}),
    "shape": frozenset({"shutter_open", "shutter_close"}),
    "volume": frozenset({"send_data"}),
}
"""Element -> parameters of 0.x that its image depends on little or not at all, and that have gone."""

_BAKE = "put its colours into an image and use a 'bitmap'"
_MESH = "export it as a mesh (ply or obj)"
_OWN = "replace its material by one that Mitsuba 3 has"
GONE = {
    ("bsdf", "hk"): _OWN,
    ("bsdf", "irawan"): _OWN,
    ("bsdf", "dipolebrdf"): _OWN,
    ("bsdf", "sssbrdf"): _OWN,
    ("bsdf", "rmbrdf"): _OWN,
    ("bsdf", "microfacet"): "replace it by 'roughplastic'",
    ("emitter", "collimated"): "replace it by a 'directionalarea' on a small shape",
    ("phase", "kkay"): "replace it by 'hg' or 'sggx'",
    ("phase", "microflake"): "replace it by 'sggx'",
    ("sensor", "fluencemeter"): "replace it by 'irradiancemeter'",
    ("sensor", "spherical"): "use a 'perspective' camera",
    ("sensor", "telecentric"): "replace it by 'orthographic'",
    ("shape", "animatedinstance"): "replace it by an 'instance' at one place",
    ("shape", "deformable"): _MESH,
    ("shape", "hair"): "export it as a 'bsplinecurve'",
    ("shape", "heightfield"): _MESH,
    ("texture", "curvature"): _BAKE,
    ("texture", "gridtexture"): _BAKE,
    ("texture", "wireframe"): _BAKE,
    ("volume", "hgridvolume"): "put its blocks into one 'gridvolume'",
    ("volume", "volcache"): "use the volume inside it",
}
"""(element, plugin) of 0.x without anything close in today's Mitsuba -> what the user can do."""

INDICES = {
    "vacuum": 1.0,
    "helium": 1.000036,
    "hydrogen": 1.000132,
    "air": 1.000277,
    "carbon dioxide": 1.00045,
    "water": 1.3330,
    "acetone": 1.36,
    "ethanol": 1.361,
    "carbon tetrachloride": 1.461,
    "glycerol": 1.4729,
    "benzene": 1.501,
    "silicone oil": 1.52045,
    "bromine": 1.661,
    "water ice": 1.31,
    "fused quartz": 1.458,
    "pyrex": 1.470,
    "acrylic glass": 1.49,
    "polypropylene": 1.49,
    "bk7": 1.5046,
    "sodium chloride": 1.544,
    "amber": 1.55,
    "pet": 1.5750,
    "diamond": 2.419,
}
"""Indices of refraction by the names that scene files may give, at 589 nm."""
