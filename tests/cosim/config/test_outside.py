"""Untrusted input: documents, file names and classes are used, or refused in one line."""

import math
import pickle
import threading
from pathlib import Path
from typing import Any

import pytest

import vcmvsp
from tests.support.cosim.command_line import assert_refused, two_cars, vcmvsp_command
from vcmvsp.cosim.errors import ScenarioError, UsageError
from vcmvsp.cosim.runs import api
from vcmvsp.cosim.util import documents

pytestmark = pytest.mark.processes

OWN = """
from vcmvsp import Agent

class Rest(BaseException):
    pass

class Mute(Exception):
    def __str__(self):
        raise RuntimeError("no words")

class Base(Agent):
    def act(self, obs, radio):
        raise Rest("enough")

class Silent(Agent):
    def act(self, obs, radio):
        raise Mute()

class Made(Agent):
    def __init__(self):
        raise Rest("enough")
    def act(self, obs, radio):
        return None

class Other:
    def act(self, obs, radio):
        return None

class Stopped(Agent):
    def act(self, obs, radio):
        raise KeyboardInterrupt
"""


@pytest.fixture(autouse=True)
def _files(here: Path) -> None:
    (here / "own.py").write_text(OWN)
    for name in ("loop.toml", "loop.py"):
        (here / name).symlink_to(name)
    (here / "w.toml").write_text("[ground]\npicture = 'nothing.png'\n")


UNNAMED = two_cars().replace('name = "car2"', "name = 5")


def world(path: str) -> str:
    return two_cars(tail=f'[world]\nkind = "file"\npath = "{path}"')


def agent(kind: str) -> str:
    return two_cars(agent=f'kind = "{kind}"')


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (two_cars(top="seed = " + "9" * 5000), "thousands of digits"),
        (two_cars(top="seed = 0x" + "f" * 5000), "s.toml line 4: seed: must fit into 64 bits"),
        (two_cars(top="seed = " + "[" * 5000), "are nested more than"),
        (two_cars(top=".".join("a" * 20_000) + " = 1"), "the key in line 4 has more than 64 parts"),
        (world("loop.toml"), "world.path: there is no file"),
        (world("a\\u0000b"), "cannot be the name of a file"),
        (world("a" * 5000), "cannot be the name of a file"),
        (world("w.toml"), "there is no picture file"),
        (agent("loop.py:X"), "s.toml line 19: vehicle.car2.agent.kind: there is no file"),
        (agent("a\\u0000.py:X"), "cannot be the name of a file"),
        (agent("own.py:Other"), "'own.py:Other' is not derived from vcmvsp.Agent"),
        (agent("own.py:Made"), "Made raised Rest: enough (own.py line 21, in __init__)"),
        (UNNAMED.replace("[-1.0", "[nan"), "line 18: vehicle[1].pose[0]: must be finite"),
        (UNNAMED + "count = 3", "vehicle[1].name: must be a string, not 5"),
        (two_cars(car1="count = 9999", car2="count = 9999"), "19998 vehicles are too many"),
    ],
)
def test_a_scenario_is_refused_in_one_line(text: str, words: str) -> None:
    Path("s.toml").write_text(text)
    assert_refused(vcmvsp_command("check", "s.toml"), words)


@pytest.mark.parametrize(
    "setting", ["a" + ".a" * 5000 + "=1", "seed=" + "[" * 5000, "seed=" + "9" * 5000, "seed=0x" + "f" * 5000]
)
def test_a_setting_is_refused_in_one_line(setting: str) -> None:
    Path("s.toml").write_text(two_cars())
    answer = vcmvsp_command("check", "s.toml", "--set", setting)
    assert_refused(answer, "vcmvsp: --set ")
    assert len(answer.err) < 500


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("Base", "agent own.py:Base of vehicle car2: raised Rest: enough (own.py line 13, in act)"),
        ("Silent", "raised Mute: (its text cannot be read) (own.py line 17, in act)"),
        ("Stopped", "interrupted at 0.000 s in agent own.py:Stopped of vehicle car2 (own.py line 31, in act)"),
    ],
)
def test_every_exception_of_an_agent_names_it_and_its_line(kind: str, words: str) -> None:
    Path("s.toml").write_text(agent(f"own.py:{kind}"))
    with pytest.raises(vcmvsp.VcmvspError) as caught:
        vcmvsp.run("s.toml")
    assert words in str(caught.value)


