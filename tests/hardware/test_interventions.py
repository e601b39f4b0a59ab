"""An operator's halt of real vehicles: zero velocity while it lasts, the newest command behind it, safety as ever."""

from typing import Any

from tests.hardware.station.test_controller import Station as Turning
from tests.hardware.test_federate import TENTH, federate, report
from tests.support.hardware.stations import FakeStation, mission
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import Event, Slot
from vcmvsp.cosim.types import Halted, RealStatus, Velocity
from vcmvsp.hardware.federate import HALTED, Hardware

STILL = Velocity()


def drive(time_ns: int, v: float) -> Event:
    return Event("car1/command", time_ns, Velocity(linear=(v, 0.0, 0.0)))


def halt(time_ns: int, *names: str, halted: bool = True) -> Event:
    return Event("operator/halted", time_ns, Halted(vehicles=names, halted=halted))


def wanted(made: Hardware, station: FakeStation, time_ns: int, *events: Event) -> Velocity | None:
    """What the station is told at a step."""
    made.step(time_ns, events)
    return station.heard[-1].command


def status(made: Hardware, time_ns: int, *events: Event) -> RealStatus:
    (found,) = [event.value for event in made.step(time_ns, events).events if isinstance(event.value, RealStatus)]
    return found


def test_who_is_halted_is_told_to_stand_until_it_is_let_go_and_then_what_its_agent_wants_now() -> None:
    made, station = federate()
    assert wanted(made, station, 0, drive(0, 0.4)) == Velocity(linear=(0.4, 0.0, 0.0))
    assert wanted(made, station, TENTH, halt(TENTH, "car2", "car1")) == STILL
    assert wanted(made, station, 2 * TENTH) == STILL
    assert wanted(made, station, 3 * TENTH, drive(3 * TENTH, 0.2)) == STILL
    assert wanted(made, station, 4 * TENTH, halt(4 * TENTH, "car2", halted=False)) == STILL
    assert wanted(made, station, 5 * TENTH, halt(5 * TENTH, "car1", halted=False)) == Velocity(linear=(0.2, 0.0, 0.0))
    assert {order.stop for order in station.heard} == {""}  # that would last


def test_a_halt_is_told_at_once() -> None:
    made, _ = federate()
    assert "operator/halted" in made.reads
    assert "operator/halted" in made.wakes
    assert made.wake_slot > Slot.WORLD  # where the operator is


def test_the_command_is_as_old_as_that_of_the_agent_who_must_be_heard_all_the_same() -> None:
    made, station = federate()
    made.step(0, [halt(0, "car1")])
    assert (station.heard[-1].command, station.heard[-1].command_ns) == (None, None)  # it never said anything
    made.step(TENTH, [drive(TENTH, 0.3)])
    given_ns = station.heard[-1].command_ns
    made.step(5 * TENTH, ())
    assert (station.heard[-1].command, station.heard[-1].command_ns) == (STILL, given_ns)
    assert given_ns == made._clock.monotonic_ns(TENTH)


def test_the_status_says_why_it_stands() -> None:
    made, station = federate()
    station.saying = [report(causes=("limits",))]
    assert HALTED not in status(made, 0, drive(0, 0.4)).causes
    station.saying = [report(causes=("limits",))]
    assert status(made, SECOND_NS, halt(SECOND_NS, "car1")).causes == (HALTED, "limits")
    station.saying = [report()]
    assert status(made, 2 * SECOND_NS, halt(2 * SECOND_NS, "car1", halted=False)).causes == ()


def test_a_robot_brakes_as_its_limits_say_and_goes_on() -> None:
    """What a station makes of such orders: no stop that lasts, nothing to be told of."""
    there: Any = Turning(mission())
    there.drive(2.0, 0.4)
    there.drive(2.0, 0.0)
    assert there.said[-1].odometry.v == 0.0
    assert there.drive(2.0, 0.4).odometry.v > 0.3
    assert [what for what, _ in there.notices] == ["connected"]
