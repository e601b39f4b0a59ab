"""State of a run in the control station from its updates, and the places of followers."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.cosim.view_pages import moving_state, positions_at, scenery, states, station_state
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.recording.run_state import LogLine
from vcmvsp.cosim.types import Follows, Presence
from vcmvsp.cosim.view.messages import PageUpdate
from vcmvsp.cosim.view.page.vehicles import places_of

ANGLES = st.floats(-3.0, 3.0)
Notes = dict[str, dict[str, float | str | bool]]
METRES = st.floats(-50.0, 50.0)


def test_omitted_values_are_unchanged() -> None:
    scene = scenery(3)
    known = station_state(scene, moving_state(scene, 1.0), PageUpdate(time_ns=2 * SECOND_NS))
    assert np.array_equal(known.position, positions_at(scene, 1.0))
    assert known.now.places.keys() == {"v2", "v3"}
    assert known.now.sent is not None
    assert known.now.time_ns == 2 * SECOND_NS


def test_of_each_key_the_newest_counts() -> None:
    scene = scenery(2)
    old: Notes = {"v1": {"mode": "old"}, "v2": {"mode": "old"}}
    new: Notes = {"v2": {"mode": "new"}}
    known = station_state(scene, PageUpdate(time_ns=0, notes=old), PageUpdate(time_ns=1, notes=new))
    assert known.now.notes == {"v1": {"mode": "old"}, "v2": {"mode": "new"}}


def test_where_time_goes_back_only_the_new_update_counts() -> None:
    scene = scenery(3)
    lines = tuple(LogLine(time_ns=second * SECOND_NS, level="info", text=f"line {second}") for second in range(5))
    late = PageUpdate(time_ns=4 * SECOND_NS, presence={"v1": Presence(state="lost", since_ns=3 * SECOND_NS)}, lines=lines)
    known = station_state(scene, late, PageUpdate(time_ns=2 * SECOND_NS, lines=lines[2:3]))
    assert known.now.presence == {}
    assert [line.text for line in known.lines] == ["line 0", "line 1", "line 2"]
    assert known.times_back == 1


def test_vehicles_are_found_by_name_in_any_order_without_unknown_ones() -> None:
    scene = scenery(3)
    vehicle_states = states([(3.0, 0.0, 0.0), (9.0, 0.0, 0.0), (1.0, 0.0, 0.0)], [0.0] * 3, ("v3", "stranger", "v1"))
    known = station_state(scene, PageUpdate(time_ns=0, states=vehicle_states))
    assert known.position[[0, 2], 0].tolist() == [1.0, 3.0]
    assert np.isnan(known.position[1]).all()


# --- formation ---


@given(yaw=ANGLES, x=METRES, y=METRES, ahead=METRES, left=METRES, own=ANGLES, off=METRES, handle=st.floats(0.0, 1.0))
def test_in_place_with_its_leaders_heading_error_is_zero(
    yaw: float, x: float, y: float, ahead: float, left: float, own: float, off: float, handle: float
) -> None:
    scene = scenery(2)
    c, s = math.cos(yaw), math.sin(yaw)
    place = (x + c * ahead - s * left, y + s * ahead + c * left, 0.5)
    follows = {"v2": Follows(leader="v1", slot=(ahead, left), handle_m=handle)}
    there = states([(x, y, 0.0), place], [yaw, yaw], ("v1", "v2"))
    exact = places_of(station_state(scene, PageUpdate(time_ns=0, states=there, places=follows)))
    assert exact.place[0] == pytest.approx(place, abs=1e-9)
    assert exact.error_m[0] == pytest.approx(0.0, abs=1e-9)
    away = states([(x, y, 0.0), (place[0] + off, place[1], place[2])], [yaw, own], ("v1", "v2"))
    places = places_of(station_state(scene, PageUpdate(time_ns=0, states=away, places=follows)))
    error = places.error_m[0]
    assert math.dist(places.place[0], (place[0] + off, *place[1:])) == pytest.approx(error, abs=1e-9)  # distance to the place
    handles = handle * math.hypot(math.cos(own) - c, math.sin(own) - s)
    assert abs(off) - handles - 1e-9 <= error <= abs(off) + handles + 1e-9


def test_a_vehicle_without_a_leader_has_no_place() -> None:
    scene = scenery(3)
    follows = {"v2": Follows(leader=None), "v3": Follows(leader="v1")}
    assert places_of(station_state(scene, moving_state(scene, 0.0, places=follows))).row.tolist() == [2]
