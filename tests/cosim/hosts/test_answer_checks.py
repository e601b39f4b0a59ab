"""Answers of a host are compared with the requests: all answers of an honest host pass, all others are refused."""

import math
import struct
import sys
import unicodedata
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vcmvsp import Agent
from vcmvsp.agents.federate import AgentHost
from vcmvsp.cosim.agent import AgentInfo, AgentSpec
from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.federate import Event, RunInfo
from vcmvsp.cosim.hosts import protocol
from vcmvsp.cosim.types import (
    AnyValue,
    Fix,
    Follows,
    Message,
    Note,
    Presence,
    ProbabilityMap,
    Sightings,
    VehicleState,
    Velocity,
    Waypoint,
)
from vcmvsp.cosim.util.codec import Decoder, encode
from vcmvsp.cosim.util.text import plain

pytestmark = pytest.mark.slow

NAMES = frozenset({"car1", "car2", "car3"})
OWN = {"car2": 100, "car3": 250}
FINITE = st.floats(-1e6, 1e6)
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=8) | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)


class ScriptedAgent(Agent):
    """Executes a script: (command, follows, notes, messages) for each tick."""

    def __init__(self, script: Any) -> None:
        self._script = iter(script)

    def act(self, obs: Any, radio: Any) -> Any:
        command, follows, notes, messages = next(self._script)
        self.follows = follows
        self.note(**notes)
        for body, more in messages:
            radio.send(body, **more)
        return command


VELOCITY = st.builds(Velocity, linear=st.tuples(FINITE, FINITE, FINITE), yaw_rate=FINITE)
WAYPOINT = st.builds(Waypoint, position=st.tuples(FINITE, FINITE, FINITE), yaw=st.none() | FINITE, speed=st.none() | FINITE)
FOLLOWS = st.builds(Follows, leader=st.sampled_from(["car1", "car3"]), slot=st.tuples(FINITE, FINITE), handle_m=FINITE)
MORE = st.fixed_dictionaries(
    {"to": st.sampled_from([None, "car1", "car3"]), "priority": st.integers(-(2**63), 2**63 - 1)},
    optional={"size_bytes": st.integers(0, 2**31 - 1)},
)
TURN = st.tuples(
    st.none() | VELOCITY | WAYPOINT,
    st.none() | FOLLOWS,
    st.dictionaries(st.sampled_from(["age_s", "status"]), st.floats() | st.text(max_size=8) | st.booleans(), max_size=2),
    st.lists(st.tuples(st.dictionaries(st.text(max_size=8), PLAIN, max_size=3) | st.binary(max_size=8), MORE), max_size=3),
)


def spec(vehicle: str, **more: Any) -> AgentSpec:
    common: dict[str, Any] = {
        "kind": "free",
        "folder": "",
        "params": {},
        "defaults": {},
        "period_s": None,
        "latency_s": 0.0,
        "source": "a.toml",
    }
    return AgentSpec(vehicle=vehicle, **{**common, **more})


@settings(max_examples=50)
@given(st.lists(TURN, max_size=4), st.sampled_from([0.0, 0.03]))
def test_all_answers_of_an_honest_host_pass(script: list[Any], latency_s: float) -> None:
    specs = [spec("car2", latency_s=latency_s)]
    host = AgentHost("host", specs, {"car2": ScriptedAgent(script)})
    protocol.check_built(protocol.Built(host.agents, host.reads, host.latest), specs)
    host.start(RunInfo(scenario="a", seed=1, duration_ns=10**9, vehicles=("car1", "car2", "car3")))
    for k in range(len(script)):
        now_ns = k * 100_000_000
        state = Event("car2/estimate", now_ns, VehicleState(position=(0.0, 0.0, 0.0)))
        step = host.step(now_ns, [state])
        answer = protocol.answers.decode(protocol.encode(protocol.Stepped(list(step.events))))
        assert isinstance(answer, protocol.Stepped)
        protocol.check_events(answer.events, {"car2": now_ns + round(latency_s * 1e9)}, NAMES)


def message(**more: Any) -> Message:
    return Message(**{"sender": "car2", "body": {"x": 1.0}, "size_bytes": 10, **more})


def deep(levels: int) -> Any:
    value: Any = 1
    for level in range(levels):
        value = [value] if level % 2 else {"deeper": value}
    return value


