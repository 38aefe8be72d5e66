"""What a scene file says of how it is to be rendered: advice, which settings of a job may overrule. Imports no Mitsuba.

An integrator decides nothing of what the scene is. Its parameters that our settings have become the defaults of a
job, and so do the samples of the sampler; an integrator that is not known is warned about. A file that says nothing of
the length of paths means paths without limit, as in Mitsuba: a limit of our own would make its image darker.
"""

from __future__ import annotations

from elps_core.scene import plugins
from elps_core.scene.markup import Node
from elps_core.scene.summary import FileDefaults
from elps_core.scene.text import shown
from elps_core.settings import MAX_DEPTH

_AROUND = frozenset({"aov", "moment", "stokes"})
"""Integrators that have another one inside, which makes the image."""
UNLIMITED = -1
"""As Mitsuba's files write a depth without limit."""


def take(integrators: list[Node], samplers: list[Node]) -> tuple[FileDefaults, list[str]]:
    """The defaults that a scene file sets for its jobs, and warnings.

    Args:
        integrators: the integrators of the scene, in the order of the file; the first one counts.
        samplers: the samplers of its cameras.
    """
    warnings: list[str] = []
    values: dict[str, int | bool | str] = {"max_depth": UNLIMITED}
    counts = {count for node in samplers if (count := _whole(node, "sample_count")) is not None and count > 0}
    if counts:
        values["samples"] = max(counts)
    node = integrators[0] if integrators else None
    while node is not None and node.type in _AROUND:
        warnings.append(f"{node}: its '{shown(node.type)}' output is not rendered: the image is that of paths")
        node = next((child for child in node.children if child.tag == "integrator"), None)
    if node is None:
        return FileDefaults.model_validate(values), warnings
    if node.type not in plugins.INTEGRATORS:
        warnings.append(f"{node}: this integrator is not known: the job's own renders")
        return FileDefaults.model_validate(values), warnings
    values["integrator"] = node.type
    depth, start = _whole(node, "max_depth"), _whole(node, "rr_depth")
    if depth is not None and (depth >= 1 or depth == UNLIMITED):
        values["max_depth"] = min(depth, MAX_DEPTH)
        if depth > MAX_DEPTH:
            warnings.append(f"{node}: max_depth {depth} is taken as {MAX_DEPTH}, the longest path there is")
    if start is not None and start >= 1:
        values["rr_depth"] = min(start, MAX_DEPTH)
    hidden = node.property("boolean", "hide_emitters")
    if hidden is not None and hidden.attributes.get("value", "").strip().lower() == "true":
        values["hide_emitters"] = True
    return FileDefaults.model_validate(values), warnings


def _whole(node: Node, name: str) -> int | None:
    """An integer parameter, or None where it is absent or no integer."""
    given = node.property("integer", name)
    try:
        return None if given is None else int(given.attributes.get("value", ""))
    except ValueError:
        return None
