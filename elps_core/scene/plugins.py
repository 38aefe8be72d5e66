"""Which elements and plugins a scene file may name. Data only; imports no Mitsuba.

A plugin name is compared exactly with these lists before Mitsuba sees it, because Mitsuba turns an
unknown name into the name of a library to load.
"""

from __future__ import annotations

from elps_core.settings import BUILT_INTEGRATORS

_TEXTURES = frozenset(
    {
        "bitmap",
        "blackbody",
        "checkerboard",
        "d65",
        "irregular",
        "mesh_attribute",
        "rawconstant",
        "regular",
        "srgb",
        "uniform",
        "volume",
    }
)

INTEGRATORS = frozenset(
    {"aov", "depth", "direct", "direct_projective", "moment", "path", "prb", "prb_basic", "prb_projective"}
    | {"prbvolpath", "ptracer", "stokes", "volpath", "volpathmis", "volprim_rf_basic"}
    | {f"elps_{name}" for name in BUILT_INTEGRATORS}
)
"""Those whose parameters mean what ours do; none is instantiated, because the settings of a render decide."""

PLUGINS: dict[str, frozenset[str]] = {
    "bsdf": frozenset(
        {
            "blendbsdf",
            "bumpmap",
            "circular",
            "conductor",
            "dielectric",
            "diffuse",
            "hair",
            "mask",
            "measured",
            "normalmap",
            "null",
            "plastic",
            "polarizer",
            "pplastic",
            "principled",
            "principledthin",
            "retarder",
            "roughconductor",
            "roughdielectric",
            "roughplastic",
            "thindielectric",
            "twosided",
        }
    ),
    "emitter": frozenset(
        {
            "area",
            "constant",
            "directional",
            "directionalarea",
            "envmap",
            "point",
            "projector",
            "spot",
            "sunsky",
            "timed_sunsky",
        }
    ),
    "film": frozenset({"hdrfilm", "specfilm"}),
    "integrator": INTEGRATORS,
    "medium": frozenset({"heterogeneous", "homogeneous"}),
    "phase": frozenset({"blendphase", "hg", "isotropic", "rayleigh", "sggx", "tabphase"}),
    "rfilter": frozenset({"box", "catmullrom", "gaussian", "lanczos", "mitchell", "tent"}),
    "sampler": frozenset({"independent", "ldsampler", "multijitter", "orthogonal", "stratified"}),
    "sensor": frozenset(
        {"batch", "distant", "irradiancemeter", "orthographic", "perspective", "radiancemeter", "thinlens"}
    ),
    "shape": frozenset(
        {
            "bsplinecurve",
            "cube",
            "cylinder",
            "disk",
            "instance",
            "linearcurve",
            "obj",
            "ply",
            "rectangle",
            "sdfgrid",
            "serialized",
            "shapegroup",
            "sphere",
        }
    ),
    "spectrum": _TEXTURES,
    "texture": _TEXTURES,
    "volume": frozenset({"constvolume", "gridvolume"}),
}
"""Element -> plugins of Mitsuba 3.9 that it may name.

Those that are left out on purpose are in :data:`REFUSED`.
"""

REFUSED: dict[tuple[str, str], str] = {
    ("bsdf", "measured_polarized"): "light has no polarization here: take a file of the plugin 'measured'",
    ("shape", "blender"): "it reads the memory of a running Blender: export the mesh as PLY",
    ("shape", "ellipsoids"): "radiance fields are not rendered: give the scene surfaces",
    ("shape", "ellipsoidsmesh"): "radiance fields are not rendered: give the scene surfaces",
    ("shape", "merge"): "shapes are merged in any case: leave nothing in it but shapes without names",
}
"""(element, plugin of Mitsuba 3.9) that a scene may not name -> why, and what to do."""

DEFAULT_MATERIAL = "diffuse"
"""Mitsuba's own, which it makes anew for each shape that names none."""

FILE_READERS: dict[tuple[str, str], str] = {
    ("bsdf", "measured"): "measured",
    ("shape", "obj"): "obj",
    ("shape", "ply"): "ply",
    ("shape", "serialized"): "serialized",
    ("shape", "bsplinecurve"): "text",
    ("shape", "linearcurve"): "text",
    ("shape", "sdfgrid"): "volume",
    ("volume", "gridvolume"): "volume",
    ("texture", "bitmap"): "image",
    ("spectrum", "bitmap"): "image",
    ("emitter", "envmap"): "image",
}
"""(element, plugin) that takes a ``filename`` -> how the file is checked before Mitsuba reads it."""

NUMBER_COUNTS: dict[str, dict[str, tuple[int, ...]]] = {
    "float": {"value": (1,)},
    "integer": {"value": (1,)},
    "point": {"value": (1, 3), "x": (1,), "y": (1,), "z": (1,)},
    "vector": {"value": (1, 3), "x": (1,), "y": (1,), "z": (1,)},
    "rgb": {"value": (1, 3)},
    "translate": {"value": (1, 3), "x": (1,), "y": (1,), "z": (1,)},
    "rotate": {"value": (1, 3), "x": (1,), "y": (1,), "z": (1,), "angle": (1,)},
    "scale": {"value": (1, 3), "x": (1,), "y": (1,), "z": (1,)},
    "lookat": {"origin": (3,), "target": (3,), "up": (3,)},
    "matrix": {"value": (9, 16)},
}
"""Element -> its numeric attributes -> how many numbers each may hold."""

TRANSFORMS = frozenset({"translate", "rotate", "scale", "lookat", "matrix"})
ATTRIBUTES: dict[str, frozenset[str]] = {
    **{tag: frozenset(NUMBER_COUNTS[tag]) for tag in TRANSFORMS},
    **{tag: frozenset(NUMBER_COUNTS[tag]) | {"name"} for tag in NUMBER_COUNTS.keys() - TRANSFORMS},
    **{tag: frozenset({"type", "name", "id"}) for tag in PLUGINS},
    "boolean": frozenset({"name", "value"}),
    "string": frozenset({"name", "value"}),
    "spectrum": frozenset({"name", "value", "filename", "type", "id"}),
    "ref": frozenset({"name", "id"}),
    "transform": frozenset({"name"}),
    "default": frozenset({"name", "value"}),
    "scene": frozenset({"version"}),
}
"""Element -> the attributes that it may have. An element that is not here is refused by name."""
