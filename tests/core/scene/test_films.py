"""What the film of a scene file asks of the image file."""

from __future__ import annotations

from typing import Any

import pytest

from elps_core.errors import SceneRejected
from elps_core.scene.films import check, described, warnings
from elps_core.scene.markup import Node
from elps_core.scene.summary import FilmSummary


def film(kind: str = "hdrfilm", **properties: Any) -> Node:
    node = Node("film", {"type": kind}, 7)
    for name, value in properties.items():
        tag = "boolean" if value in ("true", "false") else "string"
        node.children.append(Node(tag, {"name": name, "value": value}, 8))
    return node


def test_formats_are_those_of_the_file() -> None:
    assert described(None) == described(film()) == FilmSummary(pixels="rgb", half=False)
    assert described(film(pixel_format="xyza")) == FilmSummary(pixels="xyza")
    assert described(film(pixel_format="Luminance", component_format="float16")) == FilmSummary(
        pixels="luminance", half=True
    )
    assert described(film("specfilm")).pixels == "bands"


@pytest.mark.parametrize(
    ("properties", "word"),
    [
        ({"component_format": "uint32"}, "float32"),
        ({"file_format": "rgbe"}, "OpenEXR"),
        ({"file_format": "pfm"}, "OpenEXR"),
        ({"sample_border": "true"}, "sample_border"),
    ],
)
def test_what_is_not_done_is_told(properties: dict[str, str], word: str) -> None:
    (line,) = warnings(film(**properties))
    assert word in line
    assert "line 7" in line


def test_what_is_done_needs_no_words() -> None:
    assert warnings(None) == ()
    assert warnings(film(component_format="float16", file_format="openexr", sample_border="false")) == ()


def test_bands_are_for_variants_with_spectra() -> None:
    root = Node("scene", {}, 1, [Node("sensor", {"type": "perspective"}, 2, [film("specfilm")])])
    check(root, "llvm_ad_spectral")
    with pytest.raises(SceneRejected, match="choose llvm_ad_spectral"):
        check(root, "llvm_ad_rgb")
    check(Node("scene", {}, 1, [film()]), "llvm_ad_rgb")
