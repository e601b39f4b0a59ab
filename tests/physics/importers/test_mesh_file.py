"""Meshes from files: placed, turned, refused where they are broken."""

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.physics.importers.files import MeshFile
from vcmvsp.physics.world.solids import Mesh

CORNERS = ((0, 0, 0), (2, 0, 0), (0, 2, 0), (0, 0, 2))
FACES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))


def write_obj(folder: Path, corners: Any = CORNERS) -> str:
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + ["f " + " ".join(str(k + 1) for k in face) for face in FACES]
    (folder / "part.obj").write_text("\n".join(lines) + "\n")
    return str(folder / "part.obj")


def write_stl(folder: Path, binary: bool, corners: Any = CORNERS) -> str:
    triangles = np.array(corners, np.float32)[np.array(FACES)]
    path = folder / "part.stl"
    if binary:
        record = np.zeros(len(triangles), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
        record["corners"] = triangles
        path.write_bytes(b"\0" * 80 + np.uint32(len(triangles)).tobytes() + record.tobytes())
    else:
        loops = "".join(
            "outer loop\n" + "".join("vertex {} {} {}\n".format(*p) for p in t) + "endloop\n" for t in triangles.tolist()
        )
        facets = loops.replace("outer", "facet normal 0 0 0\nouter").replace("endloop", "endloop\nendfacet")
        path.write_text(f"solid part\n{facets}endsolid part\n")
    return str(path)


@pytest.mark.parametrize("form", ["obj", "stl", "ascii stl"])
def test_a_mesh_is_placed_in_the_world(tmp_path: Path, form: str) -> None:
    path = write_obj(tmp_path) if form == "obj" else write_stl(tmp_path, form == "stl")
    world = MeshFile(path=path, scale=0.5, yaw_rad=0.5 * math.pi, position=(10.0, 0.0, 1.0), material="metal").build()
    (mesh,) = world.solids
    assert isinstance(mesh, Mesh)
    assert mesh.material == "metal"
    expected = np.array([(10.0, 0.0, 1.0), (10.0, 1.0, 1.0), (9.0, 0.0, 1.0), (10.0, 0.0, 2.0)])[np.array(FACES)]
    assert mesh.triangles == pytest.approx(expected)
    a, b, c = mesh.triangles.transpose(1, 0, 2)
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0 == pytest.approx(1.0 / 6.0)  # still seen from outside


def test_y_may_point_up(tmp_path: Path) -> None:
    (mesh,) = MeshFile(path=write_obj(tmp_path, ((0, 0, 0), (3, 0, 0), (0, 5, 0), (0, 0, 1))), up="y").build().solids
    assert isinstance(mesh, Mesh)
    assert mesh.triangles.reshape(-1, 3).max(axis=0).tolist() == [3.0, 0.0, 5.0]
    assert mesh.triangles.reshape(-1, 3).min(axis=0).tolist() == [0.0, -1.0, 0.0]


@pytest.mark.parametrize("form", ["obj", "stl", "ascii stl"])
def test_a_mesh_with_nan_is_refused_with_its_triangle(tmp_path: Path, form: str) -> None:
    broken = (*CORNERS[:3], (0, 0, math.nan))
    path = write_obj(tmp_path, broken) if form == "obj" else write_stl(tmp_path, form == "stl", broken)
    with pytest.raises(ScenarioError, match=r"part\.\w+: triangle 1 has a corner that is not finite \(3 of 4 have\)"):
        MeshFile(path=path).build()


@pytest.mark.parametrize(("name", "text"), [("part.obj", "v 0 0 0\n"), ("part.stl", "solid\nendsolid\n"), ("part.xyzzy", "?")])
def test_files_without_a_mesh_are_refused(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ScenarioError, match=r"part\.\w+: (holds no triangles|trimesh cannot read it)"):
        MeshFile(path=str(tmp_path / name)).build()


def test_without_its_library_a_mesh_is_refused_with_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ScenarioError, match=r"part\.obj: reading it needs trimesh.*pip install trimesh"):
        MeshFile(path=write_obj(tmp_path)).build()