@pytest.mark.parametrize(
    "raw", [b"[" * 5000, b"9" * 5000, b'{"a":' * 200 + b"1" + b"}" * 200, b'"\xff"', b'"\\ud800"', b"{", b""]
)
def test_json_is_refused_by_one_error(raw: bytes) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        documents.read_json(raw)


@pytest.mark.parametrize("metrics", ["{", "[]", "[" * 5000, '{"schema": ' + "9" * 5000 + "}", '{"schema": "vcmvsp.metrics/1"}'])
def test_a_report_contains_all_readable_parts(metrics: str) -> None:
    Path("run").mkdir()
    for name in ("metrics.json", "about.json"):
        (Path("run") / name).write_text(metrics)
    assert vcmvsp_command("report", "run").code == 0


def test_a_name_longer_than_the_systems_is_refused_in_one_line() -> None:
    for arguments in (("export", "a" * 5000, "--csv"), ("keys", "list", "--keys", "a" * 5000), ("report", "a" * 5000)):
        assert_refused(vcmvsp_command(*arguments), "File name too long")


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan, math.inf, 1e-300])
def test_a_speed_is_a_positive_number(speed: float) -> None:
    with pytest.raises(UsageError, match=r"--realtime .*: must be from"):
        vcmvsp.run("formation-circle", realtime=speed)
    assert vcmvsp_command("run", "formation-circle", "--realtime", str(speed)).code == 2


class Still(vcmvsp.Agent):
    """Waits inside `act` until `let_go` is set, at most 20 s."""

    entered, let_go = threading.Event(), threading.Event()

    def act(self, obs: vcmvsp.Observation, radio: vcmvsp.Radio) -> None:
        self.entered.set()
        self.let_go.wait(20.0)


def test_a_class_in_the_place_of_an_agent_is_refused() -> None:
    wrong: Any = {"car2": Still}
    with pytest.raises(ScenarioError, match=r"agents.car2: must be an object .* not a class: write Still\(...\)"):
        vcmvsp.run("formation-circle", agents=wrong)


def test_an_agent_that_does_not_return_is_named() -> None:
    lines: list[str] = []

    def tell(line: str) -> None:
        lines.append(line)
        if "has been computing" in line:
            Still.let_go.set()

    settings = {"duration_s": 0.5, "agents.deadline_s": 0.1, "physics.kind": "kinematic"}
    vcmvsp.run("formation-circle", set=settings, agents={"car3": Still()}, tell=tell)
    (line,) = [line for line in lines if "has been computing" in line]
    assert line.startswith("agent Still of vehicle car3 has been computing for ")
    assert "Ctrl-C" in line
    assert api.computing(None) == ("", "")


def test_a_result_refuses_to_be_pickled(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(two_cars())
    with pytest.raises(UsageError, match=r"cannot be pickled: save\(folder\)"):
        pickle.dumps(vcmvsp.run("s.toml", mcap=False))


def test_a_typo_in_the_file_of_a_host_is_named(tmp_path: Path) -> None:
    (tmp_path / "typo.py").write_text("class Mine(Agnet): pass\n")
    answer = vcmvsp_command("agent", "typo.py:Mine", "--vehicle", "car2", "--connect", "tcp/127.0.0.1:1")
    assert_refused(answer, "vcmvsp agent: 'typo.py' cannot be imported: NameError")


@pytest.mark.parametrize(
    "section", ["vehicle.car1.driver", "vehicle[1].driver", "vehicle.car1.sensors.front.rate_hz", "vehicle.car1.agent.leader"]
)
def test_the_reference_finds_keys_as_spelled_in_messages(section: str) -> None:
    assert section.rpartition(".")[2] in vcmvsp_command("reference", section).out


def test_the_list_of_scenarios_shows_whole_sentences() -> None:
    assert "Fig. 54)." in vcmvsp_command("list").out
