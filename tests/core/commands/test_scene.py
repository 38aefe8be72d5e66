"""``elps scene info``: what a scene holds and what its file says, as text and as JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from elps_core.cli import application
from elps_core.errors import SceneRejected

XML = """<scene version="3.0.0"><default name="r" value="1"/>
<integrator type="path"><integer name="max_depth" value="7"/></integrator><integrator type="vcm"/>
<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="24"/>
</film></sensor>
<emitter type="constant"/><shape type="sphere"><float name="radius" value="$r"/></shape></scene>"""


def test_all_that_matters_is_told(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(XML)
    told = CliRunner().invoke(application(), ["scene", "info", str(tmp_path), "-D", "r=2"])
    assert told.exit_code == 0, told.output
    for words in ("32x24", "1 constant", "diffuse", "r = 2", "7, as the file says", "sha256:"):
        assert words in told.output
    line = CliRunner().invoke(application(), ["scene", "info", str(tmp_path), "--json"])
    facts = json.loads(line.output)
    assert facts["summary"]["defaults"]["max_depth"] == 7
    assert facts["summary"]["parameters"] == [{"name": "r", "value": "1"}]


def test_a_scene_that_does_not_load_is_refused(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(XML.replace("sphere", "evil"))
    with pytest.raises(SceneRejected, match="line 5"):
        CliRunner().invoke(application(), ["scene", "info", str(tmp_path)], catch_exceptions=False)
