"""A world as a scene of Mitsuba 3 for Sionna RT: a mesh for each solid, with the material and thickness of its walls.

The corners of a mesh are shared by its triangles: Sionna finds the edges that diffract by them. A thin box is the sheet in its
middle, as for the rays of `netsim.propagation.rays`.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.raycast.surfaces import surfaces_of
from vcmvsp.physics.world.solids import AnySolid

SCENE = "scene.xml"
_OPAQUE_M = 10.0  # thickness of what lets nothing through
_BEYOND_M = 1000.0  # of the ground around the solids


def files(solids: Sequence[AnySolid], slab_m: float, ground: str) -> dict[str, str]:
    """Contents of the files of a scene by name.

    Args:
        solids: of the world.
        slab_m: solids thinner than this let waves pass.
        ground: material of the plane z = 0, or none.
    """
    found = surfaces_of(solids, slab_m, ground=False)
    content: dict[str, str] = {}
    shapes, materials = [], {}

    def add(name: str, polygons: Sequence[Array], material: str, thickness_m: float) -> None:
        thickness_m = min(thickness_m, _OPAQUE_M)
        kind = f"{material}-{1000.0 * thickness_m:.6g}mm".replace(".", "p")
        materials[kind] = (
            f'<bsdf type="itu-radio-material" id="{kind}"><string name="type" value="{material}"/>'
            f'<float name="thickness" value="{thickness_m!r}"/></bsdf>'
        )
        content[f"{name}.ply"] = _ply(polygons)
        shapes.append(
            f'<shape type="ply" id="{name}"><string name="filename" value="{name}.ply"/>'
            f'<boolean name="face_normals" value="true"/><ref id="{kind}" name="bsdf"/></shape>'
        )

    for solid in np.unique(found.solid).tolist():
        facets = np.flatnonzero(found.solid == solid).tolist()
        polygons = [found.corner[found.first[k] : found.first[k + 1]] for k in facets]
        add(f"solid{solid}", polygons, solids[solid].material, float(found.thickness_m[facets[0]]))
    if ground != "none":
        points = found.corner[:, :2] if len(found.corner) else np.zeros((1, 2))
        middle, reach = points.mean(axis=0), _BEYOND_M + float(np.ptp(points, axis=0).max())
        corners = middle + reach * np.array([(-3.0, -1.0), (3.0, -1.0), (0.0, 4.0)])  # one triangle: no edge within
        add("ground", [np.column_stack([corners, np.zeros(3)])], ground, _OPAQUE_M)
    lines = [*materials.values(), *shapes]
    content[SCENE] = "\n".join(['<scene version="3.0.0">', *lines, "</scene>\n"])
    return content


def _ply(polygons: Sequence[Array]) -> str:
    """Convex polygons as triangles with shared corners."""
    number: dict[tuple[float, ...], int] = {}
    triangles = []
    for polygon in polygons:
        corners = [number.setdefault(tuple(corner), len(number)) for corner in polygon.tolist()]
        triangles += [f"3 {corners[0]} {a} {b}" for a, b in pairwise(corners[1:])]
    head = ["ply", "format ascii 1.0", f"element vertex {len(number)}", *(f"property float {axis}" for axis in "xyz")]
    head += [f"element face {len(triangles)}", "property list uchar int vertex_index", "end_header"]
    return "\n".join([*head, *("{:.9g} {:.9g} {:.9g}".format(*corner) for corner in number), *triangles, ""])
