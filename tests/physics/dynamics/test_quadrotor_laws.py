"""Quadrotor laws: equal bits interpreted and compiled, in few calls and in many; one long flight, compiled."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.physics.dynamics.test_quadrotor_fleet import MODEL, both_rates, fly
from vcmvsp.physics.dynamics.quadrotor_fleet import QuadrotorFleet
from vcmvsp.physics.vehicles.models import Quadrotor

STATE = ("position", "velocity", "velocity_before", "attitude", "rate", "rotor")


@pytest.fixture
def may_compile(monkeypatch: pytest.MonkeyPatch) -> None:
    """Allows compilation on request."""
    monkeypatch.setenv("VCMVSP_COMPILED", "1")


def model(rng: np.random.Generator, *, wash: bool) -> Quadrotor:
    drag, inertia = rng.uniform(0.0, 0.4, 3).tolist(), rng.uniform((0.003, 0.003, 0.005), (0.006, 0.006, 0.009)).tolist()
    return Quadrotor(
        mass_kg=float(rng.uniform(0.5, 1.1)),
        inertia=tuple(inertia),
        drag=tuple(drag),
        motor_lag_s=float(rng.uniform(0.02, 0.08)),
        velocity_gain=float(rng.uniform(2.0, 4.0)),
        ground_effect=wash and bool(rng.integers(2)),
        downwash=wash and bool(rng.integers(2)),
    )


def flights(seed: int, fleets: list[QuadrotorFleet], step_s: float, *, tumbling: bool) -> Iterator[list[bytes]]:
    """States of fleets under equal commands and winds; the first fleet takes as many steps per call as possible."""
    rng, n = np.random.default_rng(seed), len(fleets[0].position)
    state = {
        "velocity": rng.normal(0.0, 4.0, (n, 3)),
        "rate": rng.normal(0.0, 4.0, (n, 3)),
        "attitude": rng.normal(size=(n, 4)),
    }
    state["attitude"] /= np.linalg.norm(state["attitude"], axis=1, keepdims=True)
    for fleet in fleets if tumbling else ():
        for name, value in state.items():
            getattr(fleet, name)[:] = value
    for _ in range(30):
        row, steps, wind = int(rng.integers(n)), int(rng.integers(1, 6)), rng.normal(0.0, 3.0, (n, 3))
        numbers, yaw = rng.normal(0.0, 4.0, 3).tolist(), None if rng.random() < 0.5 else float(rng.normal(0.0, 3.0))
        to_place = bool(rng.random() < 0.5)
        for fleet in fleets:
            command(fleet, row, numbers, yaw, to_place=to_place)
        fleets[0].fly(steps, step_s, wind)
        for fleet in fleets[1:]:
            for _ in range(steps):
                fleet.integrate(*fleet.wrench(step_s, wind), step_s)
        yield [b"".join(getattr(fleet, name).tobytes() for name in STATE) for fleet in fleets]


def command(fleet: QuadrotorFleet, row: int, numbers: list[float], yaw: float | None, *, to_place: bool) -> None:
    if to_place:
        fleet.set_waypoint(row, numbers, yaw, None if yaw is None else 1.5)
    else:
        fleet.set_velocity(row, numbers, yaw or 0.0)


def random_fleet(seed: int) -> QuadrotorFleet:
    rng = np.random.default_rng(seed)
    n, wash = int(rng.integers(1, 12)), bool(rng.integers(2))
    models = [model(rng, wash=wash) for _ in range(n)]
    gravity = 0.0 if seed % 5 == 0 else 9.81
    return QuadrotorFleet(models, rng.uniform((-5.0, -5.0, 0.05), (5.0, 5.0, 8.0), (n, 3)), rng.uniform(-3.0, 3.0, n), gravity)


@pytest.mark.slow
@pytest.mark.usefixtures("may_compile")
@pytest.mark.parametrize("seed", range(16))
def test_bits_are_the_same_interpreted_and_compiled(seed: int) -> None:
    compiled, interpreted = random_fleet(seed), random_fleet(seed)
    compiled.expect(1, now=True)
    assert type(compiled._run) is not type(interpreted._run)
    for states in flights(seed, [compiled, interpreted], (1 / 120, 1 / 240, 1 / 500)[seed % 3], tumbling=seed % 2 == 0):
        assert states[0] == states[1]


@pytest.mark.slow
@pytest.mark.usefixtures("may_compile")
@both_rates
def test_it_recovers_from_any_attitude_and_comes_home(hz: float) -> None:
    rng = np.random.default_rng(5)
    n = 100
    fleet = QuadrotorFleet([MODEL] * n, np.tile((0.0, 0.0, 100.0), (n, 1)), np.zeros(n))
    fleet.expect(25.0 * hz)
    attitude = rng.normal(size=(n, 4))
    attitude[:3] = (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.6, 0.8, 0.0)  # exactly upside down
    fleet.attitude[:] = attitude / np.linalg.norm(attitude, axis=1, keepdims=True)
    fleet.rate[3:] = rng.normal(0.0, 6.0, (n - 3, 3))
    fleet.velocity[3:] = rng.normal(0.0, 3.0, (n - 3, 3))
    for row in range(n):
        fleet.set_waypoint(row, (0.0, 0.0, 100.0), yaw=1.0)
    flight = fly(fleet, 25.0, hz)
    late = np.max(np.where(flight.tilt > math.radians(45.0), flight.t[:, None], 0.0), axis=0)
    assert late[:3].max() <= 1.0
    assert late.max() <= 3.0
    assert flight.position[:, :3, 2].min() >= 98.0
    assert flight.position[-1] == pytest.approx(np.tile((0.0, 0.0, 100.0), (n, 1)), abs=0.05)
    assert np.cos(flight.yaw[-1] - 1.0) == pytest.approx(1.0, abs=1e-6)


def test_several_steps_per_call_equal_single_steps() -> None:
    for states in flights(3, [random_fleet(3), random_fleet(3)], 1 / 240, tumbling=True):
        assert states[0] == states[1]


@pytest.mark.slow
@pytest.mark.usefixtures("may_compile")
def test_a_fleet_may_change_over_at_any_step() -> None:
    plain, changing = random_fleet(8), random_fleet(8)
    for number, states in enumerate(flights(8, [plain, changing], 1 / 120, tumbling=False)):
        assert states[0] == states[1]
        if number == 11:
            changing.expect(1, now=True)


def test_little_work_is_interpreted(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    monkeypatch.setenv("VCMVSP_COMPILED", "1")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("vcmvsp.cosim.compiled.machine_code._loaded", {})
    fleet = random_fleet(1)
    before = type(fleet._run)
    fleet.expect(1000)
    assert type(fleet._run) is before
    empty = QuadrotorFleet([], [], [])
    empty.expect(1000, now=True)
    assert type(empty._run) is before
    assert not list(tmp_path.rglob("*.code"))
