"""What the kernel knows of the parts: federates that are stepped in logical time and exchange events by key.

**Order within one instant.** Federates that are due at the same time step in this order of slots, and by name within one:

1. ``WORLD``  physics and hardware publish states and readings of this instant;
2. ``RADIO``  a channel with work of its own at this instant (a frame that ends now);
3. ``AGENT``  agents see the readings, and all receptions up to and including now, and act;
4. ``SEND``   frames sent now enter the channel;
5. ``APPLY``  commands given now reach a world federate that asked to be woken by them.

A reception is always later than its sending, so no instant can loop.

**Events** carry the time at which they take effect. One that lies in the future (a command delayed by an agent's latency, a
frame on the air) is handed over when that time has come. ``reads`` says which keys land in a federate's inbox, to be seen
at its next step, ``latest`` of which keys only the newest event does; ``wakes`` which of the former step the federate at the
event's own time, in its ``wake_slot``.
"""

from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from typing import Protocol, runtime_checkable

import msgspec

from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.types import AnyValue, VehicleState


class Slot(IntEnum):
    """Where in an instant a federate steps."""

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
"""Takes what a federate brought into the run from outside, for a replay: key, time (ns), value."""


class Step(msgspec.Struct, frozen=True):
    """What a step gave: events (none earlier than now), and when to be stepped next (None: only when woken)."""

    events: Sequence[Event] = ()
    next_ns: int | None = None


class Instants(msgspec.Struct, frozen=True):
    """Times at which states are needed: those of a train of ticks, each shifted by an offset."""

    ticks: Ticks
    offset_ns: int = 0
    key: str = ""  # of the scenario, that asks for them; for messages


class RunInfo(msgspec.Struct, frozen=True, kw_only=True):
    """What every federate is told before time 0."""

    scenario: str
    seed: int
    duration_ns: int
    vehicles: tuple[str, ...]
    instants: tuple[Instants, ...] = ()  # when states are needed
    wanted: tuple[str, ...] = ()  # keys of readings that are worked out on demand, and that will be asked for
    paced: bool = False  # by the wall clock: whoever has much to do until an instant may begin before
    periods_s: Mapping[str, float] = {}  # of agents, by vehicle


class Needed:
    """The instants at which states are needed in a run: those that somebody asks for, the start and the end."""

    def __init__(self, run: RunInfo) -> None:
        self._end_ns = run.duration_ns
        self._trains = tuple(dict.fromkeys((each.ticks, each.offset_ns) for each in run.instants))  # equal ones once, in order

    def hits(self, now_ns: int) -> bool:
        """Whether now is one of them."""
        return now_ns in (0, self._end_ns) or any(ticks.hits(now_ns - offset_ns) for ticks, offset_ns in self._trains)

    def after(self, now_ns: int) -> int | None:
        """The first that is later than now; None: the run is over."""
        if now_ns >= self._end_ns:
            return None
        return min([self._end_ns, *(ticks.after(now_ns - offset_ns) + offset_ns for ticks, offset_ns in self._trains)])


@runtime_checkable
class Federate(Protocol):
    """A part of the simulation that runs in logical time."""

    name: str
    slot: Slot  # where it steps at its own wake-ups
    wake_slot: Slot  # where it steps when woken by an event
    reads: tuple[str, ...]  # key expressions: ``*`` is one chunk, ``**`` any number of chunks
    latest: tuple[str, ...]  # likewise, of which it is given only the newest event of each key since its last step
    wakes: tuple[str, ...]  # those of them that wake it

    def start(self, run: RunInfo) -> int | None:
        """Get ready for time 0 and say when to be stepped first (None: only when woken)."""

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Advance to ``now_ns``, given the events since the last step, oldest first."""

    def close(self) -> None:
        """Release everything. Called once, also after a failure."""


@runtime_checkable
class Releasable(Protocol):
    """A federate with something elsewhere, which goes on until it is told that the run is over."""

    def release(self) -> None:
        """Say that there will be no more, without waiting: called of all before any is closed."""


@runtime_checkable
class Polled(Protocol):
    """A federate that somebody outside may want something of at any time."""

    def poll(self, now_ns: int) -> bool:
        """Called before each instant: whether to be stepped in it, in the federate's own slot."""


@runtime_checkable
class Prompted(Polled, Protocol):
    """A federate to which somebody outside may come between two instants: it then has one of its own.

    It is asked (`poll`) before each instant and, on a clock that waits, as soon as ``fileno()`` is readable.
    """

    def fileno(self) -> int:
        """For select; -1: nobody will come."""


@runtime_checkable
class Waiting(Protocol):
    """A federate whose steps wait for somebody outside, who may hang: an interruption may strike in them at once."""

    waits: bool


@runtime_checkable
class RemoteFederate(Federate, Releasable, Protocol):
    """A federate elsewhere: all that are due in a slot are asked before any is awaited.

    With a lookahead the kernel awaits the answer to a question asked at t only at t + lookahead: nothing in that answer
    takes effect earlier.
    """

    lookahead_ns: int

    def ask(self, now_ns: int, inbox: Sequence[Event]) -> int | None:
        """Send the question; return the next wake-up, which must not depend on the answer."""

    def answer(self) -> Sequence[Event]:
        """Wait for the answer to the oldest open question."""


class ExternalMotion(Protocol):
    """Motion of vehicles that physics does not move: real robots, or a recording of them.

    They are bodies of infinite mass in the world: other bodies collide with them, scanners and cameras see them, the radio uses
    their positions; nothing that happens in the simulation moves them.
    """

    names: tuple[str, ...]  # of the vehicles, in the scenario's order

    def states(self, now_ns: int) -> Sequence[VehicleState]:
        """States at this instant, in the order of ``names``: asked after the federate of these vehicles has stepped.

        The times asked for never decrease, and the same time gives the same states. Between two instants physics extrapolates
        with the velocities of the earlier one.
        """


class ExternalVehicles(Federate, ExternalMotion, Protocol):
    """The federate of such vehicles: publishes their estimates and readings, takes their commands."""


def matches(expression: str, key: str) -> bool:
    """Whether a key is in the set of a key expression, with Zenoh's ``*`` (one chunk) and ``**`` (any number of chunks)."""
    return expression == key or _match(expression.split("/"), key.split("/"))


def _match(pattern: list[str], chunks: list[str]) -> bool:
    if not pattern:
        return not chunks
    if pattern[0] == "**":
        return any(_match(pattern[1:], chunks[skip:]) for skip in range(len(chunks) + 1))
    return bool(chunks) and pattern[0] in ("*", chunks[0]) and _match(pattern[1:], chunks[1:])
