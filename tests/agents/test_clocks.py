"""Vehicles with their own clocks in whole runs: observations of agents, errors of a formation, and synchronisation."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import vcmvsp
from tests.support.cosim.command_line import vcmvsp_command
from vcmvsp.cosim.agent import Agent, Observation, Radio
from vcmvsp.cosim.types import Reception

SPEED = 0.5  # m/s
OFFSET_S, DRIFT_PPM = 0.3, 1000.0


class Witness(Agent):
    """Sends at every tick and records its observations."""

    def __init__(self) -> None:
        self.observations: list[Observation] = []
        self.receptions: list[Reception] = []

    def act(self, obs: Observation, radio: Radio) -> None:
        self.observations.append(obs)
        self.receptions += list(obs.heard)
        radio.send(clock_s=obs.clock_s)


def cars(*tables: Mapping[str, Any], duration_s: float = 5.0, **more: Any) -> dict[str, Any]:
    """A scenario with car1, car2, ... side by side, 3 m apart, over a perfect radio."""
    named = [{"name": f"car{n}", "kind": "p2dx", "pose": [0.0, -3.0 * n, 0.0], **each} for n, each in enumerate(tables, 1)]
    scenario = {"name": "clocks", "duration_s": duration_s, "physics": {"kind": "kinematic"}, "radio": {"preset": "ideal"}}
    return {**scenario, **more, "vehicle": named}


def witnesses(scenario: dict[str, Any]) -> dict[str, Witness]:
    agents = {each["name"]: Witness() for each in scenario["vehicle"]}
    vcmvsp.run(scenario, agents=agents, mcap=False)
    return agents


def leader_and_follower(leader: Mapping[str, Any], follower: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    """A follower 1 m behind a leader that drives straight ahead; reports from the future are accepted."""
    lead = {"kind": "trajectory", "path": "straight", "speed": SPEED}
    follow = {"kind": "leader_follower", "leader": "car1", "slot": [-1.0, 0.0], "clock_bound_s": 10.0}
    ahead, behind = {"pose": [0.0, 0.0, 0.0], "agent": lead}, {"pose": [-1.0, 0.0, 0.0], "agent": follow}
    return cars({**ahead, **leader}, {**behind, **follower}, **more)


def gap_m(out: Path, time_s: float) -> float:
    """Distance of car2 behind car1 along x at a time."""
    rows = [each for each in pq.read_table(out / "states.parquet").to_pylist() if each["time_ns"] == round(time_s * 1e9)]
    by_name = {each["vehicle"]: each["x"] for each in rows}
    return float(by_name["car1"] - by_name["car2"])


# --- observations ---


def test_without_a_clock_an_agent_has_the_time_of_the_run() -> None:
    for witness in witnesses(cars({}, {})).values():
        assert [each.clock_ns for each in witness.observations] == [each.time_ns for each in witness.observations]


def test_a_clock_shows_offset_drift_and_step() -> None:
    clock = {"offset_s": 2.5, "drift_ppm": 40.0, "step": {"at_s": 3.0, "by_s": -0.75}}
    observations = witnesses(cars({"clock": clock}, {}))["car1"].observations
    times = np.array([each.time_s for each in observations])
    assert [each.clock_s for each in observations] == pytest.approx(
        times * (1.0 + 40e-6) + 2.5 - 0.75 * (times >= 3.0), abs=2e-9
    )


def test_jitter_is_normal_with_its_standard_deviation_and_independent_of_the_number_of_readings() -> None:
    scenario = cars({"clock": {"jitter_s": 1e-3}}, {}, duration_s=60.0, agents={"period_s": 0.05})
    observations, once_more = (witnesses(scenario)["car1"].observations for _ in range(2))
    errors_s = np.array([each.clock_ns - each.time_ns for each in observations]) / 1e9
    assert np.std(errors_s) == pytest.approx(1e-3, rel=4.0 / np.sqrt(2 * len(observations)))
    assert abs(np.mean(errors_s)) < 4e-3 / np.sqrt(len(observations))
    assert [each.clock_ns for each in observations] == [each.clock_ns for each in once_more]
    rarely = witnesses({**scenario, "agents": {"period_s": 0.1}})["car1"].observations
    assert [each.clock_ns for each in rarely] == [each.clock_ns for each in observations[::2]]


def test_messages_have_the_times_of_their_senders_and_receivers() -> None:
    clocks = {"offset_s": 10.0}, {"offset_s": -4.0}
    scenario = cars(*({"clock": clock} for clock in clocks), {}, radio={"preset": "ideal", "delay": {"seconds": 0.02}})
    agents = witnesses(scenario)
    by_sender = {(name, each.message.sender): each for name, agent in agents.items() for each in agent.receptions}
    offsets = {"car1": 10.0, "car2": -4.0, "car3": 0.0}
    assert len(by_sender) == 6
    for (receiver, sender), each in by_sender.items():
        apart_s = offsets[receiver] - offsets[sender]
        assert (each.received_ns - each.sent_ns) / 1e9 == pytest.approx(0.02 + apart_s, abs=1e-9)
        body: Any = each.message.body
        assert body["clock_s"] == pytest.approx(each.sent_ns / 1e9, abs=1e-9)  # sent at its tick
    last = agents["car2"].observations[-1]
    ages_s = dict(zip(last.heard.senders, last.heard.age_s.tolist(), strict=True))
    assert ages_s == pytest.approx({"car1": 0.1 - 14.0, "car3": 0.1 - 4.0})


def test_readings_have_the_time_of_their_vehicle() -> None:
    """A scan on demand, and a reading of a sensor with its own rate."""
    sensors = {"scan": {"kind": "lms"}, "imu": {"kind": "imu", "rate_hz": 3.0}}
    agents = witnesses(cars({"sensors": sensors, "clock": {"offset_s": 7.0}}, {"sensors": sensors}))
    readings: list[Any] = [agents[name].observations[-1].readings for name in ("car1", "car2")]
    own, same = readings
    for sensor in sensors:
        assert own[sensor].time_ns - same[sensor].time_ns == 7_000_000_000


# --- errors, and synchronisation ---


def test_a_followers_error_is_speed_times_the_difference_of_the_clocks(tmp_path: Path) -> None:
    """It extrapolates the leader's report by its age, with an error of offset + drift t."""
    clock = {"offset_s": OFFSET_S, "drift_ppm": DRIFT_PPM}
    scenario = leader_and_follower({}, {"clock": clock}, duration_s=61.0)
    vcmvsp.run(scenario, out=tmp_path / "late")
    vcmvsp.run(scenario, out=tmp_path / "exact", set={"vehicle.car2.clock.offset_s": 0, "vehicle.car2.clock.drift_ppm": 0})
    for time_s in (20.0, 40.0, 60.0):
        error_m = gap_m(tmp_path / "exact", time_s) - gap_m(tmp_path / "late", time_s)
        assert error_m == pytest.approx(SPEED * (OFFSET_S + DRIFT_PPM * 1e-6 * time_s), rel=0.02)


