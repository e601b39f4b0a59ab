"""Figures 40 and 41: a robot before a wall with doors; its choice of door, and estimated door widths (Toh 2012, 4.1).

A following AmigoBot needs 0.4 m: twice its safety distance. It chooses the wide enough door nearest in bearing to its leader;
with the leader behind it, the gap at that border of its field of view. The method alone acts: no speed limit near obstacles
(``level`` 1). A door is no wider at an angle: from further aside, a robot touches a door that is just wide enough.

`Gauge` jumps from wall to wall. At each it asks an agent ``avoid`` with the method ``gap`` whether it goes through the door,
for a series of needed widths. So these are the widths on which the platform decides, from ranges that its scanner measured.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.metrics.motion import motion
from vcmvsp.cosim.reproduction.figures.avoidance.speed_limits import TOWARDS
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Panel
from vcmvsp.cosim.reproduction.figures.scenarios import T, scene
from vcmvsp.cosim.reproduction.row import Row, absolute, at_least, at_most
from vcmvsp.cosim.reproduction.runner import Job, Runner
from vcmvsp.cosim.runs.api import Result
from vcmvsp.cosim.types import Array, Velocity

HERE = "vcmvsp.cosim.reproduction.figures.avoidance.gaps"
NEEDED_M, NARROW_M, ENOUGH_M = 0.40, 0.35, 0.45  # needed by a robot; 5 cm less and more
SIDE_M, HEIGHT_M, THIN_M, APART_M = 4.0, 8.0, 1e-5, 12.0  # walls: extent to either side and in height, thickness; spacing
LOW_M, TOP = 1.0, 6  # flight height; the free sides of a wall are gaps, too
ASIDE = 0.2  # share of the way from the middle of a door to its left jamb
STEPS, STEP_M = 15, 4.0 * 2.0**-15  # of a bisection, starting at 4 m
DOORS, PARTS, SIGHT_M = 998, 4, 2.0  # random doors, runs, look-ahead distance
DISTANCES, RANGE_M, PIER_M, FAR_M = 400, (0.8, 1.3), 0.3, 2.4  # Fig. 40: number, m; between doors; look-ahead distance
BODY_M = 0.18  # radius of an AmigoBot
WALL_M, END_M, LOOKAHEAD_M = 2.5, 3.0, 3.5  # distance of the wall, its extent to either side, look-ahead distance of robots
SIDES = ("left", "middle", "right")
ALIKE = ((1.2, 0.7), (0.0, 0.7), (-1.2, 0.7))  # centre and width of three doors, m
UNLIKE = ((0.75, NARROW_M), (0.0, ENOUGH_M), (-0.75, NARROW_M), (-1.5, 0.7))
BEYOND_M, SLOT_M = 1.6, (-0.7, 0.0)  # from the wall to the leader; slot behind the leader, m
BEHIND, ROUND = ((-1.5, 1.0), (-1.5, -1.0)), (4.9, 0.4)  # leaders behind the robot; from them to the slot beyond the wall, m
RUN_S = 30.0  # of a follower
TURNED_DEG = 60.0  # direction of the border; doors are within 45
Doors = Sequence[tuple[float, float]]  # centre and width, m
Case = tuple[Doors, tuple[float, float], tuple[float, float]]  # of `team`


def wall_pieces(doors: Doors, end: float) -> list[tuple[float, float]]:
    """Wall segments between doors (centre, width), m."""
    edges = [-end, *(edge for middle, width in sorted(doors) for edge in (middle - 0.5 * width, middle + 0.5 * width)), end]
    return list(zip(edges[::2], edges[1::2], strict=True))


def wall_box(
    x: float, y: float, low: float, high: float, tilt: float, thick: float = 0.02, height: float = 1.0
) -> dict[str, Any]:
    """A wall segment rotated about (x, y)."""
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
        """A point of the door seen from the origin, m; -1: right jamb, 1: left jamb."""
        along = self.middle + 0.5 * share * self.width
        return self.distance - along * math.sin(self.tilt), along * math.cos(self.tilt)


class Gauge(Agent):
    """Jumps to a new position at every tick and measures the apparent width of a door from there.

    The recorded height above the lowest one encodes the measured width.

    Args:
        places: position at each tick, x and y, m, world.
        doors: distance, tilt, centre and width of the door to measure from there.
        lookahead_m: look-ahead distance of the method.
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
        """Measure a door, and move to the next position."""
        index, self._tick = min(self._tick, len(self.doors) - 1), self._tick + 1
        place = self.places[min(self._tick, len(self.places) - 1)]
        target = (*place, LOW_M + self._width(obs, radio, WallDoor(*self.doors[index])))
        x, y, z = ((to - at) / self._info.period_s for to, at in zip(target, obs.state.position, strict=True))
        return Velocity(linear=(x, y, z))

    def _width(self, obs: Observation, radio: Radio, door: WallDoor) -> float:
        """The largest needed width with which the agent takes the door, m."""
        accepted_m, refused_m = 0.0, 4.0
        for _ in range(STEPS):
            needed = 0.5 * (accepted_m + refused_m)
            if self._takes(obs, radio, door, needed):
                accepted_m = needed
            else:
                refused_m = needed
        return accepted_m

    def _takes(self, obs: Observation, radio: Radio, door: WallDoor, needed: float) -> bool:
        """Whether a vehicle with this needed width goes through the door.

        Its destination is beside the centre, so that no lane there is free, but not far: a gap is cut a quarter turn from the
        desired direction, and closed at the look-ahead distance, so a door partly beyond it would look wider.
        """
        avoidance = {
            "kind": "gap",
            "level": 1,
            "top": TOP,
            "lookahead_m": self.lookahead_m,
            "margin_m": 0.0,
            "keep_m": 0.5 * needed,
        }
        task = {"kind": TOWARDS, "direction": door.at(ASIDE)}
        agent: Agent = binding.call(registry.find("agent", "avoid"), {"task": task, "avoidance": avoidance})
        agent.start(self._info)
        command = agent.act(obs, radio)
        assert isinstance(command, Velocity)  # noqa: S101
        x, y, _ = command.linear
        right, left = (math.atan2(*door.at(side)[::-1]) for side in (-1.0, 1.0))
        return bool(x or y) and right < math.atan2(y, x) < left


