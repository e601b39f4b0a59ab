"""A team member without the platform: the test gives its receptions and reads its commands and messages."""

from typing import Any

from tests.support.agents.agent_loop import info, observe, present, reception_of_body
from vcmvsp.agents.formation.followers.leader_follower import LeaderFollower
from vcmvsp.agents.formation.team.shape import Formation
from vcmvsp.cosim.agent import Radio
from vcmvsp.cosim.types import Follows, Message, Reception, Velocity

CARS = ("car1", "car2", "car3", "car4")
TICK_NS = 100_000_000
COLUMN = {"shape": "column", "topology": "chain", "spacing": 0.8}


def member(name: str, formation: dict[str, Any] | None = None, **params: Any) -> LeaderFollower:
    follower = LeaderFollower(formation=Formation(**(formation or COLUMN)), **params)
    follower.start(info(name, CARS))
    return follower


class MemberRunner:
    """A member, its radio, and its ticks."""

    def __init__(self, name: str, formation: dict[str, Any] | None = None, **params: Any) -> None:
        self.follower, self.radio, self.tick = member(name, formation, **params), Radio(name, CARS), -1

    @property
    def follows(self) -> Follows:
        """The place that it keeps."""
        return present(self.follower.follows)

    def report(self, *received: Reception, v: float = 0.0) -> dict[str, Any]:
        """Body of the report of the next tick."""
        (report,) = (message.body for message in self.act(*received, v=v)[2] if message.to is None)
        assert isinstance(report, dict)
        return report

    def act(self, *received: Reception, v: float = 0.0, x: float = -1.0) -> tuple[Velocity, dict[str, Any], list[Message]]:
        """Next tick: command, notes, and sent messages."""
        self.tick += 1
        command = self.follower.act(observe((x, 0.0, 0.0), self.tick * TICK_NS, received, v=v), self.radio)
        return command, self.follower.drain_notes(), self.radio.drain()


def report_of(sender: str, tick: int, v: float = 0.3, **more: Any) -> Reception:
    body = {"seq": tick, "t_ns": tick * TICK_NS, "x": 0.03 * tick, "y": 0.0, "th": 0.0, "v": v, "w": 0.0, **more}
    return reception_of_body(sender, body)
