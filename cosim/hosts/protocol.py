"""Messages between the kernel and a host of agents: one question and one answer at a time (`cosim.util.codec`).

=========  ==============================================  =========================
question   meaning                                         answer
=========  ==============================================  =========================
`Build`    build these agents                              `Built`, or `Failed`
`Begin`    start the agents, each with its identity        `Stepped`, or `Failed`
`Act`      these events have happened; it is now ``now``   `Stepped`, or `Failed`
`End`      the run is over, or this host is not needed     `Ended`
=========  ==============================================  =========================

Hosts are untrusted: answers are validated against the questions. A host that exceeds its rights is lost, and an error or the
recording gives the reason. Causes are worded to follow ``gave an answer that is refused:``.
"""

import hashlib
import hmac
import math
import struct
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import msgspec
import tomli_w

from vcmvsp.cosim.agent import LARGEST_MESSAGE_BYTES, SHOWN, AgentInfo, AgentSpec, Shown, check_body, unfit
from vcmvsp.cosim.clock import SECOND_NS, Ticks, seconds_to_ns
from vcmvsp.cosim.config.source_code import MOST_FILES
from vcmvsp.cosim.errors import AgentError, FederateError, ScenarioError, VcmvspError
from vcmvsp.cosim.federate import Event, RunInfo
from vcmvsp.cosim.scenario.schema import AgentTable
from vcmvsp.cosim.types import RECEPTIONS, Follows, Message, Note, Presence, Velocity, Waypoint
from vcmvsp.cosim.util import codec
from vcmvsp.cosim.util.codec import Unpacker, pack
from vcmvsp.cosim.util.documents import read_toml
from vcmvsp.cosim.util.text import LONGEST_DETAILS, LONGEST_LINE, LONGEST_NAME, plain

PROTOCOL = 10
"""Version of the protocol; the hub refuses hosts of other versions."""


Machine = tuple[str, str]
"""Name of a machine, from its certificate, and the id of its session."""

numbers = struct.Struct("<QQ")
"""Header of a question: its number, from 1 on, and that of the oldest open question."""

FAREWELL = 0
"""Question number of the message that the run expects no more answers."""

number = struct.Struct("<Q")
"""Header of an answer: the number of its question."""

SEAL = 16  # bytes

_MANY = 8  # from so many events in a step, arrays are cheaper to send together

LARGEST_PARAMS_BYTES = 2**20
"""Largest size of an agent's parameters as TOML: a path of some 20 000 points."""

