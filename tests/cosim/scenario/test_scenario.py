"""Reading scenarios: meaning of keys, precedence of values, and the place of an error."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.scenario.loader import load, settings_of, value_of

FILE = """# A scenario for these tests: short. More words.
name = "lines"
duration_s = 2          # a whole number will do

[radio]
preset = "wss"
[radio.loss]
probability = 0.2

[vehicles]
kind = "lag"

[agents]
k1 = 0.8
kind = "trajectory"

[[vehicle]]
name = "car1"           # the leader
agent = { kind = "trajectory", path = "circle" }

[[vehicle]]
pose = [-1.0, 0.5, 0.0]
name = 'car2'
kind = "p2dx"
[vehicle.agent]
kind = "leader_follower"
leader = "car1"
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "lines.toml"
    path.write_text(FILE)
    return path


def minimal(**changes: Any) -> dict[str, Any]:
    return {"name": "m", "duration_s": 1.0, "vehicle": [{"name": "car1", "kind": "kinematic"}], **changes}


def test_a_file_is_read_into_checked_tables(file: Path) -> None:
    scenario, source = load(file)
    assert (scenario.name, scenario.duration_s, scenario.seed) == ("lines", 2.0, 0)
    assert scenario.radio == {"preset": "wss", "loss": {"probability": 0.2}}
    assert scenario.agents.defaults == {"k1": 0.8, "kind": "trajectory"}
    assert scenario.agents.runs == "inprocess"
    one, two = scenario.vehicle
    assert (one.name, one.kind, one.start) == ("car1", "lag", ((0.0, 0.0, 0.0), 0.0))  # [vehicles] is the default
    assert (two.name, two.kind, two.pose) == ("car2", "p2dx", (-1.0, 0.5, 0.0))  # a vehicle's own key wins
    assert two.agent is not None
    assert two.agent.params == {"leader": "car1"}
    assert source.folder == file.parent


def test_a_mapping_is_read_like_a_file_and_not_changed() -> None:
    content = minimal(radio={"loss": {"probability": 0.1}})
    scenario, source = load(content, settings={"radio.loss.probability": 0.5, "vehicle.car1.position": [1, 2, 3]}, seed=3)
    assert scenario.vehicle[0].agent is None
    assert source.of("vehicle.car1.kind") == "scenario"
    assert content == minimal(radio={"loss": {"probability": 0.1}})


@pytest.mark.parametrize("seed", [0, 1, 2**63 - 1])
def test_the_seed_of_the_call_wins(seed: int) -> None:
    assert load(minimal(seed=5), seed=seed)[0].seed == seed
    assert load(minimal(seed=5))[0].seed == 5


def test_settings_reach_every_depth(file: Path) -> None:
    settings = {
        "duration_s": 3,
        "radio.loss.probability": 0.5,
        "radio.delay.seconds": 0.1,  # a table missing in the file
        "agents.k1": 0.1,
        "agents.period_s": 0.2,
        "vehicles.tau_v_s": 0.1,
        "vehicle.car1.pose": [1, 2, 3],
        "vehicle.car2.agent.leader": "car9",
        "vehicle.car2.name": "last",
    }
    scenario, _ = load(file, settings=settings)
    assert scenario.duration_s == 3.0
    assert scenario.radio == {"preset": "wss", "loss": {"probability": 0.5}, "delay": {"seconds": 0.1}}
    assert scenario.agents.defaults["k1"] == 0.1
    assert scenario.agents.period_s == 0.2
    one, two = scenario.vehicle
    assert one.pose == (1.0, 2.0, 3.0)
    assert one.params == {"tau_v_s": 0.1}
    assert two.agent is not None
    assert (two.name, two.agent.params) == ("last", {"leader": "car9"})


def test_a_setting_names_its_argument(file: Path) -> None:
    _, source = load(file, settings={"radio.loss": {"probability": 0.5}}, seed=2)
    assert source.of("radio.loss.probability") == "--set radio.loss={'probability': 0.5}"
    assert source.of("radio.preset") == f"{file} line 6"
    assert source.of("seed") == "--seed 2"


@given(st.text(max_size=60), st.text(max_size=20))
def test_lines_are_found_in_any_text(text: str, key: str) -> None:
    place = Source("s.toml", Path(), text).of(key)
    assert place == "s.toml" or place.startswith("s.toml line ")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0.3", 0.3),
        ("3", 3),
        ("true", True),
        ("dr", "dr"),
        ('"dr"', "dr"),
        ("'3'", "3"),
        ("[1, 2.5]", [1, 2.5]),
        ('{ kind = "fixed", seconds = 0.1 }', {"kind": "fixed", "seconds": 0.1}),
        ("my agent.py:Mine", "my agent.py:Mine"),
        ("", ""),
        ("a=b", "a=b"),
        ("True", "True"),
        ("1e-3", 1e-3),
    ],
)
def test_a_setting_is_toml_or_a_string(text: str, value: Any) -> None:
    read = value_of(text)
    assert read == value
    assert type(read) is type(value)
    assert settings_of([f"a.b={text}", "c=2", "a.b=4", f"a.b={text}"]) == {"a.b": value, "c": 2}  # the last one wins


def test_not_finite_numbers_are_found_at_every_depth(file: Path) -> None:
    nan = float("nan")
    cases: list[tuple[dict[str, Any], str]] = [
        ({"duration_s": nan}, "duration_s"),
        ({"radio.path_loss.exponent": nan}, "radio.path_loss.exponent"),
        ({"vehicle.car2.agent.k1": nan}, "vehicle.car2.agent.k1"),
        ({"vehicle.car2.pose": [0.0, nan, 0.0]}, "vehicle.car2.pose[1]"),
        ({"agents.anything": {"deep": [1, {"er": nan}]}}, "agents.anything.deep[1].er"),
    ]
    for settings, key in cases:
        with pytest.raises(ScenarioError, match="must be finite, not nan") as caught:
            load(file, settings=settings)
        assert caught.value.key.endswith(key.removeprefix("vehicle."))
        assert caught.value.source.startswith(f"--set {next(iter(settings))}=")


def test_built_in_scenarios_have_their_files_name_and_a_description() -> None:
    names = scenarios.names()
    assert "formation-circle" in names
    for name in names:
        assert load(name).scenario.name == name
        assert re.fullmatch(r"[^\n]{20,}\.", scenarios.first_words(name))


def test_a_built_in_name_wins_over_a_file_of_that_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "formation-circle").write_text(FILE)
    assert load("formation-circle")[0].name == "formation-circle"
    assert load("./formation-circle")[0].name == "lines"


def test_the_window_may_end_where_it_begins_but_not_before() -> None:
    assert load(minimal(metrics={"from_s": 1, "to_s": 1}))[0].metrics.to_s == 1.0
    with pytest.raises(ScenarioError, match=r"metrics\.to_s: must not be earlier than metrics\.from_s"):
        load(minimal(metrics={"from_s": 1.5, "to_s": 1}))


def test_numbers_and_arrays_of_numpy_count_like_plain_ones() -> None:
    plain = minimal(duration_s=2.0)
    numpys = minimal(duration_s=np.float64(2.0))
    numpys["vehicle"][0]["pose"] = np.array([1.0, 2.0, 0.5])
    plain["vehicle"][0]["pose"] = [1.0, 2.0, 0.5]
    assert load(numpys)[0] == load(plain)[0]
    with pytest.raises(ScenarioError, match="holds a object"):
        load(minimal(world=object()))
