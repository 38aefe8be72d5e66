"""Faults that bidirectional renderers have had, each with the scene in which it shows.

Light tracing is compared rather than bdpt wherever it can make the image: it has nothing but the strategy
that is at fault, while bdpt's weights would hide most of it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.core.integrators.conftest import Agree
from tests.rendering import render
from tests.zoo import ZOO

Array = np.ndarray[Any, Any]

BOUND = 0.03


def test_light_paths_land_in_their_pixel_of_a_crop_window(agree: Agree) -> None:
    agreement = agree("crop", "light", more=6.0)
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement


def test_light_paths_meet_all_of_a_thin_lens(agree: Agree) -> None:
    agreement = agree("thinlens", "light", more=4.0)
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement


@pytest.mark.parametrize("algorithm", ["bdpt", "light"])
def test_a_narrow_spot_enters_the_weights_with_its_own_cone(agree: Agree, algorithm: str) -> None:
    agreement = agree("spot-narrow", algorithm, more=2.0)
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement


@pytest.mark.parametrize("name", ["null", "directional-through-null"])
def test_null_interfaces_let_light_through(agree: Agree, name: str) -> None:
    agreement = agree(name, "bdpt")
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement


@pytest.mark.parametrize("name", ["bumps-close", "normalmap", "vertex-normals"])
def test_light_paths_see_bent_shading_normals_as_eye_paths_do(agree: Agree, name: str) -> None:
    # Rare light paths carry much of what bumps reflect.
    agreement = agree(name, "light", more=14.0 if name == "bumps-close" else 3.0)
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement


@pytest.mark.parametrize("algorithm", ["bdpt", "light"])
def test_a_white_body_in_a_white_environment_is_invisible(tmp_path: Path, algorithm: str) -> None:
    """In every pixel, at the silhouette too, and beyond it."""
    entry = ZOO["furnace"]
    images = render(entry.load(tmp_path), algorithm, images=24, spp=96, max_depth=entry.max_depth).mean(axis=-1)
    error = images.std(axis=0, ddof=1) / np.sqrt(len(images))
    # 576 pixels: Student's t with 23 degrees of freedom exceeds 7 in one of them with a chance of 0.02%.
    assert (np.abs(images.mean(axis=0) - 1.0) <= 7.0 * error + 1e-4).all()
    assert error.mean() < 0.03


def test_light_from_outside_does_not_get_into_a_closed_room(agree: Agree) -> None:
    agreement = agree("closed-room", "bdpt", more=2.0)
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement


def test_a_point_light_at_a_wall_makes_no_fireflies(tmp_path: Path) -> None:
    """What path tracing finds there has ten times the noise: weights must prefer the light paths."""
    entry = ZOO["point-at-the-wall"]
    scene = entry.load(tmp_path)
    ours, theirs = (render(scene, name, images=24, spp=64, max_depth=entry.max_depth) for name in ("bdpt", "mi_path"))
    noise = [float(images.mean(axis=(1, 2, 3)).std(ddof=1)) for images in (ours, theirs)]
    assert noise[0] < 0.4 * noise[1]
    assert ours.max() < 4.0 * ours.mean(axis=0).max()


def test_mesh_lights_shine_from_their_faces_by_area(agree: Agree) -> None:
    agreement = agree("area-mesh", "light", more=2.0)
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement


@pytest.mark.parametrize("name", ["crop-gaussian", "filter-tent", "filter-mitchell"])
def test_borders_of_a_filtered_film_are_as_bright_as_they_should(agree: Agree, name: str) -> None:
    def border(images: Array) -> Array:
        """The outermost pixels in one row: [n, 1, pixels, 3]."""
        sides = [images[:, 0], images[:, -1], images[:, 1:-1, 0], images[:, 1:-1, -1]]
        return np.concatenate(sides, axis=1)[:, None]

    agreement = agree(name, "light", more=8.0, crop=border)
    assert agreement.agrees, agreement
    assert agreement.detectable < 0.05, agreement


@pytest.mark.parametrize("name", ["roughdielectric", "principledthin"])
def test_samples_that_a_material_rejects_carry_no_light(agree: Agree, name: str) -> None:
    """Mitsuba leaves a direction and a density with them, and only the weight of zero tells."""
    agreement = agree(name, "light", more=6.0)
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement


def test_a_near_plane_casts_no_shadow(agree: Agree) -> None:
    agreement = agree("near-clip", "light", more=4.0)
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement


def test_light_of_a_point_in_glass_is_found(agree: Agree) -> None:
    agreement = agree("point-through-glass", "bdpt")
    assert agreement.agrees, agreement
    assert agreement.detectable < BOUND, agreement
