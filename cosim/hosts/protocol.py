"""What travels between the kernel and a host of agents: one question and one answer at a time (`cosim.hosts.array_codec`).

=========  ==============================================  =========================
question   meaning                                         answer
=========  ==============================================  =========================
`Build`    build these agents                              `Built`, or `Failed`
`Begin`    time 0 is near: tell every agent who it is      `Stepped`, or `Failed`
`Act`      these events have happened; it is now ``now``   `Stepped`, or `Failed`
`End`      the run is over, or this host is not needed     `Ended`
=========  ==============================================  =========================
"""

import hashlib
import hmac
import struct
from collections.abc import Sequence
from typing import Any

import msgspec

from vcmvsp.cosim.agent import AgentInfo, AgentSpec
from vcmvsp.cosim.errors import AgentError, FederateError, ScenarioError, VcmvspError
from vcmvsp.cosim.federate import Event, RunInfo
from vcmvsp.cosim.hosts.array_codec import Unpacker, pack
from vcmvsp.cosim.util import codec

PROTOCOL = 9
"""Version of this table; a host of another version is refused."""


Machine = tuple[str, str]
"""The name of a machine, from its certificate, and the id of its session."""


class Hello(msgspec.Struct, frozen=True, tag=True):
    """A host introduces itself: the vehicles whose agents it wants to run, and what it was told on its command line."""

    host: str
    protocol: int
    vehicles: tuple[str, ...]
    kind: str | None = None  # the class it was started with; None: the scenario's
    folder: str = ""  # where a relative file of that kind is
    params: dict[str, Any] = {}
    token: str = ""  # proves that a spawned host belongs to this run


class Welcome(msgspec.Struct, frozen=True, tag=True):
    """The hub's answer to a `Hello`: refused with a reason, or accepted (None)."""

    refused: str | None = None
    patience_s: float = 2.0  # how long the host is to wait for a run that it is cut off from
    seal: bytes = b""  # key of the seals of its answers, which the hub tells its session alone; empty: they need none


class Build(msgspec.Struct, frozen=True, tag=True):
    """Build these agents."""

    specs: tuple[AgentSpec, ...]


class Begin(msgspec.Struct, frozen=True, tag=True):
    """Get ready for time 0."""

    run: RunInfo


class Act(msgspec.Struct, frozen=True, tag=True):
    """Step to ``now_ns``."""

    now_ns: int
    inbox: Sequence[Event]


class End(msgspec.Struct, frozen=True, tag=True):
    """No more questions; ``reason`` is for the user of a host that was started by hand."""

    reason: str


class Built(msgspec.Struct, frozen=True, tag=True):
    """The agents stand."""

    agents: tuple[AgentInfo, ...]
    reads: tuple[str, ...]
    latest: tuple[str, ...]
    code: dict[str, dict[str, str]] = {}  # of each vehicle (`cosim.config.source_code.fingerprint`)


class Stepped(msgspec.Struct, frozen=True, tag=True):
    """What the step gave."""

    events: list[Event]


class Ended(msgspec.Struct, frozen=True, tag=True):
    """All agents are closed."""


class Failed(msgspec.Struct, frozen=True, tag=True):
    """What went wrong in the host, so that it can be raised in the kernel as if it had happened there."""

    cause: str
    details: str = ""
    vehicles: tuple[str, ...] = ()
    agent: str = ""
    key: str = ""
    source: str = ""
    bad_scenario: bool = False

    @classmethod
    def of(cls, error: VcmvspError) -> "Failed":
        """An error as a message."""
        if isinstance(error, ScenarioError):
            return cls(cause=error.problem, key=error.key, source=error.source, bad_scenario=True)
        if isinstance(error, AgentError):
            return cls(cause=error.cause, details=error.details, vehicles=error.vehicles, agent=error.agent)
        return cls(cause=str(error), details=error.details if isinstance(error, FederateError) else "")

    def error(self, vehicles: Sequence[str]) -> VcmvspError:
        """The error again, from the host of these vehicles."""
        if self.bad_scenario:
            return ScenarioError(self.cause, key=self.key, source=self.source)
        if self.vehicles:
            return AgentError(self.vehicles, self.agent, self.cause, details=self.details)
        return AgentError(tuple(vehicles), "host", self.cause, details=self.details)


Question = Build | Begin | Act | End
Answer = Built | Stepped | Ended | Failed

numbers = struct.Struct("<QQ")
"""Before each question: its number, from 1 on, and that of the oldest one which has not been answered."""

FAREWELL = 0
"""The number of what is no question: no answer is waited for any more."""

number = struct.Struct("<Q")
"""Before each answer: the number of its question."""

SEAL = 16  # bytes


def sealed(key: bytes, answer: bytes) -> bytes:
    """An answer with its seal in front (keyed BLAKE2, RFC 7693): another session cannot answer in a host's place."""
    return hashlib.blake2b(answer, key=key, digest_size=SEAL).digest() + answer


def is_sealed(key: bytes, content: bytes) -> bool:
    """Whether `sealed` has given this."""
    return hmac.compare_digest(sealed(key, content[SEAL:]), content)


_MANY = 8  # events of a step, from which on it costs less to send arrays together than each in its place


def encode(value: object) -> bytes:
    """A message as bytes; what cannot be sent raises a `ValueError`."""
    events = value.inbox if isinstance(value, Act) else value.events if isinstance(value, Stepped) else ()
    return pack(value) if len(events) >= _MANY else codec.encode(value)


questions: Unpacker[Question] = Unpacker(Question)
answers: Unpacker[Answer] = Unpacker(Answer)
hellos: codec.Decoder[Hello] = codec.Decoder(Hello)
welcomes: codec.Decoder[Welcome] = codec.Decoder(Welcome)
