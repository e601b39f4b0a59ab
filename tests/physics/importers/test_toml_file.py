"""Worlds from TOML files, and what they may not hold."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.physics.importers.files import File, MeshFile
from vcmvsp.physics.importers.geojson import GeoJson
from vcmvsp.physics.importers.occupancy_grid import Map
from vcmvsp.physics.world.solids import Box, Cylinder, Prism
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
    picture = world.ground.image  # found beside the file
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
        (TOML.replace("[-5, -5, 5, 5]", "[5, -5, -5, 5]"), ("hall.toml line 3: bounds", "must be less")),
        (TOML.replace("floor.png", "wall.png"), ("hall.toml", "there is no picture file", "wall.png")),
        (TOML.replace("floor.png", "hall.toml"), ("hall.toml", "is no picture")),
        (TOML.replace("size = [10, 10]", "size = [10, 10"), ("hall.toml", "is not TOML")),
        (TOML.replace("size = [10, 10]", "size = [0, 10]"), ("hall.toml line", "ground", "> 0")),
    ],
)
def test_what_is_wrong_with_a_toml_file_is_said_with_its_line(tmp_path: Path, text: str, words: tuple[str, ...]) -> None:
    (tmp_path / "hall.toml").write_text(text)
    cv2.imwrite(str(tmp_path / "floor.png"), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(ScenarioError) as caught:
        File(path=str(tmp_path / "hall.toml")).build()
    assert all(word in str(caught.value) for word in words), str(caught.value)


@pytest.mark.parametrize("kind", [File, Map, GeoJson, MeshFile])
def test_files_that_are_not_there_are_refused(tmp_path: Path, kind: Any) -> None:
    with pytest.raises(ScenarioError, match=r"there is no file .*nowhere\.x") as caught:
        kind(path=str(tmp_path / "nowhere.x"))
    assert caught.value.key == "path"
