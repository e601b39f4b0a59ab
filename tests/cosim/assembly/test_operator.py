"""Interventions of an operator: planned and live ones give the same run."""

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import vcmvsp
from vcmvsp.cosim.assembly import run as assembly
from vcmvsp.cosim.assembly.interventions import Operator
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.federate import Event, RunInfo
from vcmvsp.cosim.scenario.schema import HaltTable, InterventionTable, OutageTable, SetTable

SCENARIO: dict[str, Any] = {
    "name": "interfered",
    "duration_s": 6.0,
    "physics": {"kind": "kinematic"},
    "radio": {"loss": {"kind": "bernoulli", "probability": 0.2}},
    "vehicle": [
        {"name": "car1", "kind": "kinematic", "agent": {"kind": "trajectory", "path": "circle"}},
        {"name": "car2", "kind": "kinematic", "pose": [0.0, -1.0, 0.0], "agent": {"kind": "leader_follower", "leader": "car1"}},
    ],
}
INFO = RunInfo(scenario="test", seed=0, duration_ns=10**10, vehicles=("car1", "car2"))


def run(interventions: list[dict[str, Any]], observe: Any = None, **settings: Any) -> vcmvsp.Result:
    return vcmvsp.run({**SCENARIO, "intervention": interventions}, set=settings, mcap=False, observe=observe)


@given(st.lists(st.integers(0, 10**10), max_size=20))
def test_each_is_executed_once_at_its_time_in_order(times_ns: list[int]) -> None:
    planned = [OutageTable(at_s=each / 1e9, for_s=1.0) for each in times_ns]
    operator, events = Operator(planned, ["car1"], lambda *_: None), list[Event]()
    due = operator.start(INFO)
    while due is not None:
        step = operator.step(due, ())
        events += step.events
        assert all(event.time_ns == due for event in step.events)
        due = step.next_ns
    assert [event.time_ns for event in events] == sorted(times_ns)


def test_a_live_request_is_executed_at_the_current_instant() -> None:
    operator = Operator([HaltTable(at_s=5.0)], ["car1", "car2"], lambda *_: None)
    assert not operator.poll(0)
    operator.ask(OutageTable(at_s=0.0, for_s=2.0, vehicles=("car2",)))
    assert operator.poll(1_234_567_891)
    (event,) = operator.step(1_234_567_891, ()).events
    assert (event.key, event.value.vehicles, event.value.until_ns) == ("operator/outage", ("car2",), 3_234_567_891)  # type: ignore[union-attr]
    assert not operator.poll(1_234_567_892)
    assert [seconds_to_ns(each.at_s) for each in operator.all] == [1_234_567_891, 5_000_000_000]


def test_an_impossible_request_is_refused_and_dropped() -> None:
    def check(table: InterventionTable, earlier: Sequence[InterventionTable]) -> None:
        raise ValueError("no")

    operator = Operator([], ["car1"], check)
    with pytest.raises(ValueError, match="no"):
        operator.ask(HaltTable(at_s=0.0))
    assert not operator.poll(0)


def test_no_names_mean_all() -> None:
    operator = Operator([HaltTable(at_s=0.0)], ["car1", "car2"], lambda *_: None)
    (event,) = operator.step(0, ()).events
    assert event.value.vehicles == ("car1", "car2")  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"kind": "outage", "at_s": 1.0, "for_s": 1.0, "vehicles": ["car9"]}, "unknown vehicle 'car9'"),
        ({"kind": "outage", "at_s": 1.0}, "for_s is missing"),
        ({"kind": "outage", "at_s": 1.0, "for_s": 1.0, "vehicle": ["car2"]}, "unknown key 'vehicle'; did you mean 'vehicles'"),
        ({"kind": "move", "at_s": 1.0, "obstacle": "box", "position": [1e30, 0.0]}, "position"),
        ({"kind": "outage", "at_s": -1.0, "for_s": 1.0}, "at_s: must be"),
        ({"kind": "explode", "at_s": 1.0}, "kind"),
        ({"kind": "set", "at_s": 1.0, "key": "radio.loss.probability", "value": 2.0}, "probability"),
        ({"kind": "set", "at_s": 1.0, "key": "radio.loss.colour", "value": 2.0}, "colour"),
        ({"kind": "move", "at_s": 1.0, "obstacle": "box", "position": [0.0, 0.0]}, "box"),
    ],
)
def test_a_scenario_with_an_impossible_one_is_refused(table: dict[str, Any], words: str) -> None:
    with pytest.raises(ScenarioError, match=words) as caught:
        run([table])
    assert "intervention[0]" in str(caught.value)


def test_an_outage_loses_its_frames_and_changes_no_others() -> None:
    calm, cut = (run(each) for each in ([], [{"kind": "outage", "at_s": 2.0, "for_s": 1.5, "vehicles": ["car2"]}]))
    cut_frames, calm_frames = (each.radio.to_pylist() for each in (cut, calm))
    for frame, calm_frame in zip(cut_frames, calm_frames, strict=True):
        inside = 2.0 <= frame["sent_ns"] / 1e9 < 3.5
        assert frame["outcome"] == ("outage" if inside else calm_frame["outcome"])


@pytest.mark.parametrize("preset", ["ideal", "wifi-b-1"])
def test_live_interventions_are_repeated_to_the_byte(preset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Requested from within the run, at instants of all slots; the resolved scenario contains them."""
    orders: dict[int, InterventionTable] = {
        3: OutageTable(at_s=0.0, for_s=0.7),
        20: SetTable(at_s=0.0, key="radio.loss.probability", value=0.7),
        33: HaltTable(at_s=0.0, vehicles=("car1",)),
        50: HaltTable(at_s=0.0, vehicles=("car1",), halted=False),
    }
    operators: list[Operator] = []
    built = assembly._operator

    def build(*parts: Any) -> Operator:
        operators.append(built(*parts))
        return operators[-1]

    monkeypatch.setattr(assembly, "_operator", build)
    instants, settings = 0, {"radio.preset": preset}

    def progress(now_ns: int, end_ns: int) -> None:
        nonlocal instants
        instants += 1
        if instants in orders:
            operators[-1].ask(orders[instants])

    live = vcmvsp.run(SCENARIO, set=settings, progress=progress, mcap=False)
    assert len(tomllib.loads(live.scenario)["intervention"]) == len(orders)
    path = tmp_path / "again.toml"
    path.write_text(live.scenario)
    again = vcmvsp.run(path, mcap=False)
    assert again.metrics == live.metrics
    assert again.metrics["digest"] != vcmvsp.run(SCENARIO, set=settings, mcap=False).metrics["digest"]
    assert again.scenario == live.scenario


@pytest.mark.parametrize(
    "table",
    [
        OutageTable(at_s=0.0, for_s=-1.0),
        OutageTable(at_s=0.0, for_s=float("inf")),
        OutageTable(at_s=0.0, for_s=float("nan")),
        SetTable(at_s=0.0, key="radio.loss.probability", value=float("nan")),
    ],
)
def test_live_numbers_invalid_in_a_scenario_are_refused(table: InterventionTable) -> None:
    operator = Operator([], ["car1"], lambda *_: None)
    with pytest.raises(ValueError, match=r"finite|Expected"):
        operator.ask(table)