class GaugeReading(NamedTuple):
    """Doors and their measured widths."""

    doors: tuple[WallDoor, ...]
    width: Array  # (n,) m


def gauge(
    walls: Mapping[tuple[float, float], Sequence[WallDoor]], looks: Sequence[tuple[tuple[float, float], WallDoor]], far: float
) -> Job:
    """A run in which door widths are measured.

    Args:
        walls: the doors of each wall, seen from a point (m, world), the origin of their axes.
        looks: viewpoints, each with a door as seen from there.
        far: look-ahead distance, m.
    """
    boxes = []
    for (x, y), doors in walls.items():
        distance, tilt = doors[0].distance, doors[0].tilt
        for low, high in wall_pieces([(door.middle, door.width) for door in doors], SIDE_M):
            boxes.append(wall_box(x + distance, y, low, high, tilt, THIN_M, HEIGHT_M))
    places, doors = zip(*looks, strict=True)
    agent = {"kind": f"{HERE}:Gauge", "places": list(places), "doors": [list(door) for door in doors], "lookahead_m": far}
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
    world, record = {"kind": "boxes", "boxes": boxes}, {"period_s": T}
    scenario = scene("gauge", (len(looks) + 1) * T, [vehicle], world=world, record=record)
    return Job(scenario, partial(gauged, doors=doors))


def gauged(result: Result, doors: tuple[WallDoor, ...]) -> GaugeReading:
    """Read the widths measured in a run of `gauge`."""
    height = motion(result.states).position[2][:, 0]
    return GaugeReading(doors, height[1 : len(doors) + 1] - LOW_M)


