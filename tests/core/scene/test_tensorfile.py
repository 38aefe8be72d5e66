"""Measured materials: their files load where they are whole, and nothing of a file is believed."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from elps_core import device
from elps_core.scene import inspect, tensorfile
from elps_core.scene.loader import load_scene
from elps_core.scene.meshes import BadFileError
from tests.tensors import REFLECTED, Fields, material, numbers, written

from .conftest import VARIANT, Reject, load, scene_xml, zip_of

BODY = (
    '<shape type="rectangle"><bsdf type="twosided">'
    '<bsdf type="measured"><string name="filename" value="a.bsdf"/></bsdf></bsdf></shape>'
)


def spectral() -> Fields:
    """The material measured at two wavelengths."""
    fields = material(wavelengths=np.array([400, 700], np.float32), spectra=numbers(1, 3, 2, 4, 4, value=REFLECTED))
    del fields["rgb"]
    return fields


WHOLE = written(material())


def check(tmp_path: Path, content: bytes) -> int:
    (tmp_path / "a.bsdf").write_bytes(content)
    with (tmp_path / "a.bsdf").open("rb") as file:
        return tensorfile.measured(file)


def test_the_writer_writes_what_mitsuba_reads(tmp_path: Path) -> None:
    device.use(VARIANT)
    (tmp_path / "a.bsdf").write_bytes(WHOLE)
    found = mi.tensor_io.read(str(tmp_path / "a.bsdf"))
    assert {name: values.shape for name, values in found.items()} == {n: v.shape for n, v in material().items()}
    assert (found["rgb"] == np.float32(REFLECTED)).all()


def test_a_measured_material_loads_and_reflects_what_its_file_says(tmp_path: Path) -> None:
    loaded = load(tmp_path, scene_xml(BODY), {"a.bsdf": WHOLE})
    assert "measured" in loaded.summary.bsdfs
    si = mi.SurfaceInteraction3f()
    bsdf = loaded.scene.shapes()[0].bsdf()
    for side in (1, -1):
        for incident, out in (([0, 0, 1], [0.6, 0, 0.8]), ([0.3, 0.5, 0.8], [-0.7, 0.1, 0.5])):
            si.wi = mi.Vector3f(*incident) * side
            direction = mi.Vector3f(*out) * side
            value, density = bsdf.eval_pdf(mi.BSDFContext(), si, direction / np.linalg.norm(out))
            assert np.allclose(value, REFLECTED, rtol=1e-4)
            assert density > 0


def test_a_material_with_spectra_loads_in_variants_with_spectra(tmp_path: Path, reject: Reject) -> None:
    bundle = zip_of(tmp_path / "a.zip", {"scene.xml": scene_xml(BODY), "a.bsdf": written(spectral())})
    assert "_spectral" in reject(load_scene, bundle, VARIANT)
    assert "measured" in inspect.inspect(bundle).summary.bsdfs
    colours = zip_of(tmp_path / "b.zip", {"scene.xml": scene_xml(BODY), "a.bsdf": WHOLE})
    assert "_rgb" in reject(load_scene, colours, "scalar_spectral")


def test_fields_that_are_not_known_and_numbers_that_are_not_aligned_are_no_matter(tmp_path: Path) -> None:
    more = material(description=np.zeros(3, np.uint8), notes=np.zeros((2, 2)))
    assert check(tmp_path, written(more)) > check(tmp_path, WHOLE) > len(WHOLE)


HUGE = 2**62
STEEP = np.array([0, 1, 1], np.float32)


@pytest.mark.parametrize(
    ("word", "content"),
    [
        ("not a tensor file", b""),
        ("not a tensor file", b"root:x:0:0:root:/root:/bin/bash\n"),
        ("cut off", WHOLE[:12]),
        ("unknown version", WHOLE.replace(b"tensor_file\0\x01", b"tensor_file\0\x02")),
        ("at most 64", WHOLE[:14] + b"\xff\xff\xff\xff" + WHOLE[18:]),
        ("cut off", WHOLE[:60]),
        ("more numbers", WHOLE[:-1]),
        ("too long", WHOLE[:18] + b"\xff\xff" + WHOLE[20:]),
        ("there twice", WHOLE.replace(b"sigma", b"phi_i")),
        ("unknown type", WHOLE.replace(b"ndf\x02\0\x0a", b"ndf\x02\0\x0c", 1)),
        ("many dimensions", WHOLE.replace(b"ndf\x02\0\x0a", b"ndf\xff\xff\x0a", 1)),
        ("more numbers", written(material(), ndf=(0, 2**32, 2**32))),
        ("more numbers", written(material(), rgb=(100, HUGE, HUGE, HUGE, HUGE, HUGE))),
        ("more numbers", written(material(), ndf=(2**64 - 1, 2, 2))),
        ("more numbers", written(material(), ndf=(len(WHOLE) - 8, 2, 2))),
        ("more numbers", written(material(), theta_i=(0, 10**9))),
        ("'sigma'", written({name: values for name, values in material().items() if name != "sigma"})),
        ("'rgb'", written({name: values for name, values in material().items() if name != "rgb"})),
        ("'spectra'", written(material(wavelengths=numbers(3)))),
        ("do not fit", written(material(theta_i=np.linspace(0, 1, 4, dtype=np.float32)))),
        ("do not fit", written(material(vndf=numbers(1, 3, 4)))),
        ("do not fit", written(material(luminance=numbers(1, 3, 4, 5)))),
        ("do not fit", written(material(rgb=numbers(1, 3, 4, 4, 4)))),
        ("do not fit", written(material(rgb=numbers(1, 3, 3, 5, 5)))),
        ("do not fit", written(material(ndf=np.ones((2, 2))))),
        ("do not fit", written(material(jacobian=np.zeros(0, np.uint8)))),
        ("do not fit", written(material(jacobian=np.zeros(1, np.uint16)))),
        ("less than two", written(material(ndf=numbers(1, 4)))),
        ("less than two", written(material(vndf=numbers(1, 3, 0, 4)))),
        ("less than two", written(material(phi_i=numbers(0), vndf=numbers(0, 3, 4, 4), luminance=numbers(0, 3, 4, 4),
                                           rgb=numbers(0, 3, 3, 4, 4)))),
        ("not finite", written(material(rgb=numbers(1, 3, 3, 4, 4, value=np.nan)))),
        ("not finite", written(material(theta_i=np.array([0, 1, np.inf], np.float32)))),
        ("do not increase", written(material(theta_i=STEEP))),
        ("negative", written(material(luminance=-numbers(1, 3, 4, 4)))),
        ("nothing is reflected", written(material(vndf=numbers(1, 3, 4, 5, value=0)))),
    ],
)  # fmt: skip
def test_files_that_lie_are_refused(word: str, content: bytes, tmp_path: Path) -> None:
    with pytest.raises(BadFileError, match=word):
        check(tmp_path, content)


def test_a_refusal_names_material_and_file(tmp_path: Path, reject: Reject) -> None:
    message = reject(load, tmp_path, scene_xml(BODY), {"a.bsdf": WHOLE[:-1]})
    assert '<bsdf type="measured"> (line ' in message
    assert "'a.bsdf'" in message
    assert "'measured'" in reject(load, tmp_path, scene_xml(BODY.replace('"measured"', '"measured_polarized"')))


def test_any_damage_is_refused_or_harmless(tmp_path: Path) -> None:
    """Every byte of the table and every cut: an answer, and never another error."""
    table = WHOLE.index(b"even")
    refused = 0
    for at in range(table):
        changed = bytearray(WHOLE)
        changed[at] = (0, 0x7F, 0xFF)[at % 3]
        try:
            check(tmp_path, bytes(changed))
        except BadFileError:
            refused += 1
    assert refused > table // 2
    for end in range(0, table, 7):
        with pytest.raises(BadFileError):
            check(tmp_path, WHOLE[:end])
