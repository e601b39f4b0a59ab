"""Host of agents: one federate for all agents of a process.

It collects the published data of a vehicle into an `Observation`, calls the agent, and turns its command, messages and notes
into events that take effect at tick + latency (`agents.agent_runner`).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from vcmvsp.agents.agent_runner import NEVER_NS, AgentRunner
from vcmvsp.agents.factory import Kinds
from vcmvsp.cosim.agent import Agent, AgentSpec
from vcmvsp.cosim.federate import Event, RunInfo, Slot, Step


class AgentHost:
    """A federate with agents, one per vehicle.

    Args:
        name: of the federate.
        specs: specifications of the agents.
        objects: existing agents, by vehicle; the rest of their specification still applies.
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
        receivers = {f"{seat.vehicle}/heard": seat.hear for seat in self._seats}
        latest = {f"{seat.vehicle}/{what}": see for seat in self._seats for what, see in seat.sees.items()}
        self.reads, self.latest = tuple(receivers), tuple(latest)
        self._takes: dict[str, Callable[[Any], None]] = receivers | latest  # receivers of values, by key

    def start(self, run: RunInfo) -> int | None:
        """Start all agents; the first tick of each is at time 0."""
        for seat in self._seats:
            seat.start(run)
        return 0

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Distribute the inbox and run every agent that has a tick now."""
        takes = self._takes
        for event in inbox:
            takes[event.key](event.value)
        events: list[Event] = []
        after = [ticks.after(now_ns) for ticks in self._trains]
        next_ns = NEVER_NS
        for seat, train in zip(self._seats, self._train, strict=True):
            if seat.next_ns <= now_ns:
                seat.tick(now_ns, after[train], events)
            next_ns = seat.next_ns if seat.next_ns < next_ns else next_ns  # noqa: FURB136  a call less than min()
        return Step(events, next_ns)

    def close(self) -> None:
        """Close every started agent, even after a failure; the first failure is raised at the end."""
        failures = [error for seat in self._seats if (error := seat.close())]
        if failures:
            raise failures[0]
