"""Worlds from TOML files, and refused content."""

import math
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.physics.importers.files import File, MeshFile
from vcmvsp.physics.importers.geojson import GeoJson
from vcmvsp.physics.importers.occupancy_grid import Map
from vcmvsp.physics.world.solids import Box, Cylinder, Mesh, Prism
from vcmvsp.physics.world.world import Wind

TOML = """
floor_friction = 0.5
bounds = [-5, -5, 5, 5]

[ground]
picture = "floor.png"
size = [10, 10]

[[boxes]]
center = [2, 0, 0.5]
size = [0.2, 4, 1]
material = "brick"

[[cylinders]]
center = [0, 2, 0.5]
radius = 0.3
height = 1

[[prisms]]
outline = [[-3, -3], [-1, -3], [-3, -1]]
height = 2
"""


def test_a_toml_file_is_a_world(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "floor.png"), np.full((4, 4, 3), (10, 20, 30), np.uint8))
    (tmp_path / "hall.toml").write_text(TOML)
    world = File(path=str(tmp_path / "hall.toml")).build()
    assert [type(solid) for solid in world.solids] == [Box, Cylinder, Prism]
    assert (world.name, world.floor_friction, world.bounds) == ("hall", 0.5, (-5.0, -5.0, 5.0, 5.0))
    picture = world.ground.image  # relative to the file
    assert picture is not None
    assert picture[0, 0].tolist() == [30, 20, 10]


def test_the_scenario_may_change_wind_light_and_friction_of_a_file(tmp_path: Path) -> None:
    (tmp_path / "hall.toml").write_text(TOML.replace('picture = "floor.png"', ""))
    world = File(path=str(tmp_path / "hall.toml"), floor_friction=0.2, wind=Wind(gust=1.0)).build()
    assert (world.floor_friction, world.wind.gust) == (0.2, 1.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            TOML.replace("floor_friction", "floor_fricton"),
            ("hall.toml line 2: floor_fricton", "did you mean 'floor_friction'?"),
        ),
        (TOML.replace("floor_friction = 0.5", "floor_friction = -1"), ("hall.toml line 2: floor_friction", ">= 0")),
        (TOML.replace("radius", "radus"), ("hall.toml line 14: cylinders", "radus")),
        (TOML.replace("[0.2, 4, 1]", "[0.2, 4, 0]"), ("hall.toml line 9: boxes", "positive sizes")),
        (TOML.replace("[-3, -1]]", "[-2, -3]]"), ("hall.toml line 19: prisms", "no area")),
        (TOML.replace("[-5, -5, 5, 5]", "[5, -5, -5, 5]"), ("hall.toml line 3: bounds", "west < east")),
        (TOML.replace("floor.png", "wall.png"), ("hall.toml", "there is no picture file", "wall.png")),
        (TOML.replace("floor.png", "hall.toml"), ("hall.toml", "is not a picture")),
        (TOML.replace("size = [10, 10]", "size = [10, 10"), ("hall.toml", "is not TOML")),
        (TOML.replace("size = [10, 10]", "size = [0, 10]"), ("hall.toml line", "ground", "> 0")),
    ],
)
def test_errors_in_a_toml_file_name_its_line(tmp_path: Path, text: str, words: tuple[str, ...]) -> None:
    (tmp_path / "hall.toml").write_text(text)
    cv2.imwrite(str(tmp_path / "floor.png"), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(ScenarioError) as caught:
        File(path=str(tmp_path / "hall.toml")).build()
    assert all(word in str(caught.value) for word in words), str(caught.value)


@pytest.mark.parametrize("kind", [File, Map, GeoJson, MeshFile])
def test_missing_files_are_refused(tmp_path: Path, kind: Any) -> None:
    with pytest.raises(ScenarioError, match=r"there is no file .*nowhere\.x") as caught:
        kind(path=str(tmp_path / "nowhere.x"))
    assert caught.value.key == "path"


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
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0 == pytest.approx(1.0 / 6.0)  # outward orientation is kept


def test_y_may_point_up(tmp_path: Path) -> None:
    (mesh,) = MeshFile(path=write_obj(tmp_path, ((0, 0, 0), (3, 0, 0), (0, 5, 0), (0, 0, 1))), up="y").build().solids
    assert isinstance(mesh, Mesh)
    assert mesh.triangles.reshape(-1, 3).max(axis=0).tolist() == [3.0, 0.0, 5.0]
    assert mesh.triangles.reshape(-1, 3).min(axis=0).tolist() == [0.0, -1.0, 0.0]


@pytest.mark.parametrize("form", ["obj", "stl", "ascii stl"])
def test_a_mesh_with_nan_is_refused_with_its_triangle(tmp_path: Path, form: str) -> None:
    broken = (*CORNERS[:3], (0, 0, math.nan))
    path = write_obj(tmp_path, broken) if form == "obj" else write_stl(tmp_path, form == "stl", broken)
    with pytest.raises(ScenarioError, match=r"part\.\w+: triangle 1 has a non-finite corner \(3 of 4 triangles\)"):
        MeshFile(path=path).build()


@pytest.mark.parametrize(("name", "text"), [("part.obj", "v 0 0 0\n"), ("part.stl", "solid\nendsolid\n"), ("part.xyzzy", "?")])
def test_files_without_a_mesh_are_refused(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ScenarioError, match=r"part\.\w+: (contains no triangles|trimesh cannot read it)"):
        MeshFile(path=str(tmp_path / name)).build()


def test_without_its_library_a_mesh_error_names_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ScenarioError, match=r"part\.obj: reading it needs the package trimesh.*pip install trimesh"):
        MeshFile(path=write_obj(tmp_path)).build()
