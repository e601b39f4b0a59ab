"""Host of vehicles that programs of a stack drive (`cosim.federate.Stack`) in place of agents."""

from collections import defaultdict
from collections.abc import Mapping, Sequence

from vcmvsp.agents.driven_host import OutsideHost
from vcmvsp.agents.federate import AgentRunner
from vcmvsp.cosim.agent import Agent, AgentSpec, Observation
from vcmvsp.cosim.errors import AgentError
from vcmvsp.cosim.federate import Event, Log, RunInfo, Stack, StackAnswer, vehicle_of
from vcmvsp.cosim.hosts.remote_host import LinkError
from vcmvsp.cosim.recording.external_inputs import Input
from vcmvsp.cosim.types import Message, Presence, Velocity, Waypoint

OWN = ("estimate", "odometry", "battery")  # given at ticks only; all other readings at their own times


class StackHost(OutsideHost):
    """Passes readings and observations to a stack, and its answers to the run.

    ``log`` receives each answer, for a replay: ``<vehicle>/command``, ``<vehicle>/send`` and, without one, ``<vehicle>/host``.
    """

    def __init__(
        self, name: str, specs: Sequence[AgentSpec], objects: Mapping[str, Agent] | None = None, *, stack: Stack, log: Log
    ) -> None:
        super().__init__(name, specs, objects)
        self._stack, self._log = stack, log
        self._readings = tuple(key for key in self.latest if key.partition("/")[2] not in OWN)
        self.latest = tuple(key for key in self.latest if key not in self._readings)
        self.reads, self.wakes = (*self.reads, *self._readings), self._readings

    def start(self, run: RunInfo) -> int | None:
        """Let the programs connect."""
        first = super().start(run)
        self._stack.start(run)
        return first

    def ask(self, now_ns: int, inbox: Sequence[Event]) -> int | None:
        """Pass on readings, and the observations of the vehicles with a tick now."""
        self._stack.show(now_ns, [event for event in inbox if event.key in self._readings])
        next_ns = super().ask(now_ns, inbox)
        self._stack.ask(self.observations)
        return next_ns

    def answer(self) -> Sequence[Event]:
        """The events of the programs' commands and messages, in effect from now + latency on."""
        for seat in self._open:
            when = self._now_ns + seat.info.latency_ns
            if seat.absence is not None and seat.absence.final:
                continue
            try:
                answer = self._stack.answer(seat.vehicle)
            except LinkError as lost:
                self._lose(seat, when, str(lost))
                continue
            if seat.absence is not None:
                self._events.append(seat.absence.back(self._now_ns, when, 0))
                seat.absence = None
            self._conclude(seat, answer, when)
        self.observations, self._open = {}, []
        return self._events

    def close(self) -> None:
        """End all connections."""
        self._stack.close()
        super().close()

    def _conclude(self, seat: AgentRunner, answer: StackAnswer, when: int) -> None:
        command = None if answer.command is None else seat.checked(answer.command)
        if command is not None:
            self._log(f"{seat.vehicle}/command", self._now_ns, command)
        for content, to in answer.messages:
            size = seat.radio.send(content, to=to)
            message = Message(sender=seat.vehicle, body=content, size_bytes=size, to=to)
            self._log(f"{seat.vehicle}/send", self._now_ns, message)
        seat.conclude(command, when, self._events)

    def _lose(self, seat: AgentRunner, when: int, cause: str) -> None:
        self._log(f"{seat.vehicle}/host", self._now_ns, Presence(state="lost", since_ns=self._now_ns, why=cause))
        error = AgentError((seat.vehicle,), self.name, cause)
        if seat.spec.on_lost == "stop":
            raise error
        if seat.absence is None:
            seat.leave(self._now_ns, error, self._events)
        else:
            self._events.extend(seat.absence.go_on(when))


class RecordedStack:
    """The answers of an earlier run's stack, from its recorded ``inputs`` (`cosim.federate.Stack`)."""

    def __init__(self, vehicles: tuple[str, ...], inputs: Sequence[Input]) -> None:
        self.vehicles = vehicles
        self._answers: defaultdict[tuple[str, int], StackAnswer] = defaultdict(StackAnswer)
        self._lost: dict[tuple[str, int], str] = {}
        self._now_ns = 0
        for key, time_ns, value in inputs:
            place = vehicle_of(key), time_ns
            match value:
                case Velocity() | Waypoint():
                    self._answers[place] = self._answers[place]._replace(command=value)
                case Message(body=content, to=to):
                    before = self._answers[place]
                    self._answers[place] = before._replace(messages=(*before.messages, (content, to)))
                case Presence(why=why):
                    self._lost[place] = why

    def start(self, run: RunInfo) -> None:
        """No program connects."""

    def show(self, now_ns: int, readings: Sequence[Event]) -> None:
        """The readings are not passed on."""
        self._now_ns = now_ns

    def ask(self, observations: Mapping[str, Observation]) -> None:
        """The observations are not passed on."""

    def answer(self, vehicle: str) -> StackAnswer:
        """The recorded answer."""
        place = vehicle, self._now_ns
        if place in self._lost:
            raise LinkError(self._lost[place])
        return self._answers[place]

    def close(self) -> None:
        """Nothing is open."""
