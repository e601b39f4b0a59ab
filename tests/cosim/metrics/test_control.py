"""Metrics of commands: root mean squares, changes and effort."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.cosim.recordings import TENTH, metrics_after, velocity
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.types import Waypoint


def control_of(names: str, events: list[Event], seconds: float, window: tuple[float, float | None] = (0.0, None)) -> Any:
    return metrics_after(names, events, round(seconds * SECOND_NS), window)["control"]


def test_metrics_of_one_constant_command() -> None:
    """The command holds to the end: speeds as commanded, no acceleration, effort |v|^2 times the time."""
    control = control_of("ab", [velocity("a", 0, (0.3, 0.0, 0.4), -0.2)], 10.0)
    expected = {"speed_rms_m_s": 0.5, "yaw_rate_rms_rad_s": 0.2, "effort_m2_s": 2.5}
    rest = {"acceleration_rms_m_s2": None, "yaw_acceleration_rms_rad_s2": None}
    assert control["per_vehicle"]["a"] == pytest.approx(expected | rest)
    assert control["per_vehicle"]["b"] == dict.fromkeys([*expected, *rest])
    assert {key: control[key] for key in (*expected, *rest)} == control["per_vehicle"]["a"]


def test_all_vehicles_count_for_the_time_that_they_are_commanded() -> None:
    events = [velocity("a", 0, (1.0, 0.0, 0.0)), velocity("b", 6 * SECOND_NS, (2.0, 0.0, 0.0))]
    control = control_of("ab", events, 10.0)
    assert control["effort_m2_s"] == pytest.approx(1.0 * 10.0 + 4.0 * 4.0)
    assert control["speed_rms_m_s"] == pytest.approx(math.sqrt(26.0 / 14.0))


def test_of_several_commands_at_one_instant_the_last_counts() -> None:
    events = [velocity("a", 0, (9.0, 0.0, 0.0)), velocity("a", 0, (1.0, 0.0, 0.0)), velocity("a", SECOND_NS, (1.0, 0.0, 0.0))]
    control = control_of("a", events, 2.0)
    assert (control["effort_m2_s"], control["acceleration_rms_m_s2"]) == (pytest.approx(2.0), 0.0)


def test_a_huge_command_gives_an_infinite_effort() -> None:
    control = control_of("ab", [velocity("a", 0, (1e200, 0.0, 0.0)), velocity("a", SECOND_NS, (-1e200, 0.0, 0.0))], 2.0)
    assert control["effort_m2_s"] == math.inf
    assert control["per_vehicle"]["b"]["effort_m2_s"] is None
    events = [velocity("a", 0, (1e200, 0.0, 0.0)), velocity("a", SECOND_NS, (2.0, 0.0, 0.0))]
    later = control_of("a", events, 3.0, window=(2.0, None))
    assert (later["effort_m2_s"], later["speed_rms_m_s"]) == (4.0, 2.0)  # no effect of the first command


commands = st.lists(
    st.tuples(st.integers(0, 40), st.tuples(*[st.floats(-2.0, 2.0)] * 4) | st.none()),
    max_size=15,
    unique_by=lambda each: each[0],
)


@given(commands, st.integers(0, 40), st.integers(0, 60) | st.none())
@settings(deadline=None, max_examples=100)
def test_commands_equal_a_plain_loop(given_commands: list[Any], begin: int, end: int | None) -> None:
    """Against the definition, in steps of 0.1 s; None is a way-point."""
    ordered = sorted(given_commands)
    events = [
        Event("a/command", TENTH.at(k), Waypoint(position=(0.0, 0.0, 0.0)))
        if value is None
        else velocity("a", TENTH.at(k), value[:3], value[3])
        for k, value in ordered
    ]
    last = 45 if end is None else min(end, 45)
    speeds, rates = [], []
    for tick in range(begin, last):
        holds = [value for k, value in ordered if k <= tick]
        if holds and holds[-1] is not None:
            speeds.append(np.square(holds[-1][:3]).sum())
            rates.append(holds[-1][3] ** 2)
    pairs = [
        (0.1 * (k - before), np.subtract(value, held))
        for (before, held), (k, value) in pairwise(ordered)
        if begin <= k <= last and value is not None and held is not None
    ]
    control = control_of("a", events, 4.5, (begin / 10, None if end is None else end / 10))
    if not speeds:
        assert control["speed_rms_m_s"] is None
        return
    assert control["speed_rms_m_s"] == pytest.approx(np.sqrt(np.mean(speeds)))
    assert control["yaw_rate_rms_rad_s"] == pytest.approx(np.sqrt(np.mean(rates)))
    assert control["effort_m2_s"] == pytest.approx(0.1 * np.sum(speeds))
    if pairs:
        apart = sum(dt for dt, _ in pairs)
        linear = sum(np.square(step[:3]).sum() / dt for dt, step in pairs)
        assert control["acceleration_rms_m_s2"] == pytest.approx(math.sqrt(linear / apart), abs=1e-12)
        turning = sum(step[3] ** 2 / dt for dt, step in pairs)
        assert control["yaw_acceleration_rms_rad_s2"] == pytest.approx(math.sqrt(turning / apart), abs=1e-12)
    else:
        assert control["acceleration_rms_m_s2"] is None
