"""Pack a scene file and all that it names into one bundle, wherever the files lie. Imports no Mitsuba."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping
from pathlib import Path

from elps_core.scene import markup
from elps_core.scene.bundle import ROOT_XML
from elps_core.scene.canonical import canonicalize, file_names
from elps_core.scene.files import Files

_ODD = re.compile(r"[^A-Za-z0-9_.-]")
"""Characters that a name in a bundle does not need."""


def pack(xml: Path, bundle: Path, *, root: Path | None = None, defines: Mapping[str, str] | None = None) -> None:
    """Write a .zip that holds one scene file, in today's format and with everything included, and the files it names.

    Args:
        xml: the scene file.
        bundle: the archive to write.
        root: folder whose files the scene may name; absent: the folder of the scene file.
        defines: values of the scene's parameters, which are put in.

    Raises:
        SceneRejected: the scene does not pass the checks that need no Mitsuba.
    """
    files = Files(xml.parent, root, local=True)
    canonical = canonicalize(xml, files, defines=defines)
    names: dict[Path, str] = {}
    named: dict[int, str] = {}
    for owner in canonical.root.objects():
        for node, _ in file_names(owner):
            path = files.find(node.attributes.get("filename") or node.attributes.get("value", ""), str(owner))
            names.setdefault(path, f"files/{len(names):04}-{_ODD.sub('_', path.name)}")
            named[id(node)] = names[path]
    canonical.root.children += canonical.integrators
    text, _ = markup.write(canonical.root, named)
    with zipfile.ZipFile(bundle, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(ROOT_XML, text)
        for path, name in names.items():
            archive.write(path, name)
