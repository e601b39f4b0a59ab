"""A host of agents as the kernel sees it (`RemoteHost`), and as it runs where the agents are (`Desk`).

Both speak the questions and answers of `cosim.transport.wire`; the `Link` between them carries bytes and knows nothing of them.
"""

import traceback
from collections.abc import Callable, Sequence
from typing import Protocol

from cosim.agent import AgentInfo, AgentSpec
from cosim.errors import AgentError, FederateError, VcmvspError
from cosim.federate import Event, Federate, RunInfo, Slot, Step
from cosim.transport import wire


class LinkError(Exception):
    """No answer will come; the message says why, e.g. ``was killed by SIGKILL``."""


class LateError(LinkError, TimeoutError):
    """No answer came in time."""


class Link(Protocol):
    """One host, reachable: questions are answered in order."""

    def ask(self, question: bytes, deadline_s: float) -> None:
        """Send a question that is to be answered within so much wall-clock time; do not wait."""

    def answer(self) -> bytes:
        """Wait for the answer to the oldest open question; `LinkError` if none comes in time or at all."""

    def close(self) -> None:
        """Let the host go."""


class BuildsHost(Protocol):
    """How a `Desk` makes its federate: `agents.federate.AgentHost`, without this module knowing that part."""

    def __call__(self, name: str, specs: Sequence[AgentSpec]) -> "HostFederate":
        """A federate with these agents."""


class HostFederate(Federate, Protocol):
    """A federate that says which agents it holds."""

    agents: tuple[AgentInfo, ...]


class RemoteHost:
    """A `cosim.federate.RemoteFederate` for the agents of one host.

    Args:
        name: of the federate.
        link: to the host.
        specs: the agents that it is to build.
        deadline_s: wall-clock seconds within which it has to answer a step.
        build_s: the same for building its agents, which may load large libraries.
    """

    slot = wake_slot = Slot.AGENT
    wakes: tuple[str, ...] = ()

    def __init__(self, name: str, link: Link, specs: Sequence[AgentSpec], *, deadline_s: float, build_s: float) -> None:
        self.name, self._link, self._deadline_s = name, link, deadline_s
        self._vehicles = tuple(spec.vehicle for spec in specs)
        self._kinds = ", ".join(dict.fromkeys(spec.kind for spec in specs))
        self._alive, self._open, self._released = True, 0, False
        self._build_s = build_s
        self._send(wire.Build(tuple(specs)), build_s)

    def build(self) -> None:
        """Wait until the agents stand; the constructor has asked for it, so that all hosts build at once."""
        try:
            built = self._receive()
        except AgentError as error:
            if isinstance(error.__cause__, TimeoutError):
                raise self._error(f"did not build its agents within {self._build_s:g} s (agents.join_timeout_s)") from error
            raise
        if not isinstance(built, wire.Built):
            raise self._error(f"answered {type(built).__name__} to Build")
        self.agents, self.reads, self.latest = built.agents, built.reads, built.latest
        self.lookahead_ns = min(info.latency_ns for info in self.agents)

    def start(self, run: RunInfo) -> int | None:
        """Have the agents told who and where they are."""
        self._send(wire.Begin(run))
        self._receive()
        return 0

    def ask(self, now_ns: int, inbox: Sequence[Event]) -> int | None:
        """Send the step; the next wake-up follows from the agents' ticks, whatever the answer will be."""
        self._send(wire.Act(now_ns, list(inbox)))
        return min(info.ticks.after(now_ns) for info in self.agents)

    def answer(self) -> Sequence[Event]:
        """The events of the oldest step that is still open."""
        stepped = self._receive()
        if not isinstance(stepped, wire.Stepped):
            raise self._error(f"answered {type(stepped).__name__} to a step")
        return stepped.events

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Ask and wait."""
        next_ns = self.ask(now_ns, inbox)
        return Step(self.answer(), next_ns)

    def release(self) -> None:
        """Tell the host that the run is over, if it still answers."""
        if self._alive and not self._released:
            self._released = True
            self._send(wire.End("the run is over"))

    def close(self) -> None:
        """Wait until the agents are closed, and let the host go."""
        try:
            self.release()
            while self._alive and self._open:
                self._receive()
        finally:
            self._link.close()

    def _send(self, question: wire.Question, deadline_s: float | None = None) -> None:
        try:
            self._link.ask(wire.encode(question), deadline_s or self._deadline_s)
        except ValueError as error:
            raise self._error(f"cannot be asked: {error}") from error
        self._open += 1

    def _receive(self) -> wire.Answer:
        try:
            answer = wire.answers.decode(self._link.answer())
        except LinkError as error:
            self._alive = False
            raise self._error(str(error)) from error
        except ValueError as error:  # msgspec's errors among them
            self._alive = False
            raise self._error(f"gave an answer that cannot be read: {error}") from error
        self._open -= 1
        if isinstance(answer, wire.Failed):
            self._alive = False
            raise answer.error(self.name)
        return answer

    def _error(self, cause: str) -> AgentError:
        return AgentError(self._vehicles, self._kinds, cause)


class Desk:
    """The host's side: answers one question after the other with the federate that it builds."""

    def __init__(self, builds: BuildsHost) -> None:
        self._builds = builds
        self._federate: HostFederate | None = None
        self.ended: str | None = None  # why there will be no more questions
        self.failure: VcmvspError | None = None  # ... if something went wrong here

    def handle(self, question: bytes) -> bytes:
        """The answer to a question; whatever goes wrong becomes a `Failed`."""
        try:
            return wire.encode(self._answer(wire.questions.decode(question)))
        except VcmvspError as error:
            self.failure = error
        except BaseException as error:  # a host must answer, whatever its agents do
            details = "".join(traceback.format_exception(error))
            self.failure = FederateError("host", f"{type(error).__name__}: {error}", details=details)
        self.ended = str(self.failure)
        return wire.encode(wire.Failed.of(self.failure))

    def _answer(self, question: wire.Question) -> wire.Answer:
        if isinstance(question, wire.Build):
            self._federate = self._builds("host", question.specs)
            return wire.Built(self._federate.agents, self._federate.reads, self._federate.latest)
        if isinstance(question, wire.End):
            self.ended = question.reason
            self.close()
            return wire.Ended()
        if self._federate is None:
            raise FederateError("host", "was asked to step before it was told what to build")
        if isinstance(question, wire.Begin):
            self._federate.start(question.run)
            return wire.Stepped([])
        step = self._federate.step(question.now_ns, question.inbox)
        return wire.Stepped(list(step.events))

    def close(self) -> None:
        """Close the federate, once."""
        federate, self._federate = self._federate, None
        if federate is not None:
            federate.close()


class MemoryLink:
    """A `Link` within the process: the same bytes as over a wire, without one. Proves that nothing is lost in translation."""

    def __init__(self, handle: Callable[[bytes], bytes]) -> None:
        self._handle = handle
        self._answers: list[bytes] = []

    def ask(self, question: bytes, deadline_s: float) -> None:
        """Have it answered at once."""
        self._answers.append(self._handle(question))

    def answer(self) -> bytes:
        """The answer to the oldest open question."""
        return self._answers.pop(0)

    def close(self) -> None:
        """Nothing to let go."""
