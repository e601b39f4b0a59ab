"""The federate `bridge`: datagrams of external programs enter the run and leave it when their frames arrive.

=====================  =========  =====================================================================================
key                    direction  value
=====================  =========  =====================================================================================
``bridge/sent``        out        `Datagrams` from programs, each with its time
``radio/traffic``      in         `Traffic`: deliveries of these datagrams
``radio/receptions``   in         `Receptions` of agents' messages, for programs of their receivers (``bridge.agents``)
=====================  =========  =====================================================================================

Sockets live in the bridge process (`netsim.bridge.bridge_process`); the federate has numbers, sizes and times only.
The run must keep the pace of the wall clock.
"""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vcmvsp.cosim.clock import WallClock
from vcmvsp.cosim.federate import Event, Log, RunInfo, Slot, Step
from vcmvsp.cosim.types import RECEPTIONS, Array, Datagrams, Receptions, States, Traffic, frozen
from vcmvsp.netsim.bridge import messages
from vcmvsp.netsim.bridge.deliveries import Echoes, Lateness
from vcmvsp.netsim.bridge.gateways.base import LARGEST
from vcmvsp.netsim.bridge.process_client import BridgeClient

if TYPE_CHECKING:
    import pyarrow as pa

# Wall-clock times
LEVELS_NS = 100_000_000  # period of level messages
AGAIN_NS = 1_000_000  # until a message that the process has not read is sent again
BEHIND_NS = 20_000_000  # a run that is later than this catches up before it takes more datagrams,
PATIENCE_NS = 100_000_000  # but waits no longer than this

TOO_LONG = f"sent by agents in more than {LARGEST} bytes"
KILLED = "bridge: its process did not end in time and was killed"
_NETWORKS = ": 'vcmvsp net down' removes the networks that it left"


class BridgeRadio(NamedTuple):
    """One of several radios: the vehicles that have it, and their mean levels, as for `Bridge`."""

    members: tuple[str, ...]
    levels_dbm: Callable[[States], Array]