@pytest.mark.parametrize(("there_s", "back_s"), [(0.03, 0.03), (0.07, 0.01), (0.0, 0.05)])
def test_after_synchronisation_half_the_asymmetry_of_the_delays_remains(there_s: float, back_s: float) -> None:
    """Between two exchanges, 1 s apart, the clocks drift by up to 50 us."""
    witness = Witness()
    changes = [
        {"from_s": 0.0, "links": ["car2/car1"], "delay_s": there_s},
        {"from_s": 0.0, "links": ["car1/car2"], "delay_s": back_s},
    ]
    clocks = {"offset_s": 5.0}, {"offset_s": -1.0, "drift_ppm": 50.0}
    scenario = cars(
        {"clock": clocks[0], "agent": {"kind": "time_sync", "task": {"kind": "patrol", "way": [[0.0, 0.0, 0.0]]}}},
        {"clock": clocks[1], "agent": {"kind": "time_sync"}},
        duration_s=20.0,
        radio={"preset": "ideal", "script": {"changes": changes}},
    )
    vcmvsp.run(scenario, agents={"car2": synchronised(witness)}, mcap=False)
    errors_s = [each.clock_s - (each.time_s + 5.0) for each in witness.observations if each.time_s > 2.0]
    assert errors_s == pytest.approx([(there_s - back_s) / 2.0] * len(errors_s), abs=60e-6)
    assert all("ts" not in each.message.body for each in witness.receptions)


