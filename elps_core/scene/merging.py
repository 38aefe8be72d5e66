"""Meshes of one material become one mesh when a scene is made: what a kernel costs follows the materials.

Each ray that is traced asks every shape of the scene how it would be met, and all these answers are code: for a
thousand meshes a tenth of a second or two each time a kernel is put together, before any ray is traced.

Mitsuba has a merging of its own. It is not used: its meshes stand in an order that is another one in each process,
rectangles lose their bounding box by it, and the scene with them, and it refuses a scene in which a material is on
meshes with flipped normals and on others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from elps_core.arrays import on_device
from elps_core.scene import plugins
from elps_core.scene.pieces import mark_pieces, only_turns

MESHES = frozenset({"cube", "obj", "ply", "rectangle", "serialized"})
"""Shapes that are triangles with normals and texture coordinates, and nothing else."""
GEOMETRY = frozenset({"face_normals", "filename", "flip_normals", "flip_tex_coords", "shape_index", "to_world"})
"""Parameters of theirs that end in vertices, faces and the two flags that a merged mesh has as well."""
_PARTS = "elps_parts"
"""Plugin that takes the place of the scene while its parts are made."""


@dataclass(frozen=True)
class _Group:
    """What meshes have in common that may be one."""

    material: mi.BSDF
    face_normals: bool
    flipped: bool
    normals: bool
    texcoords: bool


def candidates(state: Any) -> frozenset[str]:
    """Parameters of the scene that are meshes with a material and nothing else; those without one share Mitsuba's own.

    Args:
        state: a parsed scene whose references are resolved. It gains the shared material.
    """
    resolved = mi.Properties.Type.ResolvedReference
    root = state.root.props
    found, bare = [], []
    for name in root.keys():  # noqa: SIM118 -- Mitsuba's Properties are no mapping
        if root.type(name) != resolved:
            continue
        number = root[name].index()
        node = state.nodes[number]
        if node.type != mi.ObjectType.Shape or node.props.plugin_name() not in MESHES:
            continue
        names = node.props.keys()
        parts = [key for key in names if node.props.type(key) == resolved]
        materials = [key for key in parts if state.nodes[node.props[key].index()].type == mi.ObjectType.BSDF]
        if materials != parts or not set(names) <= GEOMETRY.union(parts):
            continue
        found.append(name)
        if not parts:
            bare.append(number)
    if bare:
        shared = mi.parser.SceneNode()
        shared.type, shared.props = mi.ObjectType.BSDF, mi.Properties(plugins.DEFAULT_MATERIAL)
        state.nodes.append(shared)
        # The list may have moved: what was taken from it before is not to be touched.
        for number in bare:
            state.nodes[number].props["bsdf"] = mi.Properties.ResolvedReference(len(state.nodes) - 1)
    return frozenset(found)


def make_parts(config: Any, state: Any) -> mi.Properties:
    """Make all objects of a parsed scene but the scene itself, which would sort triangles that are sorted again.

    Returns: the parameters of the scene, objects in the order of the file.

    Raises:
        RuntimeError: Mitsuba cannot make one; its message names the place in the text.
    """
    mi.register_rfilter(_PARTS, _keep)
    root = state.root
    root.type = mi.ObjectType.ReconstructionFilter
    root.props.set_plugin_name(_PARTS)
    mi.parser.instantiate(config, state)
    # A copy, as the state keeps all that was made alive, and with it the meshes that are merged.
    parts = mi.Properties(root.props)
    parts.set_plugin_name("scene")
    state.nodes.clear()
    return parts


def _keep(parts: mi.Properties) -> mi.Object:
    """In place of the scene: takes every parameter. What it returns is not used."""
    for name in parts.keys():  # noqa: SIM118
        parts.mark_queried(name)
    return mi.load_dict({"type": "box"})


def shapes_of(parts: mi.Properties) -> list[mi.Shape]:
    """The shapes among a scene's parameters, in the order of the file."""
    return [part for _, part in parts.objects() if isinstance(part, mi.Shape)]


def merge(parts: mi.Properties, names: frozenset[str]) -> mi.Properties:
    """A scene's parameters with one mesh for all of a material and a kind, at the place of the first of them.

    Args:
        parts: the scene's parameters.
        names: those that are meshes with a material and nothing else.
    """
    groups: dict[_Group, list[mi.Mesh]] = {}
    place: dict[str, _Group] = {}
    for name, part in parts.objects():
        # Colours come with the file.
        if name in names and not part.has_mesh_attributes():
            place[name] = _group_of(part)
            groups.setdefault(place[name], []).append(part)
    result = mi.Properties("scene")
    for name in parts.keys():  # noqa: SIM118
        group = place.get(name)
        if group is None:
            result[name] = parts[name]
        elif group in groups:
            meshes = groups.pop(group)
            result[name] = _one_of(group, meshes) if len(meshes) > 1 else meshes[0]
    return result


def _group_of(mesh: mi.Mesh) -> _Group:
    return _Group(
        mesh.bsdf(),
        mesh.has_face_normals(),
        bool(mesh.has_flipped_normals()),
        mesh.has_vertex_normals(),
        mesh.has_vertex_texcoords(),
    )


def _one_of(group: _Group, meshes: list[mi.Mesh]) -> mi.Mesh:
    """One mesh with the faces of all, one after the other."""
    properties = mi.Properties("merged")
    properties["bsdf"] = group.material
    properties["face_normals"] = group.face_normals
    properties["flip_normals"] = group.flipped
    properties.set_id(meshes[0].id())
    vertices = np.array([mesh.vertex_count() for mesh in meshes])
    starts = (np.cumsum(vertices) - vertices).astype(np.uint32)
    faces = np.concatenate(
        [np.asarray(mesh.faces_buffer()) + start for mesh, start in zip(meshes, starts, strict=True)]
    )
    merged = mi.Mesh("merged", int(vertices.sum()), len(faces) // 3, properties, group.normals, group.texcoords)
    buffers = {
        "faces": faces,
        "vertex_positions": np.concatenate([np.asarray(mesh.vertex_positions_buffer()) for mesh in meshes]),
    }
    if group.normals:
        buffers["vertex_normals"] = np.concatenate([np.asarray(mesh.vertex_normals_buffer()) for mesh in meshes])
    if group.texcoords:
        buffers["vertex_texcoords"] = np.concatenate([np.asarray(mesh.vertex_texcoords_buffer()) for mesh in meshes])
    # Not followed by update(), which would compute normals anew.
    parameters = mi.traverse(merged)
    for name, values in buffers.items():
        parameters[name] = on_device(type(parameters[name]), values)
    merged.recompute_bbox()
    merged.initialize()
    if only_turns(group.material):
        mark_pieces(merged, [mesh.face_count() for mesh in meshes])
    return merged


def make_scene(parts: mi.Properties) -> mi.Scene:
    """The scene of these parameters.

    Raises:
        RuntimeError: Mitsuba cannot make it, or does not know a parameter; the message names the first line.
    """
    try:
        scene = mi.PluginManager.instance().create_object(parts)
    except RuntimeError as error:
        raise RuntimeError(f"At the scene (line 1, col 1): {error}") from None
    unknown = parts.unqueried()
    if unknown:
        raise RuntimeError(f'At the scene (line 1, col 1): unknown "{unknown[0]}"')
    return scene
