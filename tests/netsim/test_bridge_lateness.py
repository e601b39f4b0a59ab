import numpy as np

from cosim.types import Array
from netsim.bridge.lateness import Columns, Lateness


def ints(*values: int) -> Array:
    return np.array(values, np.int64)


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
    lateness = Lateness()
    lateness.sent(ints(0, 2), ints(0, 1), ints(1, 0), ints(100, 200))
    lateness.sent(ints(1), ints(0), ints(1), ints(150))
    lateness.carried(ints(0, 2, 1), ints(40, 41, 42), lost=3)
    lateness.due(ints(2, 0), ints(1, 0), ints(1_200, 1_100), ints(5_000_000, 6_000_000))
    lateness.due(ints(1), ints(0), ints(1_300), ints(9_000_000))
    lateness.went(ints(1, 0), ints(6_500_000, 8_000_000), ints(1_150, 1_400))
    told = lateness.summary({"a": {"longer than max_bytes": 2}})
    assert told == {
        "datagrams": 3,
        "delivered": 2,
        "lost": 3,
        "p50_s": (0.0005 + 0.003) / 2,
        "p99_s": told["p99_s"],
        "max_s": 0.003,
        "over_1ms": 1,
        "counts": {"a": {"longer than max_bytes": 2}},
    }
    first, second, third = lateness.table(("udp", "wss"), ("a", "b")).to_pylist()
    row = {"number": 2, "frame": 41, "door": "wss", "sender": "a", "receiver": "b", "came_ns": 200}
    assert first == {**row, "wanted_ns": 1_200, "left_ns": 1_400, "late_s": 0.003}
    row = {"number": 0, "frame": 40, "door": "udp", "sender": "b", "receiver": "a", "came_ns": 100}
    assert second == {**row, "wanted_ns": 1_100, "left_ns": 1_150, "late_s": 0.0005}
    assert (third["number"], third["left_ns"], third["late_s"]) == (1, None, None)  # the run ended before


def test_a_run_in_which_nothing_was_sent_has_no_lateness() -> None:
    told = Lateness().summary({})
    assert (told["datagrams"], told["delivered"], told["p50_s"], told["max_s"]) == (0, 0, None, None)
    assert Lateness().table(("udp",), ("a",)).num_rows == 0