def random_doors() -> list[Job]:
    """Random doors, each in its own wall, without those whose jamb is hardly visible: these merge with the free side."""
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
    """Fig 40: two doors that are too narrow and two that are not, in every order, from random distances."""
    draws = np.random.Generator(np.random.PCG64(40))
    orders = sorted(set(itertools.permutations((NARROW_M, NARROW_M, ENOUGH_M, ENOUGH_M))))
    looks = []
    for distance in draws.uniform(*RANGE_M, DISTANCES).tolist():
        which = int(draws.integers(len(orders)))
        looks += [((-distance, APART_M * which), door) for door in _doors(distance, orders[which])]
    walls = {(0.0, APART_M * which): _doors(0.0, each) for which, each in enumerate(orders)}
    return gauge(walls, looks, FAR_M)


def _doors(distance: float, widths: Sequence[float]) -> list[WallDoor]:
    """Four doors of these widths, m, beside each other in a wall ahead."""
    first = -0.5 * (2.0 * (NARROW_M + ENOUGH_M) + 3.0 * PIER_M)
    middles = [sum(widths[:k]) + 0.5 * widths[k] + k * PIER_M + first for k in range(4)]
    return [WallDoor(distance, 0.0, *door) for door in zip(middles, widths, strict=True)]


class GapRun(NamedTuple):
    """Data of a run of `team`."""

    place: Array  # (m, 2) m, of the follower
    leader: Array  # (2,) m
    clearance_m: float

    @property
    def through_m(self) -> float:
        """Lateral position at the first passage of the wall, m to the left; NaN: no passage."""
        beyond = np.flatnonzero(self.place[:, 0] > WALL_M)
        return float(self.place[beyond[0], 1]) if beyond.size else math.nan

    @property
    def first_deg(self) -> float:
        """Direction after the first 0.5 m, degrees to the left."""
        away = np.flatnonzero(np.hypot(*self.place.T) > 0.5)
        return math.degrees(math.atan2(*self.place[away[0], ::-1])) if away.size else math.nan


def team(doors: Doors, leader: tuple[float, float], slot: tuple[float, float]) -> dict[str, Any]:
    """A follower at the origin, facing east, before a wall with doors (centre and width, m), and a stationary leader."""
    avoidance = {
        "kind": "gap",
        "level": 1,
        "keep_m": 0.5 * NEEDED_M,
        "lookahead_m": LOOKAHEAD_M,
        "top": TOP,
        "max_speed": 0.3,
    }
    law = {"leader": "leader", "slot": slot, "handle": 0.4, "max_speed": 0.3, "avoidance": avoidance}
    stands = {"kind": "trajectory", "path": "straight", "speed": 0.0}
    return scene(
        "doors",
        RUN_S,
        [
            {"name": "leader", "pose": (*leader, 0.0), "agent": stands},
            {"name": "follower", "pose": (0.0, 0.0, 0.0), "agent": {"kind": "leader_follower", **law}},
        ],
        world={"kind": "boxes", "boxes": [wall_box(WALL_M, 0.0, *end, 0.0) for end in wall_pieces(doors, END_M)]},
        vehicles={"kind": "amigobot", "sensors": {"scan": {"kind": "lms", "position": (0.0, 0.0, 0.3)}}},
    )


def passed(result: Result) -> GapRun:
    """Read the data of a run of `team`."""
    movement = motion(result.states)
    x, y = (movement.position[axis] for axis in (0, 1))
    lead, own = movement.column("leader"), movement.column("follower")
    place, at = np.column_stack([x[:, own], y[:, own]]), np.array([x[0, lead], y[0, lead]])
    return GapRun(place, at, float(result.metrics["safety"]["min_clearance_m"]))


