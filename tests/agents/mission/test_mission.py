"""A mission on one vehicle: algorithms from a table, facts from the algorithms, one commander, notes and messages."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.agents.aerial_loop import BODY
from tests.support.agents.agent_loop import Uav, bodies, info, present, reception_of_body
from tests.support.agents.scans import scan_of
from vcmvsp.agents.avoidance import Gap
from vcmvsp.agents.mission.mission import SearchMission
from vcmvsp.agents.reconnaissance.roster import Claim
from vcmvsp.cosim.agent import Agent, Observation, Radio
from vcmvsp.cosim.config import registry
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Vec3, Velocity

T_NS = 100_000_000
HERE = "tests.agents.mission.test_mission"
NAMES = ("a", "b", "c")


class ScriptedAlgorithm(Agent):
    """An algorithm with a constant speed and a script of facts by tick; records its begins and ends."""

    sensors = ()
    roster: Any = None

    def __init__(self, speed: float = 1.0, facts: dict[str, dict[str, Any]] | None = None) -> None:
        self.speed, self.script = speed, facts or {}
        self.calls: list[Any] = []
        self.known: dict[str, Any] = {}
        self.claim: Claim | None = None

    def facts(self, obs: Observation) -> Mapping[str, Any]:
        self.known |= self.script.get(str(obs.time_ns // T_NS), {})
        return {"shared": self.roster.shared(obs.time_ns), **self.known}

    def begin(self, obs: Observation, place: tuple[float, float] | None) -> None:
        self.calls.append(("begin", obs.time_ns // T_NS, place))
        self.claim = Claim("alpha", place or (0.0, 0.0), obs.time_ns)

    def end(self, obs: Observation) -> None:
        self.calls.append(("end", obs.time_ns // T_NS))
        self.claim = None

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        self.note(**{f"asked{self.speed:g}": True})
        return Velocity(linear=(self.speed, 0.0, 0.0))


def table(speed: float, **facts: dict[str, Any]) -> dict[str, Any]:
    """Table of an algorithm; ``facts``: its facts from a tick on, ``t5={"shared": True}``."""
    return {"kind": f"{HERE}:ScriptedAlgorithm", "speed": speed, "facts": {name[1:]: value for name, value in facts.items()}}


FOLLOWS = {"kind": "aerial_follower", "formation": {"shape": "line", "spacing": 4.0}}


class MissionRun:
    """A mission on one vehicle, tick by tick."""

    def __init__(self, name: str = "a", *, search: Any = None, track: Any = None, **more: Any) -> None:
        algorithms = {"search": search or table(1.0)} | ({} if track is None else {"track": track})
        algorithms |= {"formation": FOLLOWS} if "sectors" in more else {}
        self.agent = SearchMission(algorithms, acceleration=1e9, yaw_acceleration=1e9, **more)
        self.radio = Radio(name, NAMES)
        self.notes: list[dict[str, Any]] = []
        self.sent: list[list[Any]] = []
        self.agent.start(info(name, NAMES, body=BODY, sensors=("scan",)))

    def tick(self, number: int, nearest: float = 9.0, *messages: tuple[str, Any], velocity: Vec3 = (1.0, 0.0, 0.0)) -> Any:
        ranges = np.full(32, 9.0)
        ranges[12:20] = nearest  # ahead
        scan = scan_of(ranges, 6.0, time_ns=number * T_NS)
        uav = Uav((0.0, 0.0, 20.0), velocity=velocity)
        command = self.agent.act(uav.see(number * T_NS, [reception_of_body(*each) for each in messages], scan=scan), self.radio)
        self.notes.append(self.agent.drain_notes())
        self.sent.append(bodies(self.radio))
        return command


def test_a_recognised_target_is_tracked_and_reported_to_all() -> None:
    flown = MissionRun(track=table(2.0, t3={"recognised": True, "place": (4.0, 5.0)}))
    commands = [flown.tick(n).linear[0] for n in range(5)]
    assert commands == [1.0, 1.0, 1.0, 2.0, 2.0]
    (track,) = (each for name, each in flown.agent._tasks.items() if name == "track")
    assert isinstance(track, ScriptedAlgorithm)
    assert track.calls == [("begin", 3, (4.0, 5.0))]
    assert flown.notes[0] | {"since_s": 0.0} == flown.notes[0]
    assert {key: flown.notes[0][key] for key in ("task", "commander")} == {"task": "search", "commander": "search"}
    assert flown.notes[3]["commander"] == flown.notes[3]["task"] == "track"
    assert flown.notes[3]["why"] == flown.notes[3]["task_why"] == "a target is recognised"
    assert flown.notes[3]["asked1"]
    assert flown.notes[3]["asked2"]  # notes of both algorithms
    assert flown.sent[3] == [{"do": "track", "ms": 300, "tg": "alpha", "at": [4.0, 5.0], "since": 300}]


def test_a_target_tracked_by_another_vehicle_is_left_to_it() -> None:
    track = table(2.0, t3={"recognised": True, "place": (4.0, 5.0)}, t9={"recognised": False, "taken": True})
    flown = MissionRun(track=track)
    commands = [flown.tick(n).linear[0] for n in range(12)]
    assert commands == 3 * [1.0] + 6 * [2.0] + 3 * [1.0]
    made = flown.agent._tasks["track"]
    assert isinstance(made, ScriptedAlgorithm)
    assert made.calls == [("begin", 3, (4.0, 5.0)), ("end", 9)]


def test_without_algorithm_there_is_no_tracking() -> None:
    flown = MissionRun(search=table(1.0, t2={"probability": 0.999, "place": (1.0, 1.0), "recognised": True}))
    assert [flown.tick(n).linear[0] for n in range(5)] == [1.0] * 5


def test_avoidance_commands_near_obstacles_and_then_the_task_again() -> None:
    flown = MissionRun(avoidance=Gap(lookahead_m=4.0, max_speed=2.0))
    commanders = []
    for n in range(30):
        flown.tick(n, 3.0 if 5 <= n < 10 else 9.0)
        commanders += [flown.notes[-1]["commander"]] if "commander" in flown.notes[-1] else []
    assert commanders == ["search", "avoid1", "search"]
    assert all(note.get("task", "search") == "search" for note in flown.notes)


def test_the_guard_keeps_the_distance_for_every_commander() -> None:
    """The obstacle appeared in the previous tick, before any switch; the guard brakes all the same."""
    flown = MissionRun(search=table(4.0), avoidance=Gap(lookahead_m=4.0, max_speed=2.0, keep_m=1.0, approach=0.4, braking=2.0))
    flown.tick(0)
    flown.tick(1, 1.5, velocity=(4.0, 0.0, 0.0))
    assert flown.tick(2, 1.5, velocity=(4.0, 0.0, 0.0)).linear[0] <= 0.4 * (1.5 - 1.0) + 1e-9


def test_the_second_in_a_sector_flies_in_formation_until_the_first_tracks() -> None:
    flown = MissionRun("b", sectors=(("a", "b"), ("c",)))
    report = {"seq": 0, "t_ns": 0, "x": 10.0, "y": 0.0, "th": 0.0, "v": 1.0, "w": 0.0}
    report |= {"vx": 1.0, "vy": 0.0, "vz": 0.0, "z": 20.0}
    flown.tick(0, 9.0, ("a", report))
    assert (flown.notes[0]["task"], flown.notes[0]["task_why"]) == ("formation", "the sector is shared")
    assert present(flown.agent.follows).leader == "a"
    flown.tick(10, 9.0, ("a", {"do": "track", "ms": 900, "tg": "alpha", "at": [0.0, 0.0], "since": 800}))
    assert flown.notes[-1]["task"] == "search"
    assert flown.agent.follows is None
    assert not [body for body in flown.sent[-1] if "seq" in body]  # no followers


def test_the_leader_of_a_sector_reports_its_motion_while_it_searches() -> None:
    flown = MissionRun(sectors=(("a", "b"), ("c",)), track=table(2.0, t3={"recognised": True, "place": (4.0, 5.0)}))
    for n in range(5):
        flown.tick(n)
    reports = [[body for body in sent if "seq" in body] for sent in flown.sent]
    assert [len(each) for each in reports] == [1, 1, 1, 0, 0]
    assert (reports[2][0]["seq"], reports[2][0]["vx"], reports[2][0]["z"]) == (2, 1.0, 20.0)


def test_files_of_the_formation_algorithm_are_found_beside_the_scenario(tmp_path: Path) -> None:
    """The folder of files is available while a mission is built, not when it starts."""
    own = "class Guess:\n    def predict(self, report, age_s):\n        return report.pose, 0.0, 0.0\n"
    (tmp_path / "own.py").write_text(own)
    formation = FOLLOWS | {"estimator": "own.py:Guess"}
    with registry.looking_in(tmp_path):
        agent = SearchMission({"search": table(1.0), "formation": formation}, sectors=(("a", "b"), ("c",)))
    for name, tasks in (("a", ["search"]), ("b", ["search", "formation"]), ("c", ["search"]), ("b", ["search", "formation"])):
        agent.start(info(name, NAMES, body=BODY, sensors=("scan",)))
        assert list(agent._tasks) == tasks


def test_inconsistent_missions_are_refused() -> None:
    with pytest.raises(ScenarioError, match="an algorithm for search is missing"):
        SearchMission({"track": table(1.0)})
    with pytest.raises(ScenarioError, match="serach"):
        SearchMission({"serach": table(1.0)})
    with pytest.raises(ScenarioError, match="formation"):
        SearchMission({"search": table(1.0)}, sectors=(("a", "b"),))
    with pytest.raises(ValueError, match="members: unknown vehicle 'd'"):
        MissionRun(members=("a", "d"))
    with pytest.raises(ScenarioError) as caught:
        SearchMission({"search": {"kind": f"{HERE}:ScriptedAlgorithm", "sped": 1.0}})
    assert caught.value.key == "algorithms.search.sped"


def test_unknown_facts_are_refused_with_the_name_of_the_algorithm() -> None:
    flown = MissionRun(search=table(1.0, t1={"probabilty": 0.5}))
    flown.tick(0)
    with pytest.raises(ValueError, match=r"algorithms.search: facts\(\) returned .*'probabilty'.*probability"):
        flown.tick(1)
