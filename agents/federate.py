"""Host of agents: one federate for all agents of a process.

It collects the published data of a vehicle into an `Observation`, calls `Agent.act`, and turns command, messages and notes into
events that take effect at tick + latency.
"""

import itertools
import math
import traceback
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import msgspec

from vcmvsp.agents.factory import Kinds, build, files_of
from vcmvsp.cosim.agent import Agent, AgentInfo, AgentSpec, Observation, Radio, VehicleInfo
from vcmvsp.cosim.clock import SECOND_NS, Ticks, seconds_to_ns
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import AgentError, ScenarioError, place_of, words_of
from vcmvsp.cosim.federate import Event, RunInfo, Slot, Step
from vcmvsp.cosim.hosts.remote_host import Absence
from vcmvsp.cosim.received import Mailboxes, ReceivedMessages
from vcmvsp.cosim.types import RECEPTIONS, Follows, Measured, Note, Period, Readings, VehicleState, Velocity, Waypoint
from vcmvsp.cosim.util.text import plain
from vcmvsp.cosim.vehicle_clock import VehicleClocks

NEVER_NS = 2**63
COMMANDS = (Velocity, Waypoint)
ALWAYS = ("odometry", "fix")  # besides the sensors of the scenario
BATTERY = "battery"


class AgentRunner:
    """Runs one agent: ``agent``, if it exists already, or one of the specification, whose class is looked up in ``kinds``."""

    def __init__(self, spec: AgentSpec, agent: Agent | None, kinds: Kinds) -> None:
        self.spec, self.vehicle, self.next_ns = spec, spec.vehicle, 0
        self._started, self._command_key, self._note_key = False, f"{spec.vehicle}/command", f"{spec.vehicle}/note"
        if agent is None:
            self.agent, params, defaults_used = build(spec, kinds)
        else:  # constructor arguments are unknown; the scenario's parameters stand in
            parameters = binding.parameters(type(agent))
            params_of_spec = {name: value for name, value in {**spec.defaults, **spec.params}.items() if name in parameters}
            self.agent, params, defaults_used = agent, binding.complete(type(agent), params_of_spec), tuple(spec.defaults)
        try:
            self._ticks = Ticks.every(binding.convert(spec.period_s or self.agent.period, Period))
        except ScenarioError as error:
            problem = f"the class's own period {error.problem}"
            raise ScenarioError(problem, key=f"vehicle.{spec.vehicle}.agent.kind", source=spec.source) from error
        requested = self.agent.sensors
        sensors = [each for each in dict.fromkeys((*ALWAYS, *spec.sensors)) if requested is None or each in requested]
        self.info = AgentInfo(
            vehicle=spec.vehicle,
            agent=spec.kind,
            ticks=self._ticks,
            latency_ns=seconds_to_ns(spec.latency_s),
            params=params,
            known=tuple(binding.parameters(type(self.agent))),
            taken=defaults_used,
            sensors=tuple(requested or ()),
            files=files_of(type(self.agent), params),
        )
        self._state: VehicleState | None = None
        self._readings = Readings()
        self.sees: dict[str, Callable[[Any], None]] = {
            "estimate": self._locate,
            **{sensor: partial(self._readings.__setitem__, sensor) for sensor in sensors},
        }
        if spec.battery:
            self._reads_battery = BATTERY in sensors
            self.sees[BATTERY] = self._take_charge
        self._follows: Follows | None = None
        self.fails_ns = NEVER_NS if spec.fails_s is None else seconds_to_ns(spec.fails_s)
        self._dead = False
        self.absence: Absence | None = None

    def start(self, run: RunInfo, clocks: VehicleClocks | None) -> None:
        """Start the agent with the data of its vehicle and of the run."""
        self._clocks = clocks if clocks is not None and self.vehicle in clocks else None
        self.radio, self._started = Radio(self.vehicle, run.vehicles, run.radios), True
        self._vehicles = run.vehicles
        about = VehicleInfo(
            name=self.vehicle,
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
        except ValueError as error:  # a name or number of the scenario is unsuitable for this agent
            key = f"vehicle.{self.vehicle}.agent"
            raise ScenarioError(str(error), key=key, source=self.spec.source) from error

    def close(self) -> AgentError | None:
        """Close the agent; returns its error, if any."""
        try:
            if self._started:
                self.guarded(self.agent.close)
        except AgentError as error:
            return error
        return None

    def _locate(self, state: VehicleState) -> None:
        self._state = state

    def _take_charge(self, reading: Measured) -> None:
        """Take a reading of the vehicle's battery; the agent fails with its end."""
        if self._reads_battery:
            self._readings[BATTERY] = reading
        if reading.values["charge"] <= 0.0:
            self.fails_ns = min(self.fails_ns, reading.time_ns)

    def is_due(self, now_ns: int) -> bool:
        """Whether the agent has a tick now; ticks missed while the host was disconnected are skipped."""
        if self.next_ns < now_ns:
            self.next_ns = self._ticks.after(now_ns - 1)
        return self.next_ns == now_ns

    def tick(self, now_ns: int, after_ns: int, received: ReceivedMessages, events: list[Event]) -> None:
        """Append the events of a tick, in effect from now + latency on."""
        self.next_ns = after_ns
        if now_ns >= self.fails_ns:
            self.die(now_ns, events)
        elif self.absence is not None:
            events.extend(self.absence.go_on(now_ns + self.info.latency_ns))
        else:
            before = len(events)
            try:
                self._act(now_ns, now_ns + self.info.latency_ns, received, events)
            except AgentError as error:
                if self.spec.on_lost == "stop":
                    raise
                del events[before:]
                self.leave(now_ns, error, events)

    def leave(self, now_ns: int, error: AgentError, events: list[Event]) -> None:
        """Go on without the agent, as ``on_lost`` says."""
        when, follows = now_ns + self.info.latency_ns, self._follows is not None
        self.absence = Absence(self.spec, now_ns, when, error.cause, follows=follows)
        events.extend(self.absence.news)

    def observe(self, now_ns: int, received: ReceivedMessages) -> Observation:
        """What the agent observes now."""
        if self._state is None:
            raise AgentError(
                (self.vehicle,), self.spec.kind, "has no state to act on: no estimate of its vehicle was published"
            )
        clocks, own_time_ns = self._clocks, None
        if clocks is None:
            readings = Readings(self._readings)
        else:
            newest = dict.items(self._readings)  # without computing those on demand
            readings = Readings({name: clocks.measured(self.vehicle, reading) for name, reading in newest})
            own_time_ns = clocks.reading_ns(self.vehicle, now_ns)
        return Observation(
            vehicle=self.vehicle,
            time_ns=now_ns,
            state=self._state,
            readings=readings,
            heard=received,
            own_time_ns=own_time_ns,
        )

    def _act(self, now_ns: int, when: int, received: ReceivedMessages, events: list[Event]) -> None:
        observation = self.observe(now_ns, received)
        try:
            command = self.agent.act(observation, self.radio)
        except KeyboardInterrupt as error:
            about = f" in agent {self.spec.kind} of vehicle {self.vehicle}{place_of(error)}"
            raise KeyboardInterrupt(about) from error
        except BaseException as error:  # as in `guarded`, a call less
            raise self._failure(error) from error
        self.conclude(command, when, events)

    def conclude(self, command: Velocity | Waypoint | None, when: int, events: list[Event]) -> None:
        """Append the events of a tick whose agent has given its command, in effect from ``when`` on."""
        agent = self.agent
        if command is not None:
            events.append(Event(self._command_key, when, self.checked(command)))
        if agent.follows is not self._follows and agent.follows != self._follows:
            self._follows = agent.follows
            events.append(Event(f"{self.vehicle}/follows", when, self._place(self._follows)))
        if agent._notes or agent._shown or self.radio._outbox:  # noqa: SLF001  checked here: runs at every tick of every agent
            self._tell(when, events)

    def _tell(self, when: int, events: list[Event]) -> None:
        if notes := self.agent.drain_notes():
            events.append(Event(self._note_key, when, Note(values=notes)))
        if self.agent._shown:  # noqa: SLF001  as in `conclude`
            events += [Event(f"{self.vehicle}/{topic}", when, value) for topic, value in self.agent.drain_shown().items()]
        if self.radio._outbox:  # noqa: SLF001  as in `conclude`
            events += [Event(f"{self.vehicle}/send", when, message) for message in self.radio.drain()]

    def die(self, now_ns: int, events: list[Event]) -> None:
        """Stop the vehicle and end all messages, at the failure time of the scenario."""
        if not self._dead:
            self._dead, when = True, now_ns + self.info.latency_ns
            note = Note(values={"status": "failed"})
            events += [Event(f"{self.vehicle}/command", when, Velocity()), Event(f"{self.vehicle}/note", when, note)]
            if self._follows is not None:
                events.append(Event(f"{self.vehicle}/follows", when, self._place(None)))

    def checked(self, command: Any) -> Velocity | Waypoint:
        """The command with plain numbers; an `AgentError` if it is none."""
        if not isinstance(command, COMMANDS):
            raise self._error(f"returned {binding.show(command)} from act(); it must return a Velocity, a Waypoint, or None")
        try:
            plain_command, total = _plain(command)
        except (TypeError, ValueError):
            raise self._error(f"returned {command}; all coordinates must be numbers") from None
        if not math.isfinite(total):
            raise self._error(f"returned a command that is not finite: {plain_command}")
        return plain_command

    def _place(self, follows: Any) -> Follows:
        if follows is None:
            return Follows(leader=None)
        try:
            place = msgspec.convert(msgspec.to_builtins(follows, enc_hook=lambda number: number.item()), Follows)
        except (msgspec.ValidationError, TypeError, AttributeError):
            raise self._error(f"set follows to {binding.show(follows)}; it must be a Follows, or None") from None
        if place.leader == self.vehicle or place.leader not in self._vehicles:
            raise self._error(f"set follows.leader to {place.leader!r}; it must be another vehicle of this run")
        return place

    def guarded(self, method: Any, *args: Any, passes: type[Exception] | tuple[()] = ()) -> Any:
        """Call a method of the agent; an exception becomes an error with agent, vehicle and line."""
        try:
            return method(*args)
        except KeyboardInterrupt:
            raise
        except passes:
            raise
        except BaseException as error:  # no exception of an agent may end the recording
            raise self._failure(error) from error

    def _failure(self, error: BaseException) -> AgentError:
        cause = f"raised {words_of(error)}{place_of(error)}"
        return self._error(cause, details="".join(traceback.format_exception(error)))

    def _error(self, cause: str, *, details: str = "") -> AgentError:
        return AgentError((self.vehicle,), self.spec.kind, plain(cause, lines=True), details=details)


def _plain(command: Velocity | Waypoint) -> tuple[Velocity | Waypoint, float]:
    """The command as plain floats, and their sum, which is finite only if all of them are."""
    if isinstance(command, Velocity):
        x, y, z = command.linear
        rate = command.yaw_rate
        if type(x) is type(y) is type(z) is type(rate) is float and type(command) is Velocity and type(command.linear) is tuple:
            return command, x + y + z + rate
        x, y, z, rate = float(x), float(y), float(z), float(rate)
        return Velocity(linear=(x, y, z), yaw_rate=rate), x + y + z + rate
    x, y, z = map(float, command.position)
    yaw = None if command.yaw is None else float(command.yaw)
    speed = None if command.speed is None else float(command.speed)
    return Waypoint(position=(x, y, z), yaw=yaw, speed=speed), x + y + z + (yaw or 0.0) + (speed or 0.0)


class AgentHost:
    """A federate with agents, one per vehicle.

    For existing agents, ``objects`` by vehicle, the specification applies except for the constructor arguments.
    """

    slot = wake_slot = Slot.AGENT
    wakes: tuple[str, ...] = ()

    def __init__(self, name: str, specs: Sequence[AgentSpec], objects: Mapping[str, Agent] | None = None) -> None:
        self.name = name
        objects_by_vehicle, kinds = objects or {}, Kinds()
        ordered = sorted(specs, key=lambda spec: spec.vehicle)
        self._seats = [AgentRunner(spec, objects_by_vehicle.get(spec.vehicle), kinds) for spec in ordered]
        self.agents = tuple(seat.info for seat in self._seats)
        self._trains = list(dict.fromkeys(info.ticks for info in self.agents))  # few, shared by many agents
        self._train = [self._trains.index(info.ticks) for info in self.agents]
        latest = {f"{seat.vehicle}/{topic}": see for seat in self._seats for topic, see in seat.sees.items()}
        self.reads: tuple[str, ...] = (RECEPTIONS,)
        self.latest = tuple(latest)
        self._takes: dict[str, Callable[[Any], None]] = latest  # receivers of values, by key

    def start(self, run: RunInfo) -> int | None:
        """Start all agents; the first tick of each is at time 0."""
        clocks = VehicleClocks(run.seed, run.clocks) if run.clocks else None
        self._mail = Mailboxes(run.vehicles, [seat.vehicle for seat in self._seats], clocks)
        self._takes[RECEPTIONS] = self._mail.put
        for seat in self._seats:
            seat.start(run, clocks)
        return 0

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Distribute the inbox and run every agent that has a tick now."""
        self._read(inbox)
        events: list[Event] = []
        after = [ticks.after(now_ns) for ticks in self._trains]
        due = [seat.is_due(now_ns) for seat in self._seats]
        receivers = None
        if not all(due):
            receivers = [seat.vehicle for seat in itertools.compress(self._seats, due)]
        received = self._mail.open(now_ns, receivers)
        nothing, next_ns = ReceivedMessages.none(now_ns), NEVER_NS
        for seat, train, is_due in zip(self._seats, self._train, due, strict=True):
            if is_due:
                seat.tick(now_ns, after[train], received.get(seat.vehicle, nothing), events)
            next_ns = seat.next_ns if seat.next_ns < next_ns else next_ns  # noqa: FURB136  a call less than min()
        return Step(events, next_ns)

    def _read(self, inbox: Sequence[Event]) -> None:
        takes = self._takes
        for event in inbox:
            takes[event.key](event.value)

    def close(self) -> None:
        """Close every started agent, even after a failure; the first failure is raised at the end."""
        failures = [error for seat in self._seats if (error := seat.close())]
        if failures:
            raise failures[0]
