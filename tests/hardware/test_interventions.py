"""Operator halts of real vehicles: zero velocity meanwhile, the newest command afterwards, unchanged safety."""

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


def command_at(made: Hardware, station: FakeStation, time_ns: int, *events: Event) -> Velocity | None:
    """Command to the station at a step."""
    made.step(time_ns, events)
    return station.orders[-1].command


def status(made: Hardware, time_ns: int, *events: Event) -> RealStatus:
    (found,) = [event.value for event in made.step(time_ns, events).events if isinstance(event.value, RealStatus)]
    return found


def test_a_halted_vehicle_gets_zero_then_the_newest_command() -> None:
    made, station = federate()
    assert command_at(made, station, 0, drive(0, 0.4)) == Velocity(linear=(0.4, 0.0, 0.0))
    assert command_at(made, station, TENTH, halt(TENTH, "car2", "car1")) == STILL
    assert command_at(made, station, 2 * TENTH) == STILL
    assert command_at(made, station, 3 * TENTH, drive(3 * TENTH, 0.2)) == STILL
    assert command_at(made, station, 4 * TENTH, halt(4 * TENTH, "car2", halted=False)) == STILL
    assert command_at(made, station, 5 * TENTH, halt(5 * TENTH, "car1", halted=False)) == Velocity(linear=(0.2, 0.0, 0.0))
    assert {order.stop for order in station.orders} == {""}  # a stop would persist


def test_a_halt_wakes_at_once() -> None:
    made, _ = federate()
    assert "operator/halted" in made.reads
    assert "operator/halted" in made.wakes
    assert made.wake_slot > Slot.WORLD  # the operator's slot


def test_a_halt_keeps_the_age_of_the_agents_command() -> None:
    made, station = federate()
    made.step(0, [halt(0, "car1")])
    assert (station.orders[-1].command, station.orders[-1].command_ns) == (None, None)  # no command so far
    made.step(TENTH, [drive(TENTH, 0.3)])
    given_ns = station.orders[-1].command_ns
    made.step(5 * TENTH, ())
    assert (station.orders[-1].command, station.orders[-1].command_ns) == (STILL, given_ns)
    assert given_ns == made._clock.monotonic_ns(TENTH)


def test_the_status_names_the_halt() -> None:
    made, station = federate()
    station.saying = [report(causes=("limits",))]
    assert HALTED not in status(made, 0, drive(0, 0.4)).causes
    station.saying = [report(causes=("limits",))]
    assert status(made, SECOND_NS, halt(SECOND_NS, "car1")).causes == (HALTED, "limits")
    station.saying = [report()]
    assert status(made, 2 * SECOND_NS, halt(2 * SECOND_NS, "car1", halted=False)).causes == ()


def test_a_robot_brakes_at_its_limits_and_resumes() -> None:
    """Station under such orders: no persistent stop, no notices."""
    there: Any = Turning(mission())
    there.drive(2.0, 0.4)
    there.drive(2.0, 0.0)
    assert there.reports[-1].odometry.v == 0.0
    assert there.drive(2.0, 0.4).odometry.v > 0.3
    assert [kind for kind, _ in there.notices] == ["connected"]