def synchronised(task: Agent) -> Agent:
    """A ``time_sync`` around an existing agent."""
    from vcmvsp.agents.time_sync import TimeSync

    made = TimeSync({"kind": "patrol", "way": [[0.0, 0.0, 0.0]]}, reference="car1")
    made.task = task
    made.sensors = task.sensors
    return made


def test_synchronised_followers_keep_their_slot(tmp_path: Path) -> None:
    """With equal delays in both directions, and clocks 30 s apart."""
    plain = leader_and_follower({}, {}, duration_s=30.0)
    lead, follow = (each["agent"] for each in plain["vehicle"])
    leader = {"agent": {"kind": "time_sync", "task": lead}}
    task, clock = {**follow, "clock_bound_s": 1.0}, {"offset_s": 30.0, "drift_ppm": 50.0}
    follower = {"agent": {"kind": "time_sync", "reference": "car1", "task": task}, "clock": clock}
    layered = leader_and_follower(leader, follower, duration_s=30.0)
    vcmvsp.run(plain, out=tmp_path / "plain")
    vcmvsp.run(layered, out=tmp_path / "layered")
    assert gap_m(tmp_path / "layered", 29.0) == pytest.approx(gap_m(tmp_path / "plain", 29.0), abs=1e-3)


@pytest.mark.processes
def test_clocks_are_equal_in_other_processes(tmp_path: Path) -> None:
    clock = {"offset_s": OFFSET_S, "drift_ppm": DRIFT_PPM, "jitter_s": 1e-3}
    scenario = leader_and_follower({}, {"clock": clock}, duration_s=3.0)
    for runs in ("inprocess", "process"):
        vcmvsp.run(scenario, out=tmp_path / runs, set={"agents.runs": runs})
    assert (tmp_path / "inprocess" / "run.mcap").read_bytes() == (tmp_path / "process" / "run.mcap").read_bytes()


def test_the_resolved_scenario_gives_the_same_bytes(tmp_path: Path) -> None:
    clock = {"offset_s": OFFSET_S, "step": {"at_s": 1.0, "by_s": 0.2}}
    vcmvsp.run(leader_and_follower({}, {"clock": clock}, duration_s=3.0), out=tmp_path / "first")
    vcmvsp.run(tmp_path / "first" / "scenario.toml", out=tmp_path / "again")
    assert (tmp_path / "first" / "run.mcap").read_bytes() == (tmp_path / "again" / "run.mcap").read_bytes()


def test_a_clock_and_a_battery_for_all_are_resolved_once(tmp_path: Path) -> None:
    shared = {"clock": {"drift_ppm": 20.0, "step": {"at_s": 1.0, "by_s": 0.1}}, "battery": {"capacity_wh": 1.0}}
    scenario = cars(
        *({"agent": {"kind": "patrol", "way": [[5.0, 0.0, 0.0]]}} for _ in range(2)), duration_s=2.0, vehicles=shared
    )
    result = vcmvsp.run(scenario, out=tmp_path / "first")
    assert set(result.metrics["energy"]) == {"car1", "car2"}
    assert (tmp_path / "first" / "scenario.toml").read_text().count("drift_ppm") == 1
    vcmvsp.run(tmp_path / "first" / "scenario.toml", out=tmp_path / "again")
    assert (tmp_path / "first" / "run.mcap").read_bytes() == (tmp_path / "again" / "run.mcap").read_bytes()


# --- refusals ---


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("vehicle.car2.clock.offset=1", "vehicle.car2.clock.offset"),
        ("vehicle.car2.clock.jitter_s=-1", "vehicle.car2.clock.jitter_s"),
        ("vehicle.car2.clock.step.at_s=1", "vehicle.car2.clock.step"),
        ("vehicle.car2.clock.drift_ppm=1e9", "vehicle.car2.clock.drift_ppm"),
        ('vehicle.car2.agent={kind="time_sync"}', "vehicle.car2.agent.task"),
        ('vehicle.car2.agent={kind="time_sync", reference="car9", task={kind="patrol", way=[[0,0,0]]}}', "reference = 'car9'"),
    ],
)
def test_invalid_settings_are_refused_in_one_line(setting: str, words: str) -> None:
    done = vcmvsp_command("check", "formation-circle", "--set", setting)
    assert done.code == 2, json.dumps(done.out)
    assert words in done.err
    assert done.err.count("\n") == 1
