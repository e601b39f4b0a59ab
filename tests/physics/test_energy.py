"""Batteries: power by closed forms, energy of frames, empty batteries."""

import math
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

import vcmvsp
from tests.support.cosim.command_line import vcmvsp_command
from vcmvsp.cosim.agent import Agent, Observation, Radio
from vcmvsp.cosim.scenario.schema import BatteryTable
from vcmvsp.cosim.types import Measured, Velocity
from vcmvsp.physics.dynamics.wind import AIR_KG_M3
from vcmvsp.physics.energy import flight_power, induced_speed, rolling_power
from vcmvsp.physics.vehicles.models import P2DX, Quadrotor

G = 9.81
ROTOR_EFFICIENCY, DRIVE_EFFICIENCY = 0.54, 0.75
NO_DRAG = (0.0, 0.0, 0.0)


class Driver(Agent):
    """Drives at constant velocity, sends ``size_bytes`` at every tick and records its battery readings."""

    def __init__(self, velocity: tuple[float, float, float], size_bytes: int = 0) -> None:
        self._command, self._size = Velocity(linear=velocity), size_bytes
        self.readings: list[Measured] = []
        self.ticks_s: list[float] = []

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        self.ticks_s.append(obs.time_s)
        reading = obs.readings.get("battery")
        if isinstance(reading, Measured):
            self.readings.append(reading)
        if self._size:
            radio.send(b"", size_bytes=self._size)
        return self._command


def scenario(*vehicles: dict[str, Any], duration_s: float, **more: Any) -> dict[str, Any]:
    named = [{"name": f"v{n}", "position": [0.0, 5.0 * n, 10.0], **each} for n, each in enumerate(vehicles)]
    plain = {"name": "energy", "duration_s": duration_s, "physics": {"kind": "kinematic"}, "radio": {"preset": "ideal"}}
    return {**plain, **more, "vehicle": named}


def hover_w(mass_kg: float, rotor_radius_m: float) -> float:
    """Momentum theory: thrust^(3/2) / sqrt(2 rho A), over the efficiencies."""
    ideal = (mass_kg * G) ** 1.5 / math.sqrt(2.0 * AIR_KG_M3 * 4.0 * math.pi * rotor_radius_m**2)
    return ideal / (ROTOR_EFFICIENCY * DRIVE_EFFICIENCY)


# --- power ---


@given(st.floats(0.1, 20.0), st.floats(0.0, 30.0), st.floats(0.0, 10.0))
def test_the_induced_speed_solves_glauerts_equation(hover: float, across: float, along: float) -> None:
    speed = induced_speed(hover, across, along)
    assert speed * math.hypot(across, along + speed) == pytest.approx(hover**2, rel=1e-9)


def test_induced_speeds_of_hover_climb_and_quick_flight() -> None:
    """Leishman: climb v = -Vc/2 + sqrt(Vc^2/4 + vh^2); in fast flight it tends to vh^2 / V."""
    assert induced_speed(5.0, 0.0, 0.0) == pytest.approx(5.0)
    assert induced_speed(5.0, 0.0, 4.0) == pytest.approx(-2.0 + math.sqrt(4.0 + 25.0))
    assert induced_speed(5.0, 100.0, 0.0) == pytest.approx(0.25, rel=1e-4)


def test_power_of_flight_falls_before_drag_raises_it() -> None:
    model, battery = Quadrotor(), BatteryTable(capacity_wh=1.0)
    power = flight_power(battery, model.mass_kg, model.rotor_radius_m, model.drag, G)
    assert power((0.0, 0.0, 0.0)) == pytest.approx(hover_w(model.mass_kg, model.rotor_radius_m))
    assert power((0.0, 0.0, 0.0)) == pytest.approx(96.0, abs=0.5)  # the documented value
    assert power((0.0, 0.0, -1.0)) == power((0.0, 0.0, 0.0))
    assert power((2.0, 0.0, 0.0)) < power((0.0, 0.0, 0.0)) < power((8.0, 0.0, 0.0))
    lossless = flight_power(battery, model.mass_kg, model.rotor_radius_m, NO_DRAG, G)
    climbed_w = (lossless((0.0, 0.0, 3.0)) - hover_w(0.8, 0.1016)) * ROTOR_EFFICIENCY * DRIVE_EFFICIENCY
    assert 0.5 * 0.8 * G * 3.0 < climbed_w < 0.8 * G * 3.0  # climbing power minus the savings by inflow


