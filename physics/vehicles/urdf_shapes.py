"""The shapes that a URDF file draws, as triangles; for pictures of vehicles, without effect on any run."""

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.types import ORIGIN, Array
from vcmvsp.cosim.util import limits
from vcmvsp.physics.world.solids import Box, Cylinder, shapes_of

GREY = (150, 154, 160)  # of shapes without a colour
AROUND, UPWARD = 16, 8  # faces of a sphere
MOST_TRIANGLES = 20_000  # of a mesh; a larger one is not drawn

Triangles = Array
"""Corners (t, 3, 3), m, counter-clockwise seen from outside."""


class DrawnPart(NamedTuple):
    """Shapes of one colour."""

    triangles: Triangles  # in the vehicle's frame
    color: tuple[int, int, int]


def visual_parts(
    links: Mapping[str, ET.Element],
    materials: Iterable[ET.Element],
    folder: Path,
    frame: Callable[[str], Array],
    origin: Callable[[ET.Element], Array],
) -> tuple[DrawnPart, ...]:
    """The visual shapes of all links by colour, or the collision shapes of a file without visual ones.

    Args:
        links: elements of the links by name.
        materials: elements of the file's own materials.
        folder: of mesh files.
        frame: vehicle_from_link, (4, 4), of a link's name.
        origin: (4, 4) of an element with an ``<origin>``.
    """
    has_visuals = any(link.find("visual") is not None for link in links.values())
    tag = "visual" if has_visuals else "collision"
    colors = {each.get("name", ""): _color(each) for each in materials}
    by_color: dict[tuple[int, int, int], list[Triangles]] = {}
    for name, link in links.items():
        for shape in link.iterfind(tag):
            material = shape.find("material")
            color = GREY if material is None else _color(material) or colors.get(material.get("name", "")) or GREY
            corners = _triangles(shape.find("geometry"), folder)
            try:
                transform = frame(name) @ origin(shape)
            except ValueError:  # numbers of a picture only: no reason to refuse the vehicle
                continue
            by_color.setdefault(color, []).append(corners @ transform[:3, :3].T + transform[:3, 3])
    parts = (DrawnPart(np.concatenate(pieces), color) for color, pieces in by_color.items())
    return tuple(part for part in parts if len(part.triangles))


def _color(material: ET.Element) -> tuple[int, int, int] | None:
    color = material.find("color")
    try:
        red, green, blue, *_ = map(float, ("" if color is None else color.get("rgba", "")).split())
    except ValueError:
        return None
    return int(255 * red), int(255 * green), int(255 * blue)


def _triangles(geometry: ET.Element | None, folder: Path) -> Triangles:
    """A geometry in its own frame; one that cannot be drawn is empty."""
    for element in () if geometry is None else geometry:
        try:
            return _KINDS[element.tag](element, folder)
        except (KeyError, OSError, ValueError):
            break
    return np.zeros((0, 3, 3))


def _box(element: ET.Element, _: Path) -> Triangles:
    length, width, height = map(float, element.get("size", "").split())
    return _surface(Box(center=ORIGIN, size=(length, width, height)))


def _cylinder(element: ET.Element, _: Path) -> Triangles:
    return _surface(Cylinder(center=ORIGIN, radius=float(element.get("radius", "")), height=float(element.get("length", ""))))


def _surface(solid: Box | Cylinder) -> Triangles:
    vertices, faces = shapes_of([solid]).mesh()
    return np.asarray(vertices[faces])


def _sphere(element: ET.Element, _: Path) -> Triangles:
    latitude, longitude = np.linspace(-0.5 * np.pi, 0.5 * np.pi, UPWARD + 1), np.linspace(0.0, 2.0 * np.pi, AROUND + 1)
    lat, lon = np.meshgrid(latitude, longitude, indexing="ij")
    points = float(element.get("radius", "")) * np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], 2)
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    return np.concatenate([np.stack(each, 2).reshape(-1, 3, 3) for each in ((a, b, c), (a, c, d))])


def _mesh(element: ET.Element, folder: Path) -> Triangles:
    """Triangles of a mesh file beside the URDF, if trimesh is installed."""
    path = folder / element.get("filename", "")
    if find_spec("trimesh") is None or not path.is_file():
        return np.zeros((0, 3, 3))
    import trimesh

    limits.check_archive(path)
    scale = np.array([float(each) for each in element.get("scale", "1 1 1").split()])
    try:
        corners = np.array(trimesh.load_mesh(path, process=False).triangles, np.float64)
    except Exception as error:  # any error of a reader of some format
        raise ValueError(str(error)) from error
    good = len(corners) <= MOST_TRIANGLES and np.isfinite(corners).all()
    return np.asarray(corners * scale) if good else np.zeros((0, 3, 3))


_KINDS: Mapping[str, Callable[[ET.Element, Path], Triangles]] = {
    "box": _box,
    "cylinder": _cylinder,
    "sphere": _sphere,
    "mesh": _mesh,
}
