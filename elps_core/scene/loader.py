"""From a checked bundle to a Mitsuba scene, without ever letting the scene choose what code runs.

The scene file is read here (:mod:`elps_core.scene.markup`), checked against lists, and written anew as
a canonical text with absolute file names. Only that text reaches Mitsuba, with a file resolver that
knows Mitsuba's own folder and no other.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Mapping
from contextlib import ExitStack
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from elps_core import device
from elps_core.errors import SceneRejected
from elps_core.scene import advice, films, headers, markup, measure, meshes, plugins, reading, rules
from elps_core.scene.bundle import is_archive, open_regular, root_xml, unpack
from elps_core.scene.digest import file_hash, scene_digest, surroundings_digest
from elps_core.scene.explain import explain
from elps_core.scene.files import Files
from elps_core.scene.markup import Node
from elps_core.scene.summary import EmitterSummary, FileDefaults, Parameter, SceneSummary, SensorSummary
from elps_core.scene.text import few, shown

if TYPE_CHECKING:
    import mitsuba as mi

    from elps_core.scene.emission import Emission
    from elps_core.scene.placement import Placement

MAX_SCENE_BYTES = 4 * 2**30
"""Memory that all files of a scene may take together, each counted as often as it is used."""
_EXPECTED = {
    "emitter": "the scene has no emitters: the image will be black; add one",
    "shape": "the scene has no shapes: there is nothing to see",
}
"""Element -> the warning where a scene has none."""
_MEDIUM = (
    "the scene has participating media, which path, light, bdpt, pssmlt and mi_path leave out: "
    "choose mi_volpath to see them"
)
_NO_CAMERA = "the scene has no <sensor>: a camera stands in front of it, looks along z and sees all of it"
_NO_SURFACE = ("instance", "shapegroup")
"""Shapes whose surfaces are those of others."""
_TOO_LARGE = "the scene needs more memory than there is: make its meshes and images smaller"


@dataclass(frozen=True)
class CanonicalScene:
    """A scene file that passed every check that needs no Mitsuba."""

    text: str
    """What Mitsuba is given: allowed plugins only, parameters put in, absolute file names."""
    nodes: tuple[Node, ...]
    """The element of the scene file behind each line of ``text``."""
    digest: str
    surroundings: str
    """Digest without the cameras."""
    root: Node
    """The tree of ``text``. The scene's integrator is left out: settings decide."""
    sensors: tuple[Node, ...]
    """Cameras in the order of the scene file."""
    files: frozenset[str]
    """The absolute file names in ``text``."""
    parameters: Mapping[str, str]
    """The parameters that can be set, with their values."""
    defaults: FileDefaults
    """What the file says of its render."""
    integrators: tuple[Node, ...]
    """Those of the scene file, which say it."""
    framed: bool
    """Whether the file has no camera, and one is to be put where it sees all shapes."""
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class LoadedScene:
    """A scene in memory, and what is known about it."""

    scene: mi.Scene
    sensor: mi.Sensor
    digest: str
    """Of the scene as uploaded: a changed size does not enter."""
    summary: SceneSummary
    variant: str
    size: tuple[int, int]
    """Width and height of the chosen camera's image in pixels."""
    sensor_index: int
    """Which camera of the scene file was chosen."""
    surroundings: str
    """Digest of the scene without its cameras."""
    extent: float = 1.0
    """How large it is as it is rendered: see :mod:`elps_core.scene.placement`."""
    scale: float = 1.0
    """How much larger it is rendered than it is: what lengths in images are to be divided by."""

    @cached_property
    def emission(self) -> Emission:
        """All its emitters, described when they are first asked for.

        Raises:
            SceneRejected: no emitter, or one that our integrators do not support.
        """
        from elps_core.scene.emission import Emission  # Needs a variant to be set

        return Emission(self.scene, self.extent)


