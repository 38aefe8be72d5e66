"""Scene files of older Mitsubas as today's, by changing the tree before it is checked. Imports no Mitsuba.

Nothing is left to Mitsuba's own step, which renames parameters while it reads, past every check, and
knows few of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from elps_core.scene import known, legacy, upgrade_bsdfs, upgrade_lights
from elps_core.scene.markup import Node
from elps_core.scene.rewriting import (
    Rewrite,
    named,
    numbers,
    put,
    refuse,
    take,
    text_of,
)
from elps_core.scene.text import shown
from elps_core.scene.upgrade_values import (
    camel_to_underscore,
    limit_reflectance,
    upgrade_names,
    upgrade_uv,
    upgrade_value,
)

Version = tuple[int, int, int]

FIRST_UNDERSCORED: Version = (2, 0, 0)
"""The version whose names are today's."""
TODAY = "3.0.0"
"""What an upgraded file says of itself, so that nothing upgrades it again."""
LINEAR_FILES = (".exr", ".hdr", ".pfm", ".rgbe")
"""Endings of images that are linear whatever their gamma is said to be."""
EDGE_MODES = frozenset({"black", "one", "white", "zero"})
"""Wrap modes of 0.x that put a constant around an image."""

_Handler = Callable[[Node, Rewrite], None]
_HANDLERS: dict[tuple[str, str], _Handler] = {
    ("bsdf", "bumpmap"): upgrade_bsdfs.bumpmap,
    ("bsdf", "coating"): upgrade_bsdfs.coating,
    ("bsdf", "conductor"): upgrade_bsdfs.conductor,
    ("bsdf", "difftrans"): upgrade_bsdfs.transmitter,
    ("bsdf", "diffuse"): upgrade_bsdfs.diffuse,
    ("bsdf", "mirror"): upgrade_bsdfs.mirror,
    ("bsdf", "mixturebsdf"): upgrade_bsdfs.mixture,
    ("bsdf", "phong"): upgrade_bsdfs.phong,
    ("bsdf", "roughcoating"): upgrade_bsdfs.coating,
    ("bsdf", "roughconductor"): upgrade_bsdfs.conductor,
    ("bsdf", "roughdielectric"): upgrade_bsdfs.distribution,
    ("bsdf", "roughdiffuse"): upgrade_bsdfs.rough_diffuse,
    ("bsdf", "roughplastic"): upgrade_bsdfs.distribution,
    ("bsdf", "ward"): upgrade_bsdfs.ward,
    ("emitter", "envmap"): upgrade_lights.envmap,
    ("emitter", "sky"): upgrade_lights.sky,
    ("emitter", "sun"): upgrade_lights.sky,
    ("emitter", "sunsky"): upgrade_lights.sky,
    ("medium", "heterogeneous"): upgrade_lights.heterogeneous,
    ("medium", "homogeneous"): upgrade_lights.homogeneous,
    ("phase", "mixturephase"): upgrade_lights.mixture_phase,
    ("sensor", "perspective_rdist"): upgrade_lights.perspective_with_distortion,
    ("texture", "scale"): upgrade_lights.scaled_texture,
    ("texture", "vertexcolors"): upgrade_lights.vertex_colors,
    ("volume", "gridvolume"): upgrade_lights.gridvolume,
}
"""(element, last plugin name of 0.x) -> what makes it today's, once its parts are."""


def upgrade(root: Node, versions: Mapping[str, Version]) -> list[str]:
    """Change a scene's tree in place to today's format.

    Args:
        root: the outermost element, the content of included files in it.
        versions: name of each file, as ``Node.file`` has it -> the Mitsuba that it is written for.

    Returns:
        Warnings, one line each, that name element and line.

    Raises:
        SceneRejected: something has gone from Mitsuba, and nothing is close to it.
    """
    rewrite = Rewrite(root)
    old = {file for file, version in versions.items() if version < FIRST_UNDERSCORED}
    if old:
        _upgrade_tree(root, None, old, rewrite)
        _check_scaled(root)
        if "version" in root.attributes:
            root.attributes["version"] = TODAY
    for node in _below(root):
        _leave_out_unknown(node, rewrite)
    return rewrite.warnings()


