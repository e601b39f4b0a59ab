"""Stations: places with radios and agents, without bodies."""

from pathlib import Path

import numpy as np
import pytest

import vcmvsp
from tests.support.paths import SCENARIOS
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.scenario import loader

CAR = {"name": "car1", "kind": "kinematic", "agent": {"kind": "trajectory", "path": "straight", "speed": 1.0}}
CONTROL = {"name": "control", "position": [2.0, 0.0, 1.0]}
BASE = {
    "name": "stations",
    "duration_s": 4.0,
    "physics": {"kind": "kinematic"},
    "radio": {"preset": "wifi-b-1"},
    "vehicle": [CAR],
}


class Answer(vcmvsp.Agent):
    """Replies to each message with its own height, m."""

    def act(self, obs: vcmvsp.Observation, radio: vcmvsp.Radio) -> None:
        for each in obs.heard:
            radio.send(to=each.message.sender, z=obs.state.position[2])


class Leave(vcmvsp.Agent):
    def act(self, obs: vcmvsp.Observation, radio: vcmvsp.Radio) -> vcmvsp.Velocity:
        return vcmvsp.Velocity(linear=(1.0, 0.0, 0.0))


def test_a_station_keeps_its_place_and_takes_part_in_the_radio() -> None:
    result = vcmvsp.run({**BASE, "station": [{**CONTROL, "agent": {}}]}, agents={"control": Answer()}, mcap=False)
    states, radio = result.states.to_pandas(), result.radio.to_pandas()
    own = states[states.vehicle == "control"]
    assert np.unique(own[["x", "y", "z"]].to_numpy(), axis=0).tolist() == [CONTROL["position"]]
    answers = radio[(radio.sender == "control") & (radio.receiver == "car1")]
    assert len(answers) == len(radio[(radio.sender == "car1") & (radio.outcome == "received")]) - 1  # the last one is too late


def test_a_station_changes_no_vehicle_and_no_clearance() -> None:
    sensors = {"scan": {"kind": "lms"}}
    cars = [{**CAR, "sensors": sensors}, {**CAR, "name": "car2", "position": [0.0, 3.0, 0.0]}]
    base = {**BASE, "physics": {"kind": "bullet"}, "vehicle": cars, "record": {"sensors": ["scan"]}}
    results: dict[bool, list[object]] = {}
    for has_station in (False, True):
        events: list[vcmvsp.Event] = []
        stations = {"station": [CONTROL]} if has_station else {}
        result = vcmvsp.run({**base, **stations}, mcap=False, observe=events.append)
        states = result.states.to_pandas()
        scans = [each.value.get().ranges.tolist() for each in events if each.key == "car1/scan"]
        assert scans
        results[has_station] = [
            scans,
            states[states.vehicle != "control"].drop(columns="vehicle").to_numpy().tolist(),
            result.metrics["safety"],
        ]
    assert results[False] == results[True]


def test_a_station_takes_no_command() -> None:
    with pytest.raises(vcmvsp.VcmvspError, match="station received a command to move"):
        vcmvsp.run({**BASE, "station": [{**CONTROL, "agent": {}}]}, agents={"control": Leave()}, mcap=False)


def test_the_resolved_scenario_has_its_stations_and_gives_the_same_bytes(tmp_path: Path) -> None:
    station = {**CONTROL, "radio": {"tx_power_dbm": 3.0}, "battery": {"capacity_wh": 1.0}, "clock": {"offset_s": 1.0}}
    content = {**BASE, "vehicles": {"pose_source": "odometry"}, "station": [station]}
    first = vcmvsp.run(content, out=tmp_path / "one")
    again = vcmvsp.run(tmp_path / "one" / "scenario.toml", out=tmp_path / "two")
    assert first.metrics["digest"] == again.metrics["digest"]
    assert (tmp_path / "one" / "run.mcap").read_bytes() == (tmp_path / "two" / "run.mcap").read_bytes()


def test_key_paths_reach_a_station_by_its_name() -> None:
    scenario, _ = loader.load("ground-station", settings={"station.mast.position": [1.0, 2.0, 3.0]})
    assert {each.name: each.position for each in scenario.vehicle}["mast"] == (1.0, 2.0, 3.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pose": [0.0, 0.0, 0.0]}, "station.control.pose"),
        ({"position": [0.0, 0.0, -1.0]}, "station.control.position: control starts 1 m below the floor"),
        ({"radio": {"power": 1.0}}, "station.control.radio.power"),
        ({"agent": {"kind": "patroll"}}, "station.control.agent.kind"),
        ({"name": "car1"}, "two vehicles are named 'car1'"),
    ],
)
def test_errors_have_the_key_of_the_station(change: dict[str, object], message: str) -> None:
    with pytest.raises(vcmvsp.ScenarioError) as caught:
        vcmvsp.run({**BASE, "station": [{**CONTROL, **change}]}, mcap=False)
    assert message in str(caught.value)


def test_a_line_of_a_station_is_found() -> None:
    text = (SCENARIOS / "ground-station.toml").read_text("utf-8").replace("[40.0, -5.0, 6.0]", "[40.0, -5.0, -6.0]")
    line = text[: text.index("-6.0]")].count("\n") + 1
    source = Source("stations.toml", Path(), text)
    source.stations = frozenset(["mast"])
    assert source.error("x", "vehicle.mast.position").source == f"stations.toml line {line}"
