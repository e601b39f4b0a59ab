"""Programs in the time of the run: each runs in its turn, while the run waits; results do not depend on wall-clock time."""

import contextlib
import socket
from collections import deque
from collections.abc import Callable, Sequence

from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.federate import Event, RunInfo, Slot, Step
from vcmvsp.cosim.scenario.schema import SocketsTable
from vcmvsp.cosim.sockets.messages import EACH, ROOM, Go, Over, Send, Stream, Up, Wait, WireError, up
from vcmvsp.cosim.types import Message, Note, Reception, Vec3, VehicleState
from vcmvsp.cosim.util.polling import readable
from vcmvsp.cosim.util.text import plain
from vcmvsp.netsim.sockets.admission import Listener, ProgramAdmission, check_endpoint

MOST_CALLS = 100_000  # datagrams in one turn
MOST_BYTES = 1 << 26  # in one turn

LEFT, MISSED = "program", "program_missed"  # keys of notes


class ProgramLeft(Exception):
    """A program has ended or was dismissed; the message is the reason."""


class Program:
    """The program of a vehicle.

    Attributes:
        noted: how many of them were noted.

    Args:
        deadline_s: wall-clock timeout of each message in its turn.
    """

    def __init__(self, vehicle: str, vehicles: frozenset[str], stream: Stream, deadline_s: float | None) -> None:
        self.vehicle, self._stream, self._deadline_s = vehicle, stream, deadline_s
        self._others = vehicles - {vehicle}
        self.wake_ns: int | None = 0  # time of the next turn at the latest; None: at the next reception only
        self.missed = self.noted = 0  # datagrams dropped because the program did not read
        self.position: Vec3 | None = None  # estimate of its vehicle, m, world
        self._wakes_on_reception = False
        self._received: deque[tuple[bytes, str]] = deque()
        self._room = ROOM
        stream.socket.settimeout(deadline_s)

    def fileno(self) -> int:
        """For poll."""
        return self._stream.socket.fileno()

    def hear(self, payload: bytes, sender: str) -> None:
        """Store a datagram for the next turn, if there is room."""
        size = len(payload) + EACH
        if size > self._room:
            self.missed += 1
        else:
            self._received.append((payload, sender))
            self._room -= size

    def is_due(self, now_ns: int) -> bool:
        """Whether its turn is now."""
        return self.wake_ns == now_ns or (self._wakes_on_reception and bool(self._received))

    def turn(self, now_ns: int, messages: list[Message]) -> None:
        """Run it until it waits again; appends its messages to ``messages``.

        Raises:
            ProgramLeft: it has ended.
            FederateError: its deadline has passed.
        """
        calls, size = 0, 0
        try:
            self._stream.send(Go(now_ns, self.position, list(self._received)))
            self._received.clear()
            while (message := self._stream.receive()) is not None:
                word = up(message)
                if isinstance(word, Wait):
                    self._wait(now_ns, word)
                    return
                messages.append(self._checked(word))
                calls, size = calls + 1, size + len(messages[-1].body)
                if calls > MOST_CALLS or size > MOST_BYTES:
                    raise ProgramLeft(f"it sent more than {MOST_CALLS} messages or {MOST_BYTES >> 20} MiB without waiting")
        except WireError as error:
            raise ProgramLeft(f"it sent an invalid message: {plain(str(error))}") from None
        except TimeoutError:
            late = f"did not wait or end within {self._deadline_s:g} s (sockets.deadline_s)"
            raise FederateError(f"the program of {self.vehicle}", f"{late}: mend it, or raise the deadline") from None
        except OSError:
            pass  # the same as an orderly end
        raise ProgramLeft("it has ended")

    def stirs(self) -> ProgramLeft:
        """Reason to dismiss a program that is active out of turn."""
        try:
            self._stream.socket.settimeout(0.0)
            return ProgramLeft("it sent out of turn" if self._stream.socket.recv(1) else "it has ended")
        except OSError:
            return ProgramLeft("it has ended")

    def farewell(self) -> None:
        """Send the end of the run, unless the program does not read."""
        with contextlib.suppress(OSError):
            self._stream.socket.settimeout(0.0)
            self._stream.send(Over())
            self._stream.socket.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        """End the connection."""
        self._stream.socket.close()

    def _wait(self, now_ns: int, word: Wait) -> None:
        if self._stream.frames:
            raise ProgramLeft("it sent out of turn")
        self.wake_ns = None if word.for_ns is None else now_ns + word.for_ns
        self._wakes_on_reception, self._room = word.hears, ROOM - word.held

    def _checked(self, word: Up) -> Message:
        if not isinstance(word, Send):
            raise WireError("a second greeting")
        if word.to is not None and word.to not in self._others:
            raise WireError(f"'{word.to}' is not another vehicle of this run")
        return Message(sender=self.vehicle, body=word.payload, size_bytes=len(word.payload), to=word.to)


