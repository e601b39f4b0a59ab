"""Walls from occupancy grids: every occupied cell once, at the place of the YAML file."""

import math
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra import numpy as arrays

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Array
from vcmvsp.physics.importers.occupancy_grid import Map, blocks_of
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import World


@settings(deadline=None)
@given(cells=arrays.arrays(bool, arrays.array_shapes(min_dims=2, max_dims=2, max_side=12)))
def test_rectangles_hold_each_occupied_cell_once_and_no_other(cells: Array) -> None:
    painted = np.zeros(cells.shape, int)
    for top, bottom, left, right in blocks_of(cells):
        painted[top:bottom, left:right] += 1
    assert (painted == cells).all()


def test_rectangles_are_few() -> None:
    room = np.zeros((100, 200), bool)
    room[[0, -1]] = room[:, [0, -1]] = True
    assert len(blocks_of(room)) == 4
    room[40:60, 50] = True
    assert len(blocks_of(room)) == 5
    assert blocks_of(np.ones((5, 7), bool)) == [(0, 5, 0, 7)]
    assert blocks_of(np.zeros((5, 7), bool)) == []


def write_map(folder: Path, grey: Array, image: str = "map.pgm", ascii_: bool = False, **keys: Any) -> Path:
    """A map in the format of map_saver."""
    if image.endswith(".pgm") and ascii_:
        rows = "\n".join(" ".join(map(str, row)) for row in grey.tolist())
        (folder / image).write_text(f"P2\n# by hand\n{grey.shape[1]} {grey.shape[0]}\n255\n{rows}\n")
    elif image.endswith(".pgm"):
        (folder / image).write_bytes(b"P5\n%d %d\n255\n" % grey.shape[::-1] + grey.astype(np.uint8).tobytes())
    else:
        cv2.imwrite(str(folder / image), grey.astype(np.uint8))
    content = {"image": image, "resolution": 0.5, "origin": [-1.0, -2.0, 0.0], "negate": 0, "occupied_thresh": 0.65, **keys}
    path = folder / "map.yaml"
    path.write_text("".join(f"{key}: {value}\n" for key, value in content.items()) + "free_thresh: 0.196\n")
    return path


GREY = np.array([[0, 254, 254, 205], [254, 254, 254, 254], [0, 0, 254, 100]])  # occupied, free, unknown, 0.61: below threshold


def area_of(world: World) -> float:
    return sum(box.size[0] * box.size[1] for box in world.solids if isinstance(box, Box))


@pytest.mark.parametrize(("image", "ascii_"), [("map.pgm", False), ("map.pgm", True), ("map.png", False)])
def test_a_map_becomes_walls(tmp_path: Path, image: str, ascii_: bool) -> None:
    world = Map(path=str(write_map(tmp_path, GREY, image, ascii_)), height=1.5).build()
    boxes = [solid for solid in world.solids if isinstance(solid, Box)]
    assert sorted((box.center, box.size) for box in boxes) == [
        ((-0.75, -0.75, 0.75), (0.5, 0.5, 1.5)),  # upper left cell; the origin is the picture's lower left corner
        ((-0.5, -1.75, 0.75), (1.0, 0.5, 1.5)),
    ]
    assert world.bounds == (-1.0, -2.0, 1.0, -0.5)


def test_threshold_negation_and_yaw(tmp_path: Path) -> None:
    assert area_of(Map(path=str(write_map(tmp_path, GREY, occupied_thresh=0.6))).build()) == pytest.approx(4 * 0.25)
    assert area_of(Map(path=str(write_map(tmp_path, GREY, negate=1))).build()) == pytest.approx(8 * 0.25)
    world = Map(path=str(write_map(tmp_path, GREY, origin=[1.0, 2.0, 0.5 * math.pi]))).build()
    lower = np.array([[0.7, 2.2], [0.8, 2.2], [0.8, 2.8], [0.7, 2.8]])
    solid, _ = world.blocking(lower, 0.0, 1.0) or (None, 0.0)
    assert solid is not None  # the two lower cells lie along the picture's x axis, which points north
    assert world.bounds == pytest.approx((-0.5, 2.0, 1.0, 4.0))


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"resolution": 0}, ("resolution", "above 0")),
        ({"resolution": "1" + "0" * 400}, ("resolution", "below 1e+09")),
        ({"resolution": "fine"}, ("resolution", "'fine'")),
        ({"origin": "[1, 2]"}, ("origin", "lower left corner")),
        ({"origin": "[1, 2, .nan]"}, ("origin", "lower left corner")),
        ({"origin": f"[1, {10**400}, 0]"}, ("origin", "lower left corner")),
        ({"saved": "2020-13-45"}, ("is not YAML", "month")),
        ({"image": "other.pgm"}, ("image", "there is no picture file", "other.pgm")),
        ({"image": "map.yaml"}, ("image", "is not a picture")),
        ({"occupied_thresh": 65}, ("occupied_thresh", "below 1")),
        ({"mode": "raw"}, ("mode", "trinary or scale")),
        ({"image": "[", "negate": "]"}, ("is not YAML",)),
    ],
)
def test_errors_of_a_map_are_named(tmp_path: Path, keys: dict[str, Any], words: tuple[str, ...]) -> None:
    write_map(tmp_path, GREY)
    content = {"image": "map.pgm", "resolution": 0.5, "origin": [-1.0, -2.0, 0.0], **keys}
    (tmp_path / "map.yaml").write_text("".join(f"{key}: {value}\n" for key, value in content.items()))
    with pytest.raises(ScenarioError) as caught:
        Map(path=str(tmp_path / "map.yaml")).build()
    assert all(word in str(caught.value) for word in (*words, "map.yaml")), str(caught.value)


def test_without_its_library_a_file_error_names_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "yaml", None)
    path = write_map(tmp_path, GREY)
    with pytest.raises(ScenarioError, match=r"map\.yaml: reading it needs the package yaml.*pip install pyyaml"):
        Map(path=str(path)).build()