def test_the_measured_rotor_is_the_default() -> None:
    """Duffy: 190 g of thrust from 16.8 W of shaft power, with 8-inch propellers."""
    battery = BatteryTable(capacity_wh=1.0, drive_efficiency=1.0)
    power = flight_power(battery, 4 * 0.19, 0.1016, NO_DRAG, G)
    assert power((0.0, 0.0, 0.0)) == pytest.approx(4 * 16.8, rel=0.02)


def test_power_on_wheels_is_rolling_resistance() -> None:
    power = rolling_power(BatteryTable(capacity_wh=1.0), 9.0, G)
    assert power((0.0, 0.0, 0.0)) == 0.0
    assert power((0.3, 0.4, 0.0)) == pytest.approx(0.02 * 9.0 * G * 0.5 / DRIVE_EFFICIENCY)


# --- runs ---


@pytest.mark.parametrize("kind", ["bullet", "kinematic"])
def test_a_quadrotor_hovers_as_long_as_momentum_theory_says(kind: str) -> None:
    """Within 5 %: battery energy over hover power."""
    pytest.importorskip("pybullet") if kind == "bullet" else None
    hovers_s = 0.5 * 3600.0 / hover_w(0.8, 0.1016)
    quadrotor = {"kind": "quadrotor", "battery": {"capacity_wh": 0.5}}
    run = scenario(quadrotor, duration_s=25.0, physics={"kind": kind})
    driver = Driver((0.0, 0.0, 0.0))
    numbers = vcmvsp.run(run, agents={"v0": driver}, mcap=False).metrics["energy"]["v0"]
    assert numbers["empty_s"] == pytest.approx(hovers_s, rel=0.05)
    assert numbers["charge_left"] == 0.0
    assert numbers["used_j"] == pytest.approx(1800.0)
    assert driver.ticks_s[-1] <= numbers["empty_s"]  # its agent has failed


def test_a_robot_uses_rolling_resistance_times_way_and_electronics_times_time() -> None:
    battery = {"capacity_wh": 10.0, "electronics_w": 5.0, "charge": 0.5}
    run = scenario({"kind": "p2dx", "battery": battery}, {"kind": "p2dx"}, duration_s=20.0)
    driver = Driver((0.5, 0.0, 0.0))
    result = vcmvsp.run(run, agents={"v0": driver, "v1": Driver((0.0, 0.0, 0.0))}, mcap=False)
    numbers = result.metrics["energy"]["v0"]
    way_j = 0.02 * P2DX().mass_kg * G * 10.0 / DRIVE_EFFICIENCY
    assert numbers["motion_j"] == pytest.approx(way_j, rel=0.01)
    assert numbers["used_j"] == pytest.approx(numbers["motion_j"] + 100.0)
    assert numbers["charge_left"] == pytest.approx(0.5 - numbers["used_j"] / 36_000.0)
    assert numbers["empty_s"] is None
    assert set(result.metrics["energy"]) == {"v0"}
    charges = [each.values["charge"] for each in driver.readings]
    assert charges == sorted(charges, reverse=True)
    assert {each.time_ns % 1_000_000_000 for each in driver.readings} == {0}


