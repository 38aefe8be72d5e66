"""A scene's integrator and sampler are advice: known values become defaults of a job, and none is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from elps_core.scene.summary import FileDefaults
from elps_core.settings import MAX_DEPTH, RenderSettings, with_file_defaults

from .conftest import SENSOR, SQUARE, load, scene_xml

DEPTHS = '<integer name="max_depth" value="7"/><integer name="rr_depth" value="3"/>'


@pytest.mark.parametrize(
    ("integrator", "expected"),
    [
        (f'<integrator type="path">{DEPTHS}</integrator>', {"integrator": "path", "max_depth": 7, "rr_depth": 3}),
        (
            '<integrator type="volpath"><integer name="max_depth" value="-1"/>'
            '<boolean name="hide_emitters" value="true"/></integrator>',
            {"integrator": "volpath", "max_depth": -1, "hide_emitters": True},
        ),
        ('<integrator type="path"><integer name="max_depth" value="9999"/></integrator>',
         {"integrator": "path", "max_depth": 256}),
        ('<integrator type="path"><boolean name="hide_emitters" value="false"/></integrator>',
         {"integrator": "path", "max_depth": -1}),
        ("", {"max_depth": -1}),
    ],
)  # fmt: skip
def test_parameters_of_a_known_integrator_are_defaults(
    integrator: str, expected: dict[str, object], tmp_path: Path
) -> None:
    assert load(tmp_path, scene_xml(integrator + SQUARE)).summary.defaults == FileDefaults.model_validate(expected)


@pytest.mark.parametrize(
    ("integrator", "word"),
    [
        (f'<integrator type="irrcache">{DEPTHS}</integrator>', "not known"),
        (f'<integrator type="aov"><string name="aovs" value="d:depth"/><integrator type="path">{DEPTHS}</integrator>'
         "</integrator>", "aov"),
    ],
)  # fmt: skip
def test_an_integrator_that_is_left_out_is_warned_about(integrator: str, word: str, tmp_path: Path) -> None:
    summary = load(tmp_path, scene_xml(integrator + SQUARE)).summary
    assert [warning for warning in summary.warnings if word in warning]
    assert summary.defaults.max_depth == (7 if "aov" in integrator else -1)


def test_samples_of_the_sampler_are_a_default(tmp_path: Path) -> None:
    sampler = '<sampler type="independent"><integer name="sample_count" value="96"/></sampler>'
    sensor = SENSOR.replace("</film>", f"</film>{sampler}")
    assert load(tmp_path, scene_xml(sensor=sensor)).summary.defaults.samples == 96


def test_what_was_given_wins_over_the_file() -> None:
    file = {"max_depth": 7, "rr_depth": 3}
    assert with_file_defaults(RenderSettings(), file).max_depth == 7
    given = with_file_defaults(RenderSettings(max_depth=RenderSettings().max_depth), file)
    assert (given.max_depth, given.rr_depth) == (RenderSettings().max_depth, 3)


def test_what_keeps_vertices_takes_the_longest_paths_that_it_can_keep() -> None:
    limits = {name: with_file_defaults(RenderSettings(integrator=name), {"max_depth": -1}).max_depth
              for name in ("path", "auto", "bdpt", "pssmlt")}  # fmt: skip
    assert limits == {"path": -1, "auto": -1, "bdpt": MAX_DEPTH, "pssmlt": MAX_DEPTH}
