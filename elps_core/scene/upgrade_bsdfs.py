"""Materials of Mitsuba 0.x, as today's. Imports no Mitsuba."""

from __future__ import annotations

import math

from elps_core.scene.legacy import INDICES
from elps_core.scene.markup import Node
from elps_core.scene.rewriting import (
    Rewrite,
    constant,
    element,
    named,
    number_of,
    numbers,
    put,
    refuse,
    rename,
    take,
    text_of,
)

MAX_MIXED = 32
"""Materials in one mixture: each is evaluated wherever light meets it."""
LOBES = {"phong": (0.5, 0.2), "ward": (0.5, 0.2)}
"""Plugin -> its diffuse and specular reflectance where the scene does not say."""
PHONG_EXPONENT = 30.0
"""Mitsuba 0.6's own."""
DIFFUSE = 0.5
"""The reflectance of ``diffuse`` where the scene does not say, then and now."""
ROUGH = ("distribution", "alpha", "alpha_u", "alpha_v")
"""Parameters that say how rough a surface is."""
ROUGHNESS = 0.1
"""The alpha of every rough material where the scene does not say, then and now."""
DEFAULT_METAL = "Cu"
"""Mitsuba 0.x's own; today's is a perfect mirror."""
AIR = 1.01
"""Largest index of refraction around a metal that may be taken for vacuum: 0.03% for air."""


def diffuse(node: Node, rewrite: Rewrite) -> None:
    """A scaled image as reflectance: a blend of the image and of black, whose weight is the scale."""
    given = named(node, "reflectance")
    source = rewrite.target(given) if given is not None else None
    if source is None or (source.tag, source.type) != ("texture", "scale"):
        return
    factor = constant(named(source, "scale"))
    inner = [child for child in source.children if child.attributes.get("name") != "scale"]
    if factor is not None and len(set(factor)) == 1 and 0.0 <= factor[0] <= 1.0 and len(inner) == 1:
        scaled = element(node, "bsdf", {"type": "diffuse"}, [rewrite.copy(inner[0], "reflectance")])
        _become(node, "blendbsdf", [_black(node), scaled])
        put(node, "float", "weight", factor[0])


def rough_diffuse(node: Node, rewrite: Rewrite) -> None:
    """The diffuse material around which its light varies."""
    node.attributes["type"] = "diffuse"
    for name in ("alpha", "use_fast_approx"):
        take(node, name)
    rewrite.warn(node, "stands for 'roughdiffuse' of Mitsuba 0.x: darker at grazing angles")
    diffuse(node, rewrite)


def distribution(node: Node, rewrite: Rewrite) -> None:
    """The distribution of a rough surface: alpha means the same in all of 0.6's, near the peak."""
    given = text_of(node, "distribution")
    if given in ("as", "phong"):
        put(node, "string", "distribution", "beckmann")
        rewrite.warn(node, f"has the distribution 'beckmann' in place of '{given}': of the same width, other tails")
    elif given:
        put(node, "string", "distribution", given)


def conductor(node: Node, rewrite: Rewrite) -> None:
    """A metal by name or by numbers, which may be relative to what is around it.

    Raises:
        SceneRejected: one of eta and k without the other, or a dense medium around a metal by name.
    """
    if node.type == "roughconductor":
        distribution(node, rewrite)
    eta, k, around = named(node, "eta"), named(node, "k"), take(node, "ext_eta")
    if (eta is None) != (k is None):
        refuse(node, "has one of eta and k: give both")
    if eta is not None:
        take(node, "material")
    elif named(node, "material") is None:
        put(node, "string", "material", DEFAULT_METAL)
    index = _index(around, node, 1.0)
    if index > AIR or index < 1.0:
        for name, value in (("eta", constant(eta)), ("k", constant(k))):
            if value is None:
                refuse(node, "lies in something denser than air: give eta and k as numbers, divided by ext_eta")
            put(node, "rgb" if len(value) == 3 else "float", name, [part / index for part in value])


def mirror(node: Node, _: Rewrite) -> None:
    """Of before 0.3, whose successor was chrome."""
    node.attributes["type"] = "conductor"
    rename(node, "reflectance", "specular_reflectance")
    put(node, "string", "material", "Cr")


def phong(node: Node, rewrite: Rewrite) -> None:
    """The modified Phong model: its lobe's height at normal incidence, (n + 2) / 2 pi, is 1 / 4 pi alpha^2."""
    exponent = number_of(node, "exponent", PHONG_EXPONENT)
    if exponent < 0.0:
        refuse(node, "has an exponent below 0")
    _two_lobes(node, {"alpha": 1.0 / math.sqrt(2.0 * exponent + 4.0)}, rewrite)