def load_scene(
    source: Path,
    variant: str,
    *,
    sensor: int = 0,
    size: tuple[int, int] | None = None,
    root: Path | None = None,
    defines: Mapping[str, str] | None = None,
) -> LoadedScene:
    """Load an .xml file, a .zip bundle or a folder; none of its content is run, whatever it is.

    Args:
        source: what to load. An .xml file may use the files beside and below it.
        variant: Mitsuba variant; it stays set.
        sensor: which camera, in the order of the scene file.
        size: (width, height) in pixels in place of the film's own, whose crop window is dropped.
        root: a folder above an .xml file, whose files it may use as well.
        defines: values of the scene's parameters in place of those of its ``<default>`` elements.

    Raises:
        SceneRejected: damaged, hostile, too large or unsupported; one line without host paths.
        DeviceUnavailable: the variant does not run here.
    """
    if not source.exists():
        raise SceneRejected(f"there is no scene '{shown(source.name)}'")
    source = source.resolve()
    mi_ = device.use(variant)
    ignored: tuple[str, ...] = ()
    with ExitStack() as until_loaded:
        if source.is_dir():
            xml = root_xml(source)
            files = Files(xml.parent, source)
        elif is_archive(source):
            folder = Path(until_loaded.enter_context(tempfile.TemporaryDirectory(prefix="elps-scene-")))
            xml, ignored = unpack(source, folder)
            files = Files(xml.parent, folder)
        else:
            xml = source
            files = Files(xml.parent, root, local=True)
        scratch = Path(until_loaded.enter_context(tempfile.TemporaryDirectory(prefix="elps-scene-")))
        canonical = canonicalize(xml, files, scratch, sensor=sensor, size=size, defines=defines)
        films.check(canonical.root, variant)
        made = _instantiate(mi_, canonical, variant)
        # Numbers are checked while the files exist: Mitsuba may evaluate some of them only now.
        summary = _summarize(made, canonical).model_copy(update={"ignored": ignored})
    scene, extent, scale = made.scene, made.placement.placed_size, made.placement.scale
    chosen = scene.sensors()[sensor]
    shown_size = summary.sensors[sensor]
    film = (shown_size.width, shown_size.height)
    return LoadedScene(
        scene, chosen, canonical.digest, summary, variant, film, sensor, canonical.surroundings, extent, scale
    )


def canonicalize(
    xml: Path,
    files: Files | None = None,
    scratch: Path | None = None,
    *,
    sensor: int = 0,
    size: tuple[int, int] | None = None,
    defines: Mapping[str, str] | None = None,
) -> CanonicalScene:
    """Read and check a scene file and the files that it names. Runs no Mitsuba.

    Args:
        xml: the scene file.
        files: the files that it may name; absent: those of its folder.
        scratch: a folder for files that have to be written anew; absent: they are gone at once.
        sensor: the camera whose film ``size`` applies to.
        size: (width, height) in pixels.
        defines: as in :func:`load_scene`.

    Raises:
        SceneRejected: as :func:`load_scene`.
    """
    files = files or Files(xml.parent)
    document = reading.read(xml, files, defines)
    scene = document.root
    integrators = [child for child in scene.children if child.tag == "integrator"]
    scene.children = [child for child in scene.children if child.tag != "integrator"]
    _flatten(scene)
    rules.check(scene)
    objects = scene.objects()
    defaults, warnings = advice.take(integrators, [node for node in objects if node.tag == "sampler"])
    sensors = _sensors(objects)
    framed = not sensors
    if framed:
        sensors = [Node("sensor", {"type": "perspective"}, scene.line)]
        scene.children += sensors
        warnings.append(_NO_CAMERA)
    absolute: dict[int, str] = {}
    hashed: dict[int, str] = {}
    checked: dict[tuple[str, str, int], _File] = {}
    contents: dict[Path, str] = {}
    memory = 0
    for owner in objects:
        for node, kind in file_names(owner):
            path = files.find(node.attributes.get("filename") or node.attributes.get("value", ""), str(owner))
            key = kind, str(path), rules.part_of(owner)
            if key not in checked:
                checked[key] = _check_file(key, owner, files, scratch, contents)
            file = checked[key]
            memory += file.memory
            if memory > MAX_SCENE_BYTES:
                raise SceneRejected(f"{owner}: with this file the scene needs more than {MAX_SCENE_BYTES >> 30} GiB")
            # A dollar sign in the path of the bundle is no parameter.
            absolute[id(node)] = str(file.path).replace("$", "\\$")
            hashed[id(node)] = f"sha256:{file.content}{path.suffix.lower()}"
    digest = scene_digest(markup.write(scene, hashed)[0])
    surroundings = surroundings_digest(markup.write(_without_sensors(scene), hashed)[0])
    if sensor not in range(len(sensors)):
        raise SceneRejected(f"the scene has {len(sensors)} sensors, counted from 0: there is no sensor {sensor}")
    if size is not None:
        rules.check_film_size(*size)
        _resize(sensors[sensor], objects, size)
    text, nodes = markup.write(_with_emitter(scene, objects), absolute)
    return CanonicalScene(
        text,
        tuple(nodes),
        digest,
        surroundings,
        scene,
        tuple(sensors),
        frozenset(str(file.path) for file in checked.values()),
        document.parameters,
        defaults,
        tuple(integrators),
        framed,
        (*document.warnings, *few(files.warnings), *few(warnings)),
    )


