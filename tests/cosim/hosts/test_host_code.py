"""A host of agents executes only what its own command line names; other code named by the run is refused."""

import shlex
import signal
from pathlib import Path

import pytest

import vcmvsp
from tests.support.cosim.run_processes import Stage, exit_of, output_at_exit, staged
from tests.support.cosim.teams import ELSEWHERE, FOLLOWER, LEADER, team

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

SCENARIO = team("far", LEADER, FOLLOWER + ELSEWHERE, duration_s=1.0, join_timeout_s=60.0, deadline_s=30.0)
CANARY = """
import pathlib, sys
if "agent" in sys.argv:  # in a host, not in the run
    pathlib.Path({canary!r}).touch()
"""
ESTIMATOR = (
    CANARY
    + """
from vcmvsp.agents.formation.reports.prediction import Hold
class Own(Hold):
    pass
"""
)
STRAIGHT = """
from vcmvsp import Agent, Velocity
class Straight(Agent):
    def act(self, obs, radio):
        return Velocity(linear=({speed}, 0.0, 0.0))
"""


class Place(Stage):
    """A run in one folder, its host in another; the run's files create a canary file when a host imports them."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.canary, self.away = folder / "canary", folder / "away"
        self.away.mkdir()
        (folder / "est.py").write_text(ESTIMATOR.format(canary=str(self.canary)))
        (folder / "straight.py").write_text((CANARY + STRAIGHT).format(canary=str(self.canary), speed=0.3))
        (folder / "far.toml").write_text(SCENARIO)

    def run_with(self, *settings: str) -> None:
        sets = [word for each in settings for word in ("--set", each)]
        self.run = self.start("run", "far.toml", "--listen", self.endpoint, "--out", "out", *sets)

    def host(self, *words: str) -> tuple[int, str]:
        """Exit code and output of a host in the other folder."""
        self.folder, home = self.away, self.folder
        try:
            return exit_of(self.start("agent", *words, "--vehicle", "car2", "--connect", self.endpoint))
        finally:
            self.folder = home

    def drives(self, agent: str) -> None:
        """Give car2 another agent."""
        path = self.folder / "far.toml"
        path.write_text(path.read_text().replace('kind = "leader_follower", leader = "car1"', f'kind = "{agent}"'))

    def printed(self) -> list[str]:
        """Words of the command that the run prints for its host."""
        assert self.run.stderr is not None
        line = next(line for line in self.run.stderr if line.startswith("vcmvsp agent"))
        return shlex.split(line)[2:]


place = staged(Place)


@pytest.mark.parametrize("arguments", [(), ("leader_follower",)], ids=["the scenario's class", "a class of its own"])
@pytest.mark.parametrize(
    "setting",
    ["agents.estimator={}/est.py:Own", "agents.estimator=est.py:Own", "vehicle.car2.agent.kind={}/straight.py:Straight"],
)
def test_a_file_that_the_run_names_is_not_executed(place: Place, arguments: tuple[str, ...], setting: str) -> None:
    if arguments and "kind" in setting:
        arguments = ("straight.py:Straight",)  # the host's folder has no such file
    place.run_with(setting.format(place.folder))
    code, output = place.host(*arguments)
    assert code == 2 or "there is no file" in output or "--folder DIR" in output
    assert code != 0
    place.run.send_signal(signal.SIGINT)  # it would wait for another host
    assert exit_of(place.run)[0] != 0
    assert not place.canary.exists()


def test_a_module_that_the_run_names_is_not_imported(place: Place) -> None:
    (place.away / "mine.py").write_text(ESTIMATOR.format(canary=str(place.canary)))
    place.run_with("vehicle.car2.agent.estimator=mine:Own")
    code, output = place.host()
    assert code != 0
    assert "the run requests 'mine:Own'" in output
    assert "--allow mine:Own" in output
    assert not place.canary.exists()


def test_a_folder_of_the_host_is_searched_by_file_name(place: Place) -> None:
    """The run names another folder, even an absolute one; the host's own copy is used and reported."""
    own_folder = place.away / "own"
    own_folder.mkdir()
    (own_folder / "est.py").write_text(ESTIMATOR.format(canary=str(place.away / "used")))
    place.run_with(f"agents.estimator={place.folder}/est.py:Own")
    code, output = place.host("--folder", "own")
    assert code == 0, output
    assert f"Own comes from {own_folder / 'est.py'}" in output
    assert (place.away / "used").exists()
    assert not place.canary.exists()
    assert exit_of(place.run)[0] == 0


@pytest.mark.parametrize("setting", ["agents.estimator=est.py:Own", "vehicle.car2.agent.kind=straight.py:Straight"])
def test_the_printed_command_works_as_it_is(place: Place, setting: str) -> None:
    """On the same machine, from any folder, with the bytes of one process."""
    if "kind" in setting:
        place.drives("trajectory")
    place.run_with(setting)
    words = place.printed()
    place.folder, home = place.away, place.folder
    host = place.start("agent", *words)
    place.folder = home
    assert [exit_of(host)[0], exit_of(place.run)[0]] == [0, 0]
    key, _, value = setting.partition("=")
    expected = vcmvsp.run(place.folder / "far.toml", set={key: value}, agents="inprocess", mcap=False).metrics["digest"]
    assert place.digest() == expected


def test_other_source_code_than_the_runs_own_is_named_and_recorded(place: Place) -> None:
    """On stderr at once, in about.json, in the report and by a replay, which runs this machine's code; imported files count."""
    place.drives("straight.py:Straight")
    for folder, speed in ((place.folder, 0.3), (place.away, 0.5)):
        (folder / "helper.py").write_text(f"SPEED = {speed}")
        (folder / "straight.py").write_text("from helper import SPEED\n" + STRAIGHT.format(speed="SPEED"))
    place.run_with()
    code, output = place.host("straight.py:Straight")
    assert code == 0, output
    output = output_at_exit(0, place.run)
    why = "helper.py differs"
    assert f"the code at the host of car2 differs from this machine's: {why}" in output
    assert place.written("about.json")["unrepeatable"] == [f"the host of car2 ran different code: {why}"]
    assert why in (place.out / "report.html").read_text()
    (place.out / "helper.py").write_text("SPEED = 0.3")
    output = output_at_exit(1, place.start("replay", "out", "--agents", "inprocess"))
    assert f"differs from out: the host of car2 ran different code: {why}" in output


def test_the_same_source_code_is_not_remarked(place: Place) -> None:
    (place.away / "est.py").write_text((place.folder / "est.py").read_text())
    place.run_with("vehicle.car2.agent.estimator=est.py:Own")
    code, output = place.host("--folder", ".")
    assert code == 0, output
    code, output = exit_of(place.run)
    assert (code, "other code" in output) == (0, False)
    output = output_at_exit(0, place.start("replay", "out", "--agents", "inprocess"))
    assert "same digest as out" in output
