"""Hosts that answer nonsense: the run ends in time, with one error that names them and a readable recording."""

import copy
import io
import math
import random
import tracemalloc
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest
from mcap.reader import make_reader

import vcmvsp
from tests.support.cosim.memory_links import MemoryLink, behind_the_wire
from vcmvsp.agents.federate import AgentHost
from vcmvsp.cosim.agent import AgentSpec
from vcmvsp.cosim.errors import AgentError, FederateError, ScenarioError, VcmvspError
from vcmvsp.cosim.federate import Event, RunInfo
from vcmvsp.cosim.hosts import protocol, remote_host
from vcmvsp.cosim.hosts.host_client import Desk
from vcmvsp.cosim.hosts.remote_host import RemoteHost
from vcmvsp.cosim.types import VehicleState

pytestmark = pytest.mark.slow

SCENARIO = {
    "name": "hostile",
    "duration_s": 0.4,
    "physics": {"kind": "kinematic"},
    "radio": {"preset": "ideal"},
    "vehicle": [
        {"name": "car1", "kind": "kinematic", "agent": {"kind": "trajectory"}},
        {"name": "car2", "kind": "kinematic", "pose": [-1.0, 0.0, 0.0], "agent": {"kind": "leader_follower", "leader": "car1"}},
    ],
}
RUN = RunInfo(scenario="hostile", seed=1, duration_ns=10**9, vehicles=("car1", "car2"))
SPEC = AgentSpec(
    vehicle="car2",
    kind="leader_follower",
    folder="",
    params={"leader": "car1"},
    defaults={},
    period_s=0.1,
    latency_s=0.0,
    source="hostile.toml",
)
INBOX = [Event("car2/estimate", 0, VehicleState(position=(0.0, 0.0, 0.0)))]
ERRORS = (AgentError, FederateError, ScenarioError)
ODD: list[Any] = [
    *(None, True, -1, 0, 2**31, 2**63, 2**64 - 1, -(2**63), 0.5, math.nan, math.inf, 1e308, "", "car1", "car1/command", "**"),
    *("\x1b[2J", "\u202e", "x" * 5000, b"", b"\xff" * 100, [], {}, [[]], {"": None}, {"type": "Stepped"}, {1: 2}),
    *(["|O", [1], b"\0" * 8], ["<f8", [2**62], b""], {"type": "states"}, {"type": "note", "values": {}}, [0] * 3000),
    *(msgspec.msgpack.Ext(5, b"x"), msgspec.msgpack.Ext(-1, b"\0" * 12), ["car2/command", 0, {"type": "velocity"}]),
]


LATER = [msgspec.structs.replace(event, time_ns=10**8) for event in INBOX]
QUESTIONS = [
    protocol.encode(question)
    for question in (
        *(protocol.Build((SPEC,)), protocol.Begin(RUN), protocol.Act(0, INBOX)),
        *(protocol.Act(10**8, LATER), protocol.End("over")),
    )
]


def honest_answers() -> list[bytes]:
    """Answers of a host from beginning to end, and both kinds of failure."""
    desk = Desk(AgentHost)
    answers = list(map(desk.handle, QUESTIONS))
    assert desk.failure is None
    failures = [protocol.Failed("it broke", "Traceback\n", ("car2",), "leader_follower")]
    failures += [protocol.Failed("must be a number", key="vehicle.car2.agent.k1", source="a.toml", bad_scenario=True)]
    return answers + list(map(protocol.encode, failures))


HONEST = honest_answers()
STEPPED = b"\x82\xa4type\xa7Stepped\xa6events"  # a list follows