def _with_emitter(root: Node, objects: list[Node]) -> Node:
    """The scene, with an emitter that gives no light where it has none: every algorithm begins or ends at one."""
    if any(node.tag == "emitter" for node in objects):
        return root
    dark = Node("emitter", {"type": "directional"}, root.line)
    dark.children = [Node("rgb", {"name": "irradiance", "value": "0"}, root.line)]
    whole = copy(root)
    whole.children = [*root.children, dark]
    return whole


def _flatten(node: Node) -> None:
    """Put the shapes of each ``merge`` in its place: meshes of one material become one in any case."""
    whole: list[Node] = []
    for child in node.children:
        _flatten(child)
        merges = child.tag == "shape" and child.type == "merge"
        if merges and all(part.tag == "shape" and "name" not in part.attributes for part in child.children):
            whole += child.children
        else:
            whole.append(child)
    node.children = whole


def _without_sensors(root: Node) -> Node:
    bare = copy(root)
    bare.children = [child for child in root.children if child.tag not in ("sensor", "film")]
    return bare


def file_names(owner: Node) -> list[tuple[Node, str]]:
    """The elements below an object that name a file, and how each file is checked."""
    found = []
    for child in owner.children:
        if child.tag == "spectrum" and "filename" in child.attributes:
            if child.is_object:
                raise SceneRejected(f"{child} has both a type and a filename")
            found.append((child, "text"))
        elif child.tag == "string" and child.attributes.get("name") == "filename":
            kind = plugins.FILE_READERS.get((owner.tag, owner.type))
            if kind is None:
                raise SceneRejected(f"{owner} takes no filename")
            found.append((child, kind))
    return found


class _File(NamedTuple):
    """A file that passed its check."""

    memory: int
    """Bytes that it takes at most."""
    content: str
    """Hash of the user's file."""
    path: Path
    """What Mitsuba is given: the file itself, or one that it reads right."""


def _check_file(
    key: tuple[str, str, int], owner: Node, files: Files, scratch: Path | None, contents: dict[Path, str]
) -> _File:
    """Check a file; where Mitsuba would refuse or misread it, write it anew into ``scratch``.

    Args:
        key: how it is read, where it lies, which of its parts is asked for.
        owner: the element that names it.
        files: where it was found.
        scratch: as in :func:`canonicalize`.
        contents: hashes of the files of this scene, taken once each.
    """
    kind, path, part = key[0], Path(key[1]), key[2]
    with open_regular(path) as file, ExitStack() as until_checked:
        content = contents[path] = contents.get(path) or file_hash(file)
        given, opened = path, file
        try:
            mended = headers.mended(kind, file, str(path))
            if mended is not None:
                data, told = mended
                folder = scratch or Path(until_checked.enter_context(tempfile.TemporaryDirectory()))
                given = folder / f"{content}{path.suffix.lower()}"
                given.write_bytes(data)
                opened = until_checked.enter_context(given.open("rb"))
                files.warnings += [f"{owner}: '{files.name_of(path)}' {what}" for what in told]
            opened.seek(0)
            return _File(headers.check(kind, opened, str(given), part), content, given)
        except meshes.BadFileError as error:
            raise SceneRejected(f"{owner}: '{files.name_of(path)}' {error}") from None


