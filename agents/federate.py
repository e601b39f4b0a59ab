"""The host of agents: one federate for all agents that live in one process.

It turns what was published about a vehicle into an `Observation`, calls the agent, and turns its command, messages and notes
into events that take effect at tick + latency. It is the only caller of `Agent.act`, in the simulation and elsewhere.
"""

import math
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from cosim import registry, table
from cosim.absence import Absence
from cosim.agent import Agent, AgentInfo, AgentSpec, Observation, Radio, VehicleInfo
from cosim.clock import SECOND_NS, Ticks, seconds_to_ns
from cosim.errors import AgentError, ScenarioError, place_of
from cosim.federate import Event, RunInfo, Slot, Step
from cosim.scenario_tables import AgentTable
from cosim.text import plain
from cosim.types import Follows, Note, Period, Readings, Reception, VehicleState, Velocity, Waypoint

NEVER_NS = 2**63
COMMANDS = (Velocity, Waypoint)
ALWAYS = ("odometry", "fix")  # what every vehicle may have besides the sensors that the scenario names


class AgentHost:
    """A federate that holds agents, one per vehicle.

    Args:
        name: of the federate.
        specs: the agents to build.
        objects: agents that exist already, by vehicle; the rest of their spec still counts.
    """

    slot = wake_slot = Slot.AGENT
    wakes: tuple[str, ...] = ()

    def __init__(self, name: str, specs: Sequence[AgentSpec], objects: Mapping[str, Agent] | None = None) -> None:
        self.name = name
        given, kinds = objects or {}, Kinds()
        ordered = sorted(specs, key=lambda spec: spec.vehicle)
        self._seats = {spec.vehicle: _Seat(spec, given.get(spec.vehicle), kinds) for spec in ordered}
        self.agents = tuple(seat.info for seat in self._seats.values())
        self._ticks = tuple(dict.fromkeys(info.ticks for info in self.agents))
        self._doors: dict[str, tuple[_Seat, str]] = {}  # by key: for whom it is, and what it is
        self.reads = tuple(f"{vehicle}/heard" for vehicle in self._seats)
        self.latest = tuple(
            f"{vehicle}/{what}" for vehicle, seat in self._seats.items() for what in ("estimate", *seat.sensors)
        )

    def start(self, run: RunInfo) -> int | None:
        """Tell every agent who and where it is; all act first at time 0."""
        for seat in self._seats.values():
            seat.start(run)
        return 0

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Hand out what arrived, and let every agent act whose tick this is."""
        doors = self._doors
        for event in inbox:
            seat, what = doors.get(event.key) or self._door(event.key)
            seat.take(what, event.value)
        events: list[Event] = []
        after = {ticks: ticks.after(now_ns) for ticks in self._ticks}  # few trains, many seats
        next_ns = NEVER_NS
        for seat in self._seats.values():
            if seat.next_ns <= now_ns:
                seat.tick(now_ns, after[seat.info.ticks], events)
            next_ns = min(next_ns, seat.next_ns)
        return Step(events, next_ns)

    def _door(self, key: str) -> tuple["_Seat", str]:
        vehicle, _, what = key.partition("/")
        door = self._doors[key] = self._seats[vehicle], what
        return door

    def close(self) -> None:
        """Close every agent that was started, even if one of them fails; the first failure is raised at the end."""
        failures = [error for seat in self._seats.values() if (error := seat.close())]
        if failures:
            raise failures[0]


class _Seat:
    """One agent, what it will see at its next tick, and what it has said."""

    def __init__(self, spec: AgentSpec, agent: Agent | None, kinds: "Kinds") -> None:
        self.spec, self.next_ns = spec, 0
        self._started = False
        self._vehicle, self._commands = spec.vehicle, f"{spec.vehicle}/command"
        if agent is None:
            self.agent, params, taken = build(spec, kinds)
        else:  # what it was made with is its maker's to know; what the scenario says is as good as any
            known = table.parameters(type(agent))
            said = {name: value for name, value in {**spec.defaults, **spec.params}.items() if name in known}
            self.agent, params, taken = agent, table.complete(type(agent), said), tuple(spec.defaults)
        try:
            self._ticks = Ticks.every(table.convert(spec.period_s or self.agent.period, Period))
        except ScenarioError as error:
            problem = f"the class's own period {error.problem}"
            raise ScenarioError(problem, key=f"vehicle.{spec.vehicle}.agent.kind", source=spec.source) from error
        wanted = self.agent.sensors
        self.sensors = tuple(each for each in dict.fromkeys((*ALWAYS, *spec.sensors)) if wanted is None or each in wanted)
        self.info = AgentInfo(
            vehicle=spec.vehicle,
            agent=spec.kind,
            ticks=self._ticks,
            latency_ns=seconds_to_ns(spec.latency_s),
            params=params,
            known=tuple(table.parameters(type(self.agent))),
            taken=taken,
            sensors=tuple(wanted or ()),
        )
        self._state: VehicleState | None = None
        self._readings = Readings()
        self._heard: list[Reception] = []
        self._follows: Follows | None = None
        self.fails_ns = NEVER_NS if spec.fails_s is None else seconds_to_ns(spec.fails_s)
        self._dead = False
        self._absence: Absence | None = None

    def start(self, run: RunInfo) -> None:
        self._radio, self._started = Radio(self._vehicle, run.vehicles), True
        self._others = frozenset(run.vehicles) - {self._vehicle}
        about = VehicleInfo(
            name=self._vehicle,
            vehicles=run.vehicles,
            period_s=float(self._ticks.period / SECOND_NS),
            latency_s=self.spec.latency_s,
            seed=run.seed,
            body=self.spec.body,
            sensors=self.spec.sensors,
            beside_m=self.spec.beside_m,
        )
        try:
            self.guarded(self.agent.start, about, passes=ValueError)
        except ValueError as error:  # a name or number of the scenario that this agent cannot work with
            key = f"vehicle.{self._vehicle}.agent"
            raise ScenarioError(str(error), key=key, source=self.spec.source) from error

    def close(self) -> AgentError | None:
        """Close the agent; what goes wrong is the answer."""
        try:
            if self._started:
                self.guarded(self.agent.close)
        except AgentError as error:
            return error
        return None

    def take(self, what: str, value: Any) -> None:
        """Note what was published about this vehicle."""
        if what == "heard":
            self._heard.append(_own_copy(value))
        elif what == "estimate":
            self._state = value
        else:
            self._readings[what] = value

    def tick(self, now_ns: int, after_ns: int, events: list[Event]) -> None:
        """Append what the agent does at its tick, or what its vehicle does without it, in effect from now + latency on."""
        if self.next_ns < now_ns:  # out of reach of the run, it has missed ticks
            self.next_ns = self._ticks.after(now_ns - 1)
            if self.next_ns > now_ns:
                return
        self.next_ns = after_ns
        if now_ns >= self.fails_ns:
            self._die(now_ns, events)
        elif self._absence is not None:
            self._heard.clear()
            events.extend(self._absence.go_on(now_ns + self.info.latency_ns))
        else:
            self._try(now_ns, events)

    def _try(self, now_ns: int, events: list[Event]) -> None:
        """Let the agent act; if it fails, the scenario says what follows."""
        given = len(events)
        try:
            self._act(now_ns, events)
        except AgentError as error:
            if self.spec.on_lost == "stop":
                raise
            del events[given:]
            when, follows = now_ns + self.info.latency_ns, self._follows is not None
            self._absence = Absence(self.spec, now_ns, when, error.cause, follows=follows)
            events.extend(self._absence.news)

    def _act(self, now_ns: int, events: list[Event]) -> None:
        if self._state is None:
            raise AgentError(
                (self._vehicle,), self.spec.kind, "has no state to act on: nothing published its vehicle's estimate"
            )
        seen = Observation(
            vehicle=self._vehicle,
            time_ns=now_ns,
            state=self._state,
            readings=Readings(self._readings),
            heard=tuple(self._heard) if self._heard else (),
        )
        if self._heard:
            self._heard.clear()
        agent = self.agent
        try:
            command = agent.act(seen, self._radio)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # as in `guarded`, a call less
            raise self._failure(error) from error
        when, vehicle = now_ns + self.info.latency_ns, self._vehicle
        if command is not None:
            events.append(Event(self._commands, when, self._checked(command)))
        if agent.follows is not self._follows and agent.follows != self._follows:
            self._follows = agent.follows
            events.append(Event(f"{vehicle}/follows", when, self._place(self._follows)))
        if notes := agent.drain_notes():
            events.append(Event(f"{vehicle}/note", when, Note(values=notes)))
        if shown := agent.drain_shown():
            events.extend(Event(f"{vehicle}/{what}", when, value) for what, value in shown.items())
        if sent := self._radio.drain():
            events.extend(Event(f"{vehicle}/send", when, message) for message in sent)

    def _die(self, now_ns: int, events: list[Event]) -> None:
        """From now on the vehicle stands still and says nothing."""
        self._heard.clear()
        if not self._dead:
            self._dead, when = True, now_ns + self.info.latency_ns
            note = Note(values={"status": "failed"})
            events += [Event(f"{self._vehicle}/command", when, Velocity()), Event(f"{self._vehicle}/note", when, note)]
            if self._follows is not None:  # it means to keep no place any more
                events.append(Event(f"{self._vehicle}/follows", when, self._place(None)))

    def _checked(self, command: Any) -> Velocity | Waypoint:
        """The command in plain floats, as it would come over a wire."""
        if not isinstance(command, COMMANDS):
            raise self._error(f"returned {table.show(command)} from act(); it must return a Velocity, a Waypoint, or None")
        try:
            plain, total = _plain(command)
        except (TypeError, ValueError):
            raise self._error(f"returned {command}; every coordinate must be a number") from None
        if not math.isfinite(total):
            raise self._error(f"returned a command that is not finite: {plain}")
        return plain

    def _place(self, follows: Any) -> Follows:
        """The place to keep in plain floats, as it would come over a wire."""
        if follows is None:
            return Follows(leader=None)
        try:
            place = msgspec.convert(msgspec.to_builtins(follows, enc_hook=lambda number: number.item()), Follows)
        except (msgspec.ValidationError, TypeError, AttributeError):
            raise self._error(f"has set follows to {table.show(follows)}; it must be a Follows, or None") from None
        if place.leader not in self._others:
            raise self._error(f"has set follows.leader to {place.leader!r}, which is not another vehicle of this run")
        return place

    def guarded(self, method: Any, *args: Any, passes: type[Exception] | tuple[()] = ()) -> Any:
        """Call a method of the agent; what it raises becomes an error that names agent, vehicle, and the line."""
        try:
            return method(*args)
        except KeyboardInterrupt:
            raise
        except passes:
            raise
        except BaseException as error:  # whatever an agent raises must not end the recording
            raise self._failure(error) from error

    def _failure(self, error: BaseException) -> AgentError:
        """What an agent raised, as an error that names agent, vehicle, and the line."""
        cause = f"raised {type(error).__name__}: {error}{place_of(error)}"
        return self._error(cause, details="".join(traceback.format_exception(error)))

    def _error(self, cause: str, *, details: str = "") -> AgentError:
        return AgentError((self._vehicle,), self.spec.kind, plain(cause, lines=True), details=details)


class Kinds:
    """Classes of agents, each looked up once per host: a file is not executed again for every vehicle."""

    def __init__(self) -> None:
        self._found: dict[tuple[str, str], Any] = {}

    def find(self, spec: AgentSpec) -> Any:
        """The class that a spec names."""
        if (spec.kind, spec.folder) not in self._found:
            key, origin = f"vehicle.{spec.vehicle}.agent.kind", table.Named(spec.source)
            found = registry.find("agent", spec.kind, folder=Path(spec.folder), key=key, origin=origin)
            self._found[spec.kind, spec.folder] = found
        return self._found[spec.kind, spec.folder]


def build(spec: AgentSpec, kinds: Kinds) -> tuple[Agent, dict[str, Any], tuple[str, ...]]:
    """Build the agent of a spec: (agent, all its parameters, the [agents] defaults that it takes)."""
    key, origin = f"vehicle.{spec.vehicle}.agent", table.Named(spec.source)
    kind = kinds.find(spec)
    if kind.act is Agent.act:
        raise ScenarioError(f"'{spec.kind}' has no act(obs, radio) of its own", key=f"{key}.kind", source=spec.source)
    known = table.parameters(kind)
    taken = tuple(name for name in spec.defaults if name in known and name not in spec.params)
    params = {**{name: spec.defaults[name] for name in taken}, **spec.params}
    params |= {
        name: table.fitted(params[name], known[name].annotation, kept)
        for name, kept in spec.replaced.items()
        if name in params and name in known
    }
    try:
        with registry.looking_in(Path(spec.folder)):
            agent: Agent = table.call(kind, params, key=key, origin=origin, also=table.parameters(AgentTable))
    except ScenarioError as error:
        name = error.key.removeprefix(f"{key}.")
        shared = name.partition(".")[0] in taken  # the first chunk: what is wrong may be inside a table
        raise (ScenarioError(error.problem, key=f"agents.{name}", source=spec.source) if shared else error) from error
    return agent, table.complete(kind, params), taken


def _plain(command: Velocity | Waypoint) -> tuple[Velocity | Waypoint, float]:
    """The command in plain floats, and their sum, which is finite only if all are."""
    if isinstance(command, Velocity):
        x, y, z = command.linear
        rate = command.yaw_rate
        if type(x) is type(y) is type(z) is type(rate) is float and type(command) is Velocity and type(command.linear) is tuple:
            return command, x + y + z + rate
        x, y, z, rate = float(x), float(y), float(z), float(rate)
        return Velocity(linear=(x, y, z), yaw_rate=rate), x + y + z + rate
    x, y, z = map(float, command.position)
    yaw, speed = (None if each is None else float(each) for each in (command.yaw, command.speed))
    return Waypoint(position=(x, y, z), yaw=yaw, speed=speed), x + y + z + (yaw or 0.0) + (speed or 0.0)


def _own_copy(reception: Reception) -> Reception:
    """The reception with a body of its own, so that an agent that changes it changes nobody else's, as over a wire."""
    message = reception.message
    if isinstance(message.body, bytes):
        return reception
    body = msgspec.msgpack.decode(msgspec.msgpack.encode(message.body))
    return msgspec.structs.replace(reception, message=msgspec.structs.replace(message, body=body))