def ward(node: Node, rewrite: Rewrite) -> None:
    """Ward's model: a lobe of slopes like Beckmann's, of the same height at normal incidence."""
    widths = {name: number_of(node, name, ROUGHNESS) for name in ("alpha_u", "alpha_v")}
    _two_lobes(node, widths, rewrite)


def _two_lobes(node: Node, widths: dict[str, float], rewrite: Rewrite) -> None:
    """A sum of a diffuse and a glossy lobe, as a blend: weights from what each reflects at most.

    The sum is scaled down to 1 as 0.6 does; of an image it supposes that it has a white texel.
    """
    kind = node.type
    lobes = []
    for part, default in zip(("diffuse", "specular"), LOBES[kind], strict=True):
        given = take(node, f"{part}_reflectance")
        amount = number_of(node, f"{part}_amount", 1.0)
        take(node, f"{part}_amount")
        value = [default] if given is None else constant(given)
        if value is not None:
            value, given = [max(amount * number, 0.0) for number in value], None
        lobes.append((given, value, max(value) if value is not None else 1.0))
    total = lobes[0][2] + lobes[1][2]
    materials = []
    for (given, value, most), kind_of, name in zip(
        lobes, ("diffuse", "roughconductor"), ("reflectance", "specular_reflectance"), strict=True
    ):
        material = element(node, "bsdf", {"type": kind_of})
        if given is not None:
            given.attributes["name"] = name
            material.children.append(given)
        elif value is not None:
            share = min(total, 1.0) / most if most > 0.0 else 0.0
            put(material, "rgb", name, [min(number * share, 1.0) for number in value])
        materials.append(material)
    put(materials[1], "string", "material", "none")
    put(materials[1], "string", "distribution", "beckmann")
    for name, alpha in widths.items():
        put(materials[1], "float", name, alpha)
    _become(node, "blendbsdf", materials)
    put(node, "float", "weight", lobes[1][2] / total if total > 0.0 else 0.0)
    rewrite.warn(node, f"stands for '{kind}' of Mitsuba 0.x: other highlights at grazing angles")


def coating(node: Node, rewrite: Rewrite) -> None:
    """A clear coat: over a diffuse base ``plastic``, over another one a blend with a mirror.

    Raises:
        SceneRejected: a coat that absorbs, or without one base.
    """
    kind = node.type
    bases = [child for child in node.children if rewrite.target(child).tag in ("bsdf", "ref")]
    absorption = take(node, "sigma_a")
    if len(bases) != 1:
        refuse(node, "needs one material to coat")
    if absorption is not None and any(constant(absorption) or [1.0]):
        refuse(node, f"has a coat that absorbs, and '{kind}' has gone from Mitsuba: use 'plastic' of another colour")
    take(node, "thickness")
    if kind == "roughcoating":
        distribution(node, rewrite)
    inside = _index(named(node, "int_ior"), node, INDICES["bk7"])
    relative = inside / _index(named(node, "ext_ior"), node, INDICES["air"])
    if relative <= 1.0:
        refuse(node, "has a coat that is thinner than what is around it: exchange int_ior and ext_ior")
    base = rewrite.target(bases[0])
    if base.type == "diffuse":
        _coat_diffuse(node, base, internal_reflectance(relative), rewrite)
    else:
        _coat_other(node, bases[0], ((relative - 1.0) / (relative + 1.0)) ** 2, rewrite)


def _coat_diffuse(node: Node, base: Node, inside: float, rewrite: Rewrite) -> None:
    """``plastic`` without the light that a coat throws back inside, which 0.6 leaves out.

    Today's plastic divides its diffuse part by 1 - F, F being the internal reflectance. A blend with a
    plastic of a black base, of weight F, is what 0.6 computes.
    """
    kind = node.type
    if named(node, "int_ior") is None:
        put(node, "string", "int_ior", "bk7")
    colour = named(base, "reflectance")
    parts = [child for child in node.children if rewrite.target(child) is not base]
    materials = []
    for black in (False, True):
        copies = [rewrite.copy(part, part.attributes.get("name", "")) for part in parts]
        material = element(node, "bsdf", {"type": "plastic" if kind == "coating" else "roughplastic"}, copies)
        if colour is not None and not black:
            material.children.append(rewrite.copy(colour, "diffuse_reflectance"))
        else:
            put(material, "float", "diffuse_reflectance", 0.0 if black else DIFFUSE)
        materials.append(material)
    _become(node, "blendbsdf", materials)
    put(node, "float", "weight", inside)
    if kind == "roughcoating":
        rewrite.warn(node, "stands for 'roughcoating' of Mitsuba 0.x: its base differs a little in brightness")


