"""Programs in the time of the run: each goes on in its turn, and the run with it; nothing depends on how long that takes."""

from collections.abc import Callable, Sequence

from vcmvsp.cosim.federate import Event, RunInfo, Slot, Step
from vcmvsp.cosim.scenario.schema import SocketsTable
from vcmvsp.cosim.sockets.messages import ROOM
from vcmvsp.cosim.types import Message, Note, Reception, VehicleState
from vcmvsp.cosim.util.polling import readable
from vcmvsp.netsim.sockets.admission import Listener, ProgramAdmission, check_endpoint
from vcmvsp.netsim.sockets.program import Program, ProgramLeft

LEFT, MISSED = "program", "program_missed"  # what is noted


class Programs:
    """The federate of all programs that keep the run's own time.

    ========================  =========  ============================================================================
    key                       direction  value
    ========================  =========  ============================================================================
    ``<vehicle>/heard``       in         `Reception`: wakes the program, if it waits for it; one of bytes is handed to it
    ``<vehicle>/estimate``    in         `VehicleState`: where it takes itself to be; the newest counts
    ``<vehicle>/send``        out        `Message` of bytes, at the instant at which the program says it
    ``<vehicle>/note``        out        `Note`: ``program`` = "left: why"; ``program_missed``: for how many datagrams there was
                                         no room so far, as soon as there is none for one more
    ========================  =========  ============================================================================

    Programs whose time has come at one instant go on one after another, in the order of their vehicles' names, each until it
    waits again. So whatever they do, alone or with one another, is the same on any machine.

    Args:
        table: ``[sockets]``.
        vehicles: all of the run.
        tell: takes lines for the user.
        connect: wait for programs; else nothing is opened, which serves to check the scenario.

    Raises:
        ValueError: ``listen`` is no endpoint, or one that other machines can reach.
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
        self._programs: dict[str, Program] = {}  # of those that are there, in the order of their turns
        self._stirred: set[int] = set()  # descriptors of those that do something while they should wait

    def start(self, run: RunInfo) -> int | None:
        """Wait until all programs are there."""
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
        """Hand out what was heard, and give their turns to those whose time has come."""
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
        """Tell all programs that the run is over."""
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
        """Let a program go on, and say what comes of it."""
        said: list[Message] = []
        try:
            program.turn(now_ns, said)
        except ProgramLeft as left:
            self._part(program, left, now_ns, events)
        events.extend(Event(f"{program.vehicle}/send", now_ns, each) for each in said)

    def _note_missed(self, program: Program, now_ns: int, events: list[Event]) -> None:
        if not program.noted:
            self._tell(
                f"the program of {program.vehicle} does not receive what it hears: more than {ROOM >> 20} MiB of it are lost"
            )
        program.noted = program.missed
        events.append(Event(f"{program.vehicle}/note", now_ns, Note(values={MISSED: float(program.missed)})))

    def _part(self, program: Program, why: ProgramLeft, now_ns: int, events: list[Event]) -> None:
        """Go on without a program."""
        program.close()
        del self._programs[program.vehicle]
        self._tell(f"the program of {program.vehicle} has left at {now_ns / 1e9:.3f} s ({why}): it sends no more")
        events.append(Event(f"{program.vehicle}/note", now_ns, Note(values={LEFT: f"left: {why}"})))
