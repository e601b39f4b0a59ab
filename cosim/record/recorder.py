"""The recorder: sees every event of a run once, in order of time, and keeps what the run leaves.

True states and frames become the rows of two tables; every event becomes a message of ``run.mcap`` under its key, with these
differences, which make the file small and a viewer useful:

- ``world/states`` is kept at the recorder's ticks and at the run's end, as ``/tf`` and as ``<vehicle>/state``;
- ``<vehicle>/estimate`` is left out where it equals the true state of the same instant;
- ``world/scene`` draws a body per vehicle, the place that each follower means to keep and, once a second, the world's targets;
  ``world/solids`` all that stands still, ``world/moving`` the frames of obstacles;
- maps, mosaics and sightings become grids and annotated pictures (`cosim.record.foxglove_shown`).

An event is handled by the type of its value; one of another type is written as it is.
"""

import functools
import hashlib
import math
from array import array
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np
import pyarrow as pa

from cosim.agent import AgentInfo
from cosim.clock import SECOND_NS, Ticks
from cosim.codec import encode
from cosim.errors import ScenarioError
from cosim.federate import Event, RunInfo
from cosim.record import foxglove, metrics, words
from cosim.record.digest import digest
from cosim.record.frames import Frames
from cosim.record.tables import NOT_LOST, Placement, RunFacts, radio_table, states_table, write_table
from cosim.record.viewer import Viewer
from cosim.types import (
    Changed,
    Contact,
    Datagrams,
    Fix,
    Follows,
    FrameReport,
    Halted,
    Image,
    Imu,
    Incident,
    Later,
    Looks,
    Measured,
    Message,
    Mosaic,
    Moved,
    Note,
    Odometry,
    Outage,
    Presence,
    ProbabilityMap,
    Pushed,
    RealStatus,
    Routed,
    Scan,
    Sightings,
    States,
    Traffic,
    Value,
    VehicleState,
    Velocity,
    Waypoint,
)


class DatagramCount(Value, frozen=True, kw_only=True):
    """How much programs outside have handed over at an instant."""

    datagrams: int
    bytes: int


class TrafficCount(Value, frozen=True, kw_only=True):
    """What became of such datagrams, as far as it is known at an instant."""

    frames: int
    arrivals: int
    lost: int  # receiver by receiver