def fig_41(runner: Runner) -> Figure:
    """Figure 41: the door that a follower takes, and apparent door widths."""
    beyond = WALL_M + BEYOND_M
    cases: dict[str, Case] = {}
    for name, (middle, _) in zip(SIDES, ALIKE, strict=True):
        cases[f"leader behind the {name} door"] = (ALIKE, (beyond, middle), SLOT_M)
    for number, (middle, _) in enumerate(UNLIKE[:3:2], 1):
        cases[f"leader behind narrow door {number}"] = (UNLIKE, (beyond, middle), SLOT_M)
    for name, side, leader in zip(SIDES[::2], (1.0, -1.0), BEHIND, strict=True):
        cases[f"leader behind the robot, {name}"] = (ALIKE, leader, (ROUND[0], side * ROUND[1]))
    answers = runner([*(Job(team(*case), passed) for case in cases.values()), four_doors(), *random_doors()])
    passages: dict[str, GapRun] = dict(zip(cases, answers[: len(cases)], strict=True))
    four, parts = answers[len(cases)], answers[len(cases) + 1 :]
    rows: list[Row] = []
    for number, (case, each) in enumerate(passages.items()):
        if number < 3:
            rows.append(absolute(f"{case}: passes the wall at y, m", ALIKE[number][0], each.through_m, 0.5 * 0.7))
        elif number < 5:
            rows.append(absolute(f"{case}: passes the one that is wide enough at y, m", 0.0, each.through_m, 0.5 * ENOUGH_M))
        else:
            side = 1.0 if number == 5 else -1.0
            rows.append(at_least(f"{case}: its way at first, deg to that side", TURNED_DEG, side * each.first_deg))
        rows.append(at_least(f"{case}: least clearance, m", BODY_M, each.clearance_m))
    return Figure(
        "Figs 40, 41: which door a follower takes", _panels(passages, four, parts), [*rows, *_widths(four, parts)], columns=3
    )


def _widths(four: GaugeReading, parts: Sequence[GaugeReading]) -> Iterator[Row]:
    true = np.array([door.width for door in four.doors])
    off = np.concatenate([_off(each) for each in parts])
    right = int(((four.width > NEEDED_M) == (true > NEEDED_M)).sum())
    yield absolute(f"{len(true)} doors 5 cm too narrow or wider than needed: told apart", len(true), right, 0.0)
    yield at_least(f"{len(off)} random doors: least width above the true one, m", -STEP_M, off.min())
    yield absolute("random doors: width above the true one, mean, m", 0.009, off.mean(), 0.001)
    yield at_most("random doors: width above the true one, m", 0.023 * 1.05, off.max())


def _off(each: GaugeReading) -> Array:
    """Error of the estimated widths, (n,) m."""
    return np.asarray(each.width - [door.width for door in each.doors])


def _panels(passages: Mapping[str, GapRun], four: GaugeReading, parts: Sequence[GaugeReading]) -> list[Panel]:
    ways = list(passages.items())
    distance = np.array([door.distance for door in four.doors])
    narrow = np.array([door.width < NEEDED_M for door in four.doors])
    texts = [
        Curve(distance[which], four.width[which], f"{width:g} m wide", color, "markers")
        for which, width, color in ((narrow, NARROW_M, 2), (~narrow, ENOUGH_M, 1))
    ]
    true = np.array([door.width for each in parts for door in each.doors])
    off = Curve(true, 100.0 * np.concatenate([_off(each) for each in parts]), "", 1, "markers")
    return [
        _map("Three doors of 0.7 m", ALIKE, ways[:3]),
        _map("Doors of 0.35, 0.45, 0.35 and 0.7 m", UNLIKE, ways[3:5]),
        _map("The leader is behind the robot", ALIKE, ways[5:]),
        Panel("Four doors", "distance of the wall [m]", "width as it looks [m]", texts, levels={"needed": NEEDED_M}),
        Panel("Random doors", "width [m]", "looks wider by [cm]", [off], y_limits=(0.0, 3.0)),
    ]


def _map(title: str, doors: Doors, ways: Sequence[tuple[str, GapRun]]) -> Panel:
    curves = [Curve(np.array([WALL_M, WALL_M]), np.array(end), "wall") for end in wall_pieces(doors, END_M)]
    for color, (_, each) in enumerate(ways, 1):
        moves = np.hypot(*(each.place - each.place[-1]).T) > 0.01
        curves.append(Curve(each.place[moves, 0], each.place[moves, 1], "follower", color, "pose"))
        curves.append(Curve(each.leader[:1], each.leader[1:], "its leader", color, "hollow"))
    return Panel(title, "x east [m]", "y north [m]", curves, equal=True)
