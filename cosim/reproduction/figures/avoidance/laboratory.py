"""Figure 54: a team among laboratory furniture, in the unchanged scenario `lab-formation`.

Three AmigoBots with bodies in Bullet keep a wedge of 0.7 m through two turns, and a column in an aisle with two objects that is
too narrow for the wedge. A demonstration: no contact, and a wedge at the end.

At the end the handles of the followers, which the law controls, are in place. The robots themselves arrive while the leader
drives on, only 4 s after the last call: they stand 0.54 m from each other and 0.65 m from it.
"""

from collections.abc import Iterator
from functools import partial

import numpy as np

from vcmvsp.cosim.assembly import worlds
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Panel
from vcmvsp.cosim.reproduction.figures.scenarios import TeamRun, team_run
from vcmvsp.cosim.reproduction.row import Row, absolute, at_least, at_most
from vcmvsp.cosim.reproduction.runner import Job, Runner
from vcmvsp.cosim.scenario import loader

SCENARIO = "lab-formation"
NAMES = ("car1", "car2", "car3")
PAIRS = ((0, 1), (0, 2), (1, 2))
SEEDS = (1, 2, 3)
SPACING_M, BODY_M, NEAR_M = 0.7, 0.18, 0.05  # of the wedge; radius of a robot; tolerance for in place
EVERY_S, STILL_M = 6.0, 0.02  # interval between drawn teams; so near to the end of a track, its heading is undefined
SMALL_M = 0.1  # legs and chair backs: below or above something larger


def fig_54(runner: Runner) -> Figure:
    """Figure 54: tracks among the furniture, shape and errors; metrics of three seeds."""
    table = loader.table_of(loader.path_of(SCENARIO))
    runs = runner([Job(table, partial(team_run, names=NAMES), seed=seed) for seed in SEEDS])
    rows = [row for seed, tour in zip(SEEDS, runs, strict=True) for row in _rows(f"seed {seed}", tour)]
    tour = runs[0]
    errors = [Curve(tour.time_s, tour.error[:, i], name, i + 2) for i, name in enumerate(NAMES[1:])]
    sides = [
        Curve(tour.time_s, np.hypot(*(tour.place[:, a] - tour.place[:, b]).T), f"{NAMES[a]} - {NAMES[b]}", color)
        for color, (a, b) in enumerate(PAIRS, 1)
    ]
    panels = [
        _map(tour),
        Panel("Formation error", "time [s]", "|z| [m]", errors, levels={"5 cm": NEAR_M}),
        Panel("Shape", "time [s]", "distance of two robots [m]", sides, levels={"wedge": SPACING_M}),
    ]
    return Figure("Fig. 54: a team among the furniture of a laboratory", panels, rows, columns=3)


def _rows(case: str, tour: TeamRun) -> Iterator[Row]:
    safety = tour.metrics["safety"]
    yield absolute(f"{case}: contacts", 0.0, safety["collisions"], 0.0)
    yield at_least(f"{case}: least clearance of a robot's middle, m", BODY_M, safety["min_clearance_m"])
    yield at_least(f"{case}: two robots' middles apart, m", 2.0 * BODY_M, safety["min_separation_m"])
    yield absolute(f"{case}: a wedge at the end", 1.0, not tour.is_column[-1], 0.0)
    for i, name in enumerate(NAMES[1:]):
        yield at_most(f"{case}: |z| of {name} at the end, m", NEAR_M, tour.error[-1, i])


def _map(tour: TeamRun) -> Panel:
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
