"""Programs in the time of the run: each runs in its turn, while the run waits; results do not depend on wall-clock time."""

from collections.abc import Callable, Sequence

from vcmvsp.cosim.federate import Event, RunInfo, Slot, Step
from vcmvsp.cosim.scenario.schema import SocketsTable
from vcmvsp.cosim.sockets.messages import ROOM
from vcmvsp.cosim.types import Message, Note, Reception, VehicleState
from vcmvsp.cosim.util.polling import readable
from vcmvsp.netsim.sockets.admission import Listener, ProgramAdmission, check_endpoint
from vcmvsp.netsim.sockets.program import Program, ProgramLeft

LEFT, MISSED = "program", "program_missed"  # keys of notes


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
        table: ``[sockets]``.
        vehicles: all of the run.
        tell: takes lines for the user.
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
        there = ProgramAdmission(listener, names, run.scenario, self._vehicles, self._tell).wait(self._table.join_timeout_s)
        listener.close()
        for name in names:
            self._programs[name] = Program(name, everybody, there[name], self._table.deadline_s)
        return 0

    def poll(self, now_ns: int) -> bool:
        """Whether a program has ended that should wait."""
        there = [program.fileno() for program in self._programs.values()]
        self._stirred = set(readable(there, 0.0)) if there else set()
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
        """Run a program until it waits again."""
        messages: list[Message] = []
        try:
            program.turn(now_ns, messages)
        except ProgramLeft as reason:
            self._part(program, reason, now_ns, events)
        events.extend(Event(f"{program.vehicle}/send", now_ns, each) for each in messages)

    def _note_missed(self, program: Program, now_ns: int, events: list[Event]) -> None:
        if not program.noted:
            self._tell(
                f"the program of {program.vehicle} does not receive what it hears: more than {ROOM >> 20} MiB of it are lost"
            )
        program.noted = program.missed
        events.append(Event(f"{program.vehicle}/note", now_ns, Note(values={MISSED: float(program.missed)})))

    def _part(self, program: Program, why: ProgramLeft, now_ns: int, events: list[Event]) -> None:
        """Remove a program."""
        program.close()
        del self._programs[program.vehicle]
        self._tell(f"the program of {program.vehicle} has left at {now_ns / 1e9:.3f} s ({why}): it sends no more")
        events.append(Event(f"{program.vehicle}/note", now_ns, Note(values={LEFT: f"left: {why}"})))