PERIODS_NS = range(SECOND_NS // 10**6, SECOND_NS * 10**6 + 1)
"""Periods that `cosim.types.Period` allows."""

_OF_SCENARIO = frozenset(AgentTable.__struct_fields__) - {"params"}  # keys of an agent in a scenario, without its parameters
_INT64 = range(-(2**63), 2**63)
_SEES = ("estimate", "odometry", "fix")  # topics of every vehicle for its own agent

_KINDS: dict[str, tuple[type, ...]] = {
    "command": (Velocity, Waypoint),
    "follows": (Follows,),
    "note": (Note,),
    "send": (Message,),
    "host": (Presence,),
    **{what: (kind,) for kind, what in SHOWN.items()},
}


class Hello(msgspec.Struct, frozen=True, tag=True):
    """Join request of a host: the vehicles whose agents it runs, and the options of its command line."""

    host: str
    protocol: int
    vehicles: tuple[str, ...]
    kind: str | None = None  # class from the command line; None: the scenario's
    folder: str = ""  # folder of a relative file in ``kind``
    params: dict[str, Any] = {}
    token: str = ""  # proof that a child process belongs to this run


class Welcome(msgspec.Struct, frozen=True, tag=True):
    """The hub's answer to a `Hello`: accepted (``refused`` is None), or refused with a reason."""

    refused: str | None = None
    patience_s: float = 2.0  # reconnect timeout of the host
    seal: bytes = b""  # key of the seals of its answers, secret between hub and host; empty: no seals


class Build(msgspec.Struct, frozen=True, tag=True):
    """Request to build these agents."""

    specs: tuple[AgentSpec, ...]


class Begin(msgspec.Struct, frozen=True, tag=True):
    """Request to start the agents at time 0."""

    run: RunInfo


class Act(msgspec.Struct, frozen=True, tag=True):
    """Request to step to ``now_ns``."""

    now_ns: int
    inbox: Sequence[Event]


class End(msgspec.Struct, frozen=True, tag=True):
    """Announcement of the last question; ``reason`` is shown to the user of a host that was started manually."""

    reason: str


class Built(msgspec.Struct, frozen=True, tag=True):
    """Answer to `Build`: the agents are built."""

    agents: tuple[AgentInfo, ...]
    reads: tuple[str, ...]
    latest: tuple[str, ...]
    code: dict[str, dict[str, str]] = {}  # fingerprints of each vehicle's code (`cosim.config.source_code.fingerprint`)


class Stepped(msgspec.Struct, frozen=True, tag=True):
    """Answer to `Begin` and `Act`: the events of the agents."""

    events: list[Event]


class Ended(msgspec.Struct, frozen=True, tag=True):
    """Answer to `End`: all agents are closed."""


class Failed(msgspec.Struct, frozen=True, tag=True):
    """An error in a host, which the kernel raises as if it had happened locally."""

    cause: str
    details: str = ""
    vehicles: tuple[str, ...] = ()
    agent: str = ""
    key: str = ""
    source: str = ""
    bad_scenario: bool = False

    @classmethod
    def of(cls, error: VcmvspError) -> "Failed":
        """The message for an error."""
        if isinstance(error, ScenarioError):
            return cls(cause=error.problem, key=error.key, source=error.source, bad_scenario=True)
        if isinstance(error, AgentError):
            return cls(cause=error.cause, details=error.details, vehicles=error.vehicles, agent=error.agent)
        return cls(cause=str(error), details=error.details if isinstance(error, FederateError) else "")

    def error(self, vehicles: Sequence[str]) -> VcmvspError:
        """The error for this message, from the host of ``vehicles``."""
        if self.bad_scenario:
            return ScenarioError(self.cause, key=self.key, source=self.source)
        if self.vehicles:
            return AgentError(self.vehicles, self.agent, self.cause, details=self.details)
        return AgentError(tuple(vehicles), "host", self.cause, details=self.details)


Question = Build | Begin | Act | End
Answer = Built | Stepped | Ended | Failed


def sealed(key: bytes, answer: bytes) -> bytes:
    """An answer with its seal in front (keyed BLAKE2, RFC 7693), so that no other session can answer for the host."""
    return hashlib.blake2b(answer, key=key, digest_size=SEAL).digest() + answer


def is_sealed(key: bytes, content: bytes) -> bool:
    """Whether content carries a valid seal of this key."""
    return hmac.compare_digest(sealed(key, content[SEAL:]), content)


def encode(value: object) -> bytes:
    """A message as bytes; `ValueError` if it cannot be encoded."""
    events: Sequence[object] = ()
    if isinstance(value, Act):
        events = value.inbox
    elif isinstance(value, Stepped):
        events = value.events
    return pack(value) if len(events) >= _MANY else codec.encode(value)


questions: Unpacker[Question] = Unpacker(Question)
answers: Unpacker[Answer] = Unpacker(Answer)
hellos: codec.Decoder[Hello] = codec.Decoder(Hello)
welcomes: codec.Decoder[Welcome] = codec.Decoder(Welcome)


def check_events(stepped: Sequence[Event], vehicles: Mapping[str, int], names: frozenset[str]) -> None:
    """Validate the events of a step: `ValueError` unless the agents of a host may publish them.

    Args:
        vehicles: the host's vehicles with a tick in this step, and the time at which their commands take effect (ns).
        names: all vehicles of the run.
    """
    keys = set[str]()
    for event in stepped:
        key = event.key
        vehicle, _, subtopic = key.partition("/")
        due_ns = vehicles.get(vehicle)
        if due_ns is None:
            raise ValueError(f"an event of {plain(vehicle, LONGEST_NAME)}, which is not one of its vehicles")
        kinds = _KINDS.get(subtopic)
        if kinds is None:
            raise ValueError(f"{plain(key, LONGEST_NAME)}, a topic that agents may not publish")
        if event.time_ns != due_ns:
            raise ValueError(f"{key} at {event.time_ns} ns, expected {due_ns} ns")
        value = event.value
        if type(value) not in kinds:
            raise ValueError(f"{key} of type {type(value).__name__}")
        if type(value) is Message:
            _message(value, vehicle, names)
            continue
        if key in keys:
            raise ValueError(f"{key} twice")
        keys.add(key)
        if type(value) is Velocity or type(value) is Waypoint:
            _command(value)
        else:
            _rare(value, vehicle, due_ns, names)


def _message(message: Message, vehicle: str, names: frozenset[str]) -> None:
    if message.sender != vehicle:
        raise ValueError(f"a message of {vehicle} with the sender {plain(message.sender, LONGEST_NAME)}")
    if message.to == vehicle:
        raise ValueError("a message to itself")
    if message.to is not None and message.to not in names:
        raise ValueError(f"a message to {plain(message.to, LONGEST_NAME)}, which is not a vehicle of this run")
    if not 0 <= message.size_bytes <= LARGEST_MESSAGE_BYTES:
        raise ValueError(f"a message of {message.size_bytes} bytes; allowed are 0 to {LARGEST_MESSAGE_BYTES}")
    if message.priority not in _INT64:
        raise ValueError(f"a message of priority {message.priority}, which exceeds 64 bits")
    if type(message.body) is dict:
        try:
            check_body(message.body)
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"a message that cannot be recorded: {plain(str(error))}") from None


