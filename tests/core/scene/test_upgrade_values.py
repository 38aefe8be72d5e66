"""Colours, spectra and transformations of Mitsuba 0.x, as today's elements."""

from __future__ import annotations

import mitsuba as mi
import pytest

from elps_core import device

from .upgrading import VARIANT, one, same, told


@pytest.fixture(autouse=True, scope="module")
def _variant() -> None:
    device.use(VARIANT)


@pytest.mark.parametrize(
    ("old", "value"),
    [
        ('<rgb name="reflectance" value="#ff8000"/>', (1.0, 128 / 255, 0.0)),  # linear: only <srgb> is encoded
        ('<rgb name="reflectance" value="1, 0.5, 0" intent="illuminant"/>', (1.0, 0.5, 0.0)),
        ('<srgb name="reflectance" value="#ff8000"/>', (1.0, ((128 / 255 + 0.055) / 1.055) ** 2.4, 0.0)),
        ('<srgb name="reflectance" value="0.5 0.02 1"/>', (((0.5 + 0.055) / 1.055) ** 2.4, 0.02 / 12.92, 1.0)),
        ('<spectrum name="reflectance" value="1, 0.5, 0"/>', (1.0, 0.5, 0.0)),
        ('<xyz name="reflectance" value="0.475227964 .5 0.544528875"/>', (0.5, 0.5, 0.5)),
    ],
)
def test_colours_are_linear_numbers(old: str, value: tuple[float, ...]) -> None:
    (colour,) = one(f'<bsdf type="diffuse">{old}</bsdf>').children
    assert (colour.tag, set(colour.attributes)) == ("rgb", {"name", "value"})
    found = [float(v) for v in colour.attributes["value"].replace(",", " ").split()]
    assert found == pytest.approx(value, abs=2e-4)


def test_a_curve_and_a_grey_spectrum_stay() -> None:
    for value in ("400:.1, 700:.5", "0.5"):
        same(f'<bsdf type="diffuse"><spectrum name="reflectance" value="{value}"/></bsdf>',
             f'<bsdf type="diffuse"><spectrum name="reflectance" value="{value}"/></bsdf>')  # fmt: skip


def test_a_black_body_is_planck_s_curve() -> None:
    """Against Mitsuba's own plugin, which makes no colour of it."""
    text = '<emitter type="constant"><blackbody name="radiance" temperature="5000K" scale="0.1"/></emitter>'
    (curve,) = one(text).children
    mi.set_variant("scalar_spectral")
    try:
        plugin = mi.load_dict({"type": "blackbody", "temperature": 5000.0})
        si = mi.SurfaceInteraction3f()
        for part in curve.attributes["value"].split(", "):
            wavelength, value = (float(number) for number in part.split(":"))
            si.wavelengths = mi.Spectrum(wavelength)
            assert value == pytest.approx(0.1 * float(plugin.eval(si)[0]), rel=1e-4)
    finally:
        mi.set_variant(VARIANT)
    assert wavelength == 830


def test_a_lookat_of_before_0_3_looks_at_a_mirror_image() -> None:
    same(
        """<camera type="perspective"><transform name="toWorld">
            <lookAt ox="1" oy="2" oz="3" tx="0" ty="0" tz="0" uy="1"/></transform></camera>""",
        """<sensor type="perspective"><string name="fov_axis" value="smaller"/><transform name="to_world">
            <scale x="-1"/><scale x="-1"/><lookat origin="1, 2, 3" target="0, 0, 0" up="0, 1, 0"/>
            </transform></sensor>""",
        (0, 2, 0),
    )


def test_an_animation_stands_at_its_first_keyframe() -> None:
    text = """<shape type="sphere"><animation name="toWorld"><transform time="1"><translate x="9"/></transform>
        <transform time="0"><translate x="2"/></transform></animation></shape>"""
    same(text, '<shape type="sphere"><transform name="to_world"><translate x="2"/></transform></shape>')
    assert "first keyframe" in told(text)[0]