def _sensors(objects: list[Node]) -> list[Node]:
    """Cameras that can render, in order; those inside a batch belong to it.

    Raises:
        SceneRejected: a film is too large.
    """
    inside = {id(part) for node in objects if node.tag == "sensor" for part in node.objects()[1:]}
    sensors = [node for node in objects if node.tag == "sensor" and id(node) not in inside]
    for film in objects:
        if film.tag == "film":
            rules.film_size(film)
    return sensors


def _resize(sensor: Node, objects: list[Node], size: tuple[int, int]) -> None:
    """Give a camera a film of its own with another size."""
    original = rules.film_of(sensor, objects)
    sized = {"width": size[0], "height": size[1]}
    dropped = {"crop_width", "crop_height", "crop_offset_x", "crop_offset_y", *sized}
    film = Node("film", {"type": original.type if original else "hdrfilm"}, sensor.line)
    film.children = [
        *(c for c in (original.children if original else ()) if c.attributes.get("name") not in dropped),
        *(Node("integer", {"name": name, "value": str(value)}, film.line) for name, value in sized.items()),
    ]
    replaced = {id(original)}
    if original is not None and all(child is not original for child in sensor.children):
        name = original.attributes["id"]
        replaced = {id(child) for child in sensor.children if child.tag == "ref" and child.attributes["id"] == name}
    sensor.children = [child for child in sensor.children if id(child) not in replaced] + [film]


@dataclass(frozen=True)
class _Made:
    """A scene that Mitsuba has made, and where it stands."""

    scene: mi.Scene
    triangles: int
    placement: Placement
    warnings: tuple[str, ...]


def _instantiate(mi_: Any, canonical: CanonicalScene, variant: str) -> _Made:
    from elps_core.scene import groups, merging, placement, placing  # here: they need the variant that is set by now

    _leave_only_mitsuba(mi_)
    config = mi_.parser.ParserConfig(variant)
    # Objects made in parallel are numbered in the order in which threads were done, kernels that call them differ from
    # process to process, and none is found again on disk.
    config.parallel = False
    # Done by ourselves, in an order that is always the same.
    config.merge_meshes = False
    level = mi_.log_level()
    # Mitsuba's warnings name files of the host.
    mi_.set_log_level(mi_.LogLevel.Error)
    try:
        state = _parse(mi_, config, canonical)
        measuring = placing.rough(state)
        if measuring.moves:
            placing.place(state, measuring)
        names, maps = merging.candidates(state), placing.file_maps(state)
        parts = merging.make_parts(config, state)
        triangles = measure.triangles(groups.with_parts(merging.shapes_of(parts)))
        placed = placement.measured(merging.shapes_of(parts), measuring)
        coarse = placement.coarse_meshes(parts, maps)
        if not placed.puts_as(measuring):
            del parts
            state = _parse(mi_, config, canonical)
            placed = placing.place(state, placed)
            names = merging.candidates(state)
            parts = merging.make_parts(config, state)
            placing.place_made(merging.shapes_of(parts), placed)
        parts = merging.merge(parts, names)
        scene = merging.make_scene(parts)
        if canonical.framed:
            placement.frame(scene)
        placement.approach(scene)
    except (RuntimeError, ValueError, TypeError, IndexError, KeyError, OverflowError, MemoryError) as error:
        if isinstance(error, MemoryError) or "bad_alloc" in str(error):
            raise SceneRejected(_TOO_LARGE) from None
        raise SceneRejected(explain(str(error), canonical.nodes)) from None
    finally:
        mi_.set_log_level(level)
    return _Made(scene, triangles, placed, (*coarse, *placement.remote(scene, placed)))


