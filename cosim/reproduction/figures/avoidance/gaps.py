"""Figures 40 and 41: a robot before a wall with doors; the door that it takes, and the estimated width of doors.

A following AmigoBot needs 0.4 m: twice its distance to keep. It takes the wide enough door nearest in bearing to its leader;
with the leader behind it, the gap at that border of its field of view. Only the method is shown: no speed limit near
obstacles (``level`` 1). `cosim.reproduction.figures.avoidance.gap_gauge` measures the estimated widths. A door is no wider at
an angle: from further aside, one that is just wide enough is touched.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from vcmvsp.cosim.metrics.motion import motion
from vcmvsp.cosim.reproduction.figures.avoidance.gap_gauge import (
    ENOUGH_M,
    NARROW_M,
    NEEDED_M,
    STEP_M,
    TOP,
    GaugeReading,
    four_doors,
    random_doors,
    wall_box,
    wall_pieces,
)
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Panel
from vcmvsp.cosim.reproduction.figures.scenarios import IDEAL
from vcmvsp.cosim.reproduction.row import Row, absolute, at_least, at_most
from vcmvsp.cosim.reproduction.runner import Job, Runner
from vcmvsp.cosim.runs.api import Result
from vcmvsp.cosim.types import Array

BODY_M = 0.18  # radius of an AmigoBot
WALL_M, END_M, LOOKAHEAD_M = 2.5, 3.0, 3.5  # how far ahead the wall is, how far it goes to either side; how far robots look
SIDES = ("left", "middle", "right")
ALIKE = ((1.2, 0.7), (0.0, 0.7), (-1.2, 0.7))  # middle and width of three doors, m
UNLIKE = ((0.75, NARROW_M), (0.0, ENOUGH_M), (-0.75, NARROW_M), (-1.5, 0.7))
BEYOND_M, SLOT_M = 1.6, (-0.7, 0.0)  # from the wall to the leader; from the leader to the place behind it, m
BEHIND, ROUND = ((-1.5, 1.0), (-1.5, -1.0)), (4.9, 0.4)  # leaders behind the robot; from them to the place beyond the wall, m
TURNED_DEG = 60.0  # a way to the border; doors are within 45


class GapRun(NamedTuple):
    """Data of a run of `team`."""

    place: Array  # (m, 2) m, of the follower
    leader: Array  # (2,) m
    clearance_m: float

    @property
    def through_m(self) -> float:
        """Where it is when it first comes through the wall, m to the left; NaN: it does not."""
        beyond = np.flatnonzero(self.place[:, 0] > WALL_M)
        return float(self.place[beyond[0], 1]) if beyond.size else math.nan

    @property
    def first_deg(self) -> float:
        """Where it is once it is 0.5 m from its start, degrees to the left."""
        away = np.flatnonzero(np.hypot(*self.place.T) > 0.5)
        return math.degrees(math.atan2(*self.place[away[0], ::-1])) if away.size else math.nan


def team(doors: Sequence[tuple[float, float]], leader: tuple[float, float], slot: tuple[float, float]) -> dict[str, Any]:
    """A follower at the origin, that looks east, before a wall with doors (middle and width, m), and a leader that stands."""
    return {
        "name": "doors",
        "duration_s": 30.0,
        "physics": {"kind": "kinematic"},
        "world": {"kind": "boxes", "boxes": [wall_box(WALL_M, 0.0, *end, 0.0) for end in wall_pieces(doors, END_M)]},
        "radio": IDEAL,
        "vehicles": {"kind": "amigobot", "sensors": {"scan": {"kind": "lms", "position": (0.0, 0.0, 0.3)}}},
        "vehicle": [
            {"name": "leader", "pose": (*leader, 0.0), "agent": {"kind": "trajectory", "path": "straight", "speed": 0.0}},
            {
                "name": "follower",
                "pose": (0.0, 0.0, 0.0),
                "agent": {
                    "kind": "leader_follower",
                    "leader": "leader",
                    "slot": slot,
                    "handle": 0.4,
                    "max_speed": 0.3,
                    "avoidance": {
                        "kind": "gap",
                        "level": 1,
                        "keep_m": 0.5 * NEEDED_M,
                        "lookahead_m": LOOKAHEAD_M,
                        "top": TOP,
                        "max_speed": 0.3,
                    },
                },
            },
        ],
    }


def passed(result: Result) -> GapRun:
    """The data of a run."""
    movement = motion(result.states)
    x, y = (movement.position[axis] for axis in (0, 1))
    lead, own = movement.column("leader"), movement.column("follower")
    place, at = np.column_stack([x[:, own], y[:, own]]), np.array([x[0, lead], y[0, lead]])
    return GapRun(place, at, float(result.metrics["safety"]["min_clearance_m"]))


def fig_41(runner: Runner) -> Figure:
    """Which door a follower takes, and how wide doors look."""
    beyond = WALL_M + BEYOND_M
    cases = {
        **{f"leader behind the {name} door": (ALIKE, (beyond, ALIKE[i][0]), SLOT_M) for i, name in enumerate(SIDES)},
        **{f"leader behind narrow door {i}": (UNLIKE, (beyond, UNLIKE[2 * i - 2][0]), SLOT_M) for i in (1, 2)},
        **{
            f"leader behind the robot, {('left', 'right')[i]}": (ALIKE, each, (ROUND[0], ROUND[1] * (1 - 2 * i)))
            for i, each in enumerate(BEHIND)
        },
    }
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


def _widths(four: GaugeReading, parts: Sequence[GaugeReading]) -> list[Row]:
    true = np.array([door.width for door in four.doors])
    off = np.concatenate([_off(each) for each in parts])
    right = int(((four.width > NEEDED_M) == (true > NEEDED_M)).sum())
    return [
        absolute(f"{len(true)} doors 5 cm too narrow or wider than needed: told apart", len(true), right, 0.0),
        at_least(f"{len(off)} random doors: least width above the true one, m", -STEP_M, off.min()),
        absolute("random doors: width above the true one, mean, m", 0.009, off.mean(), 0.001),
        at_most("random doors: width above the true one, m", 0.023 * 1.05, off.max()),
    ]


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
    true = np.concatenate([[door.width for door in each.doors] for each in parts])
    off = Curve(true, 100.0 * np.concatenate([_off(each) for each in parts]), "", 1, "markers")
    return [
        _map("Three doors of 0.7 m", ALIKE, ways[:3]),
        _map("Doors of 0.35, 0.45, 0.35 and 0.7 m", UNLIKE, ways[3:5]),
        _map("The leader is behind the robot", ALIKE, ways[5:]),
        Panel("Four doors", "distance of the wall [m]", "width as it looks [m]", texts, levels={"needed": NEEDED_M}),
        Panel("Random doors", "width [m]", "looks wider by [cm]", [off], y_limits=(0.0, 3.0)),
    ]


def _map(title: str, doors: Sequence[tuple[float, float]], ways: Sequence[tuple[str, GapRun]]) -> Panel:
    """The wall, tracks, and the leaders' positions in the same colours."""
    curves = [Curve(np.array([WALL_M, WALL_M]), np.array(end), "wall") for end in wall_pieces(doors, END_M)]
    for color, (_, each) in enumerate(ways, 1):
        moves = np.hypot(*(each.place - each.place[-1]).T) > 0.01
        curves.append(Curve(each.place[moves, 0], each.place[moves, 1], "follower", color, "pose"))
        curves.append(Curve(each.leader[:1], each.leader[1:], "its leader", color, "hollow"))
    return Panel(title, "x east [m]", "y north [m]", curves, equal=True)
