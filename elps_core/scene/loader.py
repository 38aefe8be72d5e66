"""From a checked bundle to a Mitsuba scene, without ever letting the scene choose what code runs.

Only the canonical text of a scene (:mod:`elps_core.scene.canonical`) reaches Mitsuba, with a file resolver that knows
Mitsuba's own folder and no other.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from elps_core import device
from elps_core.errors import SceneRejected
from elps_core.scene import films, measure, plugins, rules
from elps_core.scene.bundle import is_archive, root_xml, unpack
from elps_core.scene.canonical import CanonicalScene, canonicalize
from elps_core.scene.explain import explain
from elps_core.scene.files import Files
from elps_core.scene.markup import Node
from elps_core.scene.summary import EmitterSummary, Parameter, SceneSummary, SensorSummary
from elps_core.scene.text import few, shown

if TYPE_CHECKING:
    import mitsuba as mi

    from elps_core.scene.emission import Emission
    from elps_core.scene.placement import Placement

_EXPECTED = {
    "emitter": "the scene has no emitters: the image will be black; add one",
    "shape": "the scene has no shapes: there is nothing to see",
}
"""Element -> the warning where a scene has none."""
_MEDIUM = (
    "the scene has participating media, which path, light, bdpt, pssmlt and mi_path leave out: "
    "choose mi_volpath to see them"
)
_NO_SURFACE = ("instance", "shapegroup")
"""Shapes whose surfaces are those of others."""
_TOO_LARGE = "the scene needs more memory than there is: make its meshes and images smaller"


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


@dataclass(frozen=True)
class _Made:
    """A scene that Mitsuba has made, and where it stands."""

    scene: mi.Scene
    triangles: int
    placement: Placement
    warnings: tuple[str, ...]


def _instantiate(mi_: Any, canonical: CanonicalScene, variant: str) -> _Made:
    # Here: they need the variant that is set by now.
    from elps_core.scene import attributes, groups, merging, placement, placing

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
        names, maps, reads = merging.candidates(state), placing.file_maps(state), attributes.read(state)
        parts = merging.make_parts(config, state)
        triangles = measure.triangles(groups.with_parts(merging.shapes_of(parts)))
        placed = placement.measured(merging.shapes_of(parts), measuring)
        warnings = (*placement.coarse_meshes(parts, maps), *attributes.missing(parts, reads))
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
    return _Made(scene, triangles, placed, (*warnings, *placement.remote(scene, placed)))


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
