"""Interface between kernel and parts: federates are stepped in logical time and exchange events by key.

**Order within one instant.** Federates that are due at the same time step in this order of slots, and by name within one:

1. ``WORLD``  physics and hardware publish states and readings of this instant;
2. ``RADIO``  the channel finishes what is due at this instant (a frame that ends now);
3. ``AGENT``  agents get the readings, and all receptions up to and including now, and act;
4. ``SEND``   frames sent now enter the channel;
5. ``APPLY``  commands given now reach a world federate that they wake.

A reception is always later than its sending, so no instant can loop.

**Events** carry the time at which they take effect. A future event (a command delayed by an agent's latency) is delivered at
that time; receptions travel in columns with arrival times of their own (`cosim.received`). ``reads`` lists the keys of the
events in a federate's inbox, which it gets at its next step; ``latest`` the keys of which it gets only the newest event;
``wakes`` those of ``reads`` that step the federate at the event's own time, in its ``wake_slot``.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from typing import Any, NamedTuple, Protocol, runtime_checkable

import msgspec

from vcmvsp.cosim.agent import Observation
from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.types import AnyValue, Fix, Imu, Incident, Vec3, VehicleState, Velocity, Waypoint
from vcmvsp.cosim.vehicle_clock import VehicleClock


class Slot(IntEnum):
    """Order of federates within an instant."""

    WORLD = 0
    RADIO = 1
    AGENT = 2
    SEND = 3
    APPLY = 4


class Event(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """A value under its key, such as ``car2/command``, in effect from ``time_ns`` on."""

    key: str
    time_ns: int
    value: AnyValue


Log = Callable[[str, int, AnyValue], None]
"""Records external input of a federate for a replay: key, time (ns), value."""


class Step(msgspec.Struct, frozen=True):
    """Result of a step: events (none earlier than now), and the time of the next step (None: only when woken)."""

    events: Sequence[Event] = ()
    next_ns: int | None = None


class Instants(msgspec.Struct, frozen=True):
    """Times at which states are needed: the ticks of a train, shifted by an offset."""

    ticks: Ticks
    offset_ns: int = 0
    key: str = ""  # key of the scenario that asks for them; for messages


class RunInfo(msgspec.Struct, frozen=True, kw_only=True):
    """Information for every federate before time 0."""

    scenario: str
    seed: int
    duration_ns: int
    vehicles: tuple[str, ...]
    instants: tuple[Instants, ...] = ()  # when states are needed
    wanted: tuple[str, ...] = ()  # keys of readings on demand that will be requested
    paced: bool = False  # by the wall clock: long computations for an instant may begin earlier
    periods_s: Mapping[str, float] = {}  # periods of agents, by vehicle
    clocks: Mapping[str, VehicleClock] = {}  # of vehicles that do not have the run's time
    stations: tuple[str, ...] = ()  # vehicles that are stations
    radios: Mapping[str, tuple[str, ...]] = {}  # vehicles with each of several radios, by its name; empty: there is one


class Needed:
    """The instants at which a run needs states: the requested ones, the start and the end."""

    def __init__(self, run: RunInfo) -> None:
        self._end_ns = run.duration_ns
        self._trains = tuple(dict.fromkeys((each.ticks, each.offset_ns) for each in run.instants))  # distinct ones, in order

    def hits(self, now_ns: int) -> bool:
        """Whether states are needed now."""
        return now_ns in (0, self._end_ns) or any(ticks.hits(now_ns - offset_ns) for ticks, offset_ns in self._trains)

    def after(self, now_ns: int) -> int | None:
        """The first needed instant after now; None: the run is over."""
        if now_ns >= self._end_ns:
            return None
        return min([self._end_ns, *(ticks.after(now_ns - offset_ns) + offset_ns for ticks, offset_ns in self._trains)])


@runtime_checkable
class Federate(Protocol):
    """A part of the simulation that runs in logical time."""

    name: str
    slot: Slot  # slot of its scheduled steps
    wake_slot: Slot  # slot of its steps when woken by an event
    reads: tuple[str, ...]  # key expressions: ``*`` is one chunk, ``**`` any number of chunks
    latest: tuple[str, ...]  # key expressions of which it gets only the newest event of each key since its last step
    wakes: tuple[str, ...]  # expressions of ``reads`` whose events wake it

    def start(self, run: RunInfo) -> int | None:
        """Prepare for time 0; returns the time of the first step (None: only when woken)."""

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Advance to ``now_ns``, given the events since the last step, oldest first."""

    def close(self) -> None:
        """Release all resources. Called once, also after a failure."""