def _coat_other(node: Node, base: Node, reflectance: float, rewrite: Rewrite) -> None:
    """A mirror that takes the share of light that a coat reflects at normal incidence."""
    kind = node.type
    coat = element(node, "bsdf", {"type": "conductor" if kind == "coating" else "roughconductor"})
    names = {"specular_reflectance", *(ROUGH if kind == "roughcoating" else ())}
    coat.children = [child for child in node.children if child.attributes.get("name") in names]
    put(coat, "string", "material", "none")
    base.attributes.pop("name", None)
    _become(node, "blendbsdf", [base, coat])
    put(node, "float", "weight", reflectance)
    rewrite.warn(node, f"stands for '{kind}' of Mitsuba 0.x: its coat reflects alike from all sides")


def internal_reflectance(relative: float) -> float:
    """Share of diffuse light that a smooth surface of a relative index above 1 throws back inside.

    The fit of Egan and Hilgeman (1973), as Mitsuba's ``plastic`` has it, whose factor it must cancel.
    """
    return float(-1.4399 / relative**2 + 0.7099 / relative + 0.6681 + 0.0636 * relative)


def mixture(node: Node, rewrite: Rewrite) -> None:
    """A weighted sum as nested blends; what is missing from 1 is black.

    Raises:
        SceneRejected: weights that do not fit the materials, or too many.
    """
    given = take(node, "weights")
    weights = numbers(given.attributes.get("value", "")) if given is not None else []
    materials = [child for child in node.children if rewrite.target(child).tag in ("bsdf", "ref")]
    if len(weights) != len(materials) or not 0 < len(weights) <= MAX_MIXED:
        refuse(node, f"needs one weight for each of its materials, at most {MAX_MIXED}")
    total = sum(weights)
    if min(weights) < 0.0 or not total > 0.0:
        refuse(node, "needs weights of at least 0 that do not sum to 0")
    for material in materials:
        material.attributes.pop("name", None)
    if total < 1.0 or len(materials) == 1:
        weights, materials = [*weights, max(1.0 - total, 0.0)], [*materials, _black(node)]
    _blend(node, weights, materials)


def _blend(node: Node, weights: list[float], materials: list[Node]) -> None:
    """Make ``node`` the sum; halves first, so that blends nest as little as they can."""
    half = len(materials) // 2
    parts = []
    for values, group in ((weights[:half], materials[:half]), (weights[half:], materials[half:])):
        part = group[0]
        if len(group) > 1:
            part = element(node, "bsdf", {"type": "blendbsdf"})
            _blend(part, values, group)
        parts.append(part)
    _become(node, "blendbsdf", parts)
    total = sum(weights)
    put(node, "float", "weight", sum(weights[half:]) / total if total > 0.0 else 0.0)


def bumpmap(node: Node, rewrite: Rewrite) -> None:
    """The scale of its texture is a parameter of its own today."""
    for index, child in enumerate(node.children):
        source = rewrite.target(child)
        inner = [part for part in source.children if part.attributes.get("name") != "scale"]
        if source.tag == "texture" and source.type == "scale" and len(inner) == 1:
            factor = number_of(source, "scale", 1.0) * number_of(node, "scale", 1.0)
            node.children[index] = rewrite.copy(inner[0], "")
            node.children[index].attributes.pop("name", None)
            put(node, "float", "scale", factor)
            return


def transmitter(node: Node, _: Rewrite) -> None:
    """A diffuse transmitter: the transmitting half of today's thin material, without its surface."""
    node.attributes["type"] = "principledthin"
    colour = named(node, "transmittance")
    if colour is None:
        put(node, "float", "base_color", 0.5)
    else:
        colour.attributes["name"] = "base_color"
    for name, value in (("diff_trans", 2.0), ("spec_trans", 0.0), ("eta", 1.0)):
        put(node, "float", name, value)


def _index(given: Node | None, owner: Node, default: float) -> float:
    """The index of refraction that a parameter gives by name or number."""
    if given is None:
        return default
    text = given.attributes.get("value", "").strip().lower()
    value = numbers(text)
    if text in INDICES:
        return INDICES[text]
    if len(value) != 1 or not value[0] > 0.0:
        refuse(given, f"in {owner} is no index of refraction: give a number above 0")
    return value[0]


def _black(node: Node) -> Node:
    black = element(node, "bsdf", {"type": "diffuse"})
    put(black, "float", "reflectance", 0.0)
    return black


def _become(node: Node, plugin: str, materials: list[Node]) -> None:
    """Make ``node`` another material, of which only the id and the name stay."""
    node.attributes["type"] = plugin
    node.children = list(materials)
