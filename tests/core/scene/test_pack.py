"""Packing a scene: a bundle of its own that is the same scene, wherever the files lay."""

from __future__ import annotations

import zipfile
from pathlib import Path

from elps_core.scene.loader import load_scene
from elps_core.scene.pack import pack

from .conftest import OBJ, VARIANT, Reject, folder_of, mesh, png, scene_xml, texture


def test_files_from_above_and_included_ones_travel(tmp_path: Path, reject: Reject) -> None:
    body = '<include filename="../parts/a.xml"/>' + texture("../textures/A b.png")
    body += '<integrator type="path"><integer name="max_depth" value="7"/></integrator>'
    included = f'<scene version="3.0.0"><default name="k" value="a"/>{mesh("obj", "../parts/$k.obj")}</scene>'
    folder_of(
        tmp_path,
        {
            "scene/room.xml": scene_xml(body),
            "parts/a.xml": included.encode(),
            "parts/a.obj": OBJ,
            "parts/b.obj": OBJ.replace(b"1 0 0", b"2 0 0"),
            "textures/A b.png": png(2, 2, 2),
        },
    )
    xml, bundle = tmp_path / "scene" / "room.xml", tmp_path / "room.zip"
    assert "--root" in reject(pack, xml, bundle)
    for defines in ({}, {"k": "b"}):
        pack(xml, bundle, root=tmp_path, defines=defines)
        here = load_scene(xml, VARIANT, root=tmp_path, defines=defines)
        there = load_scene(bundle, VARIANT)
        assert there.digest == here.digest
        assert there.summary.defaults == here.summary.defaults
    with zipfile.ZipFile(bundle) as archive:
        assert len(archive.namelist()) == 3
