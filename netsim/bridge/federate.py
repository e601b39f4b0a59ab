"""The federate `bridge`: datagrams of programs outside enter the run, and leave it when their frames arrive.

=====================  =========  =====================================================================================
key                    direction  value
=====================  =========  =====================================================================================
``bridge/sent``        out        `Datagrams` that programs have handed to radios, each stamped with when it came
``radio/traffic``      in         `Traffic`: which of them arrive where, and when
``<vehicle>/heard``    in         `Reception` of what an agent said, for programs of that vehicle (where they hear agents)
=====================  =========  =====================================================================================

Sockets are the affair of a process beside the run (`netsim.bridge.process.bridge_process`): here are numbers, sizes and times.
The run must keep the pace of the wall clock.
"""

import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from vcmvsp.cosim.federate import Event, Log, RunInfo, Slot, Step
from vcmvsp.cosim.types import Array, Datagrams, Reception, States, Traffic, frozen
from vcmvsp.netsim.bridge.echoes import Echoes
from vcmvsp.netsim.bridge.gateways.base import LARGEST
from vcmvsp.netsim.bridge.lateness import Lateness
from vcmvsp.netsim.bridge.process import messages
from vcmvsp.netsim.bridge.process_client import Beside

if TYPE_CHECKING:
    import pyarrow as pa

# All on the wall clock, whatever the speed of the run
LEVELS_NS = 100_000_000  # from levels to the next
AGAIN_NS = 1_000_000  # until what the process has not read is said again
BEHIND_NS = 20_000_000  # a run that is later than this catches up before it takes more from programs,
PATIENCE_NS = 100_000_000  # unless it has taken nothing for so long

TOO_LONG = f"said by agents in more than {LARGEST} bytes"
KILLED = "bridge: its process did not end by itself and was killed"
_NETWORKS = ": 'vcmvsp net down' clears away what it leaves behind"


class Paced(Protocol):
    """A clock that says when its times are on this machine's monotonic clock, ns, and the other way round."""

    def logical_ns(self, monotonic_ns: int) -> int:
        """The run's time then."""

    def monotonic_ns(self, logical_ns: int) -> int:
        """When that is."""


class Air(Protocol):
    """Who knows how strongly vehicles hear each other."""

    def levels_dbm(self, states: States) -> Array:
        """Mean levels where vehicles are, (n, n): of the row's radio at the column's."""


class DoorTable(Protocol):
    """What a scenario says of a door."""

    @property
    def name(self) -> str:
        """Of its table, ``bridge.NAME``."""

    @property
    def kind(self) -> str:
        """Short name, module:Class or file.py:Class."""

    @property
    def params(self) -> dict[str, Any]:
        """Of its constructor."""


