"""Figure 54: a team among the furniture of a laboratory, `lab-formation` unchanged.

Three AmigoBots, bodies in Bullet, keep a wedge of 0.7 m through two turns, and a column in an aisle with two objects that
is too narrow for the wedge. A demonstration: without a contact, and with a wedge at the end.

In place at the end are the hand points of the followers, which the law controls. The robots themselves come into place while
the leader drives on, only 4 s after the last call: they stand 0.54 m from each other and 0.65 m from it.
"""

from dataclasses import dataclass

import numpy as np

from vcmvsp.cosim.assembly import worlds
from vcmvsp.cosim.metrics.formation import formation_errors
from vcmvsp.cosim.metrics.motion import motion
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Panel
from vcmvsp.cosim.reproduction.row import Row, absolute, at_least, at_most
from vcmvsp.cosim.reproduction.runner import Job, Runner
from vcmvsp.cosim.runs.api import Result
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.types import Array

SCENARIO = "lab-formation"
NAMES = ("car1", "car2", "car3")
PAIRS = (("car1", "car2"), ("car1", "car3"), ("car2", "car3"))
SEEDS = (1, 2, 3)
SPACING_M, BODY_M, NEAR_M = 0.7, 0.18, 0.05  # of the wedge; radius of a robot; in place
EVERY_S, STILL_M = 6.0, 0.02  # how often the team is drawn; so near to where it ends, the heading of a track says nothing
SMALL_M = 0.1  # legs, and backs of chairs: below or above something larger


@dataclass(frozen=True)
class LaboratoryRun:
    """Data of a run."""

    time_s: Array  # (m,)
    place: Array  # (m, 3, 2) m, of the robots
    error: Array  # (m, 2) m, |z| of the followers
    wide: Array  # (m,) bool: the slots are those of the wedge
    contacts: int
    clearance_m: float  # of any robot's middle to anything
    apart_m: float  # of two robots' middles

    @property
    def sides_m(self) -> Array:
        """How far the two of each of `PAIRS` are apart, (m, 3) m."""
        i, j = np.array([[NAMES.index(name) for name in pair] for pair in PAIRS]).T
        return np.asarray(np.hypot(*np.moveaxis(self.place[:, i] - self.place[:, j], -1, 0)))


def toured(result: Result) -> LaboratoryRun:
    """The data of a run."""
    movement = motion(result.states)
    columns = [movement.column(name) for name in NAMES]
    errors, safety = formation_errors(movement, result.follows), result.metrics["safety"]
    wide = np.zeros(len(movement.time_ns), bool)
    for each in result.follows:
        if each.vehicle == NAMES[1]:
            wide[movement.time_ns >= each.time_ns] = each.follows.slot[1] != 0.0
    return LaboratoryRun(
        movement.time_ns / 1e9,
        np.stack([movement.position[axis][:, columns] for axis in (0, 1)], axis=-1),
        np.stack([errors[name] for name in NAMES[1:]], axis=-1),
        wide,
        int(safety["collisions"]),
        float(safety["min_clearance_m"]),
        float(safety["min_separation_m"]),
    )


def fig_54(runner: Runner) -> Figure:
    """Tracks among the furniture, the shape, and the errors; the numbers of three seeds."""
    table = loader.table_of(loader.path_of(SCENARIO))
    runs = runner([Job(table, toured, seed=seed) for seed in SEEDS])
    rows = [row for seed, tour in zip(SEEDS, runs, strict=True) for row in _rows(f"seed {seed}", tour)]
    tour = runs[0]
    errors = [Curve(tour.time_s, tour.error[:, i], name, i + 2) for i, name in enumerate(NAMES[1:])]
    sides = [Curve(tour.time_s, tour.sides_m[:, i], f"{a} - {b}", i + 1) for i, (a, b) in enumerate(PAIRS)]
    panels = [
        _map(tour),
        Panel("Formation error", "time [s]", "|z| [m]", errors, levels={"5 cm": NEAR_M}),
        Panel("Shape", "time [s]", "distance of two robots [m]", sides, levels={"wedge": SPACING_M}),
    ]
    return Figure("Fig. 54: a team among the furniture of a laboratory", panels, rows, columns=3)


def _rows(case: str, tour: LaboratoryRun) -> list[Row]:
    rows = [
        absolute(f"{case}: contacts", 0.0, tour.contacts, 0.0),
        at_least(f"{case}: least clearance of a robot's middle, m", BODY_M, tour.clearance_m),
        at_least(f"{case}: two robots' middles apart, m", 2.0 * BODY_M, tour.apart_m),
        absolute(f"{case}: a wedge at the end", 1.0, tour.wide[-1], 0.0),
    ]
    for i, name in enumerate(NAMES[1:]):
        rows.append(at_most(f"{case}: |z| of {name} at the end, m", NEAR_M, tour.error[-1, i]))
    return rows


def _map(tour: LaboratoryRun) -> Panel:
    """The room, tracks, and the team every few seconds."""
    world, _ = worlds.world_of(SCENARIO, {})
    solids = [each for each in worlds.outlines(world) if np.ptp(each, axis=0).min() >= SMALL_M]
    closed = [np.vstack([each, each[:1]]) for each in solids]
    around = [Curve(each[:, 0], each[:, 1], style="thin") for each in closed]
    step = round(EVERY_S / float(tour.time_s[1] - tour.time_s[0]))
    teams = [Curve(each[:, 0], each[:, 1], style="thin") for each in tour.place[::step, [0, 1, 2, 0]]]
    tracks = []
    for color, track in enumerate(np.moveaxis(tour.place, 1, 0), 1):
        moves = np.hypot(*(track - track[-1]).T) > STILL_M
        tracks.append(Curve(track[moves, 0], track[moves, 1], "", color, "pose"))
    title = "car1 blue, car2 red, car3 green; the team every 6 s"
    return Panel(title, "x east [m]", "y north [m]", [*around, *teams, *tracks], equal=True)