MAP = ProbabilityMap(
    left=0.0, bottom=0.0, cell_m=1e300, probability=np.zeros((1, 1), np.uint8), seen=np.zeros((1, 1), np.bool_)
)
REFUSED: list[tuple[str, int, Any, str]] = [
    ("car9/command", 100, Velocity(), "an event of car9"),
    ("car1/command", 100, Velocity(), "an event of car1"),
    ("world/states", 100, Velocity(), "an event of world"),
    ("", 100, Velocity(), "an event of "),
    ("\x1b[31mcar2", 100, Velocity(), "an event of car2"),
    ("car2", 100, Velocity(), "car2, a topic that agents may not publish"),
    ("car2/", 100, Velocity(), "agents may not publish"),
    ("car2/state", 100, Velocity(), "car2/state, a topic that agents may not publish"),
    ("car2/heard", 100, Velocity(), "agents may not publish"),
    ("car2/estimate", 100, VehicleState(position=(0.0, 0.0, 0.0)), "agents may not publish"),
    ("car2/fix", 100, Fix(time_ns=0, position=(0.0, 0.0, 0.0), sigma_m=0.0), "agents may not publish"),
    ("car2/command/more", 100, Velocity(), "agents may not publish"),
    ("car2/*", 100, Velocity(), "agents may not publish"),
    ("car2/command", 5, Velocity(), "car2/command at 5 ns, expected 100 ns"),
    ("car2/command", 250, Velocity(), "car2/command at 250 ns, expected 100 ns"),
    ("car3/command", 100, Velocity(), "car3/command at 100 ns, expected 250 ns"),
    ("car2/command", -1, Velocity(), "at -1 ns"),
    ("car2/command", 2**63, Velocity(), "expected 100 ns"),
    ("car2/command", 100, Note(values={}), "car2/command of type Note"),
    ("car2/note", 100, Velocity(), "car2/note of type Velocity"),
    ("car2/send", 100, Velocity(), "car2/send of type Velocity"),
    ("car2/follows", 100, Velocity(), "car2/follows of type Velocity"),
    ("car2/host", 100, Velocity(), "car2/host of type Velocity"),
    ("car2/command", 100, Velocity(linear=(math.nan, 0.0, 0.0)), "a command that is not finite"),
    ("car2/command", 100, Velocity(linear=(math.inf, -math.inf, 0.0)), "a command that is not finite"),
    ("car2/command", 100, Velocity(yaw_rate=math.inf), "a command that is not finite"),
    ("car2/command", 100, Waypoint(position=(0.0, 0.0, math.nan)), "a command that is not finite"),
    ("car2/command", 100, Waypoint(position=(0.0, 0.0, 0.0), yaw=math.nan), "a command that is not finite"),
    ("car2/command", 100, Waypoint(position=(0.0, 0.0, 0.0), speed=math.inf), "a command that is not finite"),
    ("car2/map", 100, MAP, "car2/map with cells of 1e"),
    ("car2/mosaic", 100, MAP, "car2/mosaic of type ProbabilityMap"),
    ("car2/sightings", 100, Sightings(sensor="c", time_ns=0, width=0, height=9, found=()), "with a picture of 0 x 9 pixels"),
    ("car2/follows", 100, Follows(leader="car2"), "leader car2, which is not another vehicle of this run"),
    ("car2/follows", 100, Follows(leader="car9"), "leader car9, which is not another vehicle of this run"),
    ("car2/send", 100, message(sender="car9"), "a message of car2 with the sender car9"),
    ("car2/send", 100, message(sender="car3"), "a message of car2 with the sender car3"),
    ("car2/send", 100, message(to="car2"), "a message to itself"),
    ("car2/send", 100, message(to="car9"), "a message to car9, which is not a vehicle of this run"),
    ("car2/send", 100, message(size_bytes=-1), "a message of -1 bytes"),
    ("car2/send", 100, message(size_bytes=2**31), f"a message of {2**31} bytes"),
    ("car2/send", 100, message(priority=2**63), "exceeds 64 bits"),
    ("car2/send", 100, message(priority=-(2**63) - 1), "exceeds 64 bits"),
    ("car2/send", 100, message(body={"a": {None: 1}}), "a message that cannot be recorded"),
    ("car2/send", 100, message(body={"a": {True: 1}}), "a message that cannot be recorded"),
    ("car2/send", 100, message(body={"a": {(1, 2): 1}}), "a message that cannot be recorded"),
    ("car2/send", 100, message(body={"a": msgspec.msgpack.Ext(5, b"x")}), "a message that cannot be recorded"),
    ("car2/send", 100, message(body={"a": deep(64)}), "nest at most 64 lists and mappings, not"),
    ("car2/send", 100, message(body={"a": deep(900)}), "a message (with more than 64 lists|that cannot be recorded)"),
    ("car2/host", 100, Presence(state="lost", since_ns=101), "car2/host since 101 ns"),
    ("car2/host", 100, Presence(state="lost", since_ns=-1), "car2/host since -1 ns"),
    ("car2/host", 100, Presence(state="lost", since_ns=0, why="x" * 501), "a reason that is too long or cannot be shown"),
]