def _upgrade_tree(node: Node, owner: Node | None, old: set[str], rewrite: Rewrite) -> None:
    """Change an element and all below it, as far as they stand in old files: parts first, as objects depend on them."""
    changes = node.file in old
    if changes:
        _upgrade_words(node, owner, rewrite)
    for child in list(node.children):
        _upgrade_tree(child, node, old, rewrite)
    if changes and node.type and node.tag != "integrator":
        _upgrade_object(node, rewrite)


def _upgrade_words(node: Node, owner: Node | None, rewrite: Rewrite) -> None:
    """Give an element and its parameters today's names, and a value today's form."""
    of_old_cameras = node.tag == "camera"
    node.tag = legacy.TAGS.get(node.tag, node.tag)
    node.children = [child for child in node.children if child.tag != "null"]
    for child in node.children:
        if child.tag == "lookAt":
            child.tag = "lookat"
    if not node.type:
        upgrade_names(node, {})
        upgrade_value(node, owner, rewrite)
        return
    kind = node.type.lower()
    node.attributes["type"] = legacy.PLUGINS.get((node.tag, kind), kind)
    upgrade_names(node, legacy.PARAMETERS.get((node.tag, node.type), {}))
    if of_old_cameras:
        upgrade_lights.camera(node)


def _upgrade_object(node: Node, rewrite: Rewrite) -> None:
    if cure := legacy.GONE.get((node.tag, node.type)):
        refuse(node, f"has gone from Mitsuba: {cure}")
    if node.tag == "bsdf" and node.type not in upgrade_bsdfs.LOBES:
        limit_reflectance(node, rewrite)
    elif node.tag == "texture":
        upgrade_uv(node)
    elif node.tag == "shape":
        upgrade_lights.shape(node)
    elif node.tag == "subsurface":
        refuse(node, "has gone from Mitsuba: put a medium inside the shape, or replace the material")
    if handler := _HANDLERS.get((node.tag, node.type)):
        handler(node, rewrite)
    gone = legacy.NO_EFFECT.get(node.tag, frozenset())
    rewrite.leave_out(node, [child for child in node.children if child.attributes.get("name") in gone])


def _check_scaled(root: Node) -> None:
    """Drop textures that scaled others, and refuse those that are still in use."""
    used = {node.attributes.get("id") for node in _below(root) if node.tag == "ref"}
    for node in _below(root):
        kept = []
        for child in node.children:
            if (child.tag, child.type) != ("texture", "scale"):
                kept.append(child)
            elif child.attributes.get("id") in used or node.tag != "scene":
                refuse(child, "scales a texture, and nothing does today: change the texture itself")
        node.children = kept


def _below(root: Node) -> Iterator[Node]:
    """The element and all below it, in the order of the file."""
    todo = [root]
    while todo:
        node = todo.pop()
        yield node
        todo.extend(reversed(node.children))


def _leave_out_unknown(node: Node, rewrite: Rewrite) -> None:
    """In a file of any version: what the image does not depend on is no reason to refuse the scene."""
    if node.tag in known.PARAMETERS:
        _fit_recorder(node, rewrite)
    elif node.tag == "integrator":
        # It is left out itself: what no advice is taken from is no matter.
        node.children = [
            child
            for child in node.children
            if child.tag == "integrator" or child.attributes.get("name") in known.ADVICE
        ]
    elif node.tag == "bsdf" and node.type in known.SMOOTH:
        _fit_equal_indices(node)
    elif node.tag in known.HARMLESS:
        if (node.tag, node.type) == ("texture", "bitmap"):
            _fit_bitmap(node, rewrite)
        names = known.HARMLESS[node.tag]
        rewrite.leave_out(node, [child for child in node.children if child.attributes.get("name") in names])