class Recorder:
    """Keeps the tables and, where a stream is given, the MCAP file of one run.

    Args:
        run: what the federates are told of the run.
        record_ticks: when true states are recorded; the run's end always is.
        mcap: an open binary stream for the MCAP file, or None. It stays the caller's to close.
        agents: whose ticks the age of information is measured at.
        radius_m: radius of each vehicle's body, for drawing.
        sensors: whose readings are recorded although they are worked out on demand, by name; ``*``: all.
        world: what the vehicles move in; None: nothing is told of how near they came to it.
        tell: takes lines for the user: which agent was lost, and which is back.
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
        world: Any = None,
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._tell, self._world = tell, world
        self._run, self._record_ticks = run, record_ticks
        self._sensors = frozenset(sensors)
        self._ticks = {agent.vehicle: agent.ticks for agent in agents}
        self._now = 0
        self._latest: tuple[int, States] | None = None
        self._told: tuple[States | None, dict[str, VehicleState]] = None, {}  # those asked for last, by vehicle
        self._rows: list[tuple[int, States]] = []
        self._frames = Frames(run.vehicles)
        self._follows: list[Placement] = []
        self._noted, self._mission = metrics.Noted(), metrics.Mission()
        self._routing = metrics.Routing(run.vehicles)
        self._targets: Sequence[metrics.Target] = () if world is None else world.targets
        self._commands = {name: array("d") for name in run.vehicles}  # rows of time ns, velocity m/s, yaw rate rad/s
        self._presences: list[tuple[str, Presence]] = []
        self._statuses: dict[str, list[tuple[int, RealStatus]]] = {}  # of real vehicles
        self._incidents: list[tuple[str, Incident]] = []
        self._fixes: Counter[str] = Counter()
        self._collisions = 0
        self._others = hashlib.sha256()  # what is in no table, for the digest
        self._pack = msgspec.msgpack.Encoder(enc_hook=foxglove.to_json).encode
        self._tables: tuple[pa.Table, pa.Table] | None = None
        self._end_ns: int | None = None
        self._viewer = None if mcap is None else Viewer(mcap, run, radius_m, world)
        self._write: Callable[[str, int, Any], None] = _nowhere if self._viewer is None else self._viewer.put
        self._write_as_is: Callable[[str, Any, int], None] = _nowhere if self._viewer is None else self._viewer.write
        self._handlers: dict[type, Callable[[str, int, Any], None]] = {
            States: self._on_states,
            FrameReport: self._on_frame,
            Datagrams: self._on_datagrams,
            Traffic: self._on_traffic,
            Routed: self._on_routed,
            Follows: self._on_follows,
            Note: self._on_note,
            **dict.fromkeys((Velocity, Waypoint), self._on_command),
            **dict.fromkeys((Imu, Measured, Message, Odometry), self._remember),
            Later: self._on_later,
            Contact: self._on_contact,
            Presence: self._on_presence,
            RealStatus: self._on_status,
            Incident: self._on_incident,
            **dict.fromkeys((Outage, Halted, Moved, Changed), self._on_intervention),
            Fix: self._on_fix,
            Scan: self._on_scan,
            Pushed: self._on_pushed,
            Image: self._on_image,
            **dict.fromkeys((Looks, ProbabilityMap, Sightings, Mosaic), self._on_cells),
        }

    def on(self, event: Event) -> None:
        """Take an event at its own time; times never decrease."""
        time_ns, value = event.time_ns, event.value
        if time_ns != self._now:
            self._advance(time_ns)
        self._handlers.get(type(value), self._write)(event.key, time_ns, value)

    def log(self, level: str, text: str, time_ns: int) -> None:
        """Write a line into the recording: ``debug``, ``info``, ``warning``, ``error`` or ``fatal``, e.g. why the run ended."""
        if time_ns != self._now:
            self._advance(time_ns)
        if self._viewer is not None:
            self._viewer.say(level, text, time_ns)

    def close(self, end_ns: int) -> None:
        """Finish the recording of a run that lasted until ``end_ns``. May be called again."""
        if self._end_ns is not None:
            return
        self._end_instant()
        if self._latest is not None and self._latest[0] == end_ns and not self._record_ticks.hits(end_ns):
            self._record_states(*self._latest)
        self._end_ns = end_ns
        if self._viewer is not None:
            self._viewer.finish()

    @property
    def follows(self) -> tuple[Placement, ...]:
        """Who means to keep which place, and from when on."""
        return tuple(self._follows)

    @property
    def facts(self) -> RunFacts:
        """What the tables do not say of the run."""
        return RunFacts(
            scenario=self._run.scenario,
            seed=self._run.seed,
            end_ns=self._now if self._end_ns is None else self._end_ns,
            vehicles=self._run.vehicles,
            follows=self.follows,
        )

    @property
    def states(self) -> pa.Table:
        """The true states (`cosim.record.tables.STATES_SCHEMA`)."""
        return self._built()[0]

    @property
    def radio(self) -> pa.Table:
        """The frames at their receivers (`cosim.record.tables.RADIO_SCHEMA`)."""
        return self._built()[1]

    def metrics(self, *, window: metrics.Window) -> dict[str, Any]:
        """The numbers of the run (schema ``vcmvsp.metrics/1``); all but counts within the window (s)."""
        states, radio = self._built()
        moved, got = metrics.motion(states), metrics.receptions(radio)
        end_ns, vehicles = self.facts.end_ns, self._run.vehicles
        ages = metrics.age_metrics(metrics.informed(radio, got), self._follows, self._ticks, window, end_ns)
        hardware = metrics.hardware_metrics(self._statuses, self._incidents, self._fixes, got)
        mission = self._mission.metrics(moved, self._targets)
        commands = {name: np.array(rows).reshape(-1, 5) for name, rows in self._commands.items()}
        return {
            "schema": metrics.SCHEMA,
            "scenario": self._run.scenario,
            "seed": self._run.seed,
            "duration_s": end_ns / SECOND_NS,
            "formation": metrics.formation_metrics(moved, self._follows, window, self._noted, end_ns),
            "radio": metrics.radio_metrics(radio, ages, end_ns),
            **({"routing": self._routing.metrics()} if self._routing else {}),
            "control": metrics.control_metrics(commands, vehicles, window, end_ns),
            "connectivity": metrics.connectivity_metrics(got, vehicles, window, end_ns),
            "agents": metrics.agent_metrics(self._presences, self._ticks, end_ns, self._run.duration_ns),
            **({"hardware": hardware} if self._statuses else {}),
            "safety": metrics.safety_metrics(moved, self._collisions, self._world),
            **({} if mission is None else {"mission": mission}),
            "digest": digest([states, radio], self._others.digest()),
        }

    def write_tables(self, folder: Path) -> None:
        """Write ``states.parquet`` and ``radio.parquet``."""
        states, radio = self._built()
        write_table(states, folder / "states.parquet")
        write_table(radio, folder / "radio.parquet")

    def _on_states(self, key: str, time_ns: int, states: States) -> None:
        self._latest = time_ns, states
        if self._record_ticks.hits(time_ns):
            self._record_states(time_ns, states)

    def _record_states(self, time_ns: int, states: States) -> None:
        self._rows.append((time_ns, states))
        if self._viewer is not None:
            self._viewer.put_states(self._each(states), time_ns)

    def _on_frame(self, key: str, time_ns: int, report: FrameReport) -> None:
        self._frames.extend((report,))
        self._write(key, time_ns, report)

    def _on_datagrams(self, key: str, time_ns: int, datagrams: Datagrams) -> None:
        """They are in the table of frames, each; in ``run.mcap`` only how many there were."""
        self._write(key, time_ns, DatagramCount(datagrams=len(datagrams.number), bytes=int(datagrams.size_bytes.sum())))

    def _on_traffic(self, key: str, time_ns: int, traffic: Traffic) -> None:
        self._frames.extend(traffic.reports)
        lost = sum(each not in NOT_LOST for report in traffic.reports for each in report.outcome)
        self._write(key, time_ns, TrafficCount(frames=len(traffic.reports), arrivals=len(traffic.number), lost=lost))

    def _on_routed(self, key: str, time_ns: int, routed: Routed) -> None:
        """Whose message each frame carried is in the table of frames."""
        self._routing.take(routed)
        self._write(key, time_ns, routed)

    def _on_follows(self, key: str, time_ns: int, follows: Follows) -> None:
        vehicle = _vehicle(key)
        if follows.leader is not None and follows.leader not in self._run.vehicles:
            known = ", ".join(self._run.vehicles)
            raise ScenarioError(f"{vehicle} follows {follows.leader!r}, which is no vehicle of this run ({known})")
        self._follows.append(Placement(time_ns, vehicle, follows))
        self._others.update(self._pack((key, time_ns, follows)))
        self._write(key, time_ns, follows)

    def _on_note(self, key: str, time_ns: int, note: Note) -> None:
        vehicle = _vehicle(key)
        self._noted.take(vehicle, time_ns, note.values)
        self._mission.take(vehicle, time_ns, note.values)
        self._remember(key, time_ns, note)

    def _on_command(self, key: str, time_ns: int, command: Velocity | Waypoint) -> None:
        values = (*command.linear, command.yaw_rate) if isinstance(command, Velocity) else (math.nan,) * 4
        self._commands[_vehicle(key)].extend((time_ns, *values))
        self._remember(key, time_ns, command)

    def _on_contact(self, key: str, time_ns: int, contact: Contact) -> None:
        self._collisions += 1
        self._remember(key, time_ns, contact)
        self.log(*words.of_contact(contact), time_ns)

    def _on_presence(self, key: str, time_ns: int, presence: Presence) -> None:
        vehicle = _vehicle(key)
        self._presences.append((vehicle, presence))
        (self._mission.come_back if presence.state == "back" else self._mission.leave)(vehicle, time_ns)
        self._remember(key, time_ns, presence)
        self._tell_of(time_ns, *words.of_presence(vehicle, presence))

    def _on_status(self, key: str, time_ns: int, status: RealStatus) -> None:
        self._statuses.setdefault(_vehicle(key), []).append((time_ns, status))
        self._remember(key, time_ns, status)

    def _on_incident(self, key: str, time_ns: int, incident: Incident) -> None:
        self._incidents.append((_vehicle(key), incident))
        self._remember(key, time_ns, incident)
        self._tell_of(time_ns, *words.of_incident(_vehicle(key), incident))

    def _on_intervention(self, key: str, time_ns: int, done: words.Intervention) -> None:
        self._remember(key, time_ns, done)
        self._tell_of(time_ns, *words.of_intervention(done, time_ns))

    def _tell_of(self, time_ns: int, level: str, text: str) -> None:
        """Say in the log and on the terminal what happened."""
        self.log(level, text, time_ns)
        self._tell(f"at {time_ns / SECOND_NS:.3f} s {text}")

    def _on_fix(self, key: str, time_ns: int, fix: Fix) -> None:
        self._fixes[_vehicle(key)] += 1
        self._others.update(self._pack((key, time_ns, fix)))
        self._write(key, time_ns, fix)

    def _on_later(self, key: str, time_ns: int, later: Later) -> None:
        if "*" in self._sensors or key.partition("/")[2] in self._sensors:
            reading = later.get()
            self._handlers.get(type(reading), self._write)(key, time_ns, reading)

    def _on_scan(self, key: str, time_ns: int, scan: Scan) -> None:
        self._others.update(self._pack((key, time_ns, scan.time_ns)) + scan.ranges.tobytes())
        self._write(key, time_ns, scan)

    def _on_pushed(self, key: str, time_ns: int, pushed: Pushed) -> None:
        self._others.update(self._pack((key, time_ns)) + pushed.position.tobytes() + pushed.attitude.tobytes())
        self._write(key, time_ns, pushed)

    def _on_image(self, key: str, time_ns: int, image: Image) -> None:
        self._others.update(self._pack((key, time_ns, image.time_ns)) + image.pixels.tobytes())
        self._write(key, time_ns, image)

    def _on_cells(self, key: str, time_ns: int, value: Looks | ProbabilityMap | Sightings | Mosaic) -> None:
        self._others.update(encode((key, time_ns, value)))  # the bytes of arrays and pictures
        if not isinstance(value, Looks):
            self._mission.see(_vehicle(key), value)
        self._write(key, time_ns, value)

    def _remember(self, key: str, time_ns: int, value: Value) -> None:
        """Write a value that is in no table, and that viewers have no schema for, and let it count in the digest."""
        self._others.update(self._pack((key, time_ns, value)))
        self._write_as_is(key, value, time_ns)

    def _advance(self, time_ns: int) -> None:
        self._end_instant()
        self._now = time_ns

    def _end_instant(self) -> None:
        if self._viewer is not None:
            self._viewer.end_instant(self._now, self._truth, self._places)

    def _truth(self) -> dict[str, VehicleState]:
        """The true states of this instant, where they are known."""
        return self._each(self._latest[1]) if self._latest is not None and self._latest[0] == self._now else {}

    def _each(self, states: States) -> dict[str, VehicleState]:
        """The state of each vehicle by itself; worked out once, as it is asked for twice at most instants."""
        if states is not self._told[0]:
            columns = (states.position, states.velocity, states.attitude, states.angular_velocity)
            rows = zip(states.names, *(zip(*column.T.tolist(), strict=True) for column in columns), strict=True)
            self._told = (
                states,
                {name: VehicleState(position=p, velocity=v, attitude=q, angular_velocity=w) for name, p, v, q, w in rows},
            )
        return self._told[1]

    def _places(self) -> dict[str, Follows]:
        return {placement.vehicle: placement.follows for placement in self._follows}

    def _built(self) -> tuple[pa.Table, pa.Table]:
        """Both tables of a run that is over; what they are made of is given up."""
        if self._tables is None:
            self._tables = states_table(self._rows, self.facts), radio_table(self._frames, self.facts)
            self._rows.clear()
            if self._routing:
                self._tables = self._tables[0], self._routing.told(self._tables[1])
        return self._tables


def _nowhere(*_: Any) -> None:
    """Without an MCAP file, an event leaves what its handler keeps."""


@functools.cache
def _vehicle(key: str) -> str:
    return key.partition("/")[0]