@pytest.mark.parametrize(("key", "time_ns", "value", "cause"), REFUSED, ids=[cause for *_, cause in REFUSED])
def test_forbidden_events_are_refused(key: str, time_ns: int, value: Any, cause: str) -> None:
    good = Event("car3/command", 250, Velocity())
    with pytest.raises(ValueError, match=cause.replace("(0", r"\(0")):
        protocol.check_events([good, Event(key, time_ns, value)], OWN, NAMES)


def test_one_command_a_turn_and_any_number_of_messages() -> None:
    turn = [Event("car2/command", 100, Velocity()), Event("car3/command", 250, Velocity())]
    turn += [Event("car2/send", 100, message(body={"a": deep(63)})), Event("car2/send", 100, message(body=b"\xff" * 1000))]
    turn += [Event("car2/send", 100, message(body={"brackets": "[{" * 1000, "flat": [[]] * 1000}))]
    protocol.check_events(turn, OWN, NAMES)
    rare: list[AnyValue] = [Velocity(), Follows(leader=None), Note(values={}), Presence(state="removed", since_ns=0)]
    for again, value in zip(("command", "follows", "note", "host"), rare, strict=True):
        with pytest.raises(ValueError, match=f"car2/{again} twice"):
            protocol.check_events([Event(f"car2/{again}", 100, value)] * 2, OWN, NAMES)


@given(st.dictionaries(st.text(max_size=4), PLAIN, max_size=3))
def test_valid_events_can_be_recorded_and_sent_on(body: dict[str, Any]) -> None:
    """As JSON, for the recording, and as MessagePack, for the next host."""
    event = Event("car2/send", 100, message(body=body))
    protocol.check_events([event], OWN, NAMES)
    msgspec.json.encode(event.value)
    encode(event)


def specs() -> list[AgentSpec]:
    return [spec("car2", latency_s=0.05, sensors=("lidar",), defaults={"k1": 1.0}), spec("car3", period_s=0.02, kind="other")]


def answer(**changes: Any) -> protocol.Built:
    """Answer of an honest host to `specs`; ``changes`` apply to the first agent, or to agents, reads and latest."""
    whole = {name: changes.pop(name) for name in ("agents", "reads", "latest") if name in changes}
    first: dict[str, Any] = {
        "vehicle": "car2",
        "agent": "free",
        "ticks": Ticks.every(0.1),
        "latency_ns": 50_000_000,
        "params": {"k1": 1.0},
    }
    first |= {"known": ("k1",), "taken": ("k1",), "sensors": ("lidar",), **changes}
    second = {
        **first,
        "params": {},
        "vehicle": "car3",
        "agent": "other",
        "ticks": Ticks.every(0.02),
        "latency_ns": 0,
        "taken": (),
    }
    agents = [AgentInfo(**each) for each in (first, second)]
    sees = [f"{vehicle}/{topic}" for vehicle in ("car2", "car3") for topic in ("estimate", "odometry", "fix")]
    fields = {"agents": agents, "reads": ["radio/receptions"], "latest": [*sees, "car2/lidar"], **whole}
    return protocol.Built(tuple(fields["agents"]), tuple(fields["reads"]), tuple(fields["latest"]))


def test_requested_agents_are_accepted_in_any_order() -> None:
    honest = answer()
    protocol.check_built(honest, specs())
    protocol.check_built(protocol.Built(honest.agents[::-1], honest.reads[::-1], honest.latest[:2]), specs())


