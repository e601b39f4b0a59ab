"""Hosts of vehicles without an algorithm; their commands come from outside. Of `DrivenHost`: from the caller of the run."""

from collections.abc import Mapping, Sequence

from vcmvsp.agents.federate import AgentHost, AgentRunner
from vcmvsp.cosim.agent import Agent, AgentSpec, DrivenVehicle, Observation
from vcmvsp.cosim.federate import Event, RunInfo
from vcmvsp.cosim.received import ReceivedMessages
from vcmvsp.cosim.types import Receptions, Velocity, Waypoint


class OutsideHost(AgentHost):
    """A federate that gives observations at a tick (`ask`) and takes commands later within the same slot (`answer`).

    Attributes:
        observations: of the vehicles with a tick now, by vehicle; empty once their commands are taken.
        received: messages that have arrived since these vehicles' last observations, by receiver and arrival; None: none.
        from_ns: earlier ticks pass without an observation, with the last command; their messages wait for the next one.
    """

    lookahead_ns = 0

    def __init__(self, name: str, specs: Sequence[AgentSpec], objects: Mapping[str, Agent] | None = None) -> None:
        super().__init__(name, specs, objects)
        self.observations: dict[str, Observation] = {}
        self.received: Receptions | None = None
        self.from_ns = 0
        self._open: list[AgentRunner] = []  # they wait for the caller
        self._commands: dict[str, Velocity | Waypoint | None] = {}
        self._events: list[Event] = []
        self._now_ns = 0

    def start(self, run: RunInfo) -> int | None:
        """Start all agents, and give each the radio that its caller uses."""
        first = super().start(run)
        for seat in self._seats:
            if isinstance(seat.agent, DrivenVehicle):
                seat.agent.radio = seat.radio
        return first

    def ask(self, now_ns: int, inbox: Sequence[Event]) -> int | None:
        """Make the observations of the vehicles with a tick now; returns the time of the next tick."""
        self._read(inbox)
        self._now_ns, self._open, self._events = now_ns, [], []
        for seat in self._seats:
            if seat.is_due(now_ns):
                seat.next_ns = seat.info.ticks.after(now_ns)
                if now_ns >= seat.fails_ns:
                    seat.die(now_ns, self._events)
                elif now_ns >= self.from_ns:
                    self._open.append(seat)
        self._observe(now_ns)
        return min(seat.next_ns for seat in self._seats)

    def act(self, commands: Mapping[str, Velocity | Waypoint | None]) -> None:
        """Set the commands of the present tick, by vehicle; without one a vehicle keeps its last command.

        Raises:
            AgentError: a command is no command, or not finite; none of them is set then.
            KeyError: a vehicle has no tick now.
        """
        waiting = {seat.vehicle: seat for seat in self._open}
        new = {vehicle: command and waiting[vehicle].checked(command) for vehicle, command in commands.items()}
        self._commands.update(new)

    def answer(self) -> Sequence[Event]:
        """The events of the caller's commands and messages, in effect from now + latency on."""
        for seat in self._open:
            seat.conclude(self._commands.get(seat.vehicle), self._now_ns + seat.info.latency_ns, self._events)
        self.observations, self._commands, self._open = {}, {}, []
        return self._events

    def _observe(self, now_ns: int) -> None:
        self.received = self._mail.take(now_ns, [seat.vehicle for seat in self._open])
        received, nothing = self._mail.by_receiver(self.received, now_ns), ReceivedMessages.none(now_ns)
        self.observations = {seat.vehicle: seat.observe(now_ns, received.get(seat.vehicle, nothing)) for seat in self._open}

    def release(self) -> None:
        """Nothing outside this process waits."""


class DrivenHost(OutsideHost):
    """The host of the vehicles that the caller of the run drives (`vcmvsp.start`)."""

    driven = True

    def finish(self, now_ns: int, inbox: Sequence[Event]) -> None:
        """Make the last observations, at the end of the run; nothing is asked any more."""
        self._read(inbox)
        self._open = [seat for seat in self._seats if now_ns < seat.fails_ns]
        self._observe(now_ns)