def _command(command: Velocity | Waypoint) -> None:
    if isinstance(command, Velocity):
        x, y, z = command.linear
        total = x + y + z + command.yaw_rate
    else:
        x, y, z = command.position
        total = x + y + z + (command.yaw or 0.0) + (command.speed or 0.0)
    if not math.isfinite(total):
        raise ValueError(f"a command that is not finite: {command}")


def _rare(value: object, vehicle: str, due_ns: int, names: frozenset[str]) -> None:
    if type(value) is Follows and value.leader is not None and (value.leader not in names or value.leader == vehicle):
        raise ValueError(f"a leader {plain(value.leader, LONGEST_NAME)}, which is not another vehicle of this run")
    if type(value) is Presence:
        if value.state == "back" or value.late or not 0 <= value.since_ns <= due_ns:
            raise ValueError(f"{vehicle}/host since {value.since_ns} ns, {value.state}, {value.late} late, at {due_ns} ns")
        if plain(value.why) != value.why:
            raise ValueError(f"{vehicle}/host with a reason that is too long or cannot be shown")
    if isinstance(value, Shown) and (problem := unfit(value)):
        raise ValueError(f"{vehicle}/{SHOWN[type(value)]} with {problem}")


def check_built(answer: "Built", specs: Sequence[AgentSpec]) -> None:
    """Validate the answer to `Build`: `ValueError` unless it has the requested agents, with their own vehicles' topics only."""
    spec_of = {spec.vehicle: spec for spec in specs}
    vehicles = sorted(info.vehicle for info in answer.agents)
    if vehicles != sorted(spec_of):
        names = plain(", ".join(vehicles) or "none", LONGEST_LINE)
        raise ValueError(f"agents for {names}; expected {', '.join(spec_of)}")
    for info in answer.agents:
        try:
            _agent(info, spec_of[info.vehicle])
        except ValueError as error:
            raise ValueError(f"an agent for {info.vehicle} with {error}") from None
    _code(answer.code, spec_of)
    topics = {f"{spec.vehicle}/{subtopic}" for spec in specs for subtopic in (*_SEES, *spec.sensors)}
    for keys, allowed in ((answer.reads, {RECEPTIONS}), (answer.latest, topics)):
        for key in keys:
            if key not in allowed:
                raise ValueError(f"a subscription to {plain(key, LONGEST_NAME)}, which its agents may not read")
        if len(set(keys)) < len(keys):
            raise ValueError(f"two subscriptions to {next(key for key in keys if keys.count(key) > 1)}")


