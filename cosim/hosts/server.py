"""A host of agents as it runs where the agents are: it answers the questions of `cosim.hosts.protocol`."""

import traceback
from collections.abc import Mapping, Sequence
from typing import Protocol

from vcmvsp.cosim.agent import Agent, AgentInfo, AgentSpec
from vcmvsp.cosim.config.source_code import fingerprint
from vcmvsp.cosim.errors import FederateError, Interrupted, VcmvspError, words_of
from vcmvsp.cosim.federate import Federate
from vcmvsp.cosim.hosts import protocol


class BuildsHost(Protocol):
    """How a `Desk` makes its federate: `agents.federate.AgentHost`, without this module knowing that part."""

    def __call__(self, name: str, specs: Sequence[AgentSpec], objects: Mapping[str, Agent] | None = None, /) -> "HostFederate":
        """A federate with these agents; ``objects``: those that exist already, by vehicle."""


class HostFederate(Federate, Protocol):
    """A federate that says which agents it holds."""

    agents: tuple[AgentInfo, ...]


class Desk:
    """The host's side: answers one question after the other with the federate that it builds."""

    def __init__(self, builds: BuildsHost) -> None:
        self._builds = builds
        self._federate: HostFederate | None = None
        self.ended: str | None = None  # why there will be no more questions
        self.failure: VcmvspError | None = None  # ... if something went wrong here

    def handle(self, question: bytes | memoryview) -> bytes:
        """The answer to a question; whatever goes wrong becomes a `Failed`."""
        try:
            return protocol.encode(self._answer(protocol.questions.decode(question)))
        except VcmvspError as error:
            self.failure = error
        except KeyboardInterrupt:
            self.failure = Interrupted("interrupted at its host")
        except BaseException as error:  # a host must answer, whatever its agents do
            details = "".join(traceback.format_exception(error))
            self.failure = FederateError("host", words_of(error), details=details)
        self.ended = str(self.failure)
        return protocol.encode(protocol.Failed.of(self.failure))

    def _answer(self, question: protocol.Question) -> protocol.Answer:
        if isinstance(question, protocol.Build):
            if self._federate is not None:
                raise FederateError("host", "was asked to build twice")
            self._federate = self._builds("host", question.specs)
            code = {spec.vehicle: fingerprint(spec) for spec in question.specs}
            return protocol.Built(self._federate.agents, self._federate.reads, self._federate.latest, code)
        if isinstance(question, protocol.End):
            self.ended = question.reason
            self.close()
            return protocol.Ended()
        if self._federate is None:
            raise FederateError("host", "was asked to step before it was told what to build")
        if isinstance(question, protocol.Begin):
            self._federate.start(question.run)
            return protocol.Stepped([])
        step = self._federate.step(question.now_ns, question.inbox)
        return protocol.Stepped(list(step.events))

    def close(self) -> None:
        """Close the federate, once."""
        federate, self._federate = self._federate, None
        if federate is not None:
            federate.close()