class Bridge:
    """All doors of a run.

    Args:
        doors: what is opened.
        run: name of the scenario.
        folder: of the scenario.
        vehicles: of the run, in its order.
        agents: whether agents hear programs, and programs agents.
        air: asked for levels where a door wants them.
        clock: paces the run.
        tell: takes lines for the user.
        log: takes what a replay needs: key, time, value.
        connect: open the doors; else nothing comes, as long as a scenario is being checked.
    """

    name = "bridge"
    slot = Slot.WORLD
    wake_slot = Slot.APPLY
    latest: tuple[str, ...] = ("world/states",)

    def __init__(
        self,
        doors: Sequence[DoorTable],
        *,
        run: str,
        folder: str,
        vehicles: Sequence[str],
        agents: bool,
        air: Air,
        clock: Paced,
        tell: Callable[[str], None],
        log: Log,
        connect: bool,
    ) -> None:
        self.reads: tuple[str, ...] = ("radio/traffic", "*/heard") if agents else ("radio/traffic",)
        self.wakes: tuple[str, ...] = self.reads
        self._clock, self._log = clock, log
        specs = tuple(messages.DoorSpec(name=each.name, kind=each.kind, params=each.params) for each in doors)
        self._opening = messages.Opening(run=run, folder=folder, vehicles=tuple(vehicles), doors=specs, payloads=agents)
        self._vehicles = tuple(vehicles)
        self._row = {name: row for row, name in enumerate(vehicles)}
        self._air, self._tell, self._connect = air, tell, connect
        self._process: Beside | None = None
        self._came: list[messages.Came] = []  # that waits, as the run is behind
        self._ripe: list[messages.Came] = []  # for the radio, in this instant
        self._took_ns = 0  # when there was some
        self._again_ns = 0  # the next instant of its own
        self._taken = 0
        self._sent_ns = np.zeros(len(vehicles), np.int64)  # the newest of each
        self._late = Lateness(self._vehicles)
        self._counts: dict[str, dict[str, int]] = {}  # by the process
        self._own_counts: dict[str, Counter[str]] = {}
        self._wants_levels, self._levels_at_ns = False, 0
        self._states: States | None = None  # the newest
        self._echoes = Echoes(tuple(vehicles))

    @property
    def lateness(self) -> dict[str, Any]:
        """How late deliveries were, and what was counted, so far."""
        names = [name for name in self._vehicles if name in self._counts or name in self._own_counts]
        return self._late.summary({name: {**self._counts.get(name, {}), **self._own_counts.get(name, {})} for name in names})

    def table(self) -> "pa.Table":
        """A row per delivery (`Lateness.table`); ``frame`` and ``receiver`` are those of the table of frames."""
        return self._late.table(tuple(each.name for each in self._opening.doors))

    def start(self, run: RunInfo) -> int | None:
        """Open all doors and say where they are."""
        self._end_ns = run.duration_ns
        if self._connect:
            self._process = Beside.start(self._opening)
            for line in self._process.wait_ready():
                self._tell(line)
        return None

    def fileno(self) -> int:
        """Readable when something has come."""
        return -1 if self._process is None else self._process.fileno()

    def poll(self, now_ns: int) -> bool:
        """Whether something has come for the radio, or levels are to be told."""
        if self._process is None:
            return False
        self._process.go_on()
        self._hear(self._process.read())
        if now_ns >= self._end_ns:
            return False
        if self._came and not self._behind(now_ns):
            self._ripe, self._came = self._came, []
        return bool(self._ripe) or self._levels_due or (bool(self._came) and self._again_ns <= now_ns)

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Give the radio what has come, and say what is due of what it made of that."""
        process = self._process
        if process is None:
            return Step()
        for event in inbox:  # first, as it says whose some receptions of this instant are
            if isinstance(event.value, Traffic):
                self._on_traffic(process, event.value)
            elif isinstance(event.value, States):
                self._states = event.value
        for event in inbox:
            if isinstance(event.value, Reception):
                self._on_heard(process, event.key.partition("/")[0], event.value)
        events: list[Event] = []
        if self._ripe:
            events = [Event("bridge/sent", now_ns, self._datagrams(came)) for came in self._ripe]
            self._ripe = []
            for event in events:
                self._log(event.key, event.time_ns, event.value)
            process.say(messages.taken_over(self._taken))  # what comes meanwhile may be gathered
        if self._levels_due and self._states is not None:
            self._say_levels(process, self._states)
        return Step(events, self._next(process, now_ns))

    def release(self) -> None:
        """Let the process leave at once."""
        if self._process is not None:
            self._process.leave()

    def close(self) -> None:
        """Wait until it has left, and hear its last words."""
        if self._process is not None:
            self._hear(self._process.close())
            if self._process.killed:
                self._tell(f"{KILLED}{_NETWORKS if any(each.kind == 'ip' for each in self._opening.doors) else ''}")

    def _behind(self, now_ns: int) -> bool:
        """Whether the run is to catch up with the wall clock first: programs that say much must not hold it up."""
        wall_ns = time.monotonic_ns()
        if wall_ns - self._clock.monotonic_ns(now_ns) > BEHIND_NS and wall_ns - self._took_ns < PATIENCE_NS:
            return True
        self._took_ns = wall_ns
        return False

    @property
    def _levels_due(self) -> bool:
        return self._wants_levels and time.monotonic_ns() >= self._levels_at_ns

    def _next(self, process: Beside, now_ns: int) -> int | None:
        wall_ns = time.monotonic_ns()
        wishes = [max(self._levels_at_ns, wall_ns + AGAIN_NS)] if self._wants_levels else []
        wishes += [wall_ns + AGAIN_NS] if process.unsaid else []
        wishes += [wall_ns] if self._came else []  # it has caught up then
        if not wishes or now_ns >= self._end_ns:
            return None
        again_ns = min(max(now_ns + 1, self._clock.logical_ns(min(wishes))), self._end_ns)
        if not now_ns < self._again_ns <= again_ns:  # else that stays: each one that is asked for costs an instant
            self._again_ns = again_ns
        return self._again_ns

    def _say_levels(self, process: Beside, states: States) -> None:
        self._levels_at_ns = time.monotonic_ns() + LEVELS_NS
        for each in messages.levels_in_chunks(self._air.levels_dbm(states)):
            process.say(each)

    def _hear(self, received: Sequence[messages.Up]) -> None:
        for message in received:
            if isinstance(message, messages.Came):
                self._came.append(message)
            elif isinstance(message, messages.Went):
                self._late.went(message.due, message.went_ns)
            elif isinstance(message, messages.Counted):
                self._counts |= message.counts
            elif isinstance(message, messages.Asked):
                self._wants_levels = True

    def _datagrams(self, came: messages.Came) -> Datagrams:
        """What came, in the run's time: within the run, and in order for each sender.

        Where the run is late, that is after now: taken for sent now, it would arrive before its time.
        """
        logical_ns = self._clock.logical_ns
        sent_ns = np.array([logical_ns(each) for each in came.came_ns.tolist()], np.int64).clip(0, self._end_ns - 1)
        for sender in np.unique(came.sender):
            own = came.sender == sender
            sent_ns[own] = np.maximum.accumulate(np.maximum(sent_ns[own], self._sent_ns[sender]))
            self._sent_ns[sender] = sent_ns[own][-1]
        self._taken += len(came.number)
        self._late.sent(came.number, came.door, came.sender, came.to, sent_ns)
        if self._opening.payloads:
            self._echoes.said(came)
        return Datagrams(
            number=came.number,
            sender=came.sender,
            to=came.to,
            size_bytes=came.size_bytes,
            sent_ns=frozen(sent_ns),
            payloads=came.payloads,
        )

    def _on_traffic(self, process: Beside, traffic: Traffic) -> None:
        monotonic_ns = self._clock.monotonic_ns
        at_ns = np.array([monotonic_ns(each) for each in traffic.arrival_ns.tolist()], np.int64)
        self._late.due(traffic, at_ns)
        if self._opening.payloads:
            self._echoes.decided(traffic)
        for each in messages.due_in_chunks(self._taken, traffic, at_ns):
            process.say(each)

    def _on_heard(self, process: Beside, vehicle: str, heard: Reception) -> None:
        payload = self._echoes.by_agent(vehicle, heard)
        if payload is not None and len(payload) > LARGEST:
            self._own_counts.setdefault(vehicle, Counter())[TOO_LONG] += 1
        elif payload is not None:
            sender, receiver = self._row[heard.message.sender], self._row[vehicle]
            at_ns = self._clock.monotonic_ns(heard.received_ns)
            process.say(messages.Spoken(sender=sender, receiver=receiver, at_ns=at_ns, payload=payload))
