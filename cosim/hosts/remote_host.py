"""Agents elsewhere as the kernel sees them: one federate for those of one host, or of several that have come in its place.

A host that is lost, while the scenario wants the run to go on, leaves its vehicles without an agent
(`cosim.hosts.lost_agent`). They get it back when the host answers again, or when another one comes in its place. When that is
depends on the wall clock; the recording is told.
"""

from collections import deque
from collections.abc import Callable, Sequence

import msgspec

from vcmvsp.cosim.agent import AgentSpec
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import AgentError, FederateError, VcmvspError
from vcmvsp.cosim.federate import Event, RunInfo, Slot, Step
from vcmvsp.cosim.hosts import protocol
from vcmvsp.cosim.hosts.lost_agent import Absence
from vcmvsp.cosim.hosts.session import Crew
from vcmvsp.cosim.types import Follows, Presence


class RemoteHost:
    """A `cosim.federate.RemoteFederate` for agents elsewhere.

    Args:
        name: of the federate.
        crews: the hosts that are there.
        built: what they say of their agents, and what is known of those that nobody hosts yet.
        missing: specs of the latter.
        door: looks whether somebody knocks; called at each tick at which an agent is away.
        tell: takes lines for the user.

    Attributes:
        losses: vehicles, time (s) and cause of each loss of a host.
    """

    slot = wake_slot = Slot.AGENT
    wakes: tuple[str, ...] = ()

    def __init__(
        self,
        name: str,
        crews: Sequence[Crew],
        built: Sequence[protocol.Built],
        *,
        missing: Sequence[AgentSpec] = (),
        door: Callable[[], None] = lambda: None,
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.name, self._door, self._tell = name, door, tell
        self.agents = tuple(info for each in built for info in each.agents)
        self.reads = tuple(key for each in built for key in each.reads)
        self.latest = tuple(key for each in built for key in each.latest)
        self._latency_ns = {info.vehicle: info.latency_ns for info in self.agents}
        self._infos = {info.vehicle: info for info in self.agents}
        trains = dict.fromkeys(info.ticks for info in self.agents)
        self._trains = {each: frozenset(info.vehicle for info in self.agents if info.ticks == each) for each in trains}
        self.lookahead_ns = min(info.latency_ns for info in self.agents)
        self._crews = list(crews)  # those that are asked
        self._others: list[Crew] = []  # those that have yet to answer what they were asked, before they are asked again
        self._asked: deque[_Asked] = deque()
        self._missing = tuple(missing)
        self._away: dict[str, Absence] = {}
        self._kept: dict[str, Event] = {}  # the newest that vehicles have seen which are away
        policies = {spec.on_lost for crew in crews for spec in crew.specs} | {spec.on_lost for spec in missing}
        self._may_go_on = policies != {"stop"}
        self._replaceable = frozenset(self.latest) if "hold" in policies else frozenset()
        self._following: set[str] = set()  # who means to keep a place
        self.losses: list[tuple[str, float, str]] = []
        self._failed: dict[str, Crew] = {}  # agents that failed inside a host that is still there

    def start(self, run: RunInfo) -> int | None:
        """Have the agents told who and where they are."""
        self._run, self._names = run, frozenset(run.vehicles)
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
        """Send the step; the next wake-up follows from the agents' ticks, whatever the answer will be."""
        asked = _Asked(now_ns, self._due(now_ns))
        self._asked.append(asked)
        if self._replaceable:
            self._kept.update((event.key, event) for event in inbox if event.key in self._replaceable)
        if self._missing:
            self.losses += [(spec.vehicle, now_ns / SECOND_NS, "it has no host yet") for spec in self._missing]
            asked.events += self._leave(self._missing, now_ns, "it has no host yet")
            self._missing = ()
        if self._away:
            inbox = self._look_around(asked, inbox)
        whole = len(self._crews) == 1 and not self._away
        for crew in self._crews:
            mine = inbox if whole else [event for event in inbox if _vehicle(event) in crew.vehicles]
            crew.send(protocol.Act(now_ns, mine))
            asked.crews.append(crew)
        return self._next(now_ns)

    def answer(self) -> Sequence[Event]:
        """The events of the oldest step that is still open."""
        asked = self._asked.popleft()
        events, now_ns = asked.events, asked.now_ns
        for crew in asked.crews:
            effects = {vehicle: now_ns + self._latency_ns[vehicle] for vehicle in crew.vehicles if vehicle in asked.due}
            try:
                given = crew.stepped(effects, self._names)
            except FederateError as error:
                events += self._lose(crew, now_ns, error)
            else:
                events += [event for event in given if _vehicle(event) not in self._away] if self._away else given
                if self._may_go_on:
                    self._note(given, crew)
        for vehicle, absence in self._away.items():
            events += absence.go_on(now_ns + self._latency_ns[vehicle])
        return events

    def _due(self, now_ns: int) -> frozenset[str]:
        """Whose tick this is; of all, since they were asked for, where all have the same ticks."""
        due = [whose for train, whose in self._trains.items() if len(self._trains) == 1 or train.hits(now_ns)]
        return due[0] if len(due) == 1 else frozenset().union(*due)

    def _next(self, now_ns: int) -> int:
        return min([train.after(now_ns) for train in self._trains])

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Ask and wait."""
        next_ns = self.ask(now_ns, inbox)
        return Step(self.answer(), next_ns)

    def release(self) -> None:
        """Tell the hosts that the run is over, as far as they still answer."""
        for crew in (*self._crews, *self._others):
            crew.release("the run is over")

    def close(self) -> None:
        """Wait until the agents are closed, and let the hosts go; the first failure that matters is raised at the end."""
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

    # --- hosts that are lost, and those that come back or instead -------------------------------------------------------------

    def wants(self, vehicle: str) -> bool:
        """Whether this vehicle may have another host. Zenoh's thread may ask, too."""
        absence = self._away.get(vehicle)
        return absence is not None and not absence.final

    def welcome(self, crew: Crew) -> None:
        """Take a host in place of the one that was lost; it is asked as soon as its agents stand."""
        for lost in [each for each in self._others if not set(each.vehicles).isdisjoint(crew.vehicles)]:
            self._dismiss(lost, "another host has come in its place")
        self._others.append(crew)

    def _lose(self, crew: Crew, now_ns: int, error: FederateError) -> list[Event]:
        """A host has not answered: what its vehicles do from now on; the error itself, if one of them must not be lost."""
        if crew.indispensable:
            raise error
        self.losses.append((", ".join(crew.vehicles), now_ns / SECOND_NS, error.cause))
        self._crews.remove(crew)
        for asked in self._asked:
            asked.crews = [each for each in asked.crews if each is not crew]
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
            if spec.vehicle not in self._failed:  # else it has been said
                news += absence.news
        return news

    def _note(self, events: Sequence[Event], crew: Crew) -> None:
        """Who means to keep a place, and whose agent has failed."""
        for event in events:
            if isinstance(event.value, Follows):
                (self._following.discard if event.value.leader is None else self._following.add)(_vehicle(event))
            elif isinstance(event.value, Presence):
                self._failed[_vehicle(event)] = crew

    def _look_around(self, asked: "_Asked", inbox: Sequence[Event]) -> Sequence[Event]:
        """Take back those who have an agent again; the answer is what all who are there are to know."""
        self._door()
        for crew in list(self._others):
            try:
                if self._is_ready(crew):
                    inbox = self._take_back(crew, asked, inbox)
            except VcmvspError as error:
                self._tell(f"{error}")
                self._dismiss(crew, str(error))
        if not self._away:
            self._door()  # to shut it
        return inbox

    def _is_ready(self, crew: Crew) -> bool:
        """Whether a host has answered all that it was asked."""
        while crew.open:
            answer = crew.look()
            if answer is None:
                return False
            if isinstance(answer, protocol.Built):
                for info in crew.built(answer).agents:
                    expected = self._infos[info.vehicle]
                    if msgspec.structs.replace(info, agent=expected.agent) != expected:
                        raise crew.error("is not the agent that the run began with: its parameters or its period differ")
                crew.send(protocol.Begin(self._run))
        return True

    def _take_back(self, crew: Crew, asked: "_Asked", inbox: Sequence[Event]) -> Sequence[Event]:
        self._others.remove(crew)
        self._crews.append(crew)
        for vehicle in crew.vehicles:
            if not self.wants(vehicle):
                continue
            info, absence = self._infos[vehicle], self._away.pop(vehicle)
            if self._failed.get(vehicle) is crew:
                continue  # the host is back, the agent is not
            self._failed.pop(vehicle, None)
            since_ns, when = info.ticks.after(asked.now_ns - 1), asked.now_ns + info.latency_ns
            asked.events.append(absence.back(since_ns, when, crew.late))
            seen = [event for key, event in self._kept.items() if key.startswith(f"{vehicle}/")]
            inbox = [*seen, *(event for event in inbox if _vehicle(event) != vehicle)]
        crew.late = 0
        return inbox

    def _dismiss(self, crew: Crew, why: str) -> None:
        self._others.remove(crew)
        crew.dismiss(why)


class _Asked:
    """A step that has been asked: whose turn it is, who was asked, and what is to be said of the others."""

    def __init__(self, now_ns: int, due: frozenset[str]) -> None:
        self.now_ns, self.due = now_ns, due
        self.crews: list[Crew] = []
        self.events: list[Event] = []


def _vehicle(event: Event) -> str:
    return event.key.partition("/")[0]
