"""Playback: recorded events at their times, equal to the last bit; in between and after the end, as documented."""

import math
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.federate import Event, RunInfo, Slot
from vcmvsp.cosim.frames import quaternion_from_yaw, wrap, yaw_of
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.recording.external_inputs import Input
from vcmvsp.cosim.types import AnyValue, Fix, Note, Odometry, VehicleState
from vcmvsp.hardware.playback import Playback

MS = 1_000_000
V, W = 0.5, 0.4  # m/s, rad/s


def circle(t: float) -> VehicleState:
    """A vehicle that drives round the point (0, V / W)."""
    r, yaw = V / W, W * t
    return VehicleState(
        position=(r * math.sin(yaw), r * (1.0 - math.cos(yaw)), 0.0),
        velocity=(V * math.cos(yaw), V * math.sin(yaw), 0.0),
        attitude=quaternion_from_yaw(yaw),
        angular_velocity=(0.0, 0.0, W),
    )


def recording(end_ms: int, names: Sequence[str] = ("car1",), step_ms: int = 100) -> list[Input]:
    """Poses and estimates each 0.1 s from 0 on, a fix each second."""
    inputs: list[Input] = []
    for now_ms in range(0, end_ms + 1, step_ms):
        state = circle(now_ms / 1e3)
        for name in names:
            inputs.append((f"{name}/estimate", now_ms * MS, state))
            inputs.append((f"{name}/odometry", now_ms * MS, Odometry(pose=(*state.position[:2], state.yaw), v=V, w=W)))
            if now_ms % 1000 == 0:
                inputs.append((f"{name}/fix", now_ms * MS, Fix(time_ns=now_ms * MS - 5, position=state.position, sigma_m=0.1)))
        inputs += [(f"{name}/reflected", now_ms * MS, state) for name in names]
    return inputs


def events_of(playback: Playback, end_ms: int) -> list[Event]:
    """All events of a run."""
    events: list[Event] = []
    kernel = Kernel(RunInfo(scenario="x", seed=1, duration_ns=end_ms * MS, vehicles=playback.names), [playback])
    kernel.start()
    kernel.run(events.append)
    kernel.close()
    return events


def given_events(inputs: Sequence[Input]) -> list[tuple[str, int, AnyValue]]:
    return sorted((each for each in inputs if not each[0].endswith("/reflected")), key=lambda each: (each[1], each[0]))


def test_every_event_repeats_at_its_time() -> None:
    inputs = recording(3000, ("car1", "car2"))
    playback = Playback(("car1", "car2"), inputs)
    assert playback.slot is Slot.WORLD
    events = events_of(playback, 3000)
    assert [(each.key, each.time_ns, each.value) for each in events] == given_events(inputs)
    assert events[0].time_ns == 0
    assert events[-1].time_ns == 3000 * MS
    assert events_of(playback, 3000) == events  # it can be played twice


def test_events_at_odd_times_wake_it() -> None:
    odd: list[Input] = [("car1/note", at, Note(values={"at": float(at)})) for at in (1, 17, 99_999_999, 100_000_000)]
    inputs = sorted([*recording(200), *odd], key=lambda each: each[1])
    events = events_of(Playback(("car1",), inputs), 200)
    assert [each.time_ns for each in events if each.key == "car1/note"] == [1, 17, 99_999_999, 100_000_000]


def test_physics_gets_the_recorded_states() -> None:
    playback = Playback(("car2", "car1"), recording(1000, ("car1", "car2")))
    for now_ms in range(0, 1001, 100):
        assert playback.states(now_ms * MS) == [circle(now_ms / 1e3)] * 2


@given(at_ns=st.integers(0, 1000 * MS))
def test_between_instants_poses_are_nearly_exact(at_ns: int) -> None:
    """The chord of an arc is off by no more than v w dt^2 / 8, here 0.25 mm; the yaw hardly."""
    (state,), truth = Playback(("car1",), recording(1000)).states(at_ns), circle(at_ns / 1e9)
    assert math.dist(state.position, truth.position) <= V * W * 0.1**2 / 8 + 1e-12
    assert abs(wrap(state.yaw - truth.yaw)) < 1e-5
    assert math.hypot(*state.attitude) == pytest.approx(1.0, abs=1e-12)
    assert math.dist(state.velocity, truth.velocity) < 1e-3
    assert state.angular_velocity == pytest.approx((0.0, 0.0, W))


@given(yaw=st.floats(-math.pi, math.pi), turn=st.floats(-0.3, 0.3), share=st.floats(0.0, 1.0), flip=st.booleans())
def test_attitudes_take_the_shorter_way(yaw: float, turn: float, share: float, flip: bool) -> None:
    """Also through pi, and for either sign of the quaternion."""
    w, x, y, z = quaternion_from_yaw(yaw + turn)
    after = (-w, -x, -y, -z) if flip else (w, x, y, z)
    ends = [VehicleState(position=(0.0, 0.0, 0.0), attitude=each) for each in (quaternion_from_yaw(yaw), after)]
    inputs: list[Input] = [("a/reflected", 0, ends[0]), ("a/reflected", 10**9, ends[1])]
    (state,) = Playback(("a",), inputs).states(round(share * 1e9))
    assert abs(wrap(yaw_of(state.attitude) - yaw - share * turn)) < 5e-4


def test_before_its_first_instant_it_is_at_its_start() -> None:
    inputs = [each for each in recording(500) if each[1] >= 200 * MS]
    assert Playback(("car1",), inputs).states(0) == [circle(0.2)]


def test_after_the_end_it_stands_with_one_notice() -> None:
    lines: list[str] = []
    playback = Playback(("car1", "car2"), recording(500, ("car1", "car2")), tell=lines.append)
    events = events_of(playback, 2000)
    assert lines == ["the recording ends at 0.500 s: car1, car2 stand still from then on"]
    last = {each.key: each for each in events}
    for name in ("car1", "car2"):
        estimate, odometry = last[f"{name}/estimate"], last[f"{name}/odometry"]
        assert isinstance(estimate.value, VehicleState)
        assert isinstance(odometry.value, Odometry)
        assert estimate.time_ns == odometry.time_ns == 500 * MS + 1
        assert estimate.value.position == circle(0.5).position
        assert estimate.value.velocity == estimate.value.angular_velocity == (0.0, 0.0, 0.0)
        assert (odometry.value.v, odometry.value.w) == (0.0, 0.0)
    (shown, _) = playback.states(1700 * MS)
    assert (shown.position, shown.attitude) == (circle(0.5).position, circle(0.5).attitude)
    assert shown.velocity == shown.angular_velocity == (0.0, 0.0, 0.0)


def test_a_complete_recording_has_no_end_notice() -> None:
    lines: list[str] = []
    events_of(Playback(("car1",), recording(500), tell=lines.append), 500)
    events_of(Playback(("car1",), recording(500), tell=lines.append), 300)
    assert lines == []


def test_vehicles_not_named_are_omitted() -> None:
    inputs = recording(500, ("car1", "car2"))
    events = events_of(Playback(("car2",), inputs), 500)
    assert {each.key.partition("/")[0] for each in events} == {"car2"}


def test_an_unrecorded_vehicle_is_named() -> None:
    with pytest.raises(UsageError, match="has no positions of car7; it has car1, car2"):
        Playback(("car1", "car7"), recording(100, ("car1", "car2")))
    with pytest.raises(UsageError, match="it has nobody"):
        Playback(("car1",), [])
