"""Session with the emulated vehicle in simulated time: two state machines, no clock."""

import math
from typing import Any

import pytest

from vcmvsp.cosim.types import Velocity
from vcmvsp.hardware.drivers.mavlink.link import VehicleSearch
from vcmvsp.hardware.drivers.mavlink.protocol import Encoder, Message, MessageReader, Sender, mavlink
from vcmvsp.hardware.drivers.mavlink.session import ATTITUDE_NS, MavlinkSampler, MavlinkSession, SessionOptions
from vcmvsp.hardware.emulators.mavlink.vehicle import TICK_NS, Vehicle

SECOND = 1_000_000_000
OURS = Sender(system=245, component=190)
EAST = Velocity(linear=(1.0, 0.0, 0.0))


class Flight:
    """A pilot and a vehicle over a perfect link."""

    def __init__(self, vehicle: Vehicle, **orders: Any) -> None:
        self.vehicle, self.now_ns = vehicle, 0
        self.sent: list[tuple[int, Message]] = []
        self._encode = Encoder(OURS)
        search = VehicleSearch("line", 1, None)
        peer = None
        while peer is None:
            self.now_ns += TICK_NS
            peer = search.receive([("", vehicle.advance(self.now_ns))], self.now_ns)
        self.track = MavlinkSampler((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), None)
        self.track.connect()
        self.pilot = MavlinkSession(peer, SessionOptions(telemetry_hz=50.0, timeout_s=0.5, **orders), self.track, self.now_ns)

    def run(self, seconds: float, command: Velocity | None = None) -> None:
        end_ns = self.now_ns + round(seconds * SECOND)
        while self.now_ns < end_ns:
            self.now_ns += TICK_NS
            if command is not None:
                self.pilot.command(command, self.now_ns)
            messages = self.pilot.advance(self.now_ns)
            self.sent += [(self.now_ns, each) for each in messages]
            answer = self.vehicle.receive(self._encode(*messages), self.now_ns)
            for message in self.pilot.decode([("", answer)]):
                self.pilot.receive(message, self.now_ns)

    def until_ready(self) -> None:
        for _ in range(300):
            if self.pilot.ready:
                return
            self.run(0.1)
        pytest.fail(f"not ready: {self.pilot.waits_for}")

    def asked(self, number: int) -> list[Message]:
        return [each for _, each in self.sent if each.get_type() == "COMMAND_LONG" and each.command == number]

    def points(self) -> list[tuple[int, Message]]:
        return [each for each in self.sent if each[1].get_type() == "SET_POSITION_TARGET_LOCAL_NED"]

    def causes(self) -> list[str]:
        return [cause for _, cause in self.pilot.news]


FLYING: dict[str, Any] = {"start": (0.0, 0.0, 10.0, 0.0), "armed": True}


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_a_take_off_a_flight_and_no_landing(autopilot: Any) -> None:
    flight = Flight(Vehicle(autopilot=autopilot), switch_mode=True, arm=True, takeoff_m=3.0)
    flight.until_ready()
    assert flight.vehicle.state.position[2] == pytest.approx(3.0, abs=0.4)
    flight.run(0.5)
    x0 = flight.vehicle.state.position[0]
    flight.run(2.0, EAST)
    assert flight.vehicle.state.position[0] - x0 == pytest.approx(2.0 - 0.3, abs=0.1)  # minus the lag; exp(-2/0.3) is about 0
    flight.pilot.leave()
    flight.run(3.0)
    assert flight.pilot.ready
    assert flight.vehicle.mode == {"px4": "HOLD", "ardupilot": "BRAKE"}[autopilot]
    assert flight.vehicle.armed
    assert {each.param1 for each in flight.asked(mavlink.MAV_CMD_COMPONENT_ARM_DISARM)} == {1.0}  # disarming was not requested


def test_an_own_arming_on_the_ground_is_undone_at_the_end() -> None:
    rover = Flight(Vehicle(autopilot="ardupilot", kind="rover"), switch_mode=True, arm=True)
    rover.until_ready()
    rover.run(1.0, EAST)
    rover.pilot.leave()
    rover.run(4.0)
    assert (rover.vehicle.mode, rover.vehicle.armed) == ("HOLD", False)
    other = Flight(Vehicle(autopilot="ardupilot", kind="rover", armed=True), switch_mode=True)
    other.until_ready()
    other.pilot.leave()
    other.run(4.0)
    assert (other.vehicle.mode, other.vehicle.armed) == ("HOLD", True)  # armed by another party


def test_an_old_command_has_no_effect_after_a_handback() -> None:
    flight = Flight(Vehicle(mode="OFFBOARD", **FLYING))
    flight.until_ready()
    flight.run(1.0, EAST)
    flight.vehicle.pilot_switches("POSITION")
    flight.run(1.5, EAST)
    assert "its pilot or the autopilot switched it to POSITION: the driver releases control" in flight.causes()
    flight.vehicle.pilot_switches("OFFBOARD")
    flight.run(1.5)
    assert flight.vehicle.commanded() == Velocity()
    flight.run(0.2, EAST)
    assert flight.vehicle.commanded().linear == (1.0, 0.0, 0.0)


