"""Decisions of both ends: orders, times and numbers from another machine, age of velocities; and scenario options."""

import math
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Odometry, Velocity
from vcmvsp.cosim.util.codec import encode
from vcmvsp.hardware.drivers.base import Driver, LinkLost, Notice, Sample
from vcmvsp.hardware.drivers.bench_robot import Bench
from vcmvsp.hardware.drivers.threaded import NOT_YET
from vcmvsp.hardware.remote_robot import messages
from vcmvsp.hardware.remote_robot.messages import RobotOrder, RobotStatus
from vcmvsp.hardware.remote_robot.robot_side.watchdog import DriverWatchdog
from vcmvsp.hardware.remote_robot.run_side.driver import ZenohDriver
from vcmvsp.hardware.remote_robot.run_side.session import CommandState, RemoteSampler

SECOND = 10**9
AHEAD = Velocity(linear=(0.3, 0.0, 0.0))


# --- orders ---


def test_a_robot_stands_until_it_has_acknowledged_it() -> None:
    orders = CommandState(0.5)
    orders.connect(7)
    orders.command(AHEAD, 0)
    assert orders.at(0) is None
    orders.acknowledge(6)  # of the previous connection
    assert orders.at(0) is None
    orders.acknowledge(7)
    assert orders.at(0) == AHEAD


