"""Colours, spectra and transformations of Mitsuba 0.x, as today's elements. Imports no Mitsuba."""

from __future__ import annotations

import math
import re

from elps_core.scene.markup import Node
from elps_core.scene.rewriting import Rewrite, constant, element, numbers, rename, take, written

PLANCK = 6.62607015e-34
"""Planck's constant, J s."""
LIGHT_SPEED = 299_792_458.0
"""Speed of light, m/s."""
BOLTZMANN = 1.380649e-23
"""Boltzmann's constant, J/K."""
COLDEST = 1.0
"""Lowest temperature in K of a body that may shine; by 300 its light is beyond single precision anyway."""
VISIBLE = range(360, 831, 5)
"""Wavelengths in nm at which a black body is tabulated; between them its curve is straight within 0.01%."""
METRES_PER_NM = 1e-9

SRGB_LINEAR_END = 0.04045
"""Encoded value up to which the sRGB curve is a line [IEC 61966-2-1]."""
XYZ_TO_RGB = (
    (3.240479, -1.537150, -0.498535),
    (-0.969256, 1.875991, 0.041556),
    (0.055648, -0.204043, 1.057311),
)
"""Rows: red, green and blue of ITU-R BT.709 from X, Y, Z, as Mitsuba 0.x has them."""
EMISSION = {"emitter": ("radiance", "irradiance", "intensity", "power")}
"""Element -> its parameters that are light."""
REFLECTANCES = frozenset(
    {"reflectance", "diffuse_reflectance", "specular_reflectance", "specular_transmittance", "transmittance"}
)
"""Parameters of materials that cannot be above 1."""
ROUNDING = 1e-3
"""Excess of a reflectance that a conversion of its colour may leave."""
WHITE = (
    "of one number is equal energy at all wavelengths, as in Mitsuba 3, and a little red: use <rgb> for neutral white"
)

_HEX = re.compile(r"#[0-9a-fA-F]{6}")
_KELVIN = re.compile(r"([^kK]*)[kK]?")


def camel_to_underscore(name: str) -> str:
    """``intIOR`` -> ``int_ior``: an underscore before capitals that follow a small letter, which become small."""
    return re.sub(r"(?<=[a-z])[A-Z]+", lambda found: "_" + found[0].lower(), name)


def upgrade_value(node: Node, owner: Node | None, rewrite: Rewrite) -> None:
    """Change one colour, spectrum or transformation in place; leave other elements as they are."""
    if node.tag in ("rgb", "srgb", "spectrum", "xyz", "blackbody"):
        node.attributes.pop("intent", None)
    if node.tag == "rgb" and _HEX.fullmatch(node.attributes.get("value", "").strip()):
        # Mitsuba 0.x took these as linear, and only those of <srgb> as encoded.
        node.attributes["value"] = written(_components(node))
    elif node.tag == "srgb":
        node.tag = "rgb"
        if found := _components(node):
            node.attributes["value"] = written([_decoded(value) for value in found])
    elif node.tag == "xyz":
        node.tag = "rgb"
        if len(found := _components(node)) == 3:
            linear = [sum(m * v for m, v in zip(row, found, strict=True)) for row in XYZ_TO_RGB]
            node.attributes["value"] = written([max(value, 0.0) for value in linear])
    elif node.tag == "spectrum" and not node.type:
        _upgrade_spectrum(node, owner, rewrite)
    elif node.tag == "blackbody":
        _upgrade_blackbody(node)
    elif node.tag == "animation":
        _hold_still(node, owner, rewrite)
    elif node.tag == "transform" and any("ox" in part.attributes for part in node.children):
        node.children = [each for part in node.children for each in _right_handed(part)]


def _right_handed(part: Node) -> list[Node]:
    """A step of a transformation; of before 0.3, ``lookat`` had three numbers for each vector, and was left-handed."""
    if part.tag != "lookat" or "ox" not in part.attributes:
        return [part]
    _join_axes(part)
    return [element(part, "scale", {"x": "-1"}), part]


