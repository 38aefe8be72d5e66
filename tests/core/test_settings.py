"""What can be asked for, and the one line that answers what cannot."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from elps_core.errors import SettingsRejected
from elps_core.options import settings_from
from elps_core.settings import (
    BUILT_INTEGRATORS,
    ENDLESS,
    INTEGRATORS,
    MAX_DEPTH,
    RenderSettings,
    StopCriterion,
    suited,
    with_overrides,
)


@pytest.mark.parametrize("name", INTEGRATORS)
def test_every_integrator_can_be_asked_for(name: str) -> None:
    assert settings_from({"integrator": name}, None, None).integrator == name


def test_every_setting_of_an_algorithm_can_be_set_by_name() -> None:
    given = {
        "integrator": "bdpt",
        "heuristic": "cutoff",
        "path.next_event": "false",
        "light.connect": "false",
        "bdpt.strategies": "2,2 0,4",
        "bdpt.weighted": "false",
        "pssmlt.over": "bdpt",
        "pssmlt.multiplexed": "true",
        "pssmlt.large_step": ".3",
        "pssmlt.bootstrap": "4096",
        "pssmlt.chains": "512",
    }
    settings = settings_from({}, None, [f"{name}={text}" for name, text in given.items()])
    assert settings.heuristic == "cutoff"
    assert not settings.path.next_event
    assert not settings.light.connect
    assert settings.bdpt.pairs() == {(0, 4), (2, 2)}
    assert not settings.bdpt.weighted
    assert settings.pssmlt.model_dump() == {
        "over": "bdpt",
        "multiplexed": True,
        "large_step": 0.3,
        "bootstrap": 4096,
        "chains": 512,
    }
    assert RenderSettings.model_validate_json(settings.model_dump_json()) == settings


def test_strategies_are_kept_in_one_form() -> None:
    forms = ("0,4 2,2", "2,2 0,4", "2,2 00,4 2,2")
    bdpt = RenderSettings(integrator="bdpt")
    assert {with_overrides(bdpt, {"bdpt.strategies": text}).bdpt.strategies for text in forms} == {"0,4 2,2"}
    assert RenderSettings().bdpt.pairs() is None


def test_a_context_is_needed_where_lights_are_sampled() -> None:
    needs = {name: RenderSettings(integrator=name).needs_context for name in (*BUILT_INTEGRATORS, "mi_path")}
    assert needs == {"path": True, "light": True, "bdpt": True, "pssmlt": True, "mi_path": False}
    pure = with_overrides(RenderSettings(integrator="path"), {"path.next_event": False})
    assert not pure.needs_context
    assert not RenderSettings(integrator="bdpt", light_sampling="power").needs_context
    assert RenderSettings().needs_context, "auto looks for the best way"


@pytest.mark.parametrize(
    ("assignments", "line"),
    [
        (["integrator=psmlt"], "unknown integrator (did you mean 'pssmlt'?): choose one of auto, path, light, bdpt"),
        (["integrator=mi_pth"], "did you mean 'mi_path'?"),
        (["heuristik=power"], "unknown setting 'heuristik' (did you mean 'heuristic'?)"),
        (["path.next_events=true"], "unknown setting 'path.next_events' (did you mean 'path.next_event'?)"),
        (["chains=5"], "unknown setting 'chains'"),
        (["bdpt.strategies.s=1"], "unknown setting 'bdpt.strategies.s'"),
        (["pssmlt=1024"], "'pssmlt' is a group of settings: name one of pssmlt.over, pssmlt.multiplexed"),
        (["heuristic=best"], "heuristic: Input should be 'balance', 'power', 'maximum' or 'cutoff'"),
        (["path.next_event=no"], "path.next_event: give true or false"),
        (["pssmlt.chains=1.5"], "pssmlt.chains: "),
        (["pssmlt.chains=many"], "pssmlt.chains: give a whole number"),
        (["pssmlt.large_step=0"], "pssmlt.large_step: Input should be greater than 0"),
        (["bdpt.strategies=1.3"], "bdpt.strategies: give a word"),
        (["bdpt.strategies=1,3;2,2"], "bdpt.strategies: give 'all' or pairs s,t"),
        (["bdpt.strategies=1,3\n"], "bdpt.strategies: give 'all' or pairs s,t"),
        (["integrator=bdpt", "bdpt.strategies=1,1"], "bdpt.strategies: '1,1' is none: s + t is 3 to 17"),
        (["integrator=bdpt", "bdpt.strategies=4,3", "max_depth=5"], "bdpt.strategies: '4,3' is none: s + t is 3 to 6"),
        (["bdpt.weighted=false"], "bdpt: without weights every strategy is a whole image"),
    ],
)
def test_mistakes_get_one_line_that_helps(assignments: list[str], line: str) -> None:
    with pytest.raises(SettingsRejected) as caught:
        settings_from({}, None, assignments)
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


def test_settings_of_other_algorithms_are_no_mistake() -> None:
    settings: dict[str, Any] = {"integrator": "path", "max_depth": 2, "bdpt": {"strategies": "4,4"}}
    assert RenderSettings.model_validate(settings).max_depth == 2
    with pytest.raises(ValidationError, match="is none"):
        RenderSettings.model_validate(settings | {"integrator": "bdpt"})


def test_a_preset_fills_what_is_not_given() -> None:
    thesis = settings_from({"preset": "thesis", "integrator": "path"}, None, ["context.rows=8"])
    assert (thesis.integrator, thesis.direction_sampling, thesis.table_share) == ("path", "context", 0.5)
    context = thesis.context
    assert (context.particles, context.regions, context.rows, context.columns) == ("metropolis", 16384, 8, 32)
    assert not thesis.adaptive
    assert RenderSettings.model_validate({"preset": "thesis", "context": {"regions": 9}}).context.regions == 9
    assert RenderSettings.model_validate_json(thesis.model_dump_json()) == thesis
    assert settings_from({"preset": "enlightened"}, None, None).integrator == "auto"
    with pytest.raises(SettingsRejected, match="did you mean 'thesis'"):
        settings_from({"preset": "thesus"}, None, None)


@pytest.mark.parametrize(
    ("stop", "seconds"),
    [
        ({"seconds": 60.0}, 32.0),
        ({"seconds": 100.0}, 64.0),
        ({"seconds": 32.0}, 32.0),
        ({"seconds": 31.0}, 16.0),
        ({"seconds": 0.5}, 1.0),
        ({"seconds": 5e-324}, 1.0),
        ({"seconds": 1e6}, 4096.0),
        ({"samples": 4}, None),
    ],
)
def test_the_context_suits_the_time(stop: dict[str, Any], seconds: float | None) -> None:
    auto = RenderSettings(integrator="auto")
    suiting = suited(auto, StopCriterion(**stop)).context
    assert (suiting.seconds, suiting.paths) == (seconds, None)
    fixed = with_overrides(auto, {"context.paths": 4096})
    assert suited(fixed, StopCriterion(**stop)) == fixed
    plain = RenderSettings(integrator="bdpt")
    assert suited(plain, StopCriterion(**stop)) == plain


@pytest.mark.parametrize(
    ("settings", "thorough"),
    [
        ({"integrator": "path"}, True),
        ({"integrator": "light"}, True),
        ({"integrator": "bdpt", "bdpt": {"joins": False}}, True),
        ({"integrator": "pssmlt", "pssmlt": {"over": "path"}}, True),
        ({"integrator": "bdpt"}, False),
        ({"integrator": "pssmlt"}, False),
        ({"integrator": "auto", "direction_sampling": "scattering", "roulette": "albedo"}, False),
        ({"integrator": "path", "direction_sampling": "scattering"}, False),
        ({"integrator": "path", "context": {"adaptive": False}}, False),
    ],
)
def test_what_keeps_to_tables_has_them_filled_to_the_end(settings: dict[str, Any], thorough: bool) -> None:
    asked = RenderSettings.model_validate({"direction_sampling": "context", "roulette": "context"} | settings)
    assert suited(asked, StopCriterion(samples=4)).context.thorough is thorough
    fixed = with_overrides(asked, {"context.paths": 4096})
    assert suited(fixed, StopCriterion(samples=4)) == with_overrides(fixed, {"context.thorough": thorough})


@pytest.mark.parametrize(
    ("changes", "longest"),
    [
        ({"integrator": "path"}, ENDLESS),
        ({"integrator": "light"}, ENDLESS),
        ({"integrator": "auto"}, ENDLESS),
        ({"integrator": "bdpt", "bdpt.joins": False}, ENDLESS),
        ({"integrator": "bdpt"}, MAX_DEPTH),
        ({"integrator": "pssmlt"}, MAX_DEPTH),
        ({"integrator": "path", "max_depth": 7}, 7),
    ],
)
def test_no_greatest_depth_means_none_where_vertices_are_not_kept(changes: dict[str, Any], longest: int) -> None:
    assert with_overrides(RenderSettings(), {"max_depth": -1, **changes}).longest == longest


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"max_depth": 0}, "-1 for no limit"),
        ({"max_depth": -2}, "max_depth"),
        ({"max_depth": -1, "integrator": "path", "roulette": "none"}, "roulette"),
        ({"max_depth": -1, "integrator": "path", "heuristic": "cutoff"}, "heuristic"),
        ({"max_depth": -1, "integrator": "bdpt", "bdpt.strategies": "200,200"}, "bdpt.strategies"),
    ],
)
def test_depths_that_have_no_end_are_refused(changes: dict[str, Any], word: str) -> None:
    with pytest.raises(SettingsRejected, match=word):
        with_overrides(RenderSettings(), changes)
