"""The link to a host of agents, which carries bytes, and its crew, which speaks the language of `cosim.hosts.protocol`."""

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from vcmvsp.cosim.agent import AgentSpec
from vcmvsp.cosim.errors import AgentError, ScenarioError
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.hosts import answer_checks, protocol


class LinkError(Exception):
    """No answer will come; the message says why, e.g. ``was killed by SIGKILL``."""


class LateError(LinkError, TimeoutError):
    """No answer came in time; it may still come."""


class SessionLink(Protocol):
    """One host, reachable: questions are answered in order."""

    leaving: bool  # set when it is let go, so that nobody wonders where it is

    def ask(self, question: bytes, deadline_s: float) -> None:
        """Send a question that is to be answered within so much wall-clock time; do not wait."""

    def answer(self) -> bytes:
        """Wait for the answer to the oldest open question; `LinkError` if none comes in time or at all."""

    def look(self) -> bytes | None:
        """The answer to the oldest open question, if it is there, however late; `LinkError` if none will come."""

    def close(self) -> None:
        """Let the host go."""


class MemoryLink:
    """A `SessionLink` within the process: the bytes that would cross a wire, encoded and decoded."""

    leaving = False

    def __init__(self, handle: Callable[[bytes], bytes]) -> None:
        self._handle = handle
        self._answers: list[bytes] = []

    def ask(self, question: bytes, deadline_s: float) -> None:
        """Have it answered at once."""
        self._answers.append(self._handle(question))

    def answer(self) -> bytes:
        """The answer to the oldest open question."""
        return self._answers.pop(0)

    def look(self) -> bytes | None:
        """The same, if there is a question."""
        return self._answers.pop(0) if self._answers else None

    def close(self) -> None:
        """Nothing to let go."""


class Crew:
    """The agents of one host, and the questions that the host has not answered yet.

    Args:
        link: to the host.
        specs: the agents that it is to build, which it is asked at once.
        deadline_s: wall-clock seconds within which it has to answer a step.
        build_s: the same for building its agents, which may load large libraries.
        on_built: takes what the host says that it has built.

    Attributes:
        alive: it may still answer.
        open: how many questions it has not answered.
        late: how many it had not answered when it was lost.
    """

    def __init__(
        self,
        link: SessionLink,
        specs: Sequence[AgentSpec],
        *,
        deadline_s: float,
        build_s: float,
        on_built: Callable[[protocol.Built], None] = lambda _: None,
    ) -> None:
        self.link, self.specs, self._on_built = link, tuple(specs), on_built
        self.vehicles = tuple(spec.vehicle for spec in specs)
        self._deadline_s, self._build_s = deadline_s, build_s
        self._released = False
        self.alive, self.open, self.late = True, 0, 0
        self.send(protocol.Build(self.specs), build_s)

    def build(self) -> protocol.Built:
        """Wait until the agents stand; the constructor has asked for it, so that all hosts build at once."""
        try:
            return self.built(self.receive())
        except AgentError as error:
            if isinstance(error.__cause__, TimeoutError):
                raise self.error(f"did not build its agents within {self._build_s:g} s (agents.join_timeout_s)") from error
            raise

    def built(self, answer: protocol.Answer) -> protocol.Built:
        """The answer to `Build`, which is believed only in what it may say."""
        if not isinstance(answer, protocol.Built):
            raise self._unreadable(f"it answered {type(answer).__name__} to Build")
        try:
            answer_checks.built(answer, self.specs)
        except ValueError as error:
            raise self._unreadable(str(error)) from error
        self._on_built(answer)
        return answer

    def stepped(self, effects: Mapping[str, int], names: frozenset[str]) -> list[Event]:
        """Wait for the answer to a step; its events are those of these vehicles alone, at these times."""
        try:
            answer = self.receive()
        except ScenarioError as error:  # it is too late to speak of the scenario
            raise self.error(str(error)) from error
        if not isinstance(answer, protocol.Stepped):
            raise self._unreadable(f"it answered {type(answer).__name__} to a step")
        try:
            answer_checks.events(answer.events, effects, names)
        except ValueError as error:
            raise self._unreadable(str(error)) from error
        return answer.events

    def send(self, question: protocol.Question, deadline_s: float | None = None) -> None:
        """Ask, without waiting."""
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
        """The answer to the oldest open question, if it is there."""
        return self._read(self.link.look)

    def release(self, reason: str) -> None:
        """Tell the host that it is not needed any more, if it still answers."""
        if self.alive and not self._released:
            self._released = self.link.leaving = True
            self.send(protocol.End(reason))

    def dismiss(self, why: str) -> None:
        """Let the host go without waiting for it."""
        self.release(why)
        self.link.close()

    def close(self) -> None:
        """Wait until the agents are closed, and let the host go."""
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
        """An error that names these agents."""
        return AgentError(self.vehicles, ", ".join(dict.fromkeys(spec.kind for spec in self.specs)), cause)

    def _read(self, take: Callable[[], bytes | None]) -> protocol.Answer | None:
        try:
            content = take()
            answer = None if content is None else protocol.answers.decode(content)
        except LinkError as error:
            self.alive, self.late = isinstance(error, LateError), self.open
            raise self.error(str(error)) from error
        except ValueError as error:  # msgspec's errors among them
            raise self._unreadable(str(error)) from error
        if answer is not None:
            self.open -= 1
        if isinstance(answer, protocol.Failed):
            self.alive, self.link.leaving = False, True  # it has said why it goes
            raise answer_checks.failed(answer, self.vehicles).error(self.vehicles)
        return answer

    def _unreadable(self, why: str) -> AgentError:
        self.release(f"it does not accept what this host answers: {why}")
        self.alive = False
        return self.error(f"gave an answer that is refused: {why}")