BUILT: list[tuple[dict[str, Any], str]] = [
    ({"agents": ()}, "agents for none; expected car2, car3"),
    ({"agents": answer().agents[:1]}, "agents for car2; expected car2, car3"),
    ({"agents": answer().agents + answer().agents[:1]}, "agents for car2, car2, car3; expected car2, car3"),
    ({"vehicle": "car3"}, "agents for car3, car3; expected"),
    ({"vehicle": "car1"}, "agents for car1, car3; expected car2, car3"),
    ({"ticks": Ticks(0)}, "car2 with a period of 0/1 ns"),
    ({"ticks": Ticks(-5)}, "a period of -5/1 ns"),
    ({"ticks": Ticks(10**8, 0)}, "a period of 100000000/0 ns"),
    ({"ticks": Ticks(-(10**8), -1)}, "a period"),
    ({"ticks": Ticks(999)}, "a period of 999/1 ns; allowed are 1e-06 s to"),
    ({"ticks": Ticks(10**15 + 1)}, "a period"),
    ({"ticks": Ticks(10**15 * 3 + 1, 3)}, "a period"),
    ({"latency_ns": 0}, "car2 with a latency of 0 ns, expected 0.05 s"),
    ({"latency_ns": -1}, "a latency of -1 ns"),
    ({"agent": "another"}, "the class another, expected free"),
    ({"taken": ("k2",)}, "a default that .agents. does not have: k2"),
    ({"known": ("a\nb",)}, "parameters that are too many, too long or cannot be shown"),
    ({"sensors": ("x" * 101,)}, "sensors that are too many, too long or cannot be shown"),
    ({"known": ("a",) * 1001}, "parameters that are too many"),
    ({"params": {"k2": 1.0}}, "an unknown parameter: k2"),
    ({"params": {"kind": "os:system"}, "known": ("kind",)}, "an unknown parameter: kind"),
    ({"params": {"fails_s": 1.0}, "known": ("fails_s",)}, "an unknown parameter: fails_s"),
    ({"params": {"k1": None}}, "parameters that a scenario cannot express"),
    ({"params": {"k1": {"b": None}}}, "parameters that a scenario cannot express"),
    ({"params": {"k1": b"raw"}}, "parameters that a scenario cannot express"),
    ({"params": {"k1": {1: 2}}}, "parameters that a scenario cannot express"),
    ({"params": {"k1": {None: 2}}}, "parameters that a scenario cannot express"),
    ({"params": {"k1": msgspec.msgpack.Ext(5, b"x")}}, "parameters that a scenario cannot express"),
    ({"params": {"k1": deep(900)}}, "parameters that a scenario cannot express"),
    ({"params": {"k1": "x" * 2**20}}, "parameters of .* characters"),
    ({"reads": ["car2/heard"]}, "a subscription to car2/heard, which its agents may not read"),
    ({"reads": ["car2/send"]}, "subscription to car2/send"),
    ({"reads": ["**"]}, r"subscription to \*\*"),
    ({"reads": ["*/heard"]}, "subscription to"),
    ({"reads": ["car2/*"]}, "subscription to"),
    ({"reads": ["car2/**"]}, "subscription to"),
    ({"reads": ["world/states"]}, "subscription to world/states"),
    ({"reads": ["radio/receptions"] * 2}, "two subscriptions to radio/receptions"),
    ({"latest": ["car3/lidar"]}, "subscription to car3/lidar"),
    ({"latest": ["car2/state"]}, "subscription to car2/state"),
    ({"latest": ["car1/estimate"]}, "subscription to car1/estimate"),
    ({"latest": ["car2/estimate/**"]}, "subscription to"),
]


@pytest.mark.parametrize(("changes", "cause"), BUILT, ids=[f"{number} {cause}" for number, (_, cause) in enumerate(BUILT)])
def test_unrequested_answers_are_refused(changes: dict[str, Any], cause: str) -> None:
    with pytest.raises(ValueError, match=cause):
        protocol.check_built(answer(**changes), specs())


def test_a_period_of_the_scenario_binds_and_a_period_of_the_class_does_not() -> None:
    protocol.check_built(answer(ticks=Ticks.every(0.5)), specs())
    fixed = [spec("car2", latency_s=0.05, sensors=("lidar",), defaults={"k1": 1.0}, period_s=0.1), specs()[1]]
    protocol.check_built(answer(), fixed)
    with pytest.raises(ValueError, match=r"a period of 0.5 s, expected 0.1 s"):
        protocol.check_built(answer(ticks=Ticks.every(0.5)), fixed)