@runtime_checkable
class Releasable(Protocol):
    """A federate with a remote part, which runs until it learns that the run is over."""

    def release(self) -> None:
        """Announce the end of the run, without waiting; called for all federates before any is closed."""


@runtime_checkable
class Polled(Protocol):
    """A federate that may get external requests at any time."""

    def poll(self, now_ns: int) -> bool:
        """Called before each instant; returns whether to step the federate in it, in its own slot."""


@runtime_checkable
class Prompted(Polled, Protocol):
    """A federate that may get external requests between two instants, which then create an instant of their own.

    It is polled before each instant and, on a clock that waits, as soon as ``fileno()`` is readable.
    """

    def fileno(self) -> int:
        """Descriptor for select; -1: no requests will come."""


@runtime_checkable
class Waiting(Protocol):
    """A federate whose steps wait for an external party, which may hang: Ctrl-C may interrupt them at once."""

    waits: bool


@runtime_checkable
class RemoteFederate(Federate, Releasable, Protocol):
    """A remote federate: all that are due in a slot are asked before any answer is awaited.

    With a lookahead the kernel awaits the answer to a question asked at t only at t + lookahead: nothing in that answer
    takes effect earlier.
    """

    lookahead_ns: int

    def ask(self, now_ns: int, inbox: Sequence[Event]) -> int | None:
        """Send the question; returns the next wake-up, which must not depend on the answer."""

    def answer(self) -> Sequence[Event]:
        """Wait for the answer to the oldest open question."""


@runtime_checkable
class Driven(RemoteFederate, Protocol):
    """A federate whose answers the caller of the kernel gives: the kernel returns between question and answer."""

    driven: bool

    def finish(self, now_ns: int, inbox: Sequence[Event]) -> None:
        """Take the last events, at the end of the run."""


class ExternalMotion(Protocol):
    """Motion of vehicles that physics does not move: real robots, or a recording of them.

    They are bodies of infinite mass: other bodies collide with them, scanners and cameras detect them, the radio uses their
    positions; nothing in the simulation moves them.
    """

    names: tuple[str, ...]  # names of the vehicles, in the scenario's order

    def states(self, now_ns: int) -> Sequence[VehicleState]:
        """States at this instant, in the order of ``names``; called after the federate of these vehicles has stepped.

        Requested times never decrease, and equal times give equal states. Between two instants physics extrapolates with the
        velocities of the earlier one.
        """


class FlightReadings(msgspec.Struct, frozen=True, kw_only=True):
    """What the firmware of a simulated vehicle gets at a step of physics. Frames as in `cosim.types`: ENU, body FLU."""

    now_ns: int
    state: VehicleState  # true
    imu: Imu
    field_ut: Vec3 | None = None  # magnetic field along the body axes, microtesla; None: no new reading
    height_m: float | None = None  # of a barometer, above the world's z = 0; None: no new reading
    fix: Fix | None = None  # of a satellite receiver; None: no new reading