def test_a_pilots_takeover_ends_the_take_off() -> None:
    flight = Flight(Vehicle(), switch_mode=True, arm=True, takeoff_m=30.0)
    while flight.vehicle.state.position[2] < 1.0:
        flight.run(0.1)
    flight.vehicle.pilot_switches("POSITION")
    flight.run(1.5)
    assert "switched it to POSITION" in flight.pilot.interrupted
    count = len(flight.asked(mavlink.MAV_CMD_DO_SET_MODE))
    flight.pilot.leave()
    flight.run(2.0)
    assert len(flight.asked(mavlink.MAV_CMD_DO_SET_MODE)) == count
    assert flight.vehicle.mode == "POSITION"


def test_autopilot_errors_become_one_complete_notice() -> None:
    flight = Flight(Vehicle())
    long = "a text that is longer than the fifty characters of one message, and then some more of it, up to here"
    assert len(long) == 100
    for text, severity in (("low battery", 2), ("low battery", 2), (long, 3), ("all is well", 6)):
        flight.vehicle.say(text, severity)
        flight.run(0.1)
    causes = [each for each in flight.causes() if "says" in each]
    assert causes == ['the autopilot says "low battery"', f'the autopilot says "{long}"']


def test_commands_have_no_effect_while_disarmed_or_leaving() -> None:
    flight = Flight(Vehicle(mode="OFFBOARD"))
    flight.until_ready()
    flight.run(0.4, EAST)
    flight.vehicle.armed = True
    flight.run(0.05)
    assert flight.vehicle.commanded() == Velocity()
    flight.run(1.2, EAST)  # after its next heartbeat
    assert flight.vehicle.commanded().linear == (1.0, 0.0, 0.0)
    flight.pilot.leave()
    left_ns = flight.now_ns
    flight.run(0.5, EAST)
    assert {each.vy for time_ns, each in flight.points() if time_ns > left_ns} == {0.0}  # east is y
    other = Flight(Vehicle(**FLYING))
    other.until_ready()
    other.pilot.leave()
    other.vehicle.pilot_switches("OFFBOARD")
    other.run(1.5, EAST)
    assert {each.vy for _, each in other.points()} == {0.0}


def test_disarming_stops_it() -> None:
    flight = Flight(Vehicle(mode="OFFBOARD", heartbeat_s=0.1, **FLYING))
    flight.until_ready()
    flight.run(0.5, EAST)
    flight.vehicle.armed = False
    flight.run(0.2, EAST)
    assert "it has disarmed" in flight.causes()
    flight.vehicle.armed = True
    flight.run(0.2)
    assert flight.vehicle.commanded() == Velocity()


def test_a_stop_interrupts_only_a_preparation() -> None:
    flight = Flight(Vehicle(mode="OFFBOARD", **FLYING))
    flight.pilot.stop("the link was lost")
    assert not flight.pilot.interrupted
    ordered = Flight(Vehicle(**FLYING), switch_mode=True)
    ordered.pilot.stop("enough")
    assert ordered.pilot.interrupted == "enough"


def test_old_attitudes_and_earlier_links_are_ignored() -> None:
    track = MavlinkSampler((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), None)
    turned = mavlink.MAVLink_attitude_message(0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    there = mavlink.MAVLink_local_position_ned_message(0, *[1.0] * 6)
    track.attitude(turned, 0)
    assert track.position(there, ATTITUDE_NS)
    assert not track.position(there, ATTITUDE_NS + 1)
    track.attitude(turned, SECOND)
    track.connect()
    assert track.state is None
    assert not track.position(there, SECOND)


# The emulated vehicle by itself


def sent(vehicle: Vehicle, *messages: Message, at_ns: int = 0) -> list[Message]:
    return MessageReader().feed(vehicle.receive(Encoder(OURS)(*messages), at_ns))


def command(number: int, *parameters: float) -> Message:
    return mavlink.MAVLink_command_long_message(1, 1, number, 0, *parameters, *[math.nan] * (7 - len(parameters)))


def results(messages: list[Message]) -> list[int]:
    return [each.result for each in messages if each.get_type() == "COMMAND_ACK"]


def test_px4_needs_set_points_to_enter_and_to_keep_offboard() -> None:
    vehicle = Vehicle(**FLYING)
    switch = command(mavlink.MAV_CMD_DO_SET_MODE, 1, 6)
    point = mavlink.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 1479, *[0.0] * 3, 0.0, 1.0, *[0.0] * 6)
    assert results(sent(vehicle, switch)) == [mavlink.MAV_RESULT_TEMPORARILY_REJECTED]
    for tick in range(25):
        sent(vehicle, point, at_ns=tick * 50_000_000)
    assert results(sent(vehicle, switch, at_ns=25 * 50_000_000)) == [mavlink.MAV_RESULT_ACCEPTED]
    vehicle.advance(26 * 50_000_000)
    assert vehicle.commanded().linear == (1.0, 0.0, 0.0)
    vehicle.advance(3 * SECOND)
    assert vehicle.mode == "HOLD"


def test_non_finite_numbers_and_other_targets_are_ignored() -> None:
    vehicle = Vehicle()
    for number in (176, 400, 511, 22, 512):
        assert mavlink.MAV_RESULT_ACCEPTED not in results(sent(vehicle, command(number)))
    other = mavlink.MAVLink_command_long_message(9, 1, 400, 0, 1.0, *[0.0] * 6)
    assert results(sent(vehicle, other)) == []
    assert (vehicle.mode, vehicle.armed) == ("POSITION", False)
