"""Stand-ins for cameras: a detector without errors, and a loop around an agent that uses it."""

import math
from collections.abc import Callable, Mapping

import numpy as np

from tests.support.agents.aerial_loop import BODY
from tests.support.agents.agent_loop import T, Uav, info
from vcmvsp.agents.reconnaissance.ground_point import nadir_of
from vcmvsp.agents.reconnaissance.roster import Roster
from vcmvsp.agents.reconnaissance.track import TrackTarget
from vcmvsp.agents.reconnaissance.watch import GroundDisc, WatchFrame, Watching
from vcmvsp.cosim.agent import Observation, Radio
from vcmvsp.cosim.types import Image, Sighting, Waypoint

T_NS = round(T * 1e9)
MEMBERS = ("me", "other")

Point = tuple[float, float]
Targets = Callable[[float], Mapping[str, Point]]
BLACK = Image(pixels=np.zeros((480, 640, 3), np.uint8), focal_px=400.0)


def at_rest(**places: tuple[float, float]) -> Targets:
    """Targets at rest."""
    return lambda time_s: places


class FakeWatch:
    """Stand-in for a `Watch`: a picture at an interval of ticks; all targets in it are recognised."""

    region: GroundDisc | None = None

    names = ("alpha", "bravo")

    def __init__(self, targets: Targets, every: int = 1) -> None:
        self.targets, self._every_ns = targets, every * T_NS
        self.settings = Watching(targets=(), camera="eye")
        self.regions: list[GroundDisc | None] = []
        self._last: tuple[int, WatchFrame | None] = -1, None

    def look(self, obs: Observation) -> WatchFrame | None:
        if obs.time_ns != self._last[0]:
            self._last = obs.time_ns, self._frame(obs) if obs.time_ns % self._every_ns == 0 else None
        return self._last[1]

    def _frame(self, obs: Observation) -> WatchFrame:
        self.regions.append(self.region)
        image = Image(pixels=BLACK.pixels, time_ns=obs.time_ns, focal_px=BLACK.focal_px)
        nadir = nadir_of(image, obs.state)
        found = []
        for name, place in self.targets(obs.time_s).items():
            pixel = nadir.pixel(place)
            if pixel is None or not (0 <= pixel[0] < 640 and 0 <= pixel[1] < 480):
                continue
            if self.region is not None and math.dist(place, self.region.place) > self.region.reach_m:
                continue
            point = nadir.ground_point(pixel)
            assert point is not None
            found.append(Sighting(target=name, place=point, centre_px=pixel, angle=0.0, side_px=20.0, score=0.9))
        return WatchFrame(obs.time_ns, nadir, tuple(found), image, (0, 0, 640, 480), self.region is None)


def started_agent(track: TrackTarget, eye: FakeWatch, *, alone: bool = True) -> TrackTarget:
    """The agent with that camera, started under the name ``me``."""
    track.watch = eye  # type: ignore[assignment]
    track.roster = None if alone else Roster("me", MEMBERS)
    track.start(info("me", MEMBERS, body=BODY))
    return track


def positions_over(track: TrackTarget, uav: Uav, ticks: int) -> list[Uav]:
    """Positions of the vehicle at every tick; a hover command stops it."""
    radio, was = Radio("me", MEMBERS), []
    for tick in range(ticks):
        was.append(Uav(uav.position, uav.yaw))
        command = track.act(uav.see(tick * T_NS), radio)
        if not isinstance(command, Waypoint):
            uav.move(command)
    return was