class FlightFirmware(Protocol):
    """Firmware that flies simulated quadrotors in place of their autopilots, in lock-step: readings in, rotor speeds out."""

    names: tuple[str, ...]  # of the vehicles

    def exchange(self, readings: Sequence[FlightReadings]) -> Sequence[Sequence[float] | None]:
        """Give each firmware its readings, in the order of ``names``, and wait for the outputs of all.

        Returns:
            Of each vehicle the speeds of its rotors as shares of their greatest: front right, back left, front left, back
            right. None: its firmware is lost, and its own autopilot has to hold it in place.

        Raises:
            FederateError: a firmware is lost, and the run ends with it.
        """

    def command(self, vehicle: str, command: Velocity | Waypoint) -> None:
        """Take the command of an agent, in effect from the time of the next readings on."""

    def incidents(self) -> Sequence[tuple[str, Incident]]:
        """Incidents since the last call, with their vehicles."""

    def close(self) -> None:
        """End the connections and the processes that it started. Repeated calls are allowed."""


class StackAnswer(NamedTuple):
    """Answer of a stack for a vehicle at a tick."""

    command: Velocity | Waypoint | None = None  # None: the last command holds
    messages: Sequence[tuple[dict[str, Any] | bytes, str | None]] = ()  # to send by radio, and the only receiver (None: all)


class Stack(Protocol):
    """Programs that drive simulated vehicles in place of agents, over a protocol of their own."""

    vehicles: tuple[str, ...]  # their names

    def start(self, run: RunInfo) -> None:
        """Let the programs connect, and wait for those that the run needs."""

    def show(self, now_ns: int, readings: Sequence[Event]) -> None:
        """Pass on readings of the vehicles' sensors at their time."""

    def ask(self, observations: Mapping[str, Observation]) -> None:
        """Pass on the observations of a tick, by vehicle."""

    def answer(self, vehicle: str) -> StackAnswer:
        """Answer of a vehicle's programs to its last observation; of a lost vehicle, without waiting.

        Raises:
            LinkError: they are lost; the message is the reason.
        """

    def close(self) -> None:
        """End all connections. Repeated calls are allowed."""


class RunControl(Protocol):
    """What programs outside may see and change of a run. All in the run's thread, between two instants or during a pause."""

    may_pause: bool  # false: a part of the run cannot wait
    step_s: float  # shortest period of the agents: a step
    obstacles: tuple[str, ...]  # that can be moved

    @property
    def paused(self) -> bool:
        """Whether the run is paused, or makes steps."""

    @property
    def held(self) -> bool:
        """Whether the run is paused and its steps are over."""

    def truths(self) -> Mapping[str, tuple[int, VehicleState]]:
        """Newest true states of vehicles and movable obstacles, with their times, ns; before the first instant none."""

    def go(self, *, paused: bool, steps: int = 0) -> None:
        """Pause the run, after so many steps, or continue it."""

    def end(self) -> None:
        """End the run, as Ctrl-C does."""

    def move(self, obstacle: str, position: tuple[float, float], yaw: float) -> None:
        """Put an obstacle elsewhere, x, y m and yaw rad, at the next instant: an intervention, which a replay repeats.

        Raises:
            ValueError: it cannot be put there; the text says why.
        """


@runtime_checkable
class ControllingStack(Protocol):
    """A stack whose programs may also control the run."""

    def attend(self, control: RunControl) -> None:
        """Carry out the requests of programs; called some fifty times a second, also during a pause."""


class ExternalVehicles(Federate, ExternalMotion, Protocol):
    """The federate of vehicles that physics does not move: publishes their estimates and readings, takes their commands."""


@functools.cache
def vehicle_of(key: str) -> str:
    """Vehicle name in an event's key."""
    return key.partition("/")[0]


def matches(expression: str, key: str) -> bool:
    """Whether a key matches a key expression, with Zenoh's ``*`` (one chunk) and ``**`` (any number of chunks)."""
    return expression == key or _match(expression.split("/"), key.split("/"))


def _match(pattern: list[str], chunks: list[str]) -> bool:
    if not pattern:
        return not chunks
    if pattern[0] == "**":
        return any(_match(pattern[1:], chunks[skip:]) for skip in range(len(chunks) + 1))
    return bool(chunks) and pattern[0] in ("*", chunks[0]) and _match(pattern[1:], chunks[1:])