def _code(code: Mapping[str, Mapping[str, str]], vehicles: Collection[str]) -> None:
    for vehicle, files in code.items():
        if vehicle not in vehicles or len(files) > 2 * MOST_FILES:
            raise ValueError(f"source code of {plain(vehicle, LONGEST_NAME)} that was not requested, or of too many files")
        if any(plain(text, LONGEST_LINE) != text for text in (*files, *files.values())):
            raise ValueError(f"source code of {vehicle} with names that are too long or cannot be shown")


def _agent(info: AgentInfo, spec: AgentSpec) -> None:
    _ticks(info.ticks, spec.period_s)
    if info.latency_ns != seconds_to_ns(spec.latency_s):
        raise ValueError(f"a latency of {info.latency_ns} ns, expected {spec.latency_s:g} s")
    if info.agent != spec.kind:
        raise ValueError(f"the class {plain(info.agent, LONGEST_NAME)}, expected {spec.kind}")
    if strange := [name for name in info.taken if name not in spec.defaults]:
        raise ValueError(f"a default that [agents] does not have: {plain(strange[0], LONGEST_NAME)}")
    for names, label in ((info.known, "parameters"), (info.sensors, "sensors"), (info.files, "files")):
        if len(names) > 1000 or any(plain(name, LONGEST_NAME) != name for name in names):
            raise ValueError(f"{label} that are too many, too long or cannot be shown")
    if strange := [name for name in info.params if name not in info.known or name in _OF_SCENARIO]:
        raise ValueError(f"an unknown parameter: {plain(strange[0], LONGEST_NAME)}")
    try:
        text = tomli_w.dumps(info.params)
        read_toml(text)
    except (TypeError, ValueError, RecursionError, AttributeError) as error:
        raise ValueError(f"parameters that a scenario cannot express: {plain(str(error))}") from None
    if len(text) > LARGEST_PARAMS_BYTES:
        raise ValueError(f"parameters of {len(text)} characters; at most {LARGEST_PARAMS_BYTES}")


def check_greeting(hello: "Hello") -> None:
    """Validate a join request: `ValueError` unless its texts can be shown."""
    for text in (*hello.vehicles, hello.kind or ""):
        if plain(text, LONGEST_LINE) != text:
            raise ValueError("a name that is too long or cannot be shown")


def _ticks(ticks: Ticks, period_s: float | None) -> None:
    if ticks.ns < 1 or ticks.per < 1 or not PERIODS_NS.start <= ticks.period <= PERIODS_NS[-1]:
        raise ValueError(f"a period of {ticks.ns}/{ticks.per} ns; allowed are 1e-06 s to 1e+06 s")
    if period_s is not None and ticks != Ticks.every(period_s):
        raise ValueError(f"a period of {float(ticks.period) / SECOND_NS:g} s, expected {period_s:g} s")


def sanitized_failure(answer: "Failed", vehicles: Sequence[str]) -> "Failed":
    """A host's failure, made safe to show; it can blame only the host's own vehicles."""
    own = tuple(vehicle for vehicle in dict.fromkeys(answer.vehicles) if vehicle in vehicles)
    return msgspec.structs.replace(
        answer,
        cause=plain(answer.cause, lines=True),
        details=plain(answer.details, LONGEST_DETAILS, lines=True),
        vehicles=own if own or not answer.vehicles else tuple(vehicles),
        agent=plain(answer.agent),
        key=plain(answer.key),
        source=plain(answer.source),
    )