def _fit_recorder(node: Node, rewrite: Rewrite) -> None:
    """A film, sampler or filter: plugins and parameters that today's Mitsuba knows."""
    plugins = known.PARAMETERS[node.tag]
    if node.tag == "film" and node.type not in plugins.keys() | known.OLD_FILMS:
        return
    if node.type not in plugins:
        old, node.attributes["type"] = node.type, known.SUBSTITUTES[node.tag]
        if old == "mfilm" and named(node, "pixel_format") is None:
            put(node, "string", "pixel_format", "luminance")  # Its own default
        rewrite.warn(node, f"stands for '{shown(old)}', which today's Mitsuba does not have")
    rewrite.leave_out(node, [child for child in node.children if not _is_taken(child, node, plugins[node.type])])


def _is_taken(child: Node, recorder: Node, names: frozenset[str]) -> bool:
    """Whether Mitsuba takes a part of a film, sampler or filter whose parameters are ``names``."""
    if recorder.type == "specfilm" and child.tag in ("spectrum", "texture"):  # A band, under a name of its own
        return True
    if child.is_object or child.tag == "ref":
        return child.tag in ("ref", "rfilter")
    return child.attributes.get("name") in names and _is_choice(child, recorder)


def _is_choice(child: Node, owner: Node) -> bool:
    """Whether a text is one that Mitsuba takes there; it is put into today's spelling."""
    choices = known.CHOICES.get((owner.tag, child.attributes.get("name", "")))
    value = camel_to_underscore(child.attributes.get("value", "").strip()).lower()
    if choices is not None and value in choices:
        child.attributes["value"] = value
    return choices is None or value in choices


def _fit_equal_indices(node: Node) -> None:
    """A rough surface between equal indices of refraction is a smooth one."""
    inside, around = _index(named(node, "int_ior")), named(node, "ext_ior")
    outside = legacy.INDICES["air"] if around is None else _index(around)
    if inside is not None and inside == outside:
        node.attributes["type"] = known.SMOOTH[node.type]
        for name in known.ROUGHNESS:
            take(node, name)


def _index(given: Node | None) -> float | None:
    """An index of refraction by name or number; None of anything else."""
    if given is None:
        return None
    text = given.attributes.get("value", "").strip().lower()
    value = numbers(text)
    return legacy.INDICES.get(text, value[0] if len(value) == 1 else None)


def _fit_bitmap(node: Node, rewrite: Rewrite) -> None:
    """Gamma, filter and edges of an image, in today's words."""
    filter_type, gamma = named(node, "filter_type"), named(node, "gamma")
    if filter_type is not None and not _is_choice(filter_type, node):
        rewrite.leave_out(node, [filter_type])
    if gamma is not None:
        if numbers(gamma.attributes.get("value", "")) != [1.0]:
            rewrite.leave_out(node, [gamma])
        else:
            take(node, "gamma")
            if named(node, "raw") is None and not text_of(node, "filename").endswith(LINEAR_FILES):
                put(node, "boolean", "raw", "true")
    u, v = (text_of(node, f"wrap_mode_{axis}", text_of(node, "wrap_mode", "repeat")) for axis in "uv")
    if named(node, "wrap_mode_u") is not None or named(node, "wrap_mode_v") is not None:
        if u != v:
            rewrite.warn(node, f"wraps as '{shown(u)}' both ways: today's Mitsuba has one mode for an image")
        for name in ("wrap_mode_u", "wrap_mode_v"):
            take(node, name)
        put(node, "string", "wrap_mode", u)
    if u in EDGE_MODES:
        put(node, "string", "wrap_mode", "clamp")
        rewrite.warn(node, f"repeats its edge outside, where it was '{u}'")
