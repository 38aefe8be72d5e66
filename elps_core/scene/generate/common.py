"""What all generators share: the scene's XML, its bundle on disk, and the check of parameters."""

from __future__ import annotations

import functools
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ParamSpec

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ConfigDict, Field, ValidationError, validate_call

from elps_core.errors import SettingsRejected
from elps_core.scene.generate.mesh import Mesh
from elps_core.settings import MAX_PIXELS_SIDE, RenderSettings, first_problem

P = ParamSpec("P")
Pixels = Annotated[int, Field(ge=1, le=MAX_PIXELS_SIDE)]
Color = tuple[float, float, float]

SCENE_FILE = "scene.xml"
XML_VERSION = "3.0.0"
"""Version of Mitsuba's scene format that the generators write."""
SAMPLES_PER_PIXEL = 64
"""Samples per pixel that the file asks for; renders by ELPS set their own."""
ZIP_TIME = (1980, 1, 1, 0, 0, 0)
"""The earliest time a zip archive can hold: one fixed time makes equal scenes equal files."""
ZIP_UNIX = 3
ZIP_MODE = 0o100644 << 16


@dataclass(frozen=True)
class SceneDescription:
    """A complete scene: the text of its XML file, and the other files of the bundle by relative path."""

    xml: str
    files: dict[str, bytes]

    def entries(self) -> dict[str, bytes]:
        """Every file of the bundle by its path, in a fixed order."""
        return {SCENE_FILE: self.xml.encode(), **{name: self.files[name] for name in sorted(self.files)}}


def write(scene: SceneDescription, output: Path) -> None:
    """Write a bundle: a zip archive where ``output`` ends in ``.zip``, else a folder.

    Equal scenes give equal bytes.

    Raises:
        SettingsRejected: the place cannot be written.
    """
    try:
        if output.suffix.lower() == ".zip":
            output.parent.mkdir(parents=True, exist_ok=True)
            with zipfile.ZipFile(output, "w") as archive:
                for name, data in scene.entries().items():
                    entry = zipfile.ZipInfo(name, ZIP_TIME)
                    entry.create_system, entry.external_attr = ZIP_UNIX, ZIP_MODE
                    # Stored, not deflated: compressed bytes differ between versions of zlib.
                    archive.writestr(entry, data, zipfile.ZIP_STORED)
        else:
            for name, data in scene.entries().items():
                file = output / name
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(data)
    except OSError as error:
        raise SettingsRejected(f"the scene cannot be written there ({error.strerror}): choose another output") from None


def generator(function: Callable[P, SceneDescription]) -> Callable[P, SceneDescription]:
    """Check the arguments against the annotations; one line of :class:`SettingsRejected` where they fail."""
    checked: Callable[P, SceneDescription] = validate_call(config=ConfigDict(allow_inf_nan=False))(function)

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> SceneDescription:
        try:
            return checked(*args, **kwargs)
        except ValidationError as error:
            raise SettingsRejected(first_problem(error)) from None

    return wrapper


def _text(values: ArrayLike) -> str:
    # "+ 0.0" turns a negative zero into zero.
    return " ".join(f"{value + 0.0:.9g}" for value in np.asarray(values, dtype=np.float64).ravel())