def deep(levels: int) -> bytes:
    return random.Random(levels).choice([b"\x91", b"\x81\xa1a"]) * levels + b"\xc0"


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of all items in nested lists and mappings."""
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield (*path, key)
        yield from places(value[key], (*path, key))


def misshapen(draw: random.Random, honest: Sequence[bytes]) -> bytes:
    """An honest answer with some parts replaced, removed, repeated or renamed."""
    value = msgspec.msgpack.decode(draw.choice(honest))
    for _ in range(draw.choice([1, 1, 2, 5])):
        path = draw.choice(list(places(value)) or [()])
        if not path:
            break
        parent = value
        for key in path[:-1]:
            parent = parent[key]
        how = draw.randrange(4)
        if how == 0 and isinstance(parent, dict):
            parent[draw.choice(["", "type", "key", "events", 7, None, b"x"])] = parent.pop(path[-1])
        elif how == 1:
            del parent[path[-1]]
        elif how == 2 and isinstance(parent, list):
            parent += [copy.deepcopy(parent[path[-1]])] * draw.choice([1, 30])
        else:
            parent[path[-1]] = copy.deepcopy(draw.choice(ODD))
    return msgspec.msgpack.encode(value)


def flipped(draw: random.Random, honest: Sequence[bytes], counts: Sequence[int] = (1, 2, 8)) -> bytes:
    data = bytearray(draw.choice(honest))
    for _ in range(draw.choice(counts)):
        data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    return bytes(data)


def truncated(draw: random.Random, honest: Sequence[bytes]) -> bytes:
    data = draw.choice(honest)
    return data[: draw.randrange(len(data))]


def spliced(draw: random.Random, honest: Sequence[bytes]) -> bytes:
    other = draw.choice(honest)
    return truncated(draw, honest) + other[draw.randrange(len(other)) :]


def noise(draw: random.Random, honest: Sequence[bytes]) -> bytes:
    return draw.randbytes(draw.choice([0, 1, 5, 40, 400]))


def nested(draw: random.Random, honest: Sequence[bytes]) -> bytes:
    return draw.choice([b"", STEPPED]) + deep(draw.choice([60, 900, 1100, 10**5]))


def oversized(draw: random.Random, honest: Sequence[bytes]) -> bytes:
    """A list, mapping, text, bytes or extension whose declared size exceeds the bytes behind it."""
    head, size = bytes([draw.choice([0xC6, 0xC9, 0xDB, 0xDD, 0xDF])]), draw.choice([2**20, 2**31 - 1, 2**32 - 1])
    return draw.choice([b"", STEPPED]) + (head + size.to_bytes(4, "big")) * draw.choice([1, 100])


def out_of_turn(draw: random.Random, honest: Sequence[bytes]) -> bytes:
    return draw.choice(honest)


NONSENSE: dict[Callable[[random.Random, Sequence[bytes]], bytes], int] = {
    misshapen: 1200,
    flipped: 800,
    spliced: 300,
    noise: 300,
    truncated: 200,
    nested: 200,
    oversized: 200,
    out_of_turn: 200,
}
"""Kinds of nonsense, and numbers of examples."""


def ask(turn: int, nonsense: bytes) -> list[Event]:
    """Events of a host that sends ``nonsense`` as answer number ``turn``; all other answers are honest."""
    answers = iter([*HONEST[:turn], nonsense, *HONEST[turn + 1 : 5]])
    crew = remote_host.Crew(MemoryLink(lambda _: next(answers)), [SPEC], deadline_s=2.0, build_s=2.0)
    host = RemoteHost("agents", [crew], [crew.build()])
    host.start(RUN)
    events = [*host.step(0, INBOX).events, *host.step(10**8, []).events]
    host.close()
    return events


def assert_clean(error: VcmvspError) -> None:
    """The error names its vehicles or is one of the scenario, and contains no terminal control characters."""
    text = str(error)
    assert isinstance(error, ScenarioError) or "car2" in text or "car1" in text
    assert text.replace("\n", "").isprintable()
    assert len(text) < 2000


@pytest.mark.parametrize("kind", NONSENSE)
def test_nonsense_ends_in_an_error_that_names_the_host(kind: Callable[[random.Random, Sequence[bytes]], bytes]) -> None:
    draw, failed = random.Random(1), 0
    for number in range(NONSENSE[kind]):
        nonsense = kind(draw, HONEST)
        try:
            events = ask(number % 5, nonsense)
        except ERRORS as error:
            assert_clean(error)
            failed += 1
        else:  # the change may have given another valid answer
            assert {event.key.partition("/")[0] for event in events} <= {"car2"}
            protocol.encode(events)
    assert failed > 0.4 * NONSENSE[kind]


def test_nonsense_takes_no_memory_beyond_its_own_size() -> None:
    """At most one Python object per byte: an empty mapping has 64 bytes, its place in a list 8."""
    size = 2**20
    for filler in (b"\x80", b"\x90", b"\xc0", b"\x01", b"\x91" * 500 + b"\xc0"):
        body = b"\xdd" + size.to_bytes(4, "big") + (filler * size)[:size]
        tracemalloc.start()
        with pytest.raises(ERRORS):
            ask(2, STEPPED + body)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 100 * size
    tracemalloc.start()
    for data in (deep(10**6), b"\xdd\xff\xff\xff\xff" * 1000, (b"\xdd" + (2**20).to_bytes(4, "big")) * 900 + b"\xc0" * 2**20):
        with pytest.raises(ERRORS):
            ask(2, data)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 200 * size


class Hostile(MemoryLink):
    """Answers honestly, except for ``nonsense`` as answer number ``turn``."""

    turn, nonsense = -1, b""

    def __init__(self, handle: Callable[[bytes], bytes]) -> None:
        super().__init__(handle)
        self._turn = 0

    def answer(self) -> bytes:
        honest = super().answer()
        self._turn += 1
        return self.nonsense if self._turn == self.turn else honest


def run(**more: Any) -> vcmvsp.Result:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of huge numbers, which are valid in commands
        return vcmvsp.run(SCENARIO, **more)


@pytest.fixture
def answers() -> Iterator[list[bytes]]:
    """Answers of the host in an honest run; from then on hosts are `Hostile`."""
    received: list[bytes] = []

    class Listening(MemoryLink):
        def answer(self) -> bytes:
            received.append(super().answer())
            return received[-1]

    with behind_the_wire(Listening):
        reference = run().metrics["digest"]
    Hostile.turn = -1
    with behind_the_wire(Hostile):
        assert run().metrics["digest"] == reference
        yield received


def test_a_run_with_a_hostile_host_ends_with_its_error_and_a_readable_recording(answers: list[bytes], tmp_path: Path) -> None:
    draw, begun = random.Random(2), 0
    for number in range(60):
        kind = draw.choice(list(NONSENSE))
        Hostile.turn, Hostile.nonsense = draw.randrange(1, len(answers) + 1), kind(draw, answers)
        try:
            result: vcmvsp.Result | None = run()
        except ERRORS as error:
            assert_clean(error)
            result = error.result
        if result is None:  # the run had not begun
            assert Hostile.turn <= 2
            continue
        begun += 1
        folder = result.save(tmp_path / str(number)) if number % 50 == 25 else None
        recording = (folder / "run.mcap").read_bytes() if folder else result._mcap.getvalue()  # type: ignore[union-attr]
        topics = {channel.topic for _, channel, _ in make_reader(io.BytesIO(recording)).iter_messages()}
        assert {"log", "car1/state", "car2/state"} <= topics
        assert result.states.num_rows > 0
    assert begun > 30


@pytest.mark.parametrize("on_lost", ["hold", "remove"])
def test_a_run_with_optional_hosts_continues_despite_nonsense(on_lost: str, answers: list[bytes]) -> None:
    draw, lost = random.Random(on_lost), 0
    for _ in range(26):
        kind = draw.choice(list(NONSENSE))
        Hostile.turn, Hostile.nonsense = draw.randrange(3, len(answers)), kind(draw, [*answers, *HONEST[5:]])
        result = run(set={"agents.on_lost": on_lost, "agents.hold_s": 0.1}, mcap=False)
        assert result.metrics["duration_s"] == SCENARIO["duration_s"]
        assert result.about["error"] is None
        lost += any(each["missed"] for each in result.metrics["agents"].values())
    assert lost > 13


# --- greetings, and questions to a host ---


def test_nonsense_in_a_greeting_is_a_value_error() -> None:
    draw = random.Random(3)
    honest = protocol.encode(protocol.Hello("1" * 32, protocol.PROTOCOL, ("car2",), kind="still.py:Still", params={"k1": 1.0}))
    for number in range(2000):
        content = flipped(draw, [honest], (1, 4)) if number % 2 else draw.randbytes(100)
        try:
            hello = protocol.hellos.decode(content)
        except ValueError:
            continue
        assert all(isinstance(vehicle, str) for vehicle in hello.vehicles)
        protocol.encode(hello)


def test_a_host_answers_nonsense_with_its_error() -> None:
    """The host then ends: no real run sends such questions."""
    draw, failed = random.Random(4), 0
    for number in range(1000):
        desk = Desk(AgentHost)
        turn = number % 5
        for question in QUESTIONS[:turn]:
            desk.handle(question)
        damaged = flipped(draw, QUESTIONS[turn : turn + 1], (1, 4))
        nonsense = [damaged, draw.randbytes(60), deep(1200), draw.choice(QUESTIONS)][number % 4]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            answer = protocol.answers.decode(desk.handle(nonsense))
        assert isinstance(answer, protocol.Failed) == (desk.failure is not None)
        assert desk.failure is None or desk.ended
        failed += isinstance(answer, protocol.Failed)
        desk.close()
    assert failed > 300
