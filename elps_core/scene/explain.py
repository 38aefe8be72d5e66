"""One line about why Mitsuba cannot make an object, and whose fault it is. Imports no Mitsuba.

Mitsuba's own text may quote files and paths of the host. Of that text only the place is taken, names and values that
the element itself has, and sentences that are known here.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from elps_core.scene.markup import Node
from elps_core.scene.text import shown

_LOCATION = re.compile(r"\(line (\d{1,9}), col \d+\)")
_SENTENCES = {
    "Texture::mean(): not implemented": "this texture cannot be used here: its mean is asked for, which only images, "
    "constants and checkerboards have",
    "Two child BSDFs must be specified": "it needs two materials inside",
    "Only materials without a transmission component can be nested": "materials that light passes cannot stand in it",
    "The horizontal field of view must be in the range": "its field of view must lie between 0 and 180 degrees",
    "Scale factors in the camera-to-world transformation are not allowed": "a camera's 'to_world' may not scale",
    "reference to invalid vertex": "a face of its file names a vertex that the file does not have",
    "invalid vertex position data": "its file has vertices that are not finite numbers",
    "invalid vertex normal data": "its normals have no direction: scale no axis by 0 in its 'to_world'",
    "Measurements in spectral format require": "its file holds spectra: choose a variant that ends in _spectral, or "
    "take the material's file in RGB",
    "Measurements in RGB format require": "its file holds RGB colours: choose a variant that ends in _rgb, or take the "
    "material's file with spectra",
    "invalid file format": "its file is of another kind, or damaged",
    "indices of refraction must be positive and differ": "its 'int_ior' and 'ext_ior' must be positive and differ",
    "indices of refraction must be positive": "its 'int_ior' and 'ext_ior' must be positive",
    "invalid index of refraction property": "its index is out of range or given twice: give 'eta' or 'specular'",
    "'alpha_u' and 'alpha_v' must be specified": "it has one of 'alpha_u' and 'alpha_v': give both",
    "Invalid RGB reflectance value": "a part of its colour is not in the range from 0 to 1",
    "no probability mass": "its light is 0 everywhere: make it brighter, or leave it out",
    "can only render in Spectral or RGB modes": "it needs colours: choose an 'rgb' or 'spectral' variant",
    "has the wrong type": "a parameter is of another type than it takes",
}
"""Words of Mitsuba's -> what they mean."""
_MISSING = re.compile(r'Property "([a-z_0-9]{1,40})" cannot be found')
_TYPED = re.compile(
    r'property "([A-Za-z_0-9]{1,40})" has the wrong type \(expected ([a-z/]{1,60}), got ([a-z]{1,20})\)'
)


def explain(raw: str, nodes: Sequence[Node]) -> str:
    """What is wrong with the scene, in one line.

    Args:
        raw: Mitsuba's text.
        nodes: the element behind each line of the text that Mitsuba was given.
    """
    found = _LOCATION.search(raw)
    line = int(found[1]) if found else 0
    if not 1 <= line <= len(nodes):
        return "Mitsuba cannot make this scene: check it with Mitsuba's own viewer"
    node = nodes[line - 1]
    reason = raw[found.end() :] if found else raw
    children = {child.attributes.get("name", ""): child for child in node.children}
    missing, typed = _MISSING.search(reason), _TYPED.search(reason)
    if typed and typed[1] in children:
        return f"{node}: its parameter '{typed[1]}' must be of the type {typed[2].replace('/', ' or ')}, not {typed[3]}"
    if missing and missing[1] not in children:
        return f"{node} needs the parameter '{missing[1]}'"
    quoted = set(re.findall(r'"([^"\n]{1,200})"', reason))
    file = next((_file_of(child) for child in node.children if _file_of(child)), "")
    for name, child in children.items():
        value = child.attributes.get("value", "")
        if name == "filename":
            continue
        if name in quoted:
            return f"{node}: Mitsuba does not take its parameter '{shown(name)}' or its value"
        if child.tag == "string" and (value in quoted or any(f"/{value}." in text for text in quoted)):
            return f"{node}: Mitsuba does not take the value '{shown(value)}' of its parameter '{shown(name)}'"
    for words, sentence in _SENTENCES.items():
        if words in reason:
            return f"{node}: {sentence}" + (f" ('{shown(file)}')" if file else "")
    if file:
        return f"{node}: Mitsuba cannot read the file '{shown(file)}': it is damaged, cut off or of another kind"
    return f"{node}: Mitsuba cannot make this object: check its parameters"


def _file_of(node: Node) -> str:
    """The file that an element names, or an empty string."""
    if node.attributes.get("name") == "filename":
        return node.attributes.get("value", "")
    return node.attributes.get("filename", "")