def test_a_command_counts_for_its_time_and_a_stop_until_the_next_command() -> None:
    orders = CommandState(0.5)
    orders.connect(1)
    orders.acknowledge(1)
    orders.command(AHEAD, 0)
    assert orders.at(SECOND // 2 - 1) == AHEAD
    assert orders.at(SECOND // 2) is None
    assert orders.stopped == "no command for 0.5 s"
    orders.command(AHEAD, SECOND)
    assert orders.at(SECOND) == AHEAD
    orders.stop("enough")
    assert orders.at(SECOND) is None
    orders.connect(9)
    assert (orders.stopped, orders.held) == (NOT_YET, True)


# --- samples ---


def connected() -> RemoteSampler:
    track = RemoteSampler((0.0, 0.0, 0.0))
    track.connect(anew=True)
    return track


def said(
    number: int, there_ns: int, *, link: int = 1, opened: int = 1, heard: bool = True, sent_ns: int = 0, **changed: Any
) -> RobotStatus:
    """Status with a sample measured 20 ms before sending."""
    sample = Sample(
        number=number,
        link=link,
        arrived_ns=there_ns - 10_000_000,
        measured_ns=there_ns - 20_000_000,
        odometry=Odometry(pose=(0.1 * number, 0.0, 0.0), v=0.1, w=0.0),
    )
    sample = msgspec.structs.replace(sample, **changed)
    return RobotStatus(said_ns=there_ns, heard=int(heard), yours_ns=sent_ns, heard_ns=there_ns, opened=opened, sample=sample)


@given(
    offset_ns=st.integers(-(10**18), 10**18),
    there_ms=st.integers(0, 300),
    back_ms=st.integers(0, 300),
)
def test_times_are_right_to_half_the_round_trip(offset_ns: int, there_ms: int, back_ms: int) -> None:
    sent_ns = 1000 * SECOND
    heard_ns = sent_ns + there_ms * 10**6
    arrived_ns = heard_ns + back_ms * 10**6
    track = connected()
    up = said(1, heard_ns - offset_ns, sent_ns=sent_ns)
    sample = heard(track, up, arrived_ns)
    error = abs(sample.measured_ns - (heard_ns - 20_000_000))
    drift = 100e-6 * (there_ms + back_ms) * 1e6
    assert error <= (there_ms + back_ms) * 1e6 / 2 + drift + 10
    assert sample.measured_ns <= sample.arrived_ns <= arrived_ns


def heard(track: RemoteSampler, up: RobotStatus, arrived_ns: int) -> Any:
    track.hear(up, arrived_ns)
    return track.sample(up, arrived_ns, "")


def test_without_an_exchange_no_time_is_known_and_no_sample_is_made() -> None:
    track = connected()
    assert heard(track, said(1, 5, heard=False), SECOND) is None


def test_numbers_and_links_increase_for_any_robot_count() -> None:
    track = RemoteSampler((1.0, 2.0, 0.5))
    assert track.pose == (1.0, 2.0, 0.5)
    track.connect(anew=True)
    now = 10 * SECOND

    def numbered(number: int, **more: Any) -> tuple[int, int] | None:
        nonlocal now
        now += SECOND // 10
        sample = heard(track, said(number, now, sent_ns=now, **more), now)
        return None if sample is None else (sample.number, sample.link)

    assert numbered(5) == (1, 1)
    assert numbered(6) == (2, 1)
    assert numbered(6) is None  # repeated
    assert numbered(9) == (5, 1)  # two were lost
    assert numbered(10, link=2) == (6, 2)  # its own driver has reconnected
    assert numbered(1, opened=2) == (7, 3)  # its own driver was reopened
    assert track.pose == (0.1, 0.0, 0.0)
    track.connect(anew=False)
    assert numbered(2, opened=2) == (8, 4)
    track.connect(anew=True)
    assert numbered(1) == (9, 5)


def test_sonar_is_the_newest_of_each_since_the_last_read() -> None:
    track = connected()
    now = SECOND
    heard(track, said(1, now, sent_ns=now, sonar=((0, 1.0), (1, 2.0))), now)
    both = heard(track, said(2, now, sent_ns=now, sonar=((0, 1.5),)), now)
    assert dict(both.sonar) == {0: 1.5, 1: 2.0}
    track.clear_sonar()
    none = heard(track, said(3, now, sent_ns=now), now)
    assert none.sonar == ()


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_a_non_finite_sample_is_omitted(wrong: float) -> None:
    track = connected()
    for changed in (
        {"odometry": Odometry(pose=(0.0, wrong, 0.0), v=0.0, w=0.0)},
        {"sonar": ((1, wrong),)},
        {"battery_v": wrong},
    ):
        assert heard(track, said(1, SECOND, sent_ns=SECOND, **changed), SECOND) is None
    assert track.pose == (0.0, 0.0, 0.0)


@given(st.lists(st.integers(-(2**63), 2**63 - 1), min_size=6, max_size=6))
def test_any_times_and_numbers_of_a_robot_give_encodable_samples(numbers: list[int]) -> None:
    said_ns, yours_ns, heard_ns, measured_ns, arrived_ns, number = numbers
    track = connected()
    now = 100 * SECOND
    for each in (said(1, now, sent_ns=now), said(number, now, sent_ns=now, measured_ns=measured_ns, arrived_ns=arrived_ns)):
        up = msgspec.structs.replace(
            each,
            said_ns=said_ns,
            yours_ns=yours_ns,
            heard_ns=heard_ns,
            notices=(Notice(time_ns=said_ns, what="warned", cause="x" * 10_000),),
            noticed=number,
        )
        for taken in (each, up):
            sample = heard(track, taken, now)
            notices = track.notices(taken, now)
            assert sample is None or 0 <= sample.measured_ns <= sample.arrived_ns <= now
            assert len(encode((sample, notices))) < 5000


def test_repeated_notices_are_taken_once() -> None:
    track = connected()
    first, second = (Notice(time_ns=5, what="stopped", cause=each) for each in ("one", "two"))
    up = RobotStatus(said_ns=1, notices=(first,))
    assert [each.cause for each in track.notices(up, SECOND)] == ["one"]
    assert track.notices(up, SECOND) == []
    assert [each.cause for each in track.notices(RobotStatus(said_ns=2, notices=(first, second)), SECOND)] == ["two"]
    assert track.noticed == 2
    track.connect(anew=True)  # another program with its own numbering
    assert [each.cause for each in track.notices(up, SECOND)] == ["one"]


# --- aboard ---


class Robot:
    """A simulated robot behind the onboard watchdog, and the texts for its user."""

    def __init__(self, **options: Any) -> None:
        self.now = SECOND
        self.lines: list[str] = []
        self.bench = Bench(now=lambda: self.now, accel=100.0, decel=100.0, latency_s=0.0, **options)
        self.aboard = DriverWatchdog(self.bench, None, self.lines.append)
        self.aboard.open("run", (0.0, 0.0, 0.0), str)
        self.number = 0

    def hear(self, velocity: Velocity | None, *, old_s: float = 0.0, stop: str = "stand") -> None:
        self.number += 1
        yours_ns = self.now - round(old_s * SECOND)
        self.aboard.follow(RobotOrder(number=self.number, sent_ns=0, yours_ns=yours_ns, velocity=velocity, stop=stop), self.now)

    def speed(self, seconds: float = 0.1) -> float:
        self.now += round(seconds * SECOND)
        sample: Any = self.aboard.turn(self.now)
        return float(sample.odometry.v)


def test_a_robot_stands_first_then_follows_and_stops_on_silence() -> None:
    robot = Robot()
    robot.hear(AHEAD)
    assert robot.speed() == 0.0  # no order to stand received yet
    robot.hear(None)
    robot.hear(AHEAD)
    assert robot.speed() == pytest.approx(0.3)
    assert robot.speed(0.3) == pytest.approx(0.3)
    robot.speed(0.1)
    assert robot.speed() == 0.0
    assert robot.lines[-1] == "stopped: no velocity from the run for 0.5 s"
    robot.hear(AHEAD)
    assert robot.speed() == pytest.approx(0.3)
    robot.hear(None, stop="enough\x1b[2J")
    assert robot.speed() == 0.0
    assert robot.lines[-1] == "stopped: enough"
    robot.aboard.meet()
    robot.hear(AHEAD)
    assert robot.speed() == 0.0


def test_possibly_old_velocities_are_ignored() -> None:
    robot = Robot()
    robot.hear(None)
    robot.hear(AHEAD, old_s=0.6)
    assert robot.speed() == 0.0
    robot.hear(AHEAD, old_s=0.6)
    assert [each for each in robot.lines if "arrive too late" in each] == [
        "warned: velocities arrive too late and are ignored: 0.6 s for both ways"
    ]
    robot.hear(AHEAD, old_s=0.4)
    assert robot.speed() == pytest.approx(0.3)


def test_a_non_finite_velocity_stops_it() -> None:
    robot = Robot()
    robot.hear(None)
    robot.hear(AHEAD)
    robot.hear(Velocity(linear=(math.nan, 0.0, 0.0)))
    assert robot.speed() == 0.0


def test_notices_wait_for_receipt_and_none_are_from_earlier_runs() -> None:
    robot = Robot()
    robot.hear(None, stop="one")
    robot.speed()
    causes = [each.cause for each in robot.aboard.notices()]
    assert causes == ["a robot in software", "one"]
    assert robot.aboard.noticed == 0
    robot.aboard.follow(RobotOrder(number=9, sent_ns=0, noticed=1), robot.now)
    assert [each.cause for each in robot.aboard.notices()] == ["one"]
    robot.aboard.close("over")
    robot.aboard.open("next", (0.0, 0.0, 0.0), str)
    assert [each.cause for each in robot.aboard.notices()] == ["a robot in software"]
    assert robot.aboard.opened == 2


def test_driver_errors_are_reported_and_close_it() -> None:
    robot = Robot(unplugged_s=1.0)
    robot.now += 2 * SECOND
    with pytest.raises(LinkLost) as caught:
        robot.aboard.turn(robot.now)
    robot.aboard.fail(caught.value)
    failure: Any = robot.aboard.failure
    assert (failure.kind, failure.device, robot.aboard.state) == ("lost", "bench", "closed")
    robot.aboard.fail(ZeroDivisionError("division by zero"))
    failure = robot.aboard.failure
    assert failure.happened == "its driver failed (ZeroDivisionError: division by zero)"


# --- what a scenario may say ---


def test_it_is_a_driver_and_inactive_until_open() -> None:
    assert isinstance(ZenohDriver(listen="tls/0.0.0.0:7448", keys="there/is/none", vehicle="car3"), Driver)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"listen": "tls/0.0.0.0:7448"}, 'TLS needs certificates: add keys = "DIR"'),
        ({"listen": "tcp/0.0.0.0:7448"}, "add insecure = true in a trusted network"),
        ({"listen": "tcp/127.0.0.1:7448", "keys": "keys"}, "write tls/127.0.0.1:7448, or leave out keys"),
        ({"listen": "tls/0.0.0.0:7448", "keys": "keys", "insecure": True}, "exclude one another"),
        ({"listen": "7448"}, "must be tcp/HOST:PORT or tls/HOST:PORT"),
        ({"listen": "tcp/127.0.0.1:7448", "vehicle": "car/3"}, "letters, digits"),
    ],
)
def test_wrong_options(options: dict[str, Any], problem: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        ZenohDriver(**options)
    assert problem in str(caught.value)


def test_it_needs_a_vehicle_name() -> None:
    made = ZenohDriver(listen="tcp/127.0.0.1:7448")
    with pytest.raises(Exception, match="has no vehicle"):
        made.open()


@given(st.binary(max_size=200))
def test_invalid_bytes_raise_only_the_handled_error(data: bytes) -> None:
    for decoder in (messages.hellos, messages.welcomes, messages.downs, messages.ups):
        try:
            decoder.decode(data)
        except ValueError:
            continue
