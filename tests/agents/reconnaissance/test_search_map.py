"""The map of a searcher: cells of a reading and of a picture, and the surest target that is left."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.agents.reconnaissance.exchange import exchange
from vcmvsp.agents.reconnaissance.ground_point import Nadir
from vcmvsp.agents.reconnaissance.probability_map import Grid, Rectangle, Sensor
from vcmvsp.agents.reconnaissance.search_map import SearchMap, of_picture, of_reading, swaths_m
from vcmvsp.agents.reconnaissance.watch import WatchFrame
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.types import Image, Looks, Sighting

GRID = Grid(Rectangle(0.0, 0.0, 30.0, 20.0), 2.0)  # 15 x 10 cells


def map_of(*hits: tuple[int, int, int]) -> SearchMap:
    """Map in which a number of looks called cells (column, row) targets."""
    found = SearchMap(GRID, exchange("ledger", GRID, Sensor(0.9, 0.1), "a", ["a", "b"]))
    for column, row, count in hits:
        for _ in range(count):
            found.look(np.array([row * GRID.columns + column]), np.array([True]), 1)
    return found


def test_the_surest_cell_without_a_claim() -> None:
    """Looks of 0.9 and 0.1 from prior 0.5: m net hits give 9^m / (1 + 9^m)."""
    surest: Any = map_of((2, 2, 4), (3, 3, 3), (10, 8, 3), (14, 0, 2)).surest
    assert surest([]) == (pytest.approx(9**4 / (1 + 9**4)), (6.0, 6.0))  # two cells that share a corner: one target
    near = (7.0 + 3.9, 7.0)  # 3.9 m from the middle of the second cell
    assert surest([near]) == (pytest.approx(9**3 / (1 + 9**3)), (21.0, 17.0))
    assert surest([(near[0] + 0.2, 7.0)])[1] == (6.0, 6.0)
    assert surest([near, (21.0, 17.0)]) == (pytest.approx(81 / 82), None)
    assert surest([near, (21.0, 17.0), (29.0, 1.0)]) == (pytest.approx(0.5), None)


def test_a_map_without_looks_has_its_prior() -> None:
    likely, place = map_of().surest([])
    assert likely == pytest.approx(0.5)
    assert place is None
    everywhere = [(float(x), float(y)) for x in range(31) for y in range(21)]
    assert map_of((2, 2, 4)).surest(everywhere) == (0.0, None)


def test_blobs_are_the_connected_decided_cells() -> None:
    rng = np.random.default_rng(4)
    found = map_of(*((int(c), int(r), 3) for c, r in zip(rng.integers(0, 15, 40), rng.integers(0, 10, 40), strict=True)))
    cells = [set(blob.cells.tolist()) for blob in found.blobs]
    assert set().union(*cells) == set(np.flatnonzero(found.odds > math.log(99.0)).tolist())
    for one in cells:
        for other in cells:
            pairs = [(a // 15 - b // 15, a % 15 - b % 15) for a in one for b in other]
            assert (one is other) or all(max(abs(up), abs(aside)) > 1 for up, aside in pairs)
    for blob in found.blobs:
        assert blob.middle == pytest.approx(GRID.centres(blob.cells).mean(axis=0))
    assert [blob.odds for blob in found.blobs] == sorted((blob.odds for blob in found.blobs), reverse=True)


@given(
    left=st.floats(-50.0, 50.0) | st.integers(-40, 40).map(float),
    bottom=st.floats(-50.0, 50.0),
    cell=st.sampled_from([0.5, 1.0, 2.0, 3.3]),
)
def test_looks_count_for_the_cells_that_contain_their_centres(left: float, bottom: float, cell: float) -> None:
    grid = Grid(Rectangle(left, bottom, left + 12.0, bottom + 9.0), cell)
    columns = np.arange(math.floor(left / cell) - 2, math.floor((left + 12.0) / cell) + 3)
    rows = np.arange(math.floor(bottom / cell) - 2, math.floor((bottom + 9.0) / cell) + 3)
    cells = np.array([(column, row) for column in columns for row in rows], np.int32)
    hits = np.arange(len(cells)) % 3 == 0
    found, grid_hits = of_reading(grid, Looks(time_ns=0, cell_m=cell, cells=cells, hits=hits))
    assert len(set(found.tolist())) == len(found)
    assert sorted(found.tolist()) == list(range(grid.rows * grid.columns))
    middles = (cells + 0.5) * cell
    for number, hit in zip(found.tolist(), grid_hits.tolist(), strict=True):
        away = np.abs(middles - grid.centres(np.array([number])))
        nearest = int(np.hypot(*away.T).argmin())
        assert away[nearest].max() <= 0.5 * cell + 1e-6
        if away[nearest].max() < 0.499 * cell:
            assert hit == hits[nearest]


def test_a_detector_of_other_cells_is_refused() -> None:
    looks = Looks(time_ns=0, cell_m=1.0, cells=np.zeros((1, 2), np.int32), hits=np.array([True]))
    with pytest.raises(ValueError, match="cell_m = 2 must equal the cell size of the sensor, 1 m"):
        of_reading(GRID, looks)


def frame(x: float, y: float, height: float, *places: tuple[float, float], yaw: float = 0.0, ground: float = 0.0) -> WatchFrame:
    """A picture of 64 x 48 pixels at a focal length of 40."""
    nadir = Nadir((x, y, height), quaternion_from_yaw(yaw), 40.0, 64, 48, ground)
    found = tuple(Sighting(target="t", place=at, centre_px=(1.0, 1.0), angle=0.0, side_px=4.0, score=1.0) for at in places)
    return WatchFrame(0, nadir, found, Image(pixels=np.zeros((48, 64, 3), np.uint8)), (0, 0, 64, 48), True)


def test_a_picture_is_a_look_at_the_cells_that_it_shows() -> None:
    """10.1 m above (15, 10), heading east: slightly more than 8 m north and south, 6 m ahead and behind."""
    cells, hits = of_picture(GRID, frame(15.0, 10.0, 10.1, (13.5, 9.0), (500.0, 0.0)))
    x, y = GRID.centres(cells).T
    assert (x.min(), x.max(), y.min(), y.max()) == (9.0, 21.0, 3.0, 17.0)
    assert len(cells) == 7 * 8
    assert cells[hits].tolist() == [GRID.at(13.5, 9.0)]


@given(yaw=st.floats(-3.2, 3.2), height=st.floats(2.0, 40.0), ground=st.floats(-5.0, 1.0))
def test_the_swath_of_a_lane_reaches_to_the_border_of_the_picture(yaw: float, height: float, ground: float) -> None:
    """At f = 40 px: length of rays along x and y from the middle of a turned rectangle of 64 x 48 px."""
    seen_m = swaths_m(frame(3.0, 4.0, height, yaw=yaw, ground=ground), 20.0)
    ahead, aside = abs(math.cos(yaw)), abs(math.sin(yaw))
    x_px = min(24.0 / max(ahead, 1e-12), 32.0 / max(aside, 1e-12))
    y_px = min(24.0 / max(aside, 1e-12), 32.0 / max(ahead, 1e-12))
    assert seen_m == pytest.approx((x_px / 40.0 * (20.0 - ground), y_px / 40.0 * (20.0 - ground)))


def test_a_camera_without_the_nadir_in_view_has_no_swath() -> None:
    tilted = Nadir((3.0, 4.0, 20.0), (math.cos(0.4), 0.0, math.sin(0.4), 0.0), 40.0, 64, 48)
    picture = frame(3.0, 4.0, 20.0)
    assert swaths_m(dataclasses.replace(picture, nadir=tilted), 20.0) is None


def test_shown_probabilities_are_in_255ths() -> None:
    shown = map_of((2, 1, 4), (3, 1, 2)).for_recording()
    assert (shown.left, shown.bottom, shown.cell_m, shown.probability.shape) == (0.0, 0.0, 2.0, (10, 15))
    assert shown.probability[1, 1:5].tolist() == [128, 255, round(81 / 82 * 255), 128]
    assert np.argwhere(shown.seen).tolist() == [[1, 2], [1, 3]]
