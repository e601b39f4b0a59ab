"""Shapes and topologies through the whole platform: exact ones, errors that grow with distance, and a change during the run."""

import itertools
from typing import Any

import numpy as np
import pytest

import vcmvsp
from tests.support.agents.agent_loop import drive
from tests.support.agents.straight_paths import crosses
from tests.support.validation.fleets import T, lossy, poses
from tests.support.validation.teams import COLUMN, link_errors, neighbours_only, parents_of, rms_of_links, team
from vcmvsp.agents.formation.followers.leader_follower import LeaderFollower
from vcmvsp.agents.formation.leaders.trajectory import Trajectory

pytestmark = pytest.mark.slow

SHAPES = ("column", "line", "echelon", "wedge", "box", "diamond")


@pytest.mark.parametrize("topology", ["star", "chain"])
@pytest.mark.parametrize("shape", SHAPES)
def test_five_robots_keep_every_shape_on_a_circle(shape: str, topology: str) -> None:
    """R = 2 m, handle 0.5 m: every |z| < 1e-5."""
    scenario = team(5, 45.0, {"shape": shape, "topology": topology, "spacing": 0.8}, agents={"handle": 0.5})
    result = vcmvsp.run(scenario, mcap=False)
    _, errors = link_errors(result)
    assert len(errors) == 4
    assert max(error[-1] for error in errors.values()) < 1e-5
    assert result.metrics["formation"]["final_m"] < 1e-5


def test_trees_and_graphs_keep_their_shape_too() -> None:
    tree = {"shape": "wedge", "topology": "k-tree", "branching": 2, "spacing": 0.8}
    graph = {"shape": "diamond", "topology": "graph", "spacing": 0.8}
    graph["parents"] = {"car2": "car1", "car5": "car2", "car3": "car5", "car4": "car3"}
    for formation in (tree, graph):
        assert vcmvsp.run(team(5, 45.0, formation), mcap=False).metrics["formation"]["final_m"] < 1e-6


def test_errors_grow_with_the_lever_arm_in_a_star_only() -> None:
    """Column of 7, random leader, without delay and free to reverse: simulated .003 to .040 and .003 to .007 m (RMS)."""
    free: dict[str, Any] = {"handle": 0.6, "max_reverse": 1e9}
    star = [LeaderFollower("leader", slot=(-0.8 * hop, 0.0), **free) for hop in range(1, 7)]
    before = ("leader", "f0", "f1", "f2", "f3", "f4")
    chain = [LeaderFollower(name, slot=(-0.8, 0.0), broadcast=True, **free) for name in before]
    starts = [(-0.8 * hop, 0.0, 0.0) for hop in range(1, 7)]
    of_star, of_chain = (
        np.sqrt(np.mean(drive(Trajectory("random"), cars, poses=starts, duration_s=120).error[200:] ** 2, axis=0))
        for cars in (star, chain)
    )
    assert of_star[[0, -1]] == pytest.approx([0.003, 0.040], rel=0.1, abs=5e-4)
    assert of_chain[[0, -1]] == pytest.approx([0.003, 0.007], rel=0.1, abs=5e-4)
    assert (np.diff(of_star) > 0.004).all()
    assert of_chain.max() < 0.008


def test_a_chain_suits_a_column() -> None:
    """The law of the previous test through the platform: a chain suits a column."""
    formation = {**COLUMN, "topology": "star"}
    rest: dict[str, Any] = {"leader": {"path": "random"}, "agents": {"handle": 0.5}, "metrics": {"from_s": 20.0}}
    star = rms_of_links(vcmvsp.run(team(7, 70.0, formation, **rest), mcap=False))
    chain = rms_of_links(vcmvsp.run(team(7, 70.0, COLUMN, **rest), mcap=False))
    assert star[0] == chain[0]
    assert np.diff(star).min() > 0.005
    assert star[-1] > 4 * chain[-1]
    assert max(chain) < 3 * chain[0]


CHANGES = ((20.0, "column"), (45.0, "diamond"))


@pytest.mark.parametrize(("topology", "probability"), [("star", 0.0), ("chain", 0.0), ("k-tree", 0.5)])
def test_a_team_changes_its_shape_without_crossing_ways(topology: str, probability: float) -> None:
    formation = {"shape": "wedge", "topology": topology, "spacing": 1.0, "changes": CHANGES}
    result = vcmvsp.run(team(7, 75.0, formation, leader={"path": "straight"}, radio=lossy(probability)), mcap=False)
    times, errors = link_errors(result)
    _, moved = poses(result)
    beside_leader = moved[:, 1:, :2] - moved[:, :1, :2]  # the leader drives along x
    changes = [
        (int(np.argmax(times > at_s)), int(np.argmax(times >= settled_s))) for at_s, settled_s in ((20, 44.9), (45, 75.0))
    ]
    for begin, end in changes:
        ways = [(tuple(begins), tuple(ends)) for begins, ends in zip(beside_leader[begin], beside_leader[end], strict=True)]
        assert max(np.hypot(a[0] - p[0], a[1] - p[1]) for a, p in ways) > 0.5  # members do change places
        assert not any(crosses(*one, *other) for one, other in itertools.combinations(ways, 2))
        assert max(error[begin + 10] for error in errors.values()) > 0.1
        assert max(error[end] for error in errors.values()) < 2e-3
    column = sorted(beside_leader[changes[0][1]].tolist())
    assert column == pytest.approx(np.array([(-float(row), 0.0) for row in range(6, 0, -1)]), abs=0.02)


def test_a_new_shape_propagates_along_a_lossy_chain() -> None:
    """Each receives its neighbours only, with half of the messages lost: all adopt the shape, one after the other."""
    formation = {**COLUMN, "changes": ((10.0, "echelon"),)}
    result = vcmvsp.run(team(6, 40.0, formation, leader={"path": "straight"}, radio=neighbours_only(6, 0.5)), mcap=False)
    side = 0.8 * np.sqrt(0.5)
    adopted: dict[str, float] = {}
    for placed in result.follows:
        if placed.follows.slot == pytest.approx((-side, -side)):
            adopted.setdefault(placed.vehicle, placed.time_ns / 1e9)
    assert list(adopted) == [f"car{number}" for number in range(2, 7)]
    hops = np.diff([10.0, *adopted.values()])
    assert hops.min() >= T - 1e-9
    assert hops.sum() > 5 * T + 1e-9  # some messages were lost
    assert all(len(parents) == 2 for parents in parents_of(result).values())  # from the start, and from the change on
    assert result.metrics["formation"]["final_m"] < 1e-3