class Programs:
    """The federate of all programs in the time of the run.

    ========================  =========  ============================================================================
    key                       direction  value
    ========================  =========  ============================================================================
    ``<vehicle>/heard``       in         `Reception`: wakes a program that waits for it; bytes are passed to the program
    ``<vehicle>/estimate``    in         `VehicleState`: the vehicle's own estimate; the newest counts
    ``<vehicle>/send``        out        `Message` of bytes, at the instant at which the program sends it
    ``<vehicle>/note``        out        `Note`: ``program`` = "left: why"; ``program_missed``: datagrams dropped so far because
                                         the program did not read
    ========================  =========  ============================================================================

    Programs that are due at one instant run one after another, in the order of the vehicles' names, each until it waits again.
    So their behaviour is equal on any machine.

    Args:
        connect: False: open nothing; for the check of a scenario.

    Raises:
        ValueError: ``listen`` is an invalid endpoint, or one that other machines reach.
    """

    name = "sockets"
    slot = wake_slot = Slot.AGENT
    waits = True  # in its steps, for programs

    def __init__(self, table: SocketsTable, vehicles: Sequence[str], *, tell: Callable[[str], None], connect: bool) -> None:
        check_endpoint(table.listen)
        self._table, self._vehicles, self._tell, self._connect = table, tuple(vehicles), tell, connect
        names = sorted(table.vehicles)
        self.reads: tuple[str, ...] = tuple(f"{each}/heard" for each in names)
        self.latest: tuple[str, ...] = tuple(f"{each}/estimate" for each in names)
        self.wakes: tuple[str, ...] = self.reads
        self._listener: Listener | None = None
        self._programs: dict[str, Program] = {}  # in the order of their turns
        self._stirred: set[int] = set()  # descriptors of programs that are active out of turn

    def start(self, run: RunInfo) -> int | None:
        """Wait for all programs."""
        if not self._connect:
            return None
        names, everybody = sorted(self._table.vehicles), frozenset(self._vehicles)
        listener = self._listener = Listener(self._table.listen)
        self._tell(f"waiting for the programs of {', '.join(names)} at {listener.endpoint}: cosim.sockets.connect(VEHICLE)")
        connections = ProgramAdmission(listener, names, run.scenario, self._vehicles, self._tell).wait(
            self._table.join_timeout_s
        )
        listener.close()
        for name in names:
            self._programs[name] = Program(name, everybody, connections[name], self._table.deadline_s)
        return 0

    def poll(self, now_ns: int) -> bool:
        """Whether a program has ended that should wait."""
        descriptors = [program.fileno() for program in self._programs.values()]
        self._stirred = set(readable(descriptors, 0.0)) if descriptors else set()
        return bool(self._stirred)

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Pass receptions to programs, and run the programs that are due."""
        for event in inbox:
            self._take(event)
        events: list[Event] = []
        for program in list(self._programs.values()):
            if program.missed != program.noted:
                self._note_missed(program, now_ns, events)
            if program.fileno() in self._stirred:
                self._part(program, program.stirs(), now_ns, events)
            elif program.is_due(now_ns):
                self._turn(program, now_ns, events)
        self._stirred = set()
        due = [each.wake_ns for each in self._programs.values() if each.wake_ns is not None]
        return Step(events, min(due, default=None))

    def release(self) -> None:
        """Send the end of the run to all programs."""
        for program in self._programs.values():
            program.farewell()

    def close(self) -> None:
        """End all connections."""
        for program in self._programs.values():
            program.close()
        if self._listener is not None:
            self._listener.close()

    def _take(self, event: Event) -> None:
        vehicle, _, _ = event.key.partition("/")
        program, value = self._programs.get(vehicle), event.value
        if program is None:
            return
        if isinstance(value, VehicleState):
            program.position = value.position
        elif isinstance(value, Reception) and isinstance(value.message.body, bytes):
            program.hear(value.message.body, value.message.sender)

    def _turn(self, program: Program, now_ns: int, events: list[Event]) -> None:
        messages: list[Message] = []
        try:
            program.turn(now_ns, messages)
        except ProgramLeft as reason:
            self._part(program, reason, now_ns, events)
        events.extend(Event(f"{program.vehicle}/send", now_ns, each) for each in messages)

    def _note_missed(self, program: Program, now_ns: int, events: list[Event]) -> None:
        if not program.noted:
            self._tell(f"the program of {program.vehicle} reads too slowly: messages beyond {ROOM >> 20} MiB are lost")
        program.noted = program.missed
        events.append(Event(f"{program.vehicle}/note", now_ns, Note(values={MISSED: float(program.missed)})))

    def _part(self, program: Program, why: ProgramLeft, now_ns: int, events: list[Event]) -> None:
        program.close()
        del self._programs[program.vehicle]
        self._tell(f"the program of {program.vehicle} disconnected at {now_ns / 1e9:.3f} s ({why})")
        events.append(Event(f"{program.vehicle}/note", now_ns, Note(values={LEFT: f"left: {why}"})))
