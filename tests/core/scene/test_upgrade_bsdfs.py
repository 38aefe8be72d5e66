"""Materials of Mitsuba 0.x: what becomes of each, and that it reflects what the old formula says."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
import pytest

from elps_core import device
from elps_core.errors import SceneRejected
from elps_core.scene.upgrade_bsdfs import internal_reflectance

from .upgrading import SLANTED, VARIANT, made, one, reflected, same, told, upgraded


@pytest.fixture(autouse=True, scope="module")
def _variant() -> None:
    device.use(VARIANT)


def test_metals_are_copper_where_the_file_does_not_say() -> None:
    for kind in ("conductor", "roughconductor"):
        same(f'<bsdf type="{kind}"/>', f'<bsdf type="{kind}"><string name="material" value="Cu"/></bsdf>')
    given = '<bsdf type="conductor"><spectrum name="eta" value="400:1, 700:2"/><spectrum name="k" value="3"/>{}</bsdf>'
    same(given.format('<string name="material" value="Au"/><string name="extEta" value="air"/>'), given.format(""))
    same('<bsdf type="conductor"><float name="eta" value="3"/><float name="k" value="6"/>'
         '<float name="extEta" value="1.5"/></bsdf>',
         '<bsdf type="conductor"><float name="eta" value="2"/><float name="k" value="4"/></bsdf>')  # fmt: skip
    with pytest.raises(SceneRejected, match="give both"):
        one('<bsdf type="conductor"><float name="eta" value="3"/></bsdf>')
    with pytest.raises(SceneRejected, match="denser than air"):
        one('<bsdf type="conductor"><float name="extEta" value="1.33"/></bsdf>')


def test_a_rough_diffuse_material_is_diffuse() -> None:
    text = '<bsdf type="roughdiffuse"><rgb name="reflectance" value=".7 1 .7"/><float name="alpha" value=".4"/></bsdf>'
    same(text, '<bsdf type="diffuse"><rgb name="reflectance" value=".7 1 .7"/></bsdf>')
    (line,) = told(text)
    assert line.startswith("<bsdf type=\"diffuse\"> (line 1) stands for 'roughdiffuse'")


def test_reflectance_above_one_is_scaled_down_as_0_6_did() -> None:
    text = '<bsdf type="dielectric"><rgb name="specularReflectance" value="2 1 0"/></bsdf>'
    same(text, '<bsdf type="dielectric"><rgb name="specular_reflectance" value="1, 0.5, 0"/></bsdf>')
    assert "specular_reflectance is scaled down" in told(text)[0]


@pytest.mark.parametrize(
    ("text", "height"),
    [
        ('<bsdf type="phong"><float name="exponent" value="98"/>{}</bsdf>', 100 / (2 * math.pi)),
        ('<bsdf type="ward"><float name="alphaU" value="0.1"/><float name="alphaV" value="0.2"/>{}</bsdf>',
         1 / (4 * math.pi * 0.1 * 0.2)),
    ],
)  # fmt: skip
def test_two_lobes_have_their_height_and_their_energy(text: str, height: float) -> None:
    """At normal incidence: the formula of 0.6 at the peak, and what is reflected in all."""
    colours = '<rgb name="diffuseReflectance" value="0.4"/><rgb name="specularReflectance" value="0.3"/>'
    bsdf = made(one(text.format(colours)))
    up = (0.0, 0.0, 1.0)
    assert reflected(bsdf, up, up) == pytest.approx(0.4 / math.pi + 0.3 * height, rel=1e-3)
    theta, phi = np.meshgrid((np.arange(200) + 0.5) * math.pi / 400, (np.arange(24) + 0.5) * math.pi / 12)
    cosine = np.cos(theta).ravel()
    directions = zip((np.sin(theta) * np.cos(phi)).ravel(), (np.sin(theta) * np.sin(phi)).ravel(), cosine, strict=True)
    values = np.array([reflected(bsdf, up, d) for d in directions])
    total = (values * np.sin(theta).ravel()).sum() * (math.pi / 400) * (math.pi / 12)
    assert total == pytest.approx(0.7, rel=0.02)


def test_two_lobes_above_one_are_scaled_as_0_6_did() -> None:
    same(
        """<bsdf type="phong"><float name="exponent" value="48"/>
        <texture type="bitmap" name="diffuseReflectance"><string name="filename" value="a.png"/></texture>
        <rgb name="specularReflectance" value="0.25"/></bsdf>""",
        """<bsdf type="blendbsdf"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
        <string name="filename" value="a.png"/></texture></bsdf><bsdf type="roughconductor">
        <rgb name="specular_reflectance" value="1"/><string name="material" value="none"/>
        <string name="distribution" value="beckmann"/><float name="alpha" value="0.1"/></bsdf>
        <float name="weight" value="0.2"/></bsdf>""",
    )


@pytest.mark.parametrize("base", ['<bsdf type="diffuse"><rgb name="reflectance" value="0.6"/></bsdf>', '<ref id="b"/>'])
def test_a_coat_over_a_diffuse_base_loses_what_it_throws_back(base: str) -> None:
    """0.6: (1 - F(wi)) (1 - F(wo)) / eta^2 of the base, and nothing of what stays inside the coat."""
    root, warnings = upgraded(
        f"""<scene version="0.6.0"><bsdf type="diffuse" id="b"><rgb name="reflectance" value="0.6"/></bsdf>
        <bsdf type="coating"><float name="intIOR" value="1.5"/><float name="extIOR" value="1"/>{base}</bsdf></scene>"""
    )
    wi, wo = (np.array(d) / np.linalg.norm(d) for d in SLANTED)
    through = [1 - float(mi.fresnel(d[2], 1.5)[0]) for d in (wi, wo)]
    expected = 0.6 / math.pi * through[0] * through[1] / 1.5**2 * wo[2]
    assert reflected(made(root.children[1]), *SLANTED) == pytest.approx(expected, rel=1e-5)
    assert warnings == []


def test_internal_reflectance_is_the_one_that_plastic_divides_by() -> None:
    for index in (1.05, 1.33, 1.5, 2.4):
        assert internal_reflectance(index) == pytest.approx(float(mi.fresnel_diffuse_reflectance(1 / index)), rel=1e-6)


def test_a_coat_over_another_base_is_a_share_of_mirror() -> None:
    metal = '<bsdf type="roughconductor"><string name="material" value="Ag"/></bsdf>'
    text = f"""<bsdf type="roughcoating"><float name="intIOR" value="1.5"/><float name="extIOR" value="1"/>
        <float name="alpha" value="0.3"/>{metal}</bsdf>"""
    same(
        text,
        f"""<bsdf type="blendbsdf">{metal}<bsdf type="roughconductor"><float name="alpha" value="0.3"/>
        <string name="material" value="none"/></bsdf><float name="weight" value="0.04"/></bsdf>""",
    )
    assert "its coat reflects alike" in told(text)[0]
    with pytest.raises(SceneRejected, match="absorbs"):
        one('<bsdf type="coating"><rgb name="sigmaA" value="0 1 0"/><bsdf type="diffuse"/></bsdf>')
    with pytest.raises(SceneRejected, match="one material"):
        one('<bsdf type="coating"/>')


def test_a_mixture_is_a_weighted_sum() -> None:
    greys = "".join(f'<bsdf type="diffuse"><float name="reflectance" value="{g}"/></bsdf>' for g in (0.9, 0.3, 0.6))
    for weights, expected in (("0.5, 0.2, 0.1", 0.57), ("0.2 0.2 0.6", 0.6), ("2; 1; 1", 0.675), ("1, 0, 0", 0.9)):
        bsdf = made(one(f'<bsdf type="mixturebsdf"><string name="weights" value="{weights}"/>{greys}</bsdf>'))
        assert reflected(bsdf, (0, 0, 1), (0, 0, 1)) * math.pi == pytest.approx(expected, rel=1e-5)
    for weights in ("0.5, 0.5", "-1, 1, 1", "a, b, c", "0, 0, 0", ""):
        with pytest.raises(SceneRejected, match=r"mixturebsdf.* needs"):
            one(f'<bsdf type="mixturebsdf"><string name="weights" value="{weights}"/>{greys}</bsdf>')


def test_a_mixture_of_very_many_is_refused_before_it_nests() -> None:
    body = '<bsdf type="diffuse"/>' * 5000
    with pytest.raises(SceneRejected, match="at most 32"):
        one(f'<bsdf type="mixturebsdf"><string name="weights" value="{"1 " * 5000}"/>{body}</bsdf>')


def test_a_diffuse_transmitter_transmits_diffusely() -> None:
    bsdf = made(one('<bsdf type="difftrans"><rgb name="transmittance" value="0.4"/></bsdf>'))
    (x, y, z), wo = SLANTED
    assert reflected(bsdf, (x, y, z), (wo[0], wo[1], -wo[2])) == pytest.approx(
        0.4 / math.pi * wo[2] / math.hypot(*wo), rel=1e-5
    )
    for direction in ((-x, -y, z), wo):
        assert reflected(bsdf, (x, y, z), direction) == 0.0


DOCUMENTED = [
    '<bsdf type="plastic"><boolean name="preserveColors" value="true"/><spectrum name="specularReflectance" value="1"/>'
    '<srgb name="diffuseReflectance" value="#18455c"/><float name="intIOR" value="1.9"/></bsdf>',
    '<bsdf type="roughplastic"><string name="distribution" value="GGX"/><boolean name="nonlinear" value="true"/>'
    '<rgb name="diffuseReflectance" value="0"/><float name="alpha" value="0.15"/></bsdf>',
    '<bsdf type="thindielectric"><string name="intIOR" value="Acrylic Glass"/></bsdf>',
    '<bsdf type="roughdielectric"><string name="distribution" value="as"/><float name="alphaU" value=".1"/>'
    '<float name="alphaV" value=".3"/><string name="extIOR" value="air"/></bsdf>',
    '<bsdf type="roughconductor"><float name="extEta" value="1.0"/><srgb name="specularReflectance" value="1 1 1"/>'
    '<boolean name="sampleVisible" value="false"/></bsdf>',
    '<bsdf type="conductor"><rgb name="eta" value="1.65 0.88 0.52"/><rgb name="k" value="9.2 6.2 4.8"/></bsdf>',
    '<bsdf type="mask"><spectrum name="opacity" value="0.5"/><bsdf type="diffuse"/></bsdf>',
    '<bsdf type="blendbsdf"><texture name="weight" type="checkerboard"/><bsdf type="conductor"/>'
    '<bsdf type="phong"/></bsdf>',
    '<bsdf type="coating"><bsdf type="mixturebsdf"><string name="weights" value=".5 .3"/><bsdf type="diffuse"/>'
    '<bsdf type="difftrans"/></bsdf></bsdf>',
    '<bsdf type="coating"><float name="thickness" value="2"/><bsdf type="roughdiffuse"/></bsdf>',
    '<bsdf type="bumpmap"><texture type="checkerboard"/><bsdf type="ward"><string name="variant" value="ward"/>'
    "</bsdf></bsdf>",
    '<bsdf type="twosided"><bsdf type="ward"/><bsdf type="lambertian"/></bsdf>',
    '<bsdf type="dielectric"><rgb name="specularTransmittance" value="255 102 102"/></bsdf>',
    '<medium type="heterogeneous"><string name="method" value="woodcock"/><volume name="density" type="constvolume">'
    '<float name="value" value="1"/></volume><volume name="albedo" type="constvolume"><rgb name="value" value=".5"/>'
    '</volume><float name="scale" value="100"/><phase type="mixturephase"><string name="weights" value="1 3"/>'
    '<phase type="isotropic"/><phase type="hg"/></phase></medium>',
    '<sensor type="perspective"><float name="focusDistance" value="3"/><string name="focalLength" value="50mm"/>'
    "</sensor>",
    '<sensor type="orthographic"><transform name="toWorld"><scale x="10" y="10"/></transform></sensor>',
    '<emitter type="directional"><vector name="direction" x="1" y="0" z="0"/><float name="samplingWeight" value="3"/>'
    '<spectrum name="irradiance" value="400:3, 700:4"/></emitter>',
    '<shape type="cylinder"><point name="p0" x="0" y="0" z="0"/><boolean name="flipNormals" value="true"/></shape>',
]  # fmt: skip
"""Objects in the style of the manual of Mitsuba 0.6."""


@pytest.mark.parametrize("text", DOCUMENTED)
def test_what_the_manual_of_0_6_shows_can_be_made(text: str) -> None:
    assert made(one(text)) is not None


@pytest.mark.parametrize("given", ["as", "phong", "Beckmann", "GGX"])
def test_distributions_that_have_gone_are_beckmann(given: str) -> None:
    text = f'<bsdf type="roughplastic"><string name="distribution" value="{given}"/></bsdf>'
    known_name = given.lower() in ("beckmann", "ggx")
    new = given.lower() if known_name else "beckmann"
    same(text, f'<bsdf type="roughplastic"><string name="distribution" value="{new}"/></bsdf>')
    assert bool(told(text)) is not known_name
