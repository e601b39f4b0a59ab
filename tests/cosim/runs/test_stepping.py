"""A run stepped by its caller is equal to `vcmvsp.run` with agents of equal behaviour."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

import vcmvsp
from vcmvsp import AgentError, Observation, Radio, SteppedRun, UsageError, VehicleInfo, Velocity
from vcmvsp.agents.formation.leaders.trajectory import Trajectory

SHORT = {"duration_s": 4.0, "metrics.from_s": 0.0}
CARS = ("car1", "car2", "car3")


def _move(rng: np.random.Generator) -> Velocity:
    return Velocity(linear=(float(rng.uniform(-0.5, 0.5)), 0.0, 0.0), yaw_rate=float(rng.uniform(-1.0, 1.0)))


class Wanderer(vcmvsp.Agent):
    """Moves at random; sends its position and the number of messages received."""

    def start(self, info: VehicleInfo) -> None:
        self.rng = np.random.default_rng([7, CARS.index(info.name)])

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        radio.send(x=obs.state.position[0], heard=len(obs.heard))
        self.note(heard=float(len(obs.heard)))
        return _move(self.rng)


def _drive(run: SteppedRun, rngs: Mapping[str, np.random.Generator]) -> int:
    """Drive the vehicles like `Wanderer`, to the end; returns the number of steps."""
    steps, observations = 0, run.step()
    while observations:
        for name, obs in observations.items():
            run.vehicles[name].radio.send(x=obs.state.position[0], heard=len(obs.heard))
            run.vehicles[name].note(heard=float(len(obs.heard)))
        run.act({name: _move(rngs[name]) for name in observations})
        steps += 1
        observations = run.step()
    return steps


def _rngs(*names: str) -> dict[str, np.random.Generator]:
    return {name: np.random.default_rng([7, CARS.index(name)]) for name in names}


@pytest.mark.parametrize("preset", ["ideal", "wifi-b-1"])
def test_a_stepped_run_gives_the_bytes_of_a_run_with_agents(tmp_path: Path, preset: str) -> None:
    settings = {**SHORT, "radio.preset": preset}
    vcmvsp.run("formation-circle", set=settings, agents={name: Wanderer() for name in CARS}, out=tmp_path / "run")
    with vcmvsp.start("formation-circle", set=settings, out=tmp_path / "stepped") as run:
        assert _drive(run, _rngs(*CARS)) == 40
        run.result()
    for name in ("metrics.json", "radio.parquet", "states.parquet", "notes.parquet"):
        both = [(tmp_path / folder / name) for folder in ("run", "stepped")]
        assert both[0].exists() == both[1].exists()
        if both[0].exists():
            assert both[0].read_bytes() == both[1].read_bytes(), name


@pytest.mark.processes
def test_vehicles_that_are_not_driven_keep_their_agents() -> None:
    whole = vcmvsp.run("formation-circle", set=SHORT, agents={"car2": Wanderer()})
    with vcmvsp.start("formation-circle", set=SHORT, drives=["car2"]) as run:
        _drive(run, _rngs("car2"))
        result = run.result()
    assert result.metrics["digest"] == whole.metrics["digest"]


@pytest.mark.processes
def test_skipped_ticks_keep_the_command_and_queue_messages() -> None:
    radio = {"radio.preset": "ideal", "radio.loss.probability": 0.0, "radio.delay.jitter_s": 0.0}
    with vcmvsp.start("formation-circle", set=radio, drives=["car2"]) as run:
        run.step()
        run.act({"car2": Velocity(linear=(0.2, 0.0, 0.0))})
        observation = run.step(2.05)["car2"]
        assert observation.time_s == pytest.approx(2.1)
        of_leader = [each for each in observation.heard if each.message.sender == "car1"]
        assert len(of_leader) == 21  # sent at 0 to 2.0 s; each arrives 0.1 s later
        assert np.hypot(*(np.array(observation.state.position[:2]) - (-0.866, -0.5))) > 0.3


def test_a_run_ends_where_its_caller_ends_it() -> None:
    with vcmvsp.start("formation-circle", set=SHORT) as run:
        run.step(1.0)
        result = run.result()
    assert result.metrics["duration_s"] == pytest.approx(1.0)
    assert result.about["error"] is None
    assert result.states["time_ns"].to_numpy().max() == 1_000_000_000


def test_the_last_observations_are_of_the_end() -> None:
    with vcmvsp.start("formation-circle", set=SHORT) as run:
        while run.step():
            assert not run.last
        assert {each.time_ns for each in run.last.values()} == {4_000_000_000}


def test_a_failed_vehicle_has_no_more_observations() -> None:
    with vcmvsp.start("formation-circle", set={**SHORT, "vehicle.car3.agent.fails_s": 2.0}) as run:
        assert set(run.step(1.9)) == {*CARS}
        assert set(run.step()) == {"car1", "car2"}


@pytest.mark.processes
@pytest.mark.parametrize(
    ("commands", "problem"),
    [
        ({"car1": Velocity()}, "unknown vehicle 'car1'"),
        ({"car2": "left"}, "it must return a Velocity"),
        ({"car2": Velocity(linear=(float("nan"), 0.0, 0.0))}, "not finite"),
    ],
)
def test_a_wrong_command_is_one_error_and_the_run_continues(commands: dict[str, Velocity], problem: str) -> None:
    with vcmvsp.start("formation-circle", set=SHORT, drives=["car2"]) as run:
        run.step()
        with pytest.raises((UsageError, AgentError), match=problem):
            run.act(commands)
        run.act({"car2": Velocity()})
        assert run.step()["car2"].time_s == pytest.approx(0.1)


def test_an_agent_that_fails_ends_the_run_with_the_result_so_far(monkeypatch: pytest.MonkeyPatch) -> None:
    def act(_: Trajectory, obs: Observation, radio: Radio) -> Velocity:
        if obs.time_s > 0.95:
            raise RuntimeError("out of paint")
        return Velocity()

    monkeypatch.setattr(Trajectory, "act", act)
    run = vcmvsp.start("formation-circle", drives=["car2"], set={**SHORT, "agents.runs": "inprocess"})
    run.step(0.9)
    with pytest.raises(AgentError, match="out of paint") as error:
        run.step()
    run.close()
    assert error.value.result is not None
    assert error.value.result.metrics["duration_s"] == pytest.approx(1.0)


@pytest.mark.parametrize("drives", [[], ["car9"]])
def test_vehicles_to_drive_must_exist(drives: list[str]) -> None:
    with pytest.raises(UsageError, match="drives"):
        vcmvsp.start("formation-circle", drives=drives)


def test_a_run_without_a_record_or_after_its_end_has_no_result() -> None:
    with vcmvsp.start("formation-circle", set=SHORT, record=False) as run:
        while run.step():
            pass
        with pytest.raises(UsageError, match="not recorded"):
            run.result()
    closed = vcmvsp.start("formation-circle", set=SHORT)
    closed.step()
    closed.close()
    with pytest.raises(UsageError, match="closed"):
        closed.result()
