"""Isolation of runs from each other, and of the platform from its agents."""

import copy
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import vcmvsp
from tests.support.cosim.run_processes import Stage, exit_of
from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.errors import AgentError
from vcmvsp.cosim.types import Follows, Velocity

pytestmark = pytest.mark.processes


def alone(kind: str = "trajectory", **more: Any) -> dict[str, Any]:
    agent = {"kind": kind, **more}
    second = {"name": "car2", "kind": "kinematic", "pose": [3.0, 0.0, 0.0]}
    first = {"name": "car1", "kind": "kinematic", "agent": agent}
    return {"name": "alone", "duration_s": 1.0, "physics": {"kind": "kinematic"}, "vehicle": [first, second]}


class OneAction(Agent):
    """Calls ``action`` at 0.5 s, and drives on."""

    def __init__(self, action: Callable[["OneAction", Radio], object]) -> None:
        self.action = action

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        if obs.time_ns == 500_000_000:
            self.action(self, radio)
        return Velocity(linear=(0.1, 0.0, 0.0))


def test_runs_at_once_never_share_a_folder(tmp_path: Path) -> None:
    short = ["--set", "duration_s=0.5", "--set", "physics.kind=kinematic", "--quiet"]
    command = ["run", "formation-circle", "--agents", "inprocess", *short]
    with Stage(tmp_path) as stage:
        runs = [stage.start(*command, "--set", f"radio.loss.probability=0.{n}") for n in range(3)]
        assert [exit_of(run)[0] for run in runs] == [0, 0, 0]
    texts = {(path / "scenario.toml").read_text() for path in (tmp_path / "runs").iterdir()}
    assert len(texts) == 3


