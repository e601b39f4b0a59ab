"""Reports received by a follower: the newest valid one counts, in any order and among any other messages."""

import math
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.agents.agent_loop import info, observe, reception_of_body
from vcmvsp.agents.formation.followers.leader_follower import LeaderFollower
from vcmvsp.agents.formation.reports.report import ReportReceiver
from vcmvsp.cosim.agent import Radio
from vcmvsp.cosim.types import Reception, Velocity

pytestmark = pytest.mark.slow

TICK_NS = 100_000_000
POSE = (-1.0, -0.4, 0.1)
SILENT = Radio("me", ("me",))


def heard(body: Any, sender: str = "leader") -> Reception:
    return reception_of_body(sender, body)


def body_of(tick: int, **changes: Any) -> dict[str, Any]:
    """Report of a leader on a circle at a tick."""
    th = 0.015 * tick
    body = {
        "seq": tick,
        "t_ns": tick * TICK_NS,
        "x": 2 * math.sin(th),
        "y": 2 - 2 * math.cos(th),
        "th": th,
        "v": 0.3,
        "w": 0.15,
    }
    return {**body, **changes}


def outcome(*receptions: Reception, at_tick: int = 20, **params: Any) -> tuple[Velocity, dict[str, float | str | bool]]:
    """Command and notes of a new follower that has received all these by ``at_tick``."""
    follower = LeaderFollower("leader", bearing_deg=30.0, **params)
    command = follower.act(observe(POSE, at_tick * TICK_NS, receptions), SILENT)
    return command, follower.drain_notes()


NUMBERS = st.one_of(st.floats(), st.integers(-(2**63), 2**64 - 1))
ANYTHING = st.one_of(NUMBERS, st.none(), st.booleans(), st.text(max_size=3), st.lists(st.floats(), max_size=2))
GARBAGE = st.one_of(
    st.builds(  # a missing key
        lambda key: {name: value for name, value in body_of(20).items() if name != key},
        st.sampled_from(["t_ns", "x", "y", "th", "v", "w"]),
    ),
    st.builds(  # a value that is infinite, absurd or not a number
        lambda key, value: body_of(20, **{key: value}),
        st.sampled_from(["x", "y", "th", "v", "w"]),
        st.sampled_from([math.nan, math.inf, -math.inf, 1e300, -1e12, 2**64 - 1, None, "1.0", [1.0], {}]),
    ),
    st.builds(
        lambda t_ns: body_of(20, t_ns=t_ns), st.sampled_from([20 * TICK_NS + 1, 2**62, 1.9e9, math.nan, None, "0", True])
    ),
    st.binary(max_size=20),
    st.dictionaries(st.text(max_size=4), ANYTHING, max_size=5),
)


@given(
    ticks=st.lists(st.integers(0, 20), min_size=1, max_size=8),
    garbage=st.lists(GARBAGE, max_size=5),
    others=st.lists(st.integers(0, 20), max_size=3),
    data=st.data(),
)
def test_the_newest_report_wins_over_late_ones_copies_and_nonsense(
    ticks: list[int], garbage: list[Any], others: list[int], data: st.DataObject
) -> None:
    noise = [heard(body) for body in garbage] + [heard(body_of(tick, x=99.0), sender="somebody") for tick in others]
    mixed = data.draw(st.permutations([heard(body_of(tick)) for tick in ticks] + noise))
    command, notes = outcome(*mixed)
    expected, expected_notes = outcome(heard(body_of(max(ticks))))
    assert command == expected
    assert notes.pop("refused", 0) == sum(not isinstance(body, bytes) for body in garbage)  # bytes: other programs
    assert notes == expected_notes


@given(
    batches=st.lists(st.lists(st.integers(0, 12), max_size=4), min_size=1, max_size=10),
)
def test_a_report_is_kept_until_a_newer_one_is_received(batches: list[list[int]]) -> None:
    follower, newest = LeaderFollower("leader", bearing_deg=30.0), -1
    for i, batch in enumerate(batches):
        newest = max([newest, *batch])
        command = follower.act(observe(POSE, (12 + i) * TICK_NS, [heard(body_of(tick)) for tick in batch]), SILENT)
        notes = follower.drain_notes()
        if newest < 0:
            assert (command, notes) == (Velocity(), {"status": "waiting"})
        else:
            assert notes["age_s"] == pytest.approx((12 + i - newest) * 0.1, abs=1e-12)
            assert command == outcome(heard(body_of(newest)), at_tick=12 + i)[0]