def _parse(mi_: Any, config: Any, canonical: CanonicalScene) -> Any:
    """The scene as Mitsuba reads it, its references resolved and nothing made."""
    state = mi_.parser.parse_string(config, canonical.text)
    _check_again(state, canonical)
    mi_.parser.transform_all(config, state)
    return state


def _leave_only_mitsuba(mi_: Any) -> None:
    """Take every folder but Mitsuba's own off the file resolver, for good.

    Mitsuba looks for ``plugins/<name>.so`` in each folder in order, the working directory first; a
    plugin that is loaded later, for rendering, must not be found there either.
    """
    resolver = mi_.FileResolver()
    resolver.clear()
    resolver.append(str(Path(mi_.__file__).parent))
    mi_.set_file_resolver(resolver)


def _check_again(state: Any, canonical: CanonicalScene) -> None:
    """Hold what Mitsuba parsed against the lists: a second reader of the same text, before any plugin is loaded."""
    allowed = frozenset().union(*plugins.PLUGINS.values()) | {"scene"}
    for node in state.nodes:
        if node.props.plugin_name() not in allowed:
            raise SceneRejected("the scene names a plugin that is not allowed")
        if "filename" in node.props and node.props["filename"] not in canonical.files:
            raise SceneRejected("the scene names a file that is not in the bundle")


def _summarize(made: _Made, canonical: CanonicalScene) -> SceneSummary:
    measure.check_bounds(made.scene)
    objects = canonical.root.objects()
    cameras = made.scene.sensors()  # in the order of the file
    if len(cameras) != len(canonical.sensors):
        raise SceneRejected("the scene has a <sensor> in a strange place: put each directly inside <scene>")
    sensors: list[SensorSummary] = []
    asked: list[str] = []
    for node, sensor in zip(canonical.sensors, cameras, strict=True):
        width, height = measure.check_sensor(sensor, str(node))
        film = rules.film_of(node, objects)
        asked += films.warnings(film)
        sensors.append(SensorSummary(type=node.type, width=width, height=height, film=films.described(film)))
    counts = Counter(node.type for node in objects if node.tag == "emitter")
    return SceneSummary(
        sensors=tuple(sensors),
        emitters=tuple(EmitterSummary(type=kind, count=count) for kind, count in sorted(counts.items())),
        bsdfs=tuple(sorted(_materials(objects))),
        shapes=sum(node.tag == "shape" for node in objects),
        triangles=made.triangles,
        warnings=(
            *canonical.warnings,
            *_warnings({node.tag for node in objects}),
            *few(list(dict.fromkeys(asked))),
            *few(made.warnings),
        ),
        defaults=canonical.defaults,
        parameters=tuple(Parameter(name=name, value=value) for name, value in canonical.parameters.items()),
    )


def _materials(objects: list[Node]) -> set[str]:
    """Kinds of the materials on shapes, and of those that they are made of."""
    by_id = {node.attributes["id"]: node for node in objects if "id" in node.attributes}

    def parts(owner: Node) -> list[Node]:
        targets = (by_id.get(c.attributes.get("id", "")) if c.tag == "ref" else c for c in owner.children)
        return [target for target in targets if target is not None and target.tag == "bsdf"]

    shapes = [node for node in objects if node.tag == "shape" and node.type not in _NO_SURFACE]
    found = {plugins.DEFAULT_MATERIAL} if any(not parts(shape) for shape in shapes) else set()
    rest = [part for shape in shapes for part in parts(shape)]
    seen: set[int] = set()
    while rest:
        node = rest.pop()
        if id(node) not in seen:
            seen.add(id(node))
            found.add(node.type)
            rest += parts(node)
    return found


def _warnings(tags: set[str]) -> tuple[str, ...]:
    absent = [text for tag, text in _EXPECTED.items() if tag not in tags]
    return (*absent, *([_MEDIUM] if "medium" in tags else []))