class SceneBuilder:
    """Collects a scene in Mitsuba's XML format, and its mesh files.

    Film of box-filtered pixels, independent sampler, ``path`` integrator at the depth that
    :class:`RenderSettings` has by default.
    """

    def __init__(self) -> None:
        self._root = ET.Element("scene", version=XML_VERSION)
        self._files: dict[str, bytes] = {}
        integrator = ET.SubElement(self._root, "integrator", type="path")
        ET.SubElement(integrator, "integer", name="max_depth", value=str(RenderSettings().max_depth))

    def camera(
        self, origin: ArrayLike, target: ArrayLike, *, fov: float, size: tuple[int, int], up: ArrayLike = (0, 0, 1)
    ) -> None:
        """A pinhole camera with a field of view of ``fov`` degrees along the shorter side of the film."""
        sensor = ET.SubElement(self._root, "sensor", type="perspective", id="camera")
        ET.SubElement(sensor, "string", name="fov_axis", value="smaller")
        ET.SubElement(sensor, "float", name="fov", value=_text(fov))
        to_world = ET.SubElement(sensor, "transform", name="to_world")
        ET.SubElement(to_world, "lookat", origin=_text(origin), target=_text(target), up=_text(up))
        sampler = ET.SubElement(sensor, "sampler", type="independent")
        ET.SubElement(sampler, "integer", name="sample_count", value=str(SAMPLES_PER_PIXEL))
        film = ET.SubElement(sensor, "film", type="hdrfilm")
        for name, pixels in zip(("width", "height"), size, strict=True):
            ET.SubElement(film, "integer", name=name, value=str(pixels))
        ET.SubElement(film, "rfilter", type="box")

    def diffuse(self, name: str, color: Color) -> str:
        """A Lambertian material of linear RGB reflectance; returns its name."""
        bsdf = ET.SubElement(self._root, "bsdf", type="diffuse", id=name)
        ET.SubElement(bsdf, "rgb", name="reflectance", value=_text(color))
        return name

    def glass(self, name: str, ior: float = 1.5) -> str:
        """Smooth glass in air; returns its name."""
        bsdf = ET.SubElement(self._root, "bsdf", type="dielectric", id=name)
        ET.SubElement(bsdf, "float", name="int_ior", value=_text(ior))
        ET.SubElement(bsdf, "float", name="ext_ior", value=_text(1.0))
        return name

    def metal(self, name: str, material: str, roughness: float) -> str:
        """A rough conductor (GGX, ``roughness`` is its alpha) of Mitsuba's ``material``; returns its name."""
        bsdf = ET.SubElement(self._root, "bsdf", type="roughconductor", id=name)
        ET.SubElement(bsdf, "string", name="material", value=material)
        ET.SubElement(bsdf, "string", name="distribution", value="ggx")
        ET.SubElement(bsdf, "float", name="alpha", value=_text(roughness))
        return name

    def plastic(self, name: str, color: Color, roughness: float | None = None) -> str:
        """A coloured base under a clear coat, smooth or of a ``roughness`` (GGX, its alpha); returns its name."""
        bsdf = ET.SubElement(self._root, "bsdf", type="plastic" if roughness is None else "roughplastic", id=name)
        ET.SubElement(bsdf, "rgb", name="diffuse_reflectance", value=_text(color))
        if roughness is not None:
            ET.SubElement(bsdf, "string", name="distribution", value="ggx")
            ET.SubElement(bsdf, "float", name="alpha", value=_text(roughness))
        return name

    def checkered(self, name: str, dark: Color, light: Color, tiles: tuple[float, float]) -> str:
        """A Lambertian material of two colours in turns, ``tiles`` pairs of them each way; returns its name."""
        bsdf = ET.SubElement(self._root, "bsdf", type="diffuse", id=name)
        texture = ET.SubElement(bsdf, "texture", type="checkerboard", name="reflectance")
        to_uv = ET.SubElement(texture, "transform", name="to_uv")
        ET.SubElement(to_uv, "scale", x=_text(tiles[0]), y=_text(tiles[1]))
        for number, color in enumerate((dark, light)):
            ET.SubElement(texture, "rgb", name=f"color{number}", value=_text(color))
        return name

    def mesh(self, name: str, mesh: Mesh, material: str, *, flat: bool = True, radiance: Color | None = None) -> None:
        """A mesh as a PLY file; ``flat`` keeps the triangles' own normals, else they are interpolated."""
        path = f"meshes/{name}.ply"
        self._files[path] = mesh.to_ply()
        shape = self._shape("ply", name, material, radiance)
        ET.SubElement(shape, "string", name="filename", value=path)
        if flat:
            ET.SubElement(shape, "boolean", name="face_normals", value="true")

    def sphere(
        self,
        name: str,
        center: ArrayLike,
        radius: float,
        material: str,
        *,
        inside: bool = False,
        radiance: Color | None = None,
    ) -> None:
        """A sphere; ``inside`` turns its front, and what it emits, inwards."""
        shape = self._shape("sphere", name, material, radiance)
        x, y, z = (_text(value) for value in np.asarray(center, dtype=np.float64))
        ET.SubElement(shape, "point", name="center", x=x, y=y, z=z)
        ET.SubElement(shape, "float", name="radius", value=_text(radius))
        if inside:
            ET.SubElement(shape, "boolean", name="flip_normals", value="true")

    def flat(
        self,
        kind: str,
        name: str,
        center: ArrayLike,
        u: ArrayLike,
        v: ArrayLike,
        material: str,
        radiance: Color | None = None,
    ) -> None:
        """A ``rectangle`` or ``disk`` with the half axes ``u`` and ``v``; its front is along u x v."""
        shape = self._shape(kind, name, material, radiance)
        u, v, center = (np.asarray(vector, dtype=np.float64) for vector in (u, v, center))
        normal = np.cross(u, v)
        matrix = np.eye(4)
        matrix[:3] = np.stack([u, v, normal / np.linalg.norm(normal), center], axis=1)
        to_world = ET.SubElement(shape, "transform", name="to_world")
        ET.SubElement(to_world, "matrix", value=_text(matrix))

    def cylinder(
        self, name: str, start: ArrayLike, end: ArrayLike, radius: float, material: str, radiance: Color
    ) -> None:
        """A luminous open cylinder around the segment from ``start`` to ``end``; its front is outside."""
        shape = self._shape("cylinder", name, material, radiance)
        for label, point in (("p0", start), ("p1", end)):
            x, y, z = (_text(value) for value in np.asarray(point, dtype=np.float64))
            ET.SubElement(shape, "point", name=label, x=x, y=y, z=z)
        ET.SubElement(shape, "float", name="radius", value=_text(radius))

    def point_light(self, name: str, position: ArrayLike, intensity: float) -> None:
        """A point light of ``intensity`` in power per steradian, the same in each channel."""
        emitter = ET.SubElement(self._root, "emitter", type="point", id=name)
        x, y, z = (_text(value) for value in np.asarray(position, dtype=np.float64))
        ET.SubElement(emitter, "point", name="position", x=x, y=y, z=z)
        ET.SubElement(emitter, "rgb", name="intensity", value=_text([intensity] * 3))

    def sky(self, name: str, radiance: Color) -> None:
        """Light of ``radiance`` from all directions."""
        emitter = ET.SubElement(self._root, "emitter", type="constant", id=name)
        ET.SubElement(emitter, "rgb", name="radiance", value=_text(radiance))

    def finish(self) -> SceneDescription:
        """The collected scene."""
        ET.indent(self._root)
        return SceneDescription(ET.tostring(self._root, encoding="unicode") + "\n", dict(self._files))

    def _shape(self, kind: str, name: str, material: str, radiance: Color | None) -> ET.Element:
        shape = ET.SubElement(self._root, "shape", type=kind, id=name)
        ET.SubElement(shape, "ref", id=material)
        if radiance is not None:
            emitter = ET.SubElement(shape, "emitter", type="area")
            ET.SubElement(emitter, "rgb", name="radiance", value=_text(radiance))
        return shape