@given(
    st.text(alphabet=st.characters() | st.sampled_from("\x1b\x9b\x9d[]m;0\n\r\x07\\\u202e"), max_size=60), st.integers(3, 40)
)
def test_plain_text_is_printable_short_and_on_one_line(text: str, limit: int) -> None:
    shown = plain(text, limit)
    assert len(shown) <= limit
    assert not any(unicodedata.category(each)[0] == "C" or each in "\u2028\u2029" for each in shown)
    assert plain(shown, limit) == shown
    lines = plain(text, limit, lines=True)
    assert lines.replace("\n", "").isprintable()


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("all is well: 20 °C, äöü, 東京", "all is well: 20 °C, äöü, 東京"),
        ("a\x1b[31mred\x1b[0m b", "ared b"),
        ("\x1b]0;your title\x07b", "b"),
        ("\x1b]8;;http://evil\x1b\\click\x1b]8;;\x1b\\", "click"),
        ("\x9b31mred", "red"),
        ("\x1bcgone", "gone"),
        ("two\nlines\r\n", "two lines  "),
        ("\u202egnorw", " gnorw"),
        ("\x1b", " "),
        pytest.param("x" * 10**7, "x" * 497 + "...", id="long"),
    ],
)
def test_terminal_control_is_removed(text: str, shown: str) -> None:
    assert plain(text) == shown


def test_tracebacks_keep_their_lines() -> None:
    assert plain("a\n\tb\x1b[2J", lines=True) == "a\n b"


def test_a_failure_blames_its_own_vehicles_alone() -> None:
    failure = protocol.Failed(cause="\x1b[2Jit broke", details="a\nb", vehicles=("car1", "car3", "car3"), agent="x\ny")
    cleaned = protocol.sanitized_failure(failure, ("car2", "car3"))
    assert (cleaned.cause, cleaned.details, cleaned.vehicles, cleaned.agent) == ("it broke", "a\nb", ("car3",), "x y")
    for blamed, shown in ((("car1",), ("car2", "car3")), ((), ())):
        failure = msgspec.structs.replace(failure, vehicles=blamed)
        assert protocol.sanitized_failure(failure, ("car2", "car3")).vehicles == shown


@pytest.mark.parametrize("opening", [b"\x91", b"\x81\xa1a", b"\x81"])
@pytest.mark.parametrize("levels", [10**5, 10**6] + [2000] * (sys.version_info < (3, 12)))  # later Python versions decode 2000
def test_too_deep_nesting_is_a_value_error(opening: bytes, levels: int) -> None:
    anything: Decoder[Any] = Decoder(Any)
    with pytest.raises(ValueError, match=r"nested too deeply|malformed"):
        anything.decode(opening * levels + b"\xc0")


@pytest.mark.parametrize(
    "head", [b"\xdd", b"\xdf", b"\xdb", b"\xc6", b"\xc9"], ids=["list", "map", "text", "bytes", "extension"]
)
@pytest.mark.parametrize("size", [2**24, 2**31 - 1, 2**32 - 1])
def test_a_size_beyond_the_message_is_an_error_before_memory_is_taken(head: bytes, size: int) -> None:
    """Once alone, and nested 900 times, each time with enough bytes behind it to be plausible."""
    for decoder in (protocol.answers, protocol.hellos, Decoder[Any](Any), Decoder[Any](tuple[str, ...])):
        for data in (head + struct.pack(">I", size), (head + struct.pack(">I", 2**20)) * 900 + b"\0" * 2**20):
            with pytest.raises(ValueError, match=r".+"):
                decoder.decode(data)


def test_decoder_errors_contain_no_terminal_control() -> None:
    for word in ("\x1b[2J", "\u202e", "x" * 10**6):
        with pytest.raises(msgspec.ValidationError, match=r"Invalid value") as caught:
            protocol.answers.decode(msgspec.msgpack.encode({"type": word}))
        assert str(caught.value).isprintable()
        assert len(str(caught.value)) <= 300


def test_greetings_contain_no_terminal_control() -> None:
    honest = protocol.Hello("a1", protocol.PROTOCOL, ("car2",), kind="still.py:Still", folder="/home/pi")
    protocol.check_greeting(honest)
    for bad in ("\x1b[2J", "car2\n", "x" * 5000):
        for change in ({"vehicles": ("car2", bad)}, {"kind": bad}):
            with pytest.raises(ValueError, match="too long or cannot be shown"):
                protocol.check_greeting(msgspec.structs.replace(honest, **change))
