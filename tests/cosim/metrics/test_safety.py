"""Least clearance of vehicles from obstacles: through the whole platform and from tables alone."""

import json
import math
from pathlib import Path
from typing import Any

import pytest

import vcmvsp
from tests.support.cosim.recordings import TENTH, metrics_after, states
from vcmvsp import Agent, Observation, Radio, Velocity
from vcmvsp.cosim.assembly.worlds import world_of
from vcmvsp.cosim.clock import SECOND_NS


class Straight(Agent):
    """Straight ahead along the world's x axis."""

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        return Velocity(linear=(0.5, 0.0, 0.0))


def passing(world: dict[str, Any], *vehicles: dict[str, Any], **settings: Any) -> vcmvsp.Result:
    """A run of 10 s in which all vehicles drive 5 m eastwards."""
    listed = [{"name": f"v{k}", "kind": "kinematic", **each} for k, each in enumerate(vehicles)]
    scenario = {"name": "passing", "duration_s": 10.0, "physics": {"kind": "kinematic"}, "world": world, "vehicle": listed}
    return vcmvsp.run(scenario, agents={each["name"]: Straight() for each in listed}, set=settings)


def clearance(result: vcmvsp.Result) -> Any:
    return result.metrics["safety"]["min_clearance_m"]


def test_past_a_pillar_and_over_it(tmp_path: Path) -> None:
    """1 m beside its axis; a flyer 0.4 m above its top; a vehicle that ends before it: the corner is nearest."""
    pillar = {"kind": "pillar", "position": [2.5, 0.0], "radius": 0.25, "square": True, "height": 1.0}
    assert clearance(passing(pillar, {"pose": [0, 1, 0]})) == pytest.approx(0.75)
    assert clearance(passing(pillar, {"pose": [0, 1, 0]}, {"kind": "point", "position": [0, 0.1, 1.4]})) == pytest.approx(0.4)
    result = passing(pillar, {"pose": [-4.0, 1.0, 0.0]})
    assert clearance(result) == pytest.approx(math.hypot(1.25, 0.75))
    result.save(tmp_path / "run")
    assert json.loads((tmp_path / "run/metrics.json").read_text())["safety"]["min_clearance_m"] == clearance(result)


def test_clearance_is_of_all_vehicles_and_the_whole_run() -> None:
    wall = {"boxes": [{"center": [0.0, 3.0, 0.5], "size": [0.2, 4.0, 1.0]}]}
    assert clearance(passing(wall, {"pose": [0, 0, 0]}, {"pose": [0, -1, 0]}, **{"metrics.from_s": 8.0})) == pytest.approx(1.0)


def test_a_recorder_without_a_world_has_no_clearance() -> None:
    events = [states(TENTH.at(k), {"a": (0.1 * k, 0.0, 0.0)}) for k in range(11)]
    world, _ = world_of("pillar", {})
    of_world, of_none = (metrics_after("a", events, SECOND_NS, world=each) for each in (world, None))
    assert of_world["safety"]["min_clearance_m"] == pytest.approx(3.5)
    assert of_none["safety"]["min_clearance_m"] is None
    assert of_world["digest"] == of_none["digest"]
