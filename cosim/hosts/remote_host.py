"""Kernel side of agent hosts: `RemoteHost`, a federate for the agents of one host and of its replacements.

A `SessionLink` carries bytes; a `Crew` speaks `cosim.hosts.protocol` over it. If a host is lost and the scenario lets the run
continue, its vehicles have no agent (`Absence`) until the host answers again or another host replaces it. That moment depends
on the wall clock, so it is recorded.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import Protocol

import msgspec

from vcmvsp.cosim.agent import AgentSpec
from vcmvsp.cosim.clock import SECOND_NS, Ticks, seconds_to_ns
from vcmvsp.cosim.errors import AgentError, FederateError, ScenarioError, VcmvspError
from vcmvsp.cosim.federate import Event, RunInfo, Slot, Step, vehicle_of
from vcmvsp.cosim.hosts import protocol
from vcmvsp.cosim.received import Mailboxes, pruned
from vcmvsp.cosim.types import RECEPTIONS, Follows, Presence, Receptions, Velocity
from vcmvsp.cosim.util.text import plain


class Absence:
    """A vehicle without a working agent: with ``on_lost = "hold"`` it holds its last command for ``hold_s``, then it stops.

    Args:
        spec: specification of the agent; ``on_lost`` is ``hold`` or ``remove``.
        since_ns: first tick without an answer.
        now_ns: time at which that answer would have taken effect.
        follows: whether the vehicle had announced a slot in a formation.

    Attributes:
        news: events to publish at ``now_ns``.
    """

    def __init__(self, spec: AgentSpec, since_ns: int, now_ns: int, why: str, *, follows: bool) -> None:
        self.final = spec.on_lost == "remove"  # the agent cannot return
        self._vehicle, self._rests = spec.vehicle, False
        self._rests_ns = now_ns if self.final else now_ns + seconds_to_ns(spec.hold_s)
        presence = Presence(state="removed" if self.final else "lost", since_ns=since_ns, why=plain(why))
        self.news = [Event(f"{self._vehicle}/host", now_ns, presence), *self.go_on(now_ns)]
        if self.final and follows:
            self.news.append(Event(f"{self._vehicle}/follows", now_ns, Follows(leader=None)))

    def go_on(self, now_ns: int) -> list[Event]:
        """The stop command, once, when the hold time has expired; otherwise nothing."""
        if self._rests or now_ns < self._rests_ns:
            return []
        self._rests = True
        return [Event(f"{self._vehicle}/command", now_ns, Velocity())]

    def back(self, since_ns: int, now_ns: int, late: int) -> Event:
        """The event that the agent answers again, from its tick ``since_ns`` on."""
        return Event(f"{self._vehicle}/host", now_ns, Presence(state="back", since_ns=since_ns, late=late))


class LinkError(Exception):
    """The host will not answer; the message is the reason, e.g. ``was killed by SIGKILL``."""


class LateError(LinkError, TimeoutError):
    """The host missed its deadline; the answer may still come."""


class SessionLink(Protocol):
    """A connection to one host, which answers questions in order."""

    leaving: bool  # set when the run releases the host: its absence is then no error

    def ask(self, question: bytes, deadline_s: float) -> None:
        """Send a question without waiting; the host has ``deadline_s`` of wall-clock time to answer."""

    def answer(self) -> bytes:
        """Wait for the answer to the oldest open question; `LinkError` if none comes in time or at all."""

    def look(self) -> bytes | None:
        """The answer to the oldest open question if it has arrived, even late; `LinkError` if none will come."""

    def close(self) -> None:
        """Release the host."""


class Crew:
    """Session with one host: its agents and its open questions.

    Attributes:
        open: number of open questions.
        late: number of open questions when the host was lost.
    """

    def __init__(
        self,
        link: SessionLink,
        specs: Sequence[AgentSpec],  # the agents that the host builds; the constructor sends the request
        *,
        deadline_s: float,  # wall-clock seconds to answer a step
        build_s: float,  # wall-clock seconds to build the agents, which may load large libraries
        on_built: Callable[[protocol.Built], None] = lambda _: None,  # called with the host's description of its agents
    ) -> None:
        self.link, self.specs, self._on_built = link, tuple(specs), on_built
        self.vehicles = tuple(spec.vehicle for spec in specs)
        self._deadline_s, self._build_s = deadline_s, build_s
        self._released = False
        self.alive, self.open, self.late = True, 0, 0
        self.send(protocol.Build(self.specs), build_s)

    def build(self) -> protocol.Built:
        """Wait until the agents are built; the constructor sent the request, so all hosts build in parallel."""
        try:
            return self.validate_built(self.receive())
        except AgentError as error:
            if isinstance(error.__cause__, TimeoutError):
                raise self.error(f"did not build its agents within {self._build_s:g} s (agents.join_timeout_s)") from error
            raise

    def validate_built(self, answer: protocol.Answer) -> protocol.Built:
        """The validated answer to `Build`."""
        if not isinstance(answer, protocol.Built):
            raise self._unreadable(f"it answered {type(answer).__name__} to Build")
        try:
            protocol.check_built(answer, self.specs)
        except ValueError as error:
            raise self._unreadable(str(error)) from error
        self._on_built(answer)
        return answer

    def stepped(self, effects: Mapping[str, int], names: frozenset[str]) -> list[Event]:
        """Wait for the answer to a step: events of ``effects``' vehicles only, at their times."""
        try:
            answer = self.receive()
        except ScenarioError as error:  # too late to blame the scenario
            raise self.error(str(error)) from error
        if not isinstance(answer, protocol.Stepped):
            raise self._unreadable(f"it answered {type(answer).__name__} to a step")
        try:
            protocol.check_events(answer.events, effects, names)
        except ValueError as error:
            raise self._unreadable(str(error)) from error
        return answer.events

    def send(self, question: protocol.Question, deadline_s: float | None = None) -> None:
        """Send a question without waiting."""
        try:
            self.link.ask(protocol.encode(question), deadline_s or self._deadline_s)
        except ValueError as error:
            raise self.error(f"cannot be asked: {error}") from error
        self.open += 1

    def receive(self) -> protocol.Answer:
        """Wait for the answer to the oldest open question."""
        answer = self._read(self.link.answer)
        assert answer is not None  # noqa: S101
        return answer

    def look(self) -> protocol.Answer | None:
        """The answer to the oldest open question, if it has arrived."""
        return self._read(self.link.look)

    def release(self, reason: str) -> None:
        """Tell the host that the run no longer needs it, if it still answers."""
        if self.alive and not self._released:
            self._released = self.link.leaving = True
            self.send(protocol.End(reason))

    def dismiss(self, why: str) -> None:
        """Release the host without waiting for it."""
        self.release(why)
        self.link.close()

    def close(self) -> None:
        """Wait until the agents are closed, then release the host."""
        try:
            self.release("the run is over")
            while self.alive and self.open and not self.late:
                self.receive()
        finally:
            self.link.close()

    @property
    def indispensable(self) -> bool:
        """Whether the run ends when this host is lost."""
        return any(spec.on_lost == "stop" for spec in self.specs)

    def error(self, cause: str) -> AgentError:
        """An error that names the agents of this host."""
        return AgentError(self.vehicles, ", ".join(dict.fromkeys(spec.kind for spec in self.specs)), cause)

    def _read(self, take: Callable[[], bytes | None]) -> protocol.Answer | None:
        try:
            content = take()
            answer = None if content is None else protocol.answers.decode(content)
        except LinkError as error:
            self.alive, self.late = isinstance(error, LateError), self.open
            raise self.error(str(error)) from error
        except ValueError as error:  # includes msgspec's errors
            raise self._unreadable(str(error)) from error
        if answer is not None:
            self.open -= 1
        if isinstance(answer, protocol.Failed):
            self.alive, self.link.leaving = False, True  # the host gave its reason
            raise protocol.sanitized_failure(answer, self.vehicles).error(self.vehicles)
        return answer

    def _unreadable(self, why: str) -> AgentError:
        self.release(f"the run rejects the answer of this host: {why}")
        self.alive = False  # the host may still answer
        return self.error(f"sent an invalid answer: {why}")


