"""How wide doors look to a robot, by the platform's own detection of gaps (Toh 2012, 4.1 and Fig. 40).

`Gauge` jumps from wall to wall, and at each asks an agent ``avoid`` with the method ``gap``, for one width after another that
it would need, whether it goes through the door. So these are the widths by which the platform decides, from ranges that its
scanner measured.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.metrics.motion import motion
from vcmvsp.cosim.reproduction.figures.scenarios import IDEAL, T
from vcmvsp.cosim.reproduction.runner import Job
from vcmvsp.cosim.runs.api import Result
from vcmvsp.cosim.types import Array, Velocity

HERE = "vcmvsp.cosim.reproduction.figures.avoidance.gap_gauge"
NEEDED_M, NARROW_M, ENOUGH_M = 0.40, 0.35, 0.45  # a robot needs; 5 cm less and more
SIDE_M, HEIGHT_M, THIN_M, APART_M = 4.0, 8.0, 1e-5, 12.0  # of walls: how far to either side, how high, thickness; between them
LOW_M, TOP = 1.0, 6  # flight; both free sides of a wall are gaps, too
ASIDE = 0.2  # of the way from the middle of a door to its left jamb
STEPS, STEP_M = 15, 4.0 * 2.0**-15  # of a bisection from 4 m on
DOORS, PARTS, SIGHT_M = 998, 4, 2.0  # random doors, runs, look-ahead distance
DISTANCES, RANGE_M, PIER_M, FAR_M = 400, (0.8, 1.3), 0.3, 2.4  # Fig. 40: how many, m; between doors; look-ahead distance


def wall_pieces(doors: Sequence[tuple[float, float]], end: float) -> list[tuple[float, float]]:
    """From where to where there is wall between doors (middle, width), m."""
    edges = [-end, *(edge for middle, width in sorted(doors) for edge in (middle - 0.5 * width, middle + 0.5 * width)), end]
    return list(zip(edges[::2], edges[1::2], strict=True))


def wall_box(
    x: float, y: float, low: float, high: float, tilt: float, thick: float = 0.02, height: float = 1.0
) -> dict[str, Any]:
    """A piece of a wall that is turned about (x, y)."""
    along = 0.5 * (low + high)
    center = (x - along * math.sin(tilt), y + along * math.cos(tilt), 0.5 * height)
    return {"center": center, "size": (thick, high - low, height), "yaw_rad": tilt}


class WallDoor(NamedTuple):
    """A door in a wall that crosses the x axis ``distance`` ahead, turned by ``tilt``."""

    distance: float  # m
    tilt: float  # rad
    middle: float  # m along the wall, to the left
    width: float  # m

    def at(self, share: float) -> tuple[float, float]:
        """A point of it as seen from the origin, m; -1: its right jamb, 1: its left one."""
        along = self.middle + 0.5 * share * self.width
        return self.distance - along * math.sin(self.tilt), along * math.cos(self.tilt)


class Towards(Agent):
    """Flies into one direction for ever."""

    def __init__(self, direction: tuple[float, float]) -> None:
        self.direction = direction

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """The same at every tick, 1 m/s."""
        x, y = self.direction
        away = math.hypot(x, y)
        return Velocity(linear=(x / away, y / away, 0.0))


class Gauge(Agent):
    """Is at a new place at every tick, from which it asks how wide doors look.

    It tells by where it goes next: that is recorded. Its height above the lowest one is the width that it has found.

    Args:
        places: where it is at each tick, x and y, m, world.
        doors: distance, tilt, middle and width of the door that it looks at from there.
        lookahead_m: of the method.
    """

    def __init__(
        self, places: tuple[tuple[float, float], ...], doors: tuple[tuple[float, float, float, float], ...], lookahead_m: float
    ) -> None:
        self.places, self.doors, self.lookahead_m = places, doors, lookahead_m
        self._tick = 0

    def start(self, info: VehicleInfo) -> None:
        """Store the vehicle's data."""
        self._info = info

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Gauge a door, and on to the next place."""
        here, self._tick = min(self._tick, len(self.doors) - 1), self._tick + 1
        there = self.places[min(self._tick, len(self.places) - 1)]
        target = (*there, LOW_M + self._width(obs, radio, WallDoor(*self.doors[here])))
        x, y, z = ((to - at) / self._info.period_s for to, at in zip(target, obs.state.position, strict=True))
        return Velocity(linear=(x, y, z))

    def _width(self, obs: Observation, radio: Radio, door: WallDoor) -> float:
        """The largest width that may be needed for the door to be taken, m."""
        accepted_m, refused_m = 0.0, 4.0
        for _ in range(STEPS):
            needed = 0.5 * (accepted_m + refused_m)
            if self._takes(obs, radio, door, needed):
                accepted_m = needed
            else:
                refused_m = needed
        return accepted_m

    def _takes(self, obs: Observation, radio: Radio, door: WallDoor, needed: float) -> bool:
        """Whether a vehicle that needs so much goes through the door.

        It is sent beside the middle, so that no lane there is free, but not far: a gap is cut a quarter turn from where a
        vehicle wants to go, and closed at the look-ahead distance, so that a door of which a part lies there looks wider.
        """
        avoidance = {
            "kind": "gap",
            "level": 1,
            "top": TOP,
            "lookahead_m": self.lookahead_m,
            "margin_m": 0.0,
            "keep_m": 0.5 * needed,
        }
        task = {"kind": f"{HERE}:Towards", "direction": door.at(ASIDE)}
        agent: Agent = binding.call(registry.find("agent", "avoid"), {"task": task, "avoidance": avoidance})
        agent.start(self._info)
        command = agent.act(obs, radio)
        assert isinstance(command, Velocity)  # noqa: S101
        x, y, _ = command.linear
        right, left = (math.atan2(*door.at(side)[::-1]) for side in (-1.0, 1.0))
        return bool(x or y) and right < math.atan2(y, x) < left


class GaugeReading(NamedTuple):
    """Doors, and how wide they looked."""

    doors: tuple[WallDoor, ...]
    width: Array  # (n,) m


def gauge(
    walls: Mapping[tuple[float, float], Sequence[WallDoor]], looks: Sequence[tuple[tuple[float, float], WallDoor]], far: float
) -> Job:
    """A run in which doors are gauged.

    Args:
        walls: the doors of each wall, as seen from a point (m, world) that is the origin of their axes.
        looks: from where, and at which door as seen from there.
        far: look-ahead distance, m.
    """
    boxes = []
    for (x, y), doors in walls.items():
        distance, tilt = doors[0].distance, doors[0].tilt
        for low, high in wall_pieces([(door.middle, door.width) for door in doors], SIDE_M):
            boxes.append(wall_box(x + distance, y, low, high, tilt, THIN_M, HEIGHT_M))
    places, doors = [place for place, _ in looks], tuple(door for _, door in looks)
    agent = {"kind": f"{HERE}:Gauge", "places": places, "doors": [list(door) for door in doors], "lookahead_m": far}
    vehicle = {
        "name": "gauge",
        "kind": "point",
        "radius_m": 0.01,
        "max_speed": 1e6,
        "max_climb": 1e6,
        "position": (*places[0], LOW_M),
        "sensors": {"scan": {"kind": "lms", "sigma_m": 0.0, "quantum_m": 0.0}},
        "agent": agent,
    }
    scenario = {
        "name": "gauge",
        "duration_s": (len(looks) + 1) * T,
        "physics": {"kind": "kinematic"},
        "world": {"kind": "boxes", "boxes": boxes},
        "radio": IDEAL,
        "vehicle": [vehicle],
        "record": {"period_s": T},
    }
    return Job(scenario, partial(gauged, doors=doors))


def gauged(result: Result, doors: tuple[WallDoor, ...]) -> GaugeReading:
    """What a run of `gauge` has found."""
    height = motion(result.states).position[2][:, 0]
    return GaugeReading(doors, height[1 : len(doors) + 1] - LOW_M)


def random_doors() -> list[Job]:
    """Each in a wall of its own; those are left out of which a jamb is hardly in sight: they are one with the free side."""
    draws, doors = np.random.Generator(np.random.PCG64(0)), list[WallDoor]()
    while len(doors) < DOORS:
        distance, width, tilt, middle = draws.uniform((0.5, 0.4, -0.3, -0.4), (1.7, 1.6, 0.3, 0.4)).tolist()
        door = WallDoor(distance, tilt, middle, width)
        if max(math.hypot(*door.at(side)) for side in (-1.0, 1.0)) < SIGHT_M - 0.02:
            doors.append(door)
    jobs = []
    for part in range(PARTS):
        looks = [((APART_M * number, 0.0), door) for number, door in enumerate(doors[part::PARTS])]
        jobs.append(gauge({place: [door] for place, door in looks}, looks, SIGHT_M))
    return jobs


def four_doors() -> Job:
    """Fig 40: two that are too narrow and two that are not, in every order, from random distances."""
    draws = np.random.Generator(np.random.PCG64(40))
    orders = sorted(set(itertools.permutations((NARROW_M, NARROW_M, ENOUGH_M, ENOUGH_M))))
    middles = np.array([[sum(each[:k]) + 0.5 * each[k] + k * PIER_M for k in range(4)] for each in orders])
    middles -= 0.5 * (2.0 * (NARROW_M + ENOUGH_M) + 3.0 * PIER_M)
    looks = []
    for distance in draws.uniform(*RANGE_M, DISTANCES).tolist():
        which = int(draws.integers(len(orders)))
        place = (-distance, APART_M * which)
        looks += [(place, WallDoor(distance, 0.0, float(middles[which, k]), orders[which][k])) for k in range(4)]
    walls = {
        (0.0, APART_M * which): [WallDoor(0.0, 0.0, float(middles[which, k]), each[k]) for k in range(4)]
        for which, each in enumerate(orders)
    }
    return gauge(walls, looks, FAR_M)