def test_frames_cost_airtime_at_sender_and_receivers(tmp_path: Path) -> None:
    battery = {"capacity_wh": 10.0, "tx_w": 3.0, "rx_w": 2.0}
    air = {"preset": "wifi-b-1", "mac": {"kind": "ideal"}, "loss": {"probability": 0.3}}
    run = scenario(*({"kind": "p2dx", "battery": battery} for _ in range(2)), duration_s=10.0, radio=air)
    agents = {"v0": Driver((0.0, 0.0, 0.0), 1000), "v1": Driver((0.0, 0.0, 0.0))}
    numbers = vcmvsp.run(run, agents=agents, out=tmp_path / "run").metrics["energy"]
    rows = pq.read_table(tmp_path / "run" / "radio.parquet").to_pylist()
    air_s, received = rows[0]["air_time_ns"] / 1e9, sum(each["outcome"] == "received" for each in rows)
    assert 0 < received < len(rows) == 100
    assert numbers["v0"]["radio_j"] == pytest.approx(3.0 * 100 * air_s)
    assert numbers["v1"]["radio_j"] == pytest.approx(2.0 * received * air_s)


def test_a_vehicle_without_charge_stops_moving_and_sending(tmp_path: Path) -> None:
    battery = {"capacity_wh": 0.01, "electronics_w": 6.0}  # 6 s, and slightly less because of driving
    run = scenario({"kind": "p2dx", "battery": battery}, {"kind": "p2dx"}, duration_s=10.0)
    agents = {"v0": Driver((0.5, 0.0, 0.0), 10), "v1": Driver((0.0, 0.0, 0.0))}
    result = vcmvsp.run(run, agents=agents, out=tmp_path / "run")
    empty_s = result.metrics["energy"]["v0"]["empty_s"]
    assert 5.0 < empty_s < 6.0
    sent_s = [each["sent_ns"] / 1e9 for each in pq.read_table(tmp_path / "run" / "radio.parquet").to_pylist()]
    assert max(sent_s) == pytest.approx(empty_s, abs=0.11)
    states = pq.read_table(tmp_path / "run" / "states.parquet").to_pylist()
    xs = {each["time_ns"]: each["x"] for each in states if each["vehicle"] == "v0"}
    assert xs[10_000_000_000] == pytest.approx(0.5 * empty_s, abs=0.11)


@pytest.mark.processes
def test_agents_in_other_processes_fail_at_the_same_instant(tmp_path: Path) -> None:
    agent = {"kind": "trajectory", "path": "straight", "speed": 0.5}
    battery = {"capacity_wh": 0.002, "electronics_w": 6.0}
    run = scenario({"kind": "p2dx", "battery": battery, "agent": agent}, {"kind": "p2dx"}, duration_s=3.0)
    for runs in ("inprocess", "process"):
        vcmvsp.run(run, out=tmp_path / runs, set={"agents.runs": runs})
    vcmvsp.run(tmp_path / "process" / "scenario.toml", out=tmp_path / "again")
    recordings = {(tmp_path / name / "run.mcap").read_bytes() for name in ("inprocess", "process", "again")}
    assert len(recordings) == 1


def test_without_a_battery_there_are_no_energy_metrics() -> None:
    result = vcmvsp.run(scenario({"kind": "p2dx"}, duration_s=1.0), agents={"v0": Driver((0.1, 0.0, 0.0))}, mcap=False)
    assert "energy" not in result.metrics


# --- refusals ---


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["vehicle.car2.battery={}"], "vehicle.car2.battery: capacity_wh is missing"),
        (["vehicle.car2.battery.capacity_wh=0"], "vehicle.car2.battery.capacity_wh"),
        (["vehicle.car2.battery={capacity_wh=1.0, hours=2}"], "vehicle.car2.battery: unknown key 'hours'"),
        (["vehicle.car2.kind=kinematic", "vehicle.car2.battery.capacity_wh=1"], "vehicle.car2.battery.mass_kg"),
        (
            ["vehicle.car2.battery.capacity_wh=1", "vehicle.car2.sensors.battery.kind=imu"],
            "'battery' is the reading of the table vehicle.car2.battery",
        ),
    ],
)
def test_impossible_batteries_are_refused_in_one_line(settings: list[str], words: str) -> None:
    done = vcmvsp_command("check", "formation-circle", *(word for each in settings for word in ("--set", each)))
    assert done.code == 2
    assert words in done.err
    assert done.err.count("\n") == 1