class Bridge:
    """All gateways of a run."""

    name = "bridge"
    slot = Slot.WORLD
    wake_slot = Slot.APPLY
    latest: tuple[str, ...] = ("world/states",)

    def __init__(
        self,
        gateways: Sequence[messages.GatewaySpec],
        *,
        run: str,
        folder: str,
        vehicles: Sequence[str],
        agents: bool,  # agents receive datagrams of programs, and programs receive messages of agents
        levels_dbm: Callable[[States], Array],  # mean levels, (n, n) dBm: sender by row, receiver by column
        clock: WallClock,
        tell: Callable[[str], None],
        log: Log,  # takes the inputs of a replay: key, time, value
        connect: bool,  # False: open nothing; for the check of a scenario
        radios: Mapping[str, BridgeRadio] | None = None,  # by name, of several radios
    ) -> None:
        self.reads: tuple[str, ...] = ("radio/traffic", RECEPTIONS) if agents else ("radio/traffic",)
        self.wakes: tuple[str, ...] = self.reads
        self._clock, self._log = clock, log
        self._vehicles = tuple(vehicles)
        self._row = {name: row for row, name in enumerate(vehicles)}
        self._radios = dict(radios or {})
        members = {name: tuple(map(self._row.__getitem__, radio.members)) for name, radio in self._radios.items()}
        self._opening = messages.Opening(
            run=run,
            folder=folder,
            vehicles=self._vehicles,
            gateways=tuple(gateways),
            payloads=agents,
            radios=members,
        )
        self._levels_dbm, self._tell, self._connect = levels_dbm, tell, connect
        self._process: BridgeClient | None = None
        self._waiting: list[messages.NewDatagrams] = []  # until the run has caught up
        self._ready: list[messages.NewDatagrams] = []  # for the radio, at this instant
        self._took_ns = 0  # wall-clock time at which datagrams were last taken
        self._again_ns = 0  # next wake time of the bridge itself
        self._taken = 0  # datagrams so far
        self._newest_ns = np.zeros(len(vehicles), np.int64)  # time of each vehicle's newest datagram
        self._late = Lateness(self._vehicles)
        self._counts: dict[str, dict[str, int]] = {}  # from the process
        self._own_counts: dict[str, Counter[str]] = {}
        self._wants_levels, self._levels_at_ns = dict[str, None](), 0  # of these radios
        self._states: States | None = None
        self._echoes = Echoes(self._vehicles)

    @property
    def lateness(self) -> dict[str, Any]:
        """Statistics of delivery lateness, and counts, so far."""
        names = [name for name in self._vehicles if name in self._counts or name in self._own_counts]
        return self._late.summary({name: {**self._counts.get(name, {}), **self._own_counts.get(name, {})} for name in names})

    def table(self) -> "pa.Table":
        """A row per delivery (`Lateness.table`); ``frame`` and ``receiver`` are as in the table of frames."""
        return self._late.table(tuple(each.name for each in self._opening.gateways))

    def start(self, run: RunInfo) -> int | None:
        """Open all gateways and print their addresses."""
        self._end_ns = run.duration_ns
        if self._connect:
            self._process = BridgeClient.start(self._opening)
            for line in self._process.wait_ready():
                self._tell(line)
        return None

    def fileno(self) -> int:
        """Readable when the process has sent a message."""
        return -1 if self._process is None else self._process.fileno()

    def poll(self, now_ns: int) -> bool:
        """Whether datagrams wait for the radio, or levels are due."""
        if self._process is None:
            return False
        self._process.send_outbox()
        self._receive(self._process.read())
        if now_ns >= self._end_ns:
            return False
        if self._waiting and not self._behind(now_ns):
            self._ready, self._waiting = self._waiting, []
        return bool(self._ready) or self._levels_due or (bool(self._waiting) and self._again_ns <= now_ns)

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Pass new datagrams to the radio, and deliveries to the process."""
        process = self._process
        if process is None:
            return Step()
        for event in inbox:  # before receptions: `Echoes` needs the deliveries of this instant
            if isinstance(event.value, Traffic):
                self._on_traffic(process, event.value)
            elif isinstance(event.value, States):
                self._states = event.value
        for event in inbox:
            if isinstance(event.value, Receptions):
                self._on_receptions(process, event.value)
        events = [Event("bridge/sent", now_ns, each) for batch in self._ready for each in self._datagrams(batch)]
        if self._ready:
            self._ready = []
            for event in events:
                self._log(event.key, event.time_ns, event.value)
            process.send(messages.confirmation_only(self._taken))
        self._send_levels(process)
        return Step(events, self._next(process, now_ns))

    def release(self) -> None:
        """Ask the process to end."""
        if self._process is not None:
            self._process.leave()

    def close(self) -> None:
        """Wait for the end of the process, and take its last messages."""
        if self._process is not None:
            self._receive(self._process.close())
            if self._process.killed:
                kinds = {each.kind for each in self._opening.gateways}
                self._tell(KILLED + _NETWORKS if "ip" in kinds else KILLED)

    def _behind(self, now_ns: int) -> bool:
        wall_ns = time.monotonic_ns()
        if wall_ns - self._clock.monotonic_ns(now_ns) > BEHIND_NS and wall_ns - self._took_ns < PATIENCE_NS:
            return True
        self._took_ns = wall_ns
        return False

    @property
    def _levels_due(self) -> bool:
        return bool(self._wants_levels) and time.monotonic_ns() >= self._levels_at_ns

    def _next(self, process: BridgeClient, now_ns: int) -> int | None:
        wall_ns = time.monotonic_ns()
        wake_ns = [max(self._levels_at_ns, wall_ns + AGAIN_NS)] if self._wants_levels else []
        wake_ns += [wall_ns + AGAIN_NS] if process.has_outbox else []
        wake_ns += [wall_ns] if self._waiting else []
        if not wake_ns or now_ns >= self._end_ns:
            return None
        again_ns = min(max(now_ns + 1, self._clock.logical_ns(min(wake_ns))), self._end_ns)
        if not now_ns < self._again_ns <= again_ns:  # else the earlier wake time stays: each one costs a step of the kernel
            self._again_ns = again_ns
        return self._again_ns

    def _send_levels(self, process: BridgeClient) -> None:
        if self._levels_due and self._states is not None:
            self._levels_at_ns = time.monotonic_ns() + LEVELS_NS
            for radio in self._wants_levels:
                for each in messages.levels_in_chunks(self._levels_of(radio, self._states), radio):
                    process.send(each)

    def _levels_of(self, radio: str, states: States) -> Array:
        if not radio:
            return self._levels_dbm(states)
        members, levels_dbm = self._radios[radio]
        absent = [row for row, name in enumerate(states.names) if name not in members]
        own = levels_dbm(states).copy()  # of the channel, which several radios may share
        own[absent] = own[:, absent] = np.nan
        return own

    def _receive(self, received: Sequence[messages.Up]) -> None:
        for message in received:
            if isinstance(message, messages.NewDatagrams):
                self._waiting.append(message)
            elif isinstance(message, messages.Delivered):
                self._late.delivered(message.due, message.at_ns)
            elif isinstance(message, messages.Counts):
                self._counts |= message.counts
            elif isinstance(message, messages.LevelsRequest):
                self._wants_levels[message.radio] = None

    def _datagrams(self, batch: messages.NewDatagrams) -> list[Datagrams]:
        """Datagrams of each radio with times of the run, in order for each sender; after now if the run is late."""
        logical_ns = self._clock.logical_ns
        sent_ns = np.array([logical_ns(each) for each in batch.came_ns.tolist()], np.int64).clip(0, self._end_ns - 1)
        for sender in np.unique(batch.sender):
            own = batch.sender == sender
            sent_ns[own] = np.maximum.accumulate(np.maximum(sent_ns[own], self._newest_ns[sender]))
            self._newest_ns[sender] = sent_ns[own][-1]
        self._taken += len(batch.number)
        others = np.array([len(each.members) - 1 for each in self._radios.values()])
        to_all = None if batch.radio is None else others[batch.radio]
        self._late.sent(batch.number, batch.gateway, batch.sender, batch.to, sent_ns, to_all)
        if self._opening.payloads:
            self._echoes.sent(batch)
        fields: dict[str, Any] = {name: getattr(batch, name) for name in ("number", "sender", "to", "size_bytes")}
        if batch.radio is None:
            return [Datagrams(**fields, sent_ns=frozen(sent_ns), payloads=batch.payloads)]
        fields["sent_ns"] = sent_ns
        datagrams = []
        for number, name in enumerate(self._radios):
            (own,) = np.nonzero(batch.radio == number)
            payloads: tuple[bytes, ...] = ()
            if batch.payloads:
                payloads = tuple([batch.payloads[each] for each in own])
            if len(own):
                columns = {key: frozen(values[own]) for key, values in fields.items()}
                datagrams.append(Datagrams(**columns, payloads=payloads, radio=name))
        return datagrams

    def _on_traffic(self, process: BridgeClient, traffic: Traffic) -> None:
        monotonic_ns = self._clock.monotonic_ns
        at_ns = np.array([monotonic_ns(each) for each in traffic.arrival_ns.tolist()], np.int64)
        self._late.due(traffic, at_ns)
        if self._opening.payloads:
            self._echoes.decided(traffic)
        for each in messages.due_in_chunks(self._taken, traffic, at_ns):
            process.send(each)

    def _on_receptions(self, process: BridgeClient, batch: Receptions) -> None:
        columns = (batch.message, batch.receiver, batch.arrival_ns)
        for number, receiver, received_ns in zip(*(each.tolist() for each in columns), strict=True):
            message, vehicle = batch.messages[number], self._vehicles[receiver]
            payload = self._echoes.agent_payload(vehicle, message, received_ns)
            if payload is not None and len(payload) > LARGEST:
                self._own_counts.setdefault(vehicle, Counter())[TOO_LONG] += 1
            elif payload is not None:
                sender, at_ns = self._row[message.sender], self._clock.monotonic_ns(received_ns)
                to = {"sender": sender, "receiver": receiver}
                process.send(messages.AgentDatagram(**to, at_ns=at_ns, payload=payload, radio=message.radio or ""))
