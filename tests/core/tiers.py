"""Tests that every change has no time for: what proves the same again, with other tables, lamps or variants.

``make test`` leaves them out, ``make thorough`` runs them with all others. Beside a test stands what still shows the
same in ``make test``, and the seconds that it takes on a core with cold kernels.
"""

from __future__ import annotations

from collections.abc import Mapping

THOROUGH: Mapping[str, tuple[str, ...]] = {
    # The furnished room by area-shapes0; the others are rarer shapes of the same walks: 64 s.
    "particles/test_caustics.py": ("weights_are_those_that_eye_paths_find[constant-",),
    # Cut off in two phases; the others differ in what the context already holds: 80 s.
    "test_progressive.py": (
        "[never]",
        "[before the race]",
        "[before there are regions]",
        "[with tables of one step]",
        "[before the first step]",
    ),
    "integrators/test_context.py": (
        "test_no_tables_move_the_image_of_unjoined_paths",  # in a sphere, by test_no_tables_move_what_unjoined: 26 s
        "[roughdielectric path spiked]",  # 25 s
        "[bdpt-random-options3]",  # 14 s
        "test_no_roulette_by_context_moves_the_image[bdpt]",  # in a sphere: 9 s
        "[mixed light random]",  # 8 s
        "sphere[bdpt-spiked]",  # 7 s
        "sphere[bdpt-foreign]",  # 6 s
        "other_variants[llvm_ad_mono]",  # 6 s
        "what_unjoined_paths_find[random]",  # 9 s
    ),
    "integrators/test_many_lamps.py": (
        "mitsuba[llvm_ad_spectral]",  # rgb: 28 s
        "no_context_moves_the_image[bdpt-random]",  # path: 25 s
        "number_of_lamps[bdpt]",  # path: 5 s
    ),
    "commands/test_render.py": (
        "test_tables_that_were_not_filled_to_the_end_are_told_of",  # the rule itself in test_training: 25 s
        "test_every_integrator_has_alpha[mi_ptracer]",
        "test_every_integrator_has_alpha[pssmlt]",
        "test_the_file_has_what_the_film_asks_for[mi_path]",
    ),
    "context/test_adjoint.py": ("moves_the_mean[random]", "moves_the_mean[empty]"),  # spiked: 36 s
    "context/test_surroundings.py": ("test_a_camera_beside_needs_fewer_steps_and_has_the_same_light",),  # 20 s
    "context/test_departures.py": ("test_light_paths_gain_by_it",),  # leaves for the door: 9 s
    # Two other kinds, and both quantities of this one in a sphere by test_contract: 25 s.
    "context/test_tables.py": ("fills_tables[metropolis]", "walls_reflect[metropolis]", "albedo_leaves[metropolis]"),
    "context/test_lookup.py": ("error_on_surfaces[maze-", "error_on_surfaces[door-"),  # 13 s
    "particles/test_contract.py": ("furnished_room_both_are_those_of_path_tracing[metropolis]",),  # sphere: 15 s
    "particles/test_worth.py": ("[metropolis]",),
    "integrators/test_pssmlt.py": (
        "agree_with_the_reference[crop-gaussian]",  # caustic: 17 s
        "[area-unjoined-2048]",
        "[point-unjoined-2048]",
        "[area-unjoined-128]",
        "[point-bdpt-128]",
        "numbers_are_kept_as_are_taken[pinhole-multiplexed]",
        "numbers_are_kept_as_are_taken[lens-multiplexed]",
        "one_wavelength_on_both_sides[bidirectional]",
        "states_of_all_strategies[area-2]",
    ),
    "integrators/test_unjoined.py": (
        "no_context_moves_it[envmap]",  # thinlens-wide: 14 s
        "no_lights_by_context_move_it[area-mesh]",  # mixed: 13 s
        "sum_to_one[balance]",
        "sum_to_one[cutoff]",
        "reference[mixed-",
    ),
    "integrators/test_sensors.py": ("[1-pssmlt]",),  # Camera 0: 5 s
    "integrators/test_analytic.py": (
        "whole_of_its_paths[area]",  # point: 14 s
        "[pssmlt-point-8]",  # 14 s
        "sum_to_one[lens-balance]",
        "sum_to_one[lens-maximum]",
        "sum_to_one[pinhole-maximum]",
        "sum_to_one[pinhole-balance]",
    ),
    "integrators/test_agreement.py": (
        "[area-mesh-random_table]",  # mixed, envmap: 8 s
        "[area-disk-cylinder-random_table]",
        "[mixed-empty_table]",
        "[roughdielectric-power]",  # Power is what nobody need ask for: this and the next are those of test_zoo.
        "[thinlens-wide-power]",
        "[roughdielectric-balance]",
        "[roughdielectric-maximum]",
        "[balance-light]",
        "[power-light]",
        "[cutoff-path]",
    ),
    # Those of test_zoo by the same samples, or by more: 10 s.
    "integrators/test_regressions.py": (
        "[null]",
        "[directional-through-null]",
        "test_light_of_a_point_in_glass_is_found",
    ),
    "scene/test_emission.py": (
        "the_table_follows_radiance[sky of a moment]",  # other skies: 10 s
        "irradiance_from_an_environment[sky of a moment]",  # 6 s
    ),
    "scene/test_radiance.py": ("[300-llvm_ad_spectral]", "[300-llvm_ad_mono]"),  # rgb: 16 s
    "selection/test_trials.py": ("renders[bdpt, enlightened, 4 eye paths]",),
    # The validation run has all of these at a higher power. Each class is met by another scene or algorithm.
    "integrators/test_zoo.py": (
        "[timed-sunsky by bdpt]",  # path: 22 s
        "[thinlens-wide by light pure]",  # 16 s
        "[envmap by pssmlt]",  # 13 s
        "[sunsky, spectral by bdpt]",  # 13 s
        "[bumpmap-conductor by bdpt]",  # 12 s
        "[mixed, spectral by bdpt]",
        "[sunsky by bdpt]",  # path: 8 s
        "[facing-away by bdpt]",
        "[area-mesh by bdpt]",
        "[thinlens by bdpt]",
        "[bumpmap-dielectric by bdpt]",
        "[orthographic by bdpt]",
        "[roughconductor-anisotropic by bdpt]",
        "[twosided by light]",
        "[principled by light]",
        "[area-two-sided-surface by light]",
        "[mixed by path]",
        "[spot-narrow by bdpt]",
        "[spot-textured by bdpt]",
        "[vertex-normals-glass by bdpt]",
        "[near-clip by bdpt]",
        "[area-textured by path]",  # light, bdpt
        "[bumps-close by bdpt]",  # light, in test_regressions
        "[filter-mitchell by bdpt]",  # path
    ),
}
"""File below tests/core -> parts of the names of its tests."""


def is_thorough(file: str, name: str) -> bool:
    """Whether a test is left to ``make thorough``."""
    return any(part in name for part in THOROUGH.get(file, ()))
