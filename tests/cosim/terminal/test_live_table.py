"""The table of a run's vehicles: newest values, the worst vehicles where there are too many, never too wide."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.cosim.recordings import Pose, follows, frame, note, recorder_after, states
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.received import receptions_at
from vcmvsp.cosim.terminal.live_table import GAP, LiveTable
from vcmvsp.cosim.types import RECEPTIONS, Halted, Message, Presence, Reception, States, frozen

WIDE = 200


NAMES = ("car1", "car2", *(f"uav{i}" for i in range(100)))


def heard(vehicle: str, time_ns: int) -> Event:
    message = Message(sender="x", body={}, size_bytes=1)
    reception = Reception(message=message, rssi_dbm=-50.0, sent_ns=time_ns, received_ns=time_ns)
    return Event(RECEPTIONS, time_ns, receptions_at(vehicle, [reception], NAMES))


def table_of(*events: Event, **agents: str) -> LiveTable:
    table = LiveTable(agents)
    for event in events:
        table.on(event)
    return table


def rows(table: LiveTable, now_ns: int = SECOND_NS, height: int = 40) -> dict[str, dict[str, str]]:
    """Cells by vehicle and title, from the columns below the titles."""
    head, *lines = (line.text for line in table.lines(now_ns, WIDE, height))
    titles = [title for title in table._widths if title in head]
    found = {}
    for line in lines:
        cells, begin = {}, 0
        for title in titles:
            cells[title] = line[begin : begin + table._widths[title]].strip()
            begin += table._widths[title] + len(GAP)
        found[cells["vehicle"]] = cells
    return found


def many(count: int) -> dict[str, Pose]:
    return {f"uav{i}": (float(i), 2.0 * i, 0.1) for i in range(count)}


def test_it_shows_positions_and_commanders() -> None:
    table = table_of(
        states(0, {"car1": (1.0, 2.0, 0.0), "car2": (3.0, -4.0, 0.0)}), note("car2", 0, commander="avoid1"), car1="goal"
    )
    shown = rows(table)
    assert list(shown) == ["car1", "car2"]
    assert shown["car1"]["position [m]"].split() == ["1.0", "2.0"]
    assert [shown[name]["by"] for name in shown] == ["goal", "avoid1"]
    table.on(states(1, {"car1": (9.0, 2.0, 0.0), "car2": (3.0, -4.0, 0.0)}))
    table.on(note("car2", 1, commander="search", other=1.0))
    assert rows(table)["car1"]["position [m]"].split() == ["9.0", "2.0"]
    assert rows(table)["car2"]["by"] == "search"


def test_speed_covers_all_axes_and_flyers_have_a_height() -> None:
    value = States(
        names=("uav1",),
        position=frozen([(1.0, 2.0, 7.5)]),
        velocity=frozen([(2.0, 3.0, 6.0)]),
        attitude=frozen([(1.0, 0.0, 0.0, 0.0)]),
        angular_velocity=frozen(np.zeros((1, 3))),
    )
    shown = rows(table_of(Event("world/states", 0, value)))["uav1"]
    assert shown["speed [m/s]"] == "7.00"
    assert shown["position [m]"].split() == ["1.0", "2.0", "7.5"]


@given(st.lists(st.tuples(*[st.floats(-20.0, 20.0)] * 2, st.floats(-math.pi, math.pi)), min_size=2, max_size=2))
@settings(max_examples=20)
def test_the_error_equals_the_metric(poses: list[Pose]) -> None:
    events = [states(0, dict(zip(("car1", "car2"), poses, strict=True))), follows("car2", "car1", (-1.0, 0.5), 0.2)]
    metric = recorder_after(("car1", "car2"), events, 0).metrics(window=(0.0, None))["formation"]["final_m"]
    shown = rows(table_of(*events))
    assert float(shown["car2"]["error [m]"]) == pytest.approx(metric, abs=0.00051)
    assert shown["car1"]["error [m]"] == ""


def test_it_shows_share_and_age_of_messages() -> None:
    frames = [frame(k, "car1", k, {"car2": None if k % 4 == 0 else k, "car3": None}) for k in range(8)]
    shown = rows(
        table_of(
            states(0, {"car1": (0.0,) * 3, "car2": (0.0,) * 3, "car3": (0.0,) * 3}), *frames, heard("car2", SECOND_NS // 2)
        )
    )
    assert [shown[name]["delivered"] for name in shown] == ["", "75 %", "0 %"]
    assert [shown[name]["heard [s ago]"] for name in shown] == ["", "0.5", "never"]


def test_memory_for_frames_does_not_grow_with_the_run() -> None:
    table = table_of(*(frame(k, "car1", k, {"car2": k}) for k in range(500)))
    table.lines(0, WIDE, 10)
    assert rows(table)["car2"]["delivered"] == "100 %"
    assert len(table._run.tallies) == 1


def test_it_shows_lost_gone_back_and_halted() -> None:
    def present(vehicle: str, state: str) -> Event:
        return Event(f"{vehicle}/host", 0, Presence(state=state, since_ns=0))  # type: ignore[arg-type]

    table = table_of(states(0, many(4)), present("uav0", "lost"), present("uav1", "removed"), present("uav2", "lost"))
    table.on(present("uav2", "back"))
    table.on(Event("operator/halted", 0, Halted(vehicles=("uav3",), halted=True)))
    assert [cells["state"] for cells in rows(table).values()] == ["lost", "gone", "ok", "halted"]
    assert [line.kind for line in table.lines(0, WIDE, 10)] == ["head", "bad", "bad", "", "halted"]
    table.on(Event("operator/halted", 0, Halted(vehicles=("uav3",), halted=False)))
    assert rows(table)["uav3"]["state"] == "ok"


def test_of_too_many_vehicles_the_worst_are_shown() -> None:
    table = table_of(states(0, many(100)), *(heard(f"uav{i}", 0 if i == 77 else 9 * SECOND_NS) for i in range(100)))
    table.on(Event("uav50/host", 0, Presence(state="lost", since_ns=0)))
    table.on(Event("operator/halted", 0, Halted(vehicles=("uav60",), halted=True)))
    lines = table.lines(10 * SECOND_NS, WIDE, 40)
    assert [line.text.split()[0] for line in lines[1:4]] == ["uav50", "uav60", "uav77"]
    assert len(lines) == 22
    assert lines[-1].text == "... and 80 more"


@given(st.integers(0, 150), st.integers(-3, 40), st.integers(0, 40))
@settings(max_examples=60)
def test_it_stays_within_width_and_height(width: int, height: int, count: int) -> None:
    table = (
        LiveTable({})
        if not count
        else table_of(states(0, many(count)), *(follows(f"uav{i}", "uav0", (1.0, 1.0), 0.1) for i in range(1, count)))
    )
    table.on(frame(1, "uav0", 0, {f"uav{i}": i for i in range(1, count)}))
    lines = table.lines(0, width, height)
    assert len(lines) <= max(height, 0)
    assert all(len(line.text) <= width for line in lines)
    if count and width >= 40 and height >= 4:
        assert lines[0].text.split()[:2] == ["vehicle", "state"]


def test_notes_of_agents_cannot_control_the_terminal() -> None:
    table = table_of(states(0, many(1)), note("uav0", 0, commander="\x1b[2J\x1b]0;x\x07" + "y" * 500))
    assert rows(table)["uav0"]["by"].startswith("yyy")
    assert all(line.text.isprintable() for line in table.lines(0, WIDE, 10))


def test_columns_do_not_move_when_values_become_shorter() -> None:
    table = table_of(states(0, {"car1": (-1000.0, 2000.0, 0.0)}))
    before = table.lines(0, WIDE, 10)[0].text
    table.on(states(1, {"car1": (1.0, 2.0, 0.0)}))
    assert table.lines(0, WIDE, 10)[0].text == before
