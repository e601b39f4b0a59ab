"""The recorder: receives every event of a run once, in order of time, and produces the run's output.

Events are handled by the type of their value. Each enters tables, metrics and digest (`cosim.recording.accumulators`) and
becomes a message of ``run.mcap`` under its key (`cosim.recording.run_mcap`), with these exceptions, which keep the file small
and suit viewers:

- ``world/states`` is written at the recorder's ticks and at the run's end, as ``/tf`` and as ``<vehicle>/state``;
- ``<vehicle>/heard`` has what an agent gets at a tick, if ``record.heard`` asks for it; ``radio/frame`` has every reception;
- ``<vehicle>/estimate`` is omitted if it equals the true state of the same instant;
- ``world/scene`` draws a body per vehicle, the slot of each follower and, once a second, the world's targets;
  ``world/solids`` all static bodies, ``world/moving`` the frames of obstacles;
- maps, mosaics and sightings become grids and annotated pictures (`cosim.recording.foxglove`).

Events of unknown types are written unchanged.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import msgspec

from vcmvsp.cosim.agent import AgentInfo
from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.federate import Event, RunInfo, vehicle_of
from vcmvsp.cosim.metrics.agents import limited_by_s
from vcmvsp.cosim.received import Mailboxes
from vcmvsp.cosim.recording import event_text
from vcmvsp.cosim.recording.accumulators import PACKED, Accumulators, Take
from vcmvsp.cosim.recording.foxglove import to_json
from vcmvsp.cosim.recording.mcap_writer import MessageSink
from vcmvsp.cosim.recording.run_mcap import Viewer
from vcmvsp.cosim.recording.scene import DrawnWorld
from vcmvsp.cosim.types import Contact, Heard, Later, Reception, Receptions, States


class Way(NamedTuple):
    """Steps that handle values of a type, in this order."""

    take: Take | None  # for tables and metrics
    is_packed: bool  # for the digest
    write: Take | None  # into ``run.mcap``


class Recorder(Accumulators):
    """Records the tables and, to a given stream, the MCAP file of one run.

    Args:
        run: run data as the federates receive them.
        record_ticks: ticks at which true states are recorded; the run's end is always recorded.
        mcap: an open binary stream for the MCAP file, or None. The caller closes it.
        agents: ticks of each agent, at which the age of information is measured.
        radius_m: radius of each vehicle's body, for drawing.
        sensors: names of on-demand sensors whose readings are recorded; ``*``: all.
        heard: write the messages that each agent receives, as ``<vehicle>/heard``.
        world: the world of the run; None: no distance to obstacles is measured.
        sink: also receives the messages of the MCAP file.
        folder: of temporary files; None: the system's folder for them.
        tell: receives lines for the user: agents that were lost or are back.
    """

    def __init__(
        self,
        run: RunInfo,
        *,
        record_ticks: Ticks,
        mcap: BinaryIO | None,
        agents: Sequence[AgentInfo],
        radius_m: Mapping[str, float],
        sensors: Sequence[str] = (),
        heard: bool = False,
        world: DrawnWorld | None = None,
        sink: MessageSink | None = None,
        folder: Path | None = None,
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._tell, self._record_ticks, self._sensors = tell, record_ticks, frozenset(sensors)
        super().__init__(run, agents, world, folder)
        self._is_closed = False
        self._mail = Mailboxes(run.vehicles, self._ticks)
        self._writes_heard = heard and mcap is not None
        self._next_tick_ns = 0  # of any agent, if messages are recorded
        self._latest: tuple[int, States] | None = None
        self._viewer = None if mcap is None else Viewer(mcap, run, radius_m, world, sink)
        self._write: Take | None = None if self._viewer is None else self._viewer.write
        self._pack = msgspec.msgpack.Encoder(enc_hook=to_json).encode_into
        self._as_it_is = Way(None, False, self._write)
        takers = self._takers | {States: self._take_states}
        writers: dict[Any, Take | None] = {} if self._viewer is None else dict(self._viewer.putters)
        writers |= dict.fromkeys((States, Receptions, Reception)) | dict.fromkeys(event_text.TOLD, self._write_told)
        writers[Later] = self._write_later
        if self._writes_heard:
            writers[Receptions] = lambda _key, _time_ns, batch: self._mail.put(batch)
        self._ways = {
            kind: Way(takers.get(kind), kind in PACKED, writers.get(kind, self._write)) for kind in (*takers, *PACKED, *writers)
        }

    def on(self, event: Event) -> None:
        """Record an event at its own time; times never decrease."""
        key, time_ns, value = event.key, event.time_ns, event.value
        if time_ns != self._now:
            self._advance(time_ns)
        take, is_packed, write = self._ways.get(type(value), self._as_it_is)
        if take is not None:
            take(key, time_ns, value)
        if is_packed:
            self._pack(event, self._packed, -1)
        if write is not None:
            write(key, time_ns, value)

    def log(self, level: str, text: str, time_ns: int) -> None:
        """Write a log line: ``debug``, ``info``, ``warning``, ``error`` or ``fatal``, e.g. why the run ended."""
        if time_ns != self._now:
            self._advance(time_ns)
        if self._viewer is not None:
            self._viewer.say(level, text, time_ns)

    def close(self, end_ns: int, *, is_cut: bool = False) -> None:
        """Finish the recording of a run that ended at ``end_ns`` or was cut within that instant. Repeated calls are allowed."""
        if self._is_closed:
            return
        self._is_closed = True
        self._advance(end_ns, is_cut=is_cut)
        if self._latest is not None and self._latest[0] == end_ns and not self._record_ticks.hits(end_ns):
            self._record_states(*self._latest)
        for vehicle, statuses in sorted(self._statuses.items()):
            if by_s := limited_by_s(statuses):
                self.log("info", f"{vehicle} was held back: {event_text.of_limits(by_s)}", end_ns)
        if self._viewer is not None:
            self._viewer.finish()

    def _take_states(self, key: str, time_ns: int, states: States) -> None:
        self._latest = time_ns, states
        if self._record_ticks.hits(time_ns):
            self._record_states(time_ns, states)

    def _record_states(self, time_ns: int, states: States) -> None:
        self._states.append(time_ns, states)
        if self._viewer is not None:
            self._viewer.put_states(time_ns, states)

    def _write_later(self, key: str, time_ns: int, later: Later) -> None:
        """Write an on-demand reading if its sensor is recorded."""
        if "*" in self._sensors or key.partition("/")[2] in self._sensors:
            self.on(Event(key, time_ns, later.get()))

    def _write_told(self, key: str, time_ns: int, event: event_text.Told) -> None:
        """Write an event to the log and, except contacts, which may be frequent, to the terminal."""
        if self._write is not None:
            self._write(key, time_ns, event)
        level, text = event_text.of_event(vehicle_of(key), event, time_ns)
        self.log(level, text, time_ns)
        if not isinstance(event, Contact):
            self._tell(f"at {time_ns / SECOND_NS:.3f} s {text}")

    def _write_heard(self, before_ns: int) -> None:
        """Write the messages that agents got at their ticks before a time."""
        while self._write is not None and self._writes_heard and self._next_tick_ns < before_ns:
            now_ns, ticks = self._next_tick_ns, self._ticks
            due = [vehicle for vehicle, train in ticks.items() if train.hits(now_ns)]
            for vehicle, received in sorted(self._mail.open(now_ns, due).items()):
                self._write(f"{vehicle}/heard", now_ns, Heard(receptions=tuple(received)))
            self._next_tick_ns = min((train.after(now_ns) for train in ticks.values()), default=before_ns)

    def _advance(self, time_ns: int, *, is_cut: bool = False) -> None:
        self._write_heard(time_ns)
        if self._viewer is not None:
            self._viewer.end_instant(self._now, self._latest, is_cut=is_cut and time_ns == self._now)
        self._hash_much()
        self._now = time_ns
