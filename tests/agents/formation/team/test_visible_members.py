"""A follower on wheels does not get around the leader that it follows, however it is told whom to follow."""

from typing import Any

import pytest

from tests.support.agents.formation_member import says
from tests.support.agents.passage_team import CARS, info, scan, sees
from vcmvsp.agents.avoidance import Gap, Vfh
from vcmvsp.agents.formation.followers.leader_follower import LeaderFollower
from vcmvsp.agents.formation.team.shape import Formation, Passage
from vcmvsp.cosim.agent import Radio
from vcmvsp.cosim.types import Velocity

WAYS = [
    {"leader": "car1", "slot": (-0.8, 0.0), "handle": 0.4},
    {"formation": Formation(shape="column", spacing=0.8)},
    {"formation": Formation(shape="own", offsets=((0.0, 0.0), (-0.8, 0.0), (-0.8, 0.8)), passage=Passage(spacing=0.8))},
]
LEADER = (0.6, 0.1)  # m from the follower, nearer than its place is
BACK = ((0.45, 0.0), (0.45, 0.1), (0.45, 0.2))  # of the leader, as the follower sees it


def command(told: dict[str, Any], points: tuple[tuple[float, float], ...], **more: Any) -> Velocity:
    """Of a follower that sees returns at these points, m, and has heard of its leader."""
    follower = LeaderFollower(**told, **more)
    follower.start(info("car2"))
    return follower.act(sees(scan(*points), 0, says("car1", 0, v=0.3, x=LEADER[0], y=LEADER[1])), Radio("car2", CARS))


@pytest.mark.parametrize("told", WAYS)
@pytest.mark.parametrize("method", [Gap(), Vfh()])
def test_a_follower_does_not_get_around_its_leader(told: dict[str, Any], method: Any) -> None:
    assert command(told, BACK, avoidance=method) == command(told, BACK)


@pytest.mark.parametrize("told", WAYS)
def test_a_follower_gets_around_what_stands_before_its_leader(told: dict[str, Any]) -> None:
    before = ((0.2, -0.2), (0.2, -0.15))
    around = command(told, (*before, *BACK), avoidance=Gap())
    assert around == command(told, before, avoidance=Gap()) != command(told, before)
