"""Parameters that today's Mitsuba knows where a scene is not refused for others. Data only; imports no Mitsuba."""

from __future__ import annotations

_SIZE = {"width", "height", "crop_width", "crop_height", "crop_offset_x", "crop_offset_y", "sample_border"}
_COUNT = {"sample_count", "seed"}

PARAMETERS: dict[str, dict[str, frozenset[str]]] = {
    "film": {
        "hdrfilm": frozenset(_SIZE | {"component_format", "file_format", "pixel_format"}),
        "specfilm": frozenset(_SIZE | {"component_format"}),
    },
    "sampler": {
        "independent": frozenset(_COUNT),
        "ldsampler": frozenset(_COUNT),
        "multijitter": frozenset(_COUNT | {"jitter"}),
        "orthogonal": frozenset(_COUNT | {"jitter", "strength"}),
        "stratified": frozenset(_COUNT | {"jitter"}),
    },
    "rfilter": {
        "box": frozenset(),
        "catmullrom": frozenset(),
        "gaussian": frozenset({"stddev"}),
        "lanczos": frozenset({"lobes"}),
        "mitchell": frozenset({"B", "C"}),
        "tent": frozenset({"radius"}),
    },
}
"""Element -> its plugins -> their parameters, objects apart."""

SUBSTITUTES = {"film": "hdrfilm", "sampler": "independent", "rfilter": "gaussian"}
"""Element -> the plugin that stands in for one that today's Mitsuba does not have."""

OLD_FILMS = frozenset({"exrfilm", "ldrfilm", "mfilm", "pngfilm", "tiledhdrfilm"})
"""Films that have gone; others that are not known may mean anything, and are refused."""

ADVICE = frozenset({"max_depth", "rr_depth", "hide_emitters", "samples_per_pass", "aovs"})
"""Parameters of integrators that defaults of a job are taken from."""

CHOICES = {
    ("film", "pixel_format"): frozenset({"luminance", "luminance_alpha", "rgb", "rgba", "xyz", "xyza"}),
    ("film", "component_format"): frozenset({"float16", "float32", "uint32"}),
    ("film", "file_format"): frozenset({"openexr", "rgbe", "pfm"}),
    ("texture", "filter_type"): frozenset({"bilinear", "nearest"}),
}
"""(element, parameter) -> the texts that it takes; with another one it is left out."""

HARMLESS = {
    "texture": frozenset({"cache", "max_anisotropy"}),
    "shape": frozenset({"collapse", "load_materials", "max_smooth_angle", "srgb"}),
}
"""Element -> unknown parameters that its image depends on little or not at all."""

SMOOTH = {"roughdielectric": "dielectric", "roughplastic": "plastic", "pplastic": "plastic"}
"""Rough materials that Mitsuba refuses where their indices of refraction are equal -> the smooth one, which it takes.
Where nothing is reflected or bent, the roughness of a surface changes nothing."""
ROUGHNESS = ("alpha", "alpha_u", "alpha_v", "distribution", "sample_visible")
"""Parameters of theirs that the smooth one does not have."""
