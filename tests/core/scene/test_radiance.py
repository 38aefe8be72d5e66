"""What lamps send out: tables say what Mitsuba says."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from elps_core import device
from tests.lamps import KINDS, room

LANES = 1 << 14


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral"])
@pytest.mark.parametrize("lamps", [16, 300])
def test_radiance_is_that_of_the_emitter(variant: str, lamps: int) -> None:
    mi = device.use(variant)
    import drjit as dr

    from elps_core.paths.stream import Stream
    from elps_core.scene.emission import Emission
    from elps_core.scene.spectrum import sample_wavelengths

    try:
        emission = Emission(room(mi, lamps))
        stream = Stream.of(LANES, 5)
        wavelengths, _ = sample_wavelengths(stream.next_1d())
        index = dr.minimum(mi.UInt32(stream.next_1d() * lamps), lamps - 1)
        point = emission.point(index, stream.next_2d(), wavelengths, mi.Bool(True))
        direction = mi.warp.square_to_uniform_sphere(stream.next_2d())
        found, cosine = emission.radiance(point, direction, mi.Bool(True))
        si = mi.SurfaceInteraction3f(point.si)
        si.wi = si.to_local(direction)
        near = mi.Interaction3f(0.0, emission.time, wavelengths, point.si.p + direction)
        wanted = dr.select(
            point.delta,
            point.emitter.sample_direction(near, mi.Point2f(0.5), point.delta)[1],
            point.emitter.eval(si, ~point.delta),
        )
        assert np.allclose(np.array(found), np.array(wanted), rtol=1e-5, atol=1e-6)
        lit = np.array(dr.max(found) > 0.0)
        assert not np.any(lit & ~np.array(point.delta) & (np.array(cosine) <= 0.0))
        assert 0.3 < lit.mean() < 0.7
    finally:
        device.use("llvm_ad_rgb")


def test_lamps_of_one_radiance_are_known_without_mitsuba(mi: Any) -> None:
    from elps_core.scene.emission import Emission

    emission = Emission(room(mi, 2 * len(KINDS)))
    asked = emission.power[~emission._radiance.known]
    assert len(asked) == 4, "spots and pictures"
    assert (emission.power > 0.0).all()


def test_power_by_closed_forms_is_that_of_a_grid(mi: Any) -> None:
    from elps_core.scene.emission import Emission

    emission = Emission(room(mi, 24))
    grid = emission._measured_power(np.arange(24))
    assert emission.power == pytest.approx(grid, rel=1e-4)
