"""A team of three before a passage, without the platform: the test gives scans and receptions."""

import math
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from tests.support.agents import agent_loop
from tests.support.agents.agent_loop import bodies, observe, present
from tests.support.agents.formation_member import TICK_NS, report_of
from tests.support.agents.scans import scan_of
from vcmvsp.agents.formation.leaders.trajectory import Trajectory
from vcmvsp.agents.formation.reports.prediction import DeadReckoning
from vcmvsp.agents.formation.reports.report import ReportReceiver
from vcmvsp.agents.formation.team.passage import Lookout
from vcmvsp.agents.formation.team.shape import Formation, Passage
from vcmvsp.agents.formation.team.team import Team
from vcmvsp.cosim.agent import Body, Observation, Radio, VehicleInfo
from vcmvsp.cosim.types import Reception, Scan, Velocity

CARS = ("car1", "car2", "car3")
AMIGO = Body(width_m=0.28, radius_m=0.22)
BEAMS = 181  # a degree apart, from right to left
SIDE = 0.5 + 0.14 + 0.1  # of the wedge of three, spacing 1 m: slots, half a body, margin


def info(name: str = "car1", **more: Any) -> VehicleInfo:
    return agent_loop.info(name, **{"vehicles": CARS, "body": AMIGO, **more})


def formation(**passage: Any) -> Formation:
    return Formation(spacing=1.0, passage=Passage(**{"spacing": 0.8, **passage}))


def lookout(name: str = "car1", team_formation: Formation | None = None, **about: Any) -> Lookout:
    of = team_formation or formation()
    return Lookout(present(of.passage), Team(of, CARS, name), info(name, **about))


def scan(*points: tuple[float, float], time_ns: int = 0) -> Scan:
    """A return on the beams that are nearest to these points, x and y, m; nothing else."""
    ranges = np.full(BEAMS, np.inf, np.float32)
    for x, y in points:
        ranges[90 + round(math.degrees(math.atan2(y, x)))] = math.hypot(x, y)
    return scan_of(ranges, time_ns=time_ns)


def observation(reading: Any, tick: int = 0, *received: Reception) -> Observation:
    return observe((0.03 * tick, 0.0, 0.0), tick * TICK_NS, received, v=0.3, scan=reading)


def free(reading: Any, *, ahead_m: float = 2.0, receiver: ReportReceiver | None = None, of: Lookout | None = None) -> bool:
    return (of or lookout()).is_free(observation(reading), receiver or ReportReceiver((), 0.0), DeadReckoning(), ahead_m)


def receptions_of(*receptions: Reception) -> ReportReceiver:
    """Receptions of the leader, at the origin."""
    listening = ReportReceiver(CARS, 0.0)
    listening.take(observation(None, 1000, *receptions))
    return listening


def at(sender: str, x: float, y: float, tick: int = 0, **more: Any) -> Reception:
    return report_of(sender, tick, v=0.0, **{"x": x, "y": y, **more})


def clear(car: str, tick: int, cl: Any = 1) -> Reception:
    return report_of(car, tick, cl=cl)


class ScriptedLeader:
    """A leader whose scans and receptions the test gives."""

    def __init__(self, of: Formation, clock_bound_s: float = 0.0, **sees_and_is: Any) -> None:
        self.agent = Trajectory("straight", formation=of, clock_bound_s=clock_bound_s)
        self.radio, self.tick = Radio("car1", CARS), -1
        self.agent.start(info(**sees_and_is))

    def act(self, reading: Any, *received: Reception) -> tuple[dict[str, Any], Mapping[str, Any]]:
        """Next tick: notes, and the sent report."""
        self.tick += 1
        reading = msgspec.structs.replace(reading, time_ns=self.tick * TICK_NS) if isinstance(reading, Scan) else reading
        assert isinstance(self.agent.act(observation(reading, self.tick, *received), self.radio), Velocity)
        (report,) = bodies(self.radio)
        return self.agent.drain_notes(), report