class RemoteHost:
    """A `cosim.federate.RemoteFederate` for agents that run in hosts."""

    slot = wake_slot = Slot.AGENT
    wakes: tuple[str, ...] = ()

    def __init__(
        self,
        name: str,
        crews: Sequence[Crew],
        built: Sequence[protocol.Built],  # descriptions of the agents, including the expected ones of missing hosts
        *,
        missing: Sequence[AgentSpec] = (),  # specs of agents without a host yet
        door: Callable[[], None] = lambda: None,  # handles join requests; called at each tick at which an agent is missing
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.name, self._door, self._tell = name, door, tell
        self.agents = tuple(info for each in built for info in each.agents)
        self.reads = tuple(dict.fromkeys(key for each in built for key in each.reads))
        self.latest = tuple(key for each in built for key in each.latest)
        self._latency_ns = {info.vehicle: info.latency_ns for info in self.agents}
        self._infos = {info.vehicle: info for info in self.agents}
        self._trains: dict[Ticks, frozenset[str]] = {}
        for info in self.agents:
            self._trains[info.ticks] = self._trains.get(info.ticks, frozenset()) | {info.vehicle}
        self.lookahead_ns = min(info.latency_ns for info in self.agents)
        self._crews = list(crews)  # hosts that receive steps
        self._others: list[Crew] = []  # hosts that owe an answer before their next step
        self._open_steps: deque[_OpenStep] = deque()
        self._missing = tuple(missing)
        self._away: dict[str, Absence] = {}
        self._newest: dict[str, Event] = {}  # newest events that absent vehicles have received
        specs = [*chain.from_iterable(crew.specs for crew in crews), *missing]
        policies = {spec.on_lost for spec in specs}
        self._may_go_on = policies != {"stop"}
        self._replaceable = frozenset(self.latest) if "hold" in policies else frozenset()
        self._following: set[str] = set()  # vehicles that have announced a slot in a formation
        self.losses: list[tuple[str, float, str]] = []  # vehicles, time (s) and cause of each loss of a host
        self._failed: dict[str, Crew] = {}  # agents that failed inside a host that still runs

    def start(self, run: RunInfo) -> int | None:
        """Send every agent its identity and start pose."""
        self._run, self._names = run, frozenset(run.vehicles)
        self._mail = Mailboxes(run.vehicles, [info.vehicle for info in self.agents])
        for crew in self._crews:
            crew.send(protocol.Begin(run))
        for crew in list(self._crews):
            try:
                crew.receive()
            except AgentError:
                if crew.indispensable:
                    raise
                self._crews.remove(crew)
                self._others.append(crew)
                self._missing += crew.specs
        return 0

    def ask(self, now_ns: int, inbox: Sequence[Event]) -> int | None:
        """Send the step. The next wake-up follows from the agents' ticks, independent of the answer."""
        open_step = _OpenStep(now_ns, self._due(now_ns))
        self._open_steps.append(open_step)
        batches = [event.value for event in inbox if isinstance(event.value, Receptions)]
        for batch in batches:
            self._mail.put(batch)
        if batches:
            inbox = [event for event in inbox if event.key != RECEPTIONS]
        if self._replaceable:
            self._newest.update((event.key, event) for event in inbox if event.key in self._replaceable)
        if self._away:
            self._mail.take(now_ns, self._away)  # lost
        if self._missing:
            self.losses += [(spec.vehicle, now_ns / SECOND_NS, "it has no host yet") for spec in self._missing]
            open_step.events += self._leave(self._missing, now_ns, "it has no host yet")
            self._missing = ()
        if self._away:
            inbox = self._look_around(open_step, inbox)
        whole = len(self._crews) == 1 and not self._away
        for crew in self._crews:
            events = list(inbox)
            if not whole:
                events = [event for event in inbox if vehicle_of(event.key) in crew.vehicles]
            received = self._mail.take(now_ns, crew.vehicles)
            if received is not None:
                events.append(Event(RECEPTIONS, now_ns, pruned(received)))
            crew.send(protocol.Act(now_ns, events))
            open_step.crews.append(crew)
        return min([train.after(now_ns) for train in self._trains])

    def answer(self) -> Sequence[Event]:
        """The events of the oldest open step."""
        open_step = self._open_steps.popleft()
        events, now_ns = open_step.events, open_step.now_ns
        for crew in open_step.crews:
            effects = {vehicle: now_ns + self._latency_ns[vehicle] for vehicle in crew.vehicles if vehicle in open_step.due}
            try:
                answer = crew.stepped(effects, self._names)
            except FederateError as error:
                events += self._lose(crew, now_ns, error)
            else:
                accepted = answer
                if self._away:
                    accepted = [event for event in answer if vehicle_of(event.key) not in self._away]
                events += accepted
                if self._may_go_on:
                    self._note(answer, crew)
        for vehicle, absence in self._away.items():
            events += absence.go_on(now_ns + self._latency_ns[vehicle])
        return events

    def _due(self, now_ns: int) -> frozenset[str]:
        due = [vehicles for train, vehicles in self._trains.items() if len(self._trains) == 1 or train.hits(now_ns)]
        return due[0] if len(due) == 1 else frozenset().union(*due)

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Send the step and wait for its events."""
        next_ns = self.ask(now_ns, inbox)
        return Step(self.answer(), next_ns)

    def release(self) -> None:
        """Tell all hosts that still answer that the run is over."""
        for crew in (*self._crews, *self._others):
            crew.release("the run is over")

    def close(self) -> None:
        """Wait until the agents are closed and release the hosts; then raise the first failure that matters."""
        failure: VcmvspError | None = None
        for crew in self._crews:
            try:
                crew.close()
            except VcmvspError as error:
                failure = failure or (error if crew.indispensable else None)
        for crew in self._others:
            crew.link.close()
        if failure:
            raise failure

    # --- lost, returning and replacement hosts --------------------------------------------------------------------------------

    def accepts_host_for(self, vehicle: str) -> bool:
        """Whether this vehicle may get another host; called by Zenoh's thread, too."""
        absence = self._away.get(vehicle)
        return absence is not None and not absence.final

    def welcome(self, crew: Crew) -> None:
        """Accept a replacement for a lost host; it receives steps once its agents are built."""
        for lost in [each for each in self._others if not set(each.vehicles).isdisjoint(crew.vehicles)]:
            self._dismiss(lost, "another host has replaced it")
        self._others.append(crew)

    def _lose(self, crew: Crew, now_ns: int, error: FederateError) -> list[Event]:
        if crew.indispensable:
            raise error
        self.losses.append((", ".join(crew.vehicles), now_ns / SECOND_NS, error.cause))
        self._crews.remove(crew)
        for open_step in self._open_steps:
            open_step.crews = [each for each in open_step.crews if each is not crew]
        if crew.alive and any(spec.on_lost == "hold" for spec in crew.specs):
            self._others.append(crew)
        else:
            crew.dismiss(error.cause)
        return self._leave([spec for spec in crew.specs if spec.vehicle not in self._away], now_ns, error.cause)

    def _leave(self, specs: Sequence[AgentSpec], now_ns: int, why: str) -> list[Event]:
        news: list[Event] = []
        for spec in specs:
            info, follows = self._infos[spec.vehicle], spec.vehicle in self._following
            absence = Absence(spec, info.ticks.after(now_ns - 1), now_ns + info.latency_ns, why, follows=follows)
            self._away[spec.vehicle] = absence
            if spec.vehicle not in self._failed:  # else already reported
                news += absence.news
        return news

    def _note(self, events: Sequence[Event], crew: Crew) -> None:
        for event in events:
            if isinstance(event.value, Follows):
                (self._following.discard if event.value.leader is None else self._following.add)(vehicle_of(event.key))
            elif isinstance(event.value, Presence):
                self._failed[vehicle_of(event.key)] = crew

    def _look_around(self, open_step: "_OpenStep", inbox: Sequence[Event]) -> Sequence[Event]:
        """Reinstate vehicles whose agents answer again; returns the events that all present hosts receive."""
        self._door()
        for crew in list(self._others):
            try:
                if self._is_ready(crew):
                    inbox = self._take_back(crew, open_step, inbox)
            except VcmvspError as error:
                self._tell(f"{error}")
                self._dismiss(crew, str(error))
        if not self._away:
            self._door()  # closes admission again
        return inbox

    def _is_ready(self, crew: Crew) -> bool:
        while crew.open:
            answer = crew.look()
            if answer is None:
                return False
            if isinstance(answer, protocol.Built):
                for info in crew.validate_built(answer).agents:
                    expected = self._infos[info.vehicle]
                    if msgspec.structs.replace(info, agent=expected.agent) != expected:
                        raise crew.error("differs from the agent at the start of the run in its parameters or period")
                crew.send(protocol.Begin(self._run))
        return True

    def _take_back(self, crew: Crew, open_step: "_OpenStep", inbox: Sequence[Event]) -> Sequence[Event]:
        self._others.remove(crew)
        self._crews.append(crew)
        for vehicle in crew.vehicles:
            if not self.accepts_host_for(vehicle):
                continue
            info, absence = self._infos[vehicle], self._away.pop(vehicle)
            if self._failed.get(vehicle) is crew:
                continue  # the host is back, the agent is not
            self._failed.pop(vehicle, None)
            since_ns, when = info.ticks.after(open_step.now_ns - 1), open_step.now_ns + info.latency_ns
            open_step.events.append(absence.back(since_ns, when, crew.late))
            newest = [event for key, event in self._newest.items() if key.startswith(f"{vehicle}/")]
            inbox = [*newest, *(event for event in inbox if vehicle_of(event.key) != vehicle)]
        crew.late = 0
        return inbox

    def _dismiss(self, crew: Crew, why: str) -> None:
        self._others.remove(crew)
        crew.dismiss(why)


class _OpenStep(msgspec.Struct):
    now_ns: int
    due: frozenset[str]  # vehicles with a tick in this step
    crews: list[Crew] = []  # hosts that received the step
    events: list[Event] = []  # events of absent vehicles