@given(
    changes=st.dictionaries(st.sampled_from(["t_ns", "x", "y", "th", "v", "w", "seq"]), ANYTHING),
    estimator=st.sampled_from(["hold", "dr"]),
)
def test_every_message_gives_a_finite_command(changes: dict[str, Any], estimator: str) -> None:
    crossed_the_air = msgspec.msgpack.decode(msgspec.msgpack.encode(body_of(5, **changes)))
    command, _ = outcome(heard(crossed_the_air), estimator=estimator)
    assert math.isfinite(command.linear[0])
    assert math.isfinite(command.yaw_rate)


def test_a_clock_ahead_within_its_bound_is_accepted_with_age_zero() -> None:
    early = heard(body_of(20, t_ns=20 * TICK_NS + 5_000_000))
    assert outcome(early)[1] == {"status": "waiting", "refused": 1}
    command, notes = outcome(early, clock_bound_s=0.005)
    assert notes["age_s"] == 0.0
    assert command == outcome(heard(body_of(20)))[0]


def test_messages_of_other_programs_do_not_hide_a_silent_agent() -> None:
    listening = ReportReceiver(["leader"], 0.0)
    for tick, body in enumerate([body_of(0), b"\x00", msgspec.msgpack.encode(body_of(2)), b""]):
        listening.take(observe(POSE, tick * TICK_NS, [heard(body)]))
    assert (listening.absent_ns("leader", 3 * TICK_NS), listening.refused) == (3 * TICK_NS, 0)
    listening.take(observe(POSE, 4 * TICK_NS, [heard({"ack": 1})]))
    assert listening.absent_ns("leader", 4 * TICK_NS) == 0


@pytest.mark.parametrize("estimator", ["hold", "dr"])
def test_the_follower_stops_for_a_silent_leader_and_continues_with_its_next_report(estimator: str) -> None:
    follower = LeaderFollower("leader", bearing_deg=30.0, estimator=estimator, timeout_s=3.0, fade_s=1.0)
    commands, states = [], []
    for tick in range(61):
        receptions = [heard(body_of(tick))] if tick in (0, 60) else []
        commands.append(follower.act(observe(POSE, tick * TICK_NS, receptions), SILENT))
        states.append(follower.drain_notes()["status"])
    assert states == ["following"] * 30 + ["leader lost"] * 30 + ["following"]
    last = commands[29]
    for tick in range(30, 60):  # the last command, along its arc, to rest within 1 s
        left = max(0.0, 1.0 - (tick - 30) * 0.1)
        assert commands[tick].linear[0] == pytest.approx(last.linear[0] * left, abs=1e-12)
        assert commands[tick].yaw_rate == pytest.approx(last.yaw_rate * left, abs=1e-12)
    assert commands[59] == Velocity()
    assert commands[60] != Velocity()


def test_commands_are_limited() -> None:
    far = heard(body_of(20, x=50.0, y=30.0, v=0.0, w=0.0))
    free = outcome(far, handle=0.4)[0]
    assert free.linear[0] > 30.0
    assert free.yaw_rate > 20.0
    limited = outcome(far, handle=0.4, max_speed=1.6, max_yaw_rate=1.75)[0]
    assert (limited.linear[0], limited.yaw_rate) == (1.6, 1.75)
    back = heard(body_of(20, x=-50.0, y=-30.0, v=0.0, w=0.0))
    assert outcome(back)[0].linear[0] == -0.1
    backed = outcome(back, handle=0.4, max_reverse=0.3, max_yaw_rate=1.0)[0]
    assert (backed.linear[0], backed.yaw_rate) == (-0.3, -1.0)


@pytest.mark.parametrize("leader", ["car7", "car2"])
def test_a_leader_that_is_not_another_vehicle_is_refused(leader: str) -> None:
    with pytest.raises(ValueError, match="is not another vehicle of this run; other vehicles: car1"):
        LeaderFollower(leader).start(info("car2", ("car1", "car2")))
    LeaderFollower("car1").start(info("car2", ("car1", "car2")))
