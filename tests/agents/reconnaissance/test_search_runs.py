"""A search through the whole platform: vehicles, a detector of cells, a radio that loses, and the notes of it."""

import math
from typing import Any

import pytest

from vcmvsp.agents.reconnaissance.search import Search
from vcmvsp.cosim.agent import Observation, Radio
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.runs.api import run
from vcmvsp.cosim.types import Velocity

TARGETS = ((9.0, 31.0), (27.0, 13.0))
SEARCH: dict[str, Any] = {"kind": "search", "area": [0, 0, 40, 40], "sensor": "looks", "swath_m": 8.0, "alive_s": 30.0}


def scenario(**search: Any) -> dict[str, Any]:
    vehicle = {"kind": "point", "sensors": {"looks": {"kind": "target_sensor"}}, "agent": {**SEARCH, **search}}
    return {
        "name": "search",
        "duration_s": 45.0,
        "seed": 3,
        "physics": {"kind": "kinematic"},
        "world": {"kind": "empty", "targets": [{"place": list(place)} for place in TARGETS]},
        "radio": {"preset": "ideal", "loss": {"probability": 0.5}},
        "vehicle": [{**vehicle, "name": f"uav{i}", "position": [20.0 * i - 19.0, 1.0, 20.0]} for i in (1, 2)],
    }


class Told(Search):
    """Remembers what it notes."""

    def __init__(self, area: tuple[float, float, float, float], **params: Any) -> None:
        super().__init__(area, **params)
        self.noted: list[dict[str, Any]] = []

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        command = super().act(obs, radio)
        if self._notes:
            self.noted.append({**self._notes, "time_s": obs.time_s})
        return command


def searched(seed: int) -> dict[str, list[dict[str, Any]]]:
    params = {name: value for name, value in SEARCH.items() if name not in {"kind", "area"}}
    agents = {name: Told((0.0, 0.0, 40.0, 40.0), targets=2, **params) for name in ("uav1", "uav2")}
    run(scenario(targets=2), seed=seed, agents=agents, mcap=False)
    return {name: agent.noted for name, agent in agents.items()}


def test_both_find_both_targets_and_the_same_again() -> None:
    notes = searched(3)
    for noted in notes.values():
        found = [(note["found_x"], note["found_y"]) for note in noted if "found" in note]
        assert all(min(math.dist(target, place) for place in found) < 3.0 for target in TARGETS)
        assert [note["status"] for note in noted if "status" in note] == ["done"]
    assert searched(3) == notes
    assert searched(4) != notes


@pytest.mark.parametrize(
    ("params", "key"),
    [
        ({"exchange": "gossip"}, r"agent\.exchange"),
        ({"speed": 0.0}, r"agent\.speed"),
        ({"overlap": 1.0}, r"agent\.overlap"),
        ({"most": 0}, r"agent\.most"),
        ({"p": 0.1}, "0 < q < p < 1"),
        ({"sensor": "camera"}, "watching"),
    ],
)
def test_a_scenario_that_makes_no_sense_says_where(params: dict[str, Any], key: str) -> None:
    with pytest.raises(ScenarioError, match=key):
        run(scenario(**params), mcap=False)