def limit_reflectance(node: Node, rewrite: Rewrite) -> None:
    """Scale a material's colours that are above 1 down to it, as 0.6 did to conserve energy."""
    for child in node.children:
        value = constant(child) or [0.0]
        if child.attributes.get("name") in REFLECTANCES and child.tag in ("rgb", "spectrum") and max(value) > 1.0:
            child.attributes["value"] = written([part / max(value) for part in value])
            if max(value) > 1.0 + ROUNDING:
                rewrite.warn(node, f"reflects more than it gets: its {child.attributes['name']} is scaled down to 1")


def upgrade_uv(node: Node) -> None:
    """``uscale``, ``uoffset`` and their like as a transformation: scaled first, then moved."""
    parts = []
    for tag, kind in (("scale", "scale"), ("translate", "offset")):
        both = take(node, f"uv{kind}")
        given = {axis: take(node, f"{name}{kind}") or both for axis, name in (("x", "u"), ("y", "v"))}
        values = {axis: child.attributes.get("value", "") for axis, child in given.items() if child is not None}
        if values:
            parts.append(element(node, tag, values))
    if parts:
        node.children.append(element(node, "transform", {"name": "to_uv"}, parts))


def _components(node: Node) -> list[float]:
    text = node.attributes.get("value", "").strip()
    if _HEX.fullmatch(text):
        return [int(text[start : start + 2], 16) / 255 for start in (1, 3, 5)]
    return numbers(text)


def _decoded(value: float) -> float:
    """Linear value of an sRGB one."""
    return value / 12.92 if value <= SRGB_LINEAR_END else ((value + 0.055) / 1.055) ** 2.4


def _upgrade_spectrum(node: Node, owner: Node | None, rewrite: Rewrite) -> None:
    found = numbers(node.attributes.get("value", ""))
    if len(found) == 3:
        node.tag = "rgb"  # The samples of a spectrum, in the usual build of 0.x
    elif len(found) == 1 and owner is not None and node.attributes.get("name") in EMISSION.get(owner.tag, ()):
        rewrite.warn(node, WHITE)


def _upgrade_blackbody(node: Node) -> None:
    kelvin = numbers(_KELVIN.fullmatch(node.attributes.pop("temperature", "").strip())[1])  # type: ignore[index]
    factors = [numbers(node.attributes.pop(name, "1")) for name in ("scale", "multiplier")]
    node.tag = "spectrum"
    if len(kelvin) == 1 and kelvin[0] >= COLDEST and all(len(factor) == 1 for factor in factors):
        scale = factors[0][0] * factors[1][0]
        values = (f"{length}:{written(scale * _radiance(length, kelvin[0]))}" for length in VISIBLE)
        node.attributes["value"] = ", ".join(values)


def _radiance(wavelength: float, kelvin: float) -> float:
    """Of a black body, W per square metre, steradian and nm; the wavelength in nm [Planck's law]."""
    metres = wavelength * METRES_PER_NM
    exponent = PLANCK * LIGHT_SPEED / (metres * BOLTZMANN * kelvin)
    spectral = 2.0 * PLANCK * LIGHT_SPEED**2 / metres**5 * METRES_PER_NM
    # exp(-x) / (1 - exp(-x)): of a cold body exp(x) is too large for a number.
    return spectral * math.exp(-exponent) / -math.expm1(-exponent)


def _hold_still(node: Node, owner: Node | None, rewrite: Rewrite) -> None:
    """Replace an animation by its first keyframe, which is all that a closed shutter at time 0 saw."""
    keys = [child for child in node.children if child.tag == "transform"]
    times = [numbers(key.attributes.pop("time", "")) for key in keys]
    first = min(range(len(keys)), key=lambda index: times[index][:1] or [0.0], default=None)
    node.tag = "transform"
    node.children = keys[first].children if first is not None else []
    rewrite.warn(owner or node, "moves in the file, and stands at its first keyframe here: there is no motion blur")


def _join_axes(lookat: Node) -> None:
    for name in ("origin", "target", "up"):
        parts = [lookat.attributes.pop(name[0] + axis, "") for axis in "xyz"]
        if any(parts):
            lookat.attributes[name] = ", ".join(part or "0" for part in parts)


def upgrade_names(node: Node, renamed: dict[str, str]) -> None:
    """Give the parameters of an object today's names."""
    for child in node.children:
        if "name" in child.attributes:
            child.attributes["name"] = camel_to_underscore(child.attributes["name"])
    for old, new in renamed.items():
        rename(node, old, new)