def test_the_current_folder_does_not_shadow_the_hosts_modules(tmp_path: Path) -> None:
    for name in ("agents", "cosim"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise SystemExit('the wrong one')")
    (tmp_path / "random.py").write_text("raise SystemExit('the wrong one')")
    vcmvsp = Path(sys.executable).parent / "vcmvsp"
    command = [str(vcmvsp), "run", "formation-circle", "--set", "duration_s=1", "--quiet"]
    assert subprocess.run(command, cwd=tmp_path, check=False, timeout=500).returncode == 0


def test_files_beside_two_agents_do_not_mix_and_are_read_again(tmp_path: Path) -> None:
    scenario = alone()
    for vehicle, gain in zip(scenario["vehicle"], ("0.1", "0.4"), strict=True):
        folder = tmp_path / vehicle["name"]
        folder.mkdir()
        (folder / "gains.py").write_text(f"SPEED = {gain}")
        (folder / f"{vehicle['name']}.py").write_text(
            "from gains import SPEED\nfrom vcmvsp import Agent, Velocity\n"
            "class A(Agent):\n    def act(self, obs, radio):\n        return Velocity(linear=(SPEED, 0.0, 0.0))\n"
        )
        vehicle["agent"] = {"kind": f"{folder}/{vehicle['name']}.py:A"}

    def moved() -> list[float]:
        one, two = vcmvsp.run(scenario).states["x"].to_numpy()[-2:]
        return [round(float(one), 9), round(float(two) - 3.0, 9)]

    assert moved() == [0.1, 0.4]
    (tmp_path / "car2" / "gains.py").write_text("SPEED = -0.25")
    assert moved() == [0.1, -0.25]


BAD: dict[str, Callable[[OneAction, Radio], object]] = {
    "keys that are no strings": lambda _, radio: radio.send({1: 2.0}),  # type: ignore[dict-item]
    "a value that cannot be written": lambda _, radio: radio.send(x=object()),
    "a number too large": lambda _, radio: radio.send(x=2**70),
    "a size too large": lambda _, radio: radio.send(x=1, size_bytes=10**30),
    "a note that is no text": lambda agent, _: agent.note(words="\ud800"),
    "an unknown leader": lambda agent, _: setattr(agent, "follows", Follows(leader="car9")),
    "itself as leader": lambda agent, _: setattr(agent, "follows", Follows(leader="car1")),
    "no place": lambda agent, _: setattr(agent, "follows", 3),
    "a way out": lambda _, __: sys.exit(0),
}


@pytest.mark.parametrize("fault", BAD)
def test_an_error_of_an_agent_names_it_and_keeps_the_recording(fault: str) -> None:
    with pytest.raises(AgentError, match="vehicle car1") as raised:
        vcmvsp.run(alone(), agents={"car1": OneAction(BAD[fault])})
    assert raised.value.result.states["time_ns"].to_numpy().max() == 500_000_000


def test_an_agent_that_leaves_before_the_start_is_named() -> None:
    class Leaving(Agent):
        def start(self, info: VehicleInfo) -> None:
            sys.exit(0)

    with pytest.raises(AgentError, match="vehicle car1: raised SystemExit"):
        vcmvsp.run(alone(), agents={"car1": Leaving()})


def test_every_agent_is_closed_even_if_one_fails() -> None:
    closed = []

    class Closing(Agent):
        def __init__(self, name: str) -> None:
            self.name = name

        def act(self, obs: Observation, radio: Radio) -> None:
            pass

        def close(self) -> None:
            closed.append(self.name)
            raise RuntimeError(self.name)

    with pytest.raises(AgentError, match="RuntimeError: car1"):
        vcmvsp.run(alone(), agents={"car1": Closing("car1"), "car2": Closing("car2")})
    assert closed == ["car1", "car2"]


def test_the_digest_differs_if_only_commands_or_messages_differ() -> None:
    def digest(action: Callable[[OneAction, Radio], object]) -> str:
        return vcmvsp.run(alone(), agents={"car1": OneAction(action)}).metrics["digest"]

    digests = [digest(lambda _, radio, x=x: radio.send(x=x)) for x in (1.0, 2.0)]  # type: ignore[misc]
    assert len({*digests, digest(lambda _, __: None)}) == 3


def test_a_follower_that_stops_following_is_measured_no_longer() -> None:
    class Leaving(Agent):
        def act(self, obs: Observation, radio: Radio) -> Velocity:
            self.follows = Follows(leader="car2", slot=(-1.0, 0.0), handle_m=0.5) if obs.time_s < 0.5 else None
            return Velocity(linear=(-1.0, 0.0, 0.0))

    formation = vcmvsp.run(alone(), agents={"car1": Leaving()}).metrics["formation"]
    assert formation["max_m"] == pytest.approx(2.0 + 0.4, abs=0.11)  # it starts 2 m off, and drives away while it follows
    assert formation["final_m"] is None


def test_a_frame_under_way_at_the_end_is_neither_received_nor_lost() -> None:
    scenario = {**alone(), "radio": {"delay": {"seconds": 0.35}}}
    radio = vcmvsp.run(scenario).metrics["radio"]
    assert (radio["frames"], radio["receptions"], radio["delivery_ratio"], radio["losses"]) == (10, 7, 1.0, {})


def test_settings_are_left_as_they_were_given() -> None:
    settings = {"vehicle.car1.agent": {"kind": "trajectory"}, "vehicle.car1.agent.speed": 0.5}
    vcmvsp.run(alone(), set=settings)
    assert settings == {"vehicle.car1.agent": {"kind": "trajectory"}, "vehicle.car1.agent.speed": 0.5}


def test_a_result_can_be_saved_where_it_is_and_elsewhere(tmp_path: Path) -> None:
    first = vcmvsp.run(alone(), out=tmp_path / "a")
    first.save(tmp_path / "a", force=True)
    first.save(tmp_path / "b")
    assert (tmp_path / "a" / "run.mcap").read_bytes() == (tmp_path / "b" / "run.mcap").read_bytes()
    second = vcmvsp.run(alone(), out=tmp_path / "d")
    vcmvsp.run(alone(), out=tmp_path / "d", force=True, set={"duration_s": 0.5})
    with pytest.raises(vcmvsp.UsageError, match="now contains another run"):
        second.save(tmp_path / "c")


@pytest.mark.parametrize(
    ("settings", "changed"),
    [
        ({"radio.loss.kind": "none"}, {"loss": {"kind": "none"}}),
        ({"radio.delay.kind": "uniform", "radio.delay.from_s": 0.1, "radio.delay.to_s": 0.2}, {}),
        ({"radio.path_loss.kind": "friis"}, {"path_loss": {"kind": "friis", "frequency_hz": 2.4e9}}),
    ],
)
def test_another_kind_can_be_set_as_it_is(settings: dict[str, Any], changed: dict[str, Any]) -> None:
    short = {"duration_s": 0.5, "physics.kind": "kinematic"}
    resolved = tomllib.loads(vcmvsp.run("formation-circle", set={**short, **settings}, agents="inprocess").scenario)
    assert resolved["radio"] == {**resolved["radio"], **changed}


def test_another_agent_keeps_its_known_parameters_of_the_file() -> None:
    settings = {"duration_s": 0.5, "physics.kind": "kinematic", "vehicle.car2.agent.kind": "trajectory"}
    first = vcmvsp.run("formation-circle", set=settings, agents="inprocess")
    agent = tomllib.loads(first.scenario)["vehicle"][1]["agent"]
    assert (agent["kind"], "leader" in agent) == ("trajectory", False)
    assert vcmvsp.run(tomllib.loads(first.scenario)).metrics == first.metrics


def test_a_wrong_parameter_beside_a_kind_that_is_set_is_still_refused() -> None:
    with pytest.raises(vcmvsp.ScenarioError, match="unknown key 'probabilty'"):
        vcmvsp.run("formation-circle", set={"radio.loss.kind": "bernoulli", "radio.loss.probabilty": 0.5})


@pytest.mark.parametrize(
    "body", [{"x": 1.0}, {"x": 1.0, "way": [[0.0, 1.0]]}, {"x": 1.0, "more": {"y": 2.0}}, b"raw"], ids=repr
)
def test_an_agent_that_changes_a_received_message_changes_no_others(body: Any) -> None:
    bodies: list[Any] = []

    class Changing(Agent):
        def act(self, obs: Observation, radio: Radio) -> None:
            for each in obs.heard:
                own = each.message.body
                bodies.append(copy.deepcopy(own))
                if isinstance(own, dict):
                    for value in own.values():
                        if isinstance(value, list | dict):
                            value.clear()
                    own.clear()

    class Sending(Agent):
        def act(self, obs: Observation, radio: Radio) -> None:
            if obs.time_ns == 0:
                radio.send(copy.deepcopy(body))

    scenario = {**alone(), "radio": {"preset": "ideal"}}
    scenario["vehicle"].append({"name": "car3", "kind": "kinematic"})
    vcmvsp.run(scenario, agents={"car1": Changing(), "car2": Changing(), "car3": Sending()})
    assert bodies == [body, body]
