import numpy as np

from vcmvsp.cosim.types import Array, Traffic
from vcmvsp.netsim.bridge.deliveries import Columns, Lateness


def ints(*values: int) -> Array:
    return np.array(values, np.int64)


def traffic(*rows: tuple[int, int, int, int], settled: tuple[int, ...] = ()) -> Traffic:
    """Number, receiver, time and frame of each arrival."""
    number, receiver, arrival_ns, frame = np.array(rows, np.int64).reshape(-1, 4).T
    return Traffic(
        reports=(), carries=ints(), number=number, receiver=receiver, arrival_ns=arrival_ns, frame=frame, settled=ints(*settled)
    )


def test_columns_grow_and_keep_what_they_hold() -> None:
    columns = Columns("a", "b")
    for k in range(5000):
        columns.add(a=ints(k))
    columns.reach(100)
    assert columns["a"].tolist() == list(range(5000))
    assert set(columns["b"].tolist()) == {-1}
    columns["b"][ints(3, 4999)] = ints(7, 8)
    assert columns["b"][4999] == 8


def test_deliveries_are_told_with_what_carried_them_and_how_late_they_were() -> None:
    lateness = Lateness(("a", "b"))
    lateness.sent(ints(0, 2), ints(0, 1), ints(1, 0), ints(0, 1), ints(100, 200))
    lateness.sent(ints(1), ints(0), ints(1), ints(-1), ints(150))
    lateness.due(traffic((2, 1, 1_200, 41), (0, 0, 1_100, 40), settled=(0, 2)), ints(5_000_000, 6_000_000))
    lateness.due(traffic((1, 0, 1_300, 42), settled=(1,)), ints(9_000_000))
    lateness.delivered(ints(1, 0), ints(6_500_000, 8_000_000))
    told = lateness.summary({"a": {"longer than max_bytes": 2}})
    assert told == {
        "datagrams": 3,
        "delivered": 2,
        "lost": 0,
        "p50_s": (0.0005 + 0.003) / 2,
        "p99_s": told["p99_s"],
        "max_s": 0.003,
        "over_1ms": 1,
        "counts": {"a": {"longer than max_bytes": 2}},
    }
    first, second, third = lateness.table(("udp", "wss")).to_pylist()
    row = {"number": 2, "frame": 41, "door": "wss", "sender": "a", "receiver": "b", "came_ns": 200}
    assert first == {**row, "wanted_ns": 1_200, "late_s": 0.003}
    row = {"number": 0, "frame": 40, "door": "udp", "sender": "b", "receiver": "a", "came_ns": 100}
    assert second == {**row, "wanted_ns": 1_100, "late_s": 0.0005}
    assert (third["number"], third["frame"], third["late_s"]) == (1, 42, None)  # the run ended before


def test_lost_is_a_datagram_at_a_vehicle_that_it_was_meant_for_however_often_it_came_to_others() -> None:
    lateness = Lateness(tuple("abcd"))
    to_all, to_one = -1, 2
    lateness.sent(ints(0, 1, 2), ints(0, 0, 0), ints(0, 0, 0), ints(to_all, to_one, to_all), ints(1, 2, 3))
    lateness.due(traffic((0, 1, 10, 7), (0, 1, 12, 7)), ints(10, 12))  # it is doubled on its way
    assert lateness.summary({})["lost"] == 0  # the others may still receive it
    lateness.due(traffic((0, 3, 20, 9), settled=(0, 1)), ints(20))
    assert lateness.summary({})["lost"] == 1 + 1  # the first at c, the second at c
    assert lateness.table(("udp",))["frame"].to_pylist() == [7, 7, 9]


def test_a_run_in_which_nothing_was_sent_has_no_lateness() -> None:
    told = Lateness(("a",)).summary({})
    assert (told["datagrams"], told["delivered"], told["p50_s"], told["max_s"]) == (0, 0, None, None)
    assert Lateness(("a",)).table(("udp",)).num_rows == 0
