"""File names in scenarios: recognised by the parameter's type, in any table, and copied with the resolved scenario."""

import tomllib
from pathlib import Path

import pytest

from tests.support.cosim.command_line import two_cars, vcmvsp_command
from vcmvsp.cosim.config import registry

OWN = """
from pathlib import Path

from vcmvsp import Agent
from vcmvsp.cosim.types import Measured
from vcmvsp.physics.sensors.sensor import Sensor


class Table(Sensor):
    def __init__(self, path: str, file: str, table: Path | None = None, **more) -> None:
        super().__init__(**more)
        assert (path, file, table.read_text()) == ("circle", "nothing", "1")

    def measure(self, scene, row, rng):
        return Measured(time_ns=scene.now_ns, values={"one": 1.0})


class Reader(Agent):
    def __init__(self, table: Path, picture: str = "") -> None:
        assert table.read_text() == "1", table
        assert picture == "table.csv"

    def act(self, obs, radio):
        return None
"""


@pytest.fixture(autouse=True)
def _files(here: Path) -> None:
    (here / "s").mkdir()
    for name, text in (("own.py", OWN), ("table.csv", "1"), ("circle", "no circle")):
        (here / "s" / name).write_text(text)


def test_a_string_named_path_is_no_file(tmp_path: Path) -> None:
    sensor = 'sensors = { t = { kind = "own.py:Table", path = "circle", file = "nothing", table = "table.csv" } }'
    (tmp_path / "s" / "s.toml").write_text(two_cars(car1=sensor))
    assert vcmvsp_command("run", "s/s.toml", "--out", "out", "--quiet").code == 0
    sensor_table = tomllib.loads((tmp_path / "out" / "scenario.toml").read_text())["vehicle"][0]["sensors"]["t"]
    assert (sensor_table["path"], sensor_table["file"], sensor_table["table"]) == ("circle", "nothing", "table.csv")
    assert (tmp_path / "out" / "table.csv").read_text() == "1"
    assert not (tmp_path / "out" / "circle").exists()


def test_the_file_of_an_agent_is_copied_and_equal_strings_name_it_too(tmp_path: Path) -> None:
    (tmp_path / "s" / "s.toml").write_text(two_cars(agent='kind = "own.py:Reader", table = "table.csv", picture = "table.csv"'))
    answer = vcmvsp_command("run", "s/s.toml", "--out", "out", "--quiet")
    assert answer.code == 0, answer.err
    assert (tmp_path / "out" / "table.csv").read_text() == "1"
    assert vcmvsp_command("run", "out/scenario.toml", "--out", "again", "--quiet").code == 0


def test_a_built_in_scenario_takes_files_of_the_current_folder(tmp_path: Path) -> None:
    text = "from vcmvsp import Agent\nclass Still(Agent):\n    def act(self, obs, radio):\n        return None\n"
    (tmp_path / "mine.py").write_text(text)
    answer = vcmvsp_command("check", "formation-circle", "--set", "vehicle.car2.agent.kind=mine.py:Still")
    assert answer.code == 0, answer.err
    assert registry.located("mine.py", registry.SHIPPED) == tmp_path / "mine.py"
    assert registry.located("targets/alpha.png", registry.SHIPPED) == registry.SHIPPED / "targets" / "alpha.png"
