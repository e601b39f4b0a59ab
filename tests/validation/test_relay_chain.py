"""A star of followers beyond its leader's radio range: lost without routing, kept with it (Toh 2012, 7.2)."""

import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import pytest

import vcmvsp
from tests.support.cosim.receptions import receptions_in
from tests.support.paths import SCENARIOS
from vcmvsp import Agent, Observation, Radio
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.runs.replay import replay
from vcmvsp.cosim.tables.columns import names_of, numbers
from vcmvsp.cosim.types import Routed

pytestmark = pytest.mark.processes

TEXT = (SCENARIOS / "relay-chain.toml").read_text("utf-8")
SETTINGS: dict[str, Any] = {"duration_s": 24.0, "metrics.from_s": 8.0}
CHAIN = [f"car{i + 1}" for i in range(6)]
KINDS: dict[str, dict[str, Any]] = {
    "flooding": {},
    "static": {"routing.kind": "static", "routing.chain": CHAIN},
    "distance_vector": {"routing.kind": "distance_vector"},
    "none": {"routing.kind": "none"},
}


@cache
def run(kind: str) -> vcmvsp.Result:
    return vcmvsp.run("relay-chain", set={**SETTINGS, **KINDS[kind]}, mcap=False)


@cache
def perfect() -> vcmvsp.Result:
    """The same scenario over a radio without range limit or delay."""
    scenario = {**tomllib.loads(TEXT), "radio": {"preset": "ideal"}, "routing": {"kind": "none"}}
    return vcmvsp.run(scenario, set=SETTINGS, mcap=False)


def rms_m(result: vcmvsp.Result) -> float:
    return float(result.metrics["formation"]["rms_m"])


def test_without_routing_distant_followers_receive_nothing() -> None:
    result = run("none")
    each = result.metrics["formation"]["per_follower"]
    assert all(each[name]["rms_m"] < 0.05 for name in ("car2", "car3"))
    assert all(each[name]["final_m"] > 8.0 for name in ("car4", "car5", "car6"))
    assert "routing" not in result.metrics
    assert "origin" not in result.radio.column_names
    receivers, to = names_of(result.radio, "receiver")
    received = numbers(result.radio, "received_ns", -1) >= 0
    assert {receivers[code] for code in to[received].tolist()} == {"car2", "car3"}


@pytest.mark.parametrize("kind", ["flooding", "static", "distance_vector"])
def test_with_routing_all_followers_keep_their_slots(kind: str) -> None:
    result, routing = run(kind), run(kind).metrics["routing"]
    assert rms_m(result) < 2.0 * rms_m(perfect())
    assert routing["messages"] == 240
    assert routing["hops_max"] >= 3  # spacing 10 m, range 25 m
    assert routing["delivery_ratio"] > 0.85
    assert result.metrics["radio"]["age_s"]["max"] < 1.0
    assert result.metrics["radio"]["frames"] == 240 + routing["forwarded"] + routing["control_frames"]
    assert (routing["control_frames"] > 0) == (kind == "distance_vector")


class Caller(Agent):
    """Calls the leader once a second, at rest: after 25 s the others are too far away."""

    period = 1.0

    def act(self, obs: Observation, radio: Radio) -> None:
        radio.send(at=obs.time_ns, to="car1")


@pytest.mark.parametrize("kind", ["static", "distance_vector"])
def test_an_agent_calls_another_over_several_hops(kind: str) -> None:
    events: list[Event] = []
    settings = {**SETTINGS, **KINDS[kind], "duration_s": 18.0}
    vcmvsp.run("relay-chain", set=settings, agents={"car6": Caller()}, mcap=False, observe=events.append)
    calls = [each.value for each in events if isinstance(each.value, Routed) and each.value.to == "car1"]
    receptions = [each for vehicle, each in receptions_in(events) if vehicle == "car1"]
    answered = {each.sent_ns: each.received_ns for each in receptions if each.message.sender == "car6"}
    hops = 5 if kind == "static" else 3
    came = [each for each in calls if "car1" in each.receivers]
    assert len(came) >= 5
    assert {each.sent_ns: each.received_ns[-1] for each in came} == answered
    for call in came:
        assert len(call.frames) == call.hops[-1] == len(call.receivers)
        assert call.via == ("car6", *call.receivers[:-1])
    assert min(call.hops[-1] for call in came) == hops


@pytest.mark.parametrize("kind", ["flooding", "static", "distance_vector"])
def test_a_seed_gives_equal_results_in_any_process(kind: str) -> None:
    settings = {**SETTINGS, **KINDS[kind], "duration_s": 3.0, "metrics.from_s": 1.0}
    here, apart = (vcmvsp.run("relay-chain", set=settings, agents=runs, mcap=False) for runs in ("inprocess", "process"))
    assert here.metrics["digest"] == apart.metrics["digest"]
    assert here.radio.equals(apart.radio)


@pytest.mark.parametrize("kind", ["flooding", "static", "distance_vector"])
def test_recorded_radio_gives_the_same_table(kind: str, tmp_path: Path) -> None:
    """The outcomes of frames are those of the recording; the network layer decides anew."""
    settings = {**SETTINGS, **KINDS[kind], "duration_s": 3.0, "metrics.from_s": 1.0}
    first = vcmvsp.run("relay-chain", set=settings, out=tmp_path / "one")
    again = replay(tmp_path / "one", radio="recorded", out=tmp_path / "two")
    assert first.radio.equals(again.radio)
    assert first.metrics["routing"] == again.metrics["routing"]
