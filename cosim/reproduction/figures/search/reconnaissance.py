"""Figures 49 to 51: two quadrotors with cameras search a town for two targets, `recon-urban` with a longer duration.

The complete mission: bodies in Bullet, recognition in rendered pictures, maps over 802.11g with loss. Each seed has its own
town. Both targets are found and tracked, each by one vehicle, without a contact.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vcmvsp.cosim.assembly import worlds
from vcmvsp.cosim.metrics.motion import motion
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Panel
from vcmvsp.cosim.reproduction.figures.scenarios import places_of
from vcmvsp.cosim.reproduction.row import Row, absolute, at_least
from vcmvsp.cosim.reproduction.runner import Job, Runner
from vcmvsp.cosim.runs.api import Result
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.types import Array

SCENARIO = "recon-urban"
NAMES = ("uav1", "uav2")
SEEDS = (1, 2, 3)
DURATION_S = 300.0  # after the first target the other vehicle searches the whole town
BODY_M = 0.5  # minimum distance between vehicles and of each from solids: some are as high as the flight
SPEED, SEEN_M = 4.0, 24.0  # m/s; approximate width of the strip that a camera sees
SLOW = 3.5  # times the time to fly over the whole town once: turns, obstacles, occlusions
ON_IT_M, LAST_S = 1.0, 10.0  # maximum distance of a tracker over the last seconds


@dataclass(frozen=True)
class MissionRun:
    """Data of a run."""

    time_s: Array  # (m,)
    place: Array  # (m, 2, 2) m, of the vehicles, in the plane
    mission: Mapping[str, Any]  # its metrics
    safety: Mapping[str, Any]

    @property
    def found_s(self) -> dict[str, float]:
        """Time by target; NaN: never found."""
        found_s = self.mission["found_s"]
        return dict(zip(found_s, np.array([*found_s.values()], float).tolist(), strict=True))


def scouted(result: Result) -> MissionRun:
    """Read the data of a run."""
    movement = motion(result.states)
    return MissionRun(movement.time_ns / 1e9, places_of(movement, NAMES), result.metrics["mission"], result.metrics["safety"])


def fig_51(runner: Runner, seeds: tuple[int, ...] = SEEDS) -> Figure:
    """Figure 51: tracks through three towns, and distances of the vehicles to the targets."""
    table = loader.table_of(loader.path_of(SCENARIO))
    runs: list[MissionRun] = runner([Job(table, scouted, {"duration_s": DURATION_S}, seed) for seed in seeds])
    rows: list[Row] = []
    tracks, distances = [], []
    for seed, mission in zip(seeds, runs, strict=True):
        world, _ = worlds.world_of(SCENARIO, {"seed": seed})
        targets = {each.name: np.array([*map(each.place, mission.time_s)]) for each in world.targets}
        assert world.bounds is not None  # noqa: S101  towns have them
        west, south, east, north = world.bounds
        once_s = (east - west) * (north - south) / (len(NAMES) * SPEED * SEEN_M)
        away = {name: np.hypot(*np.moveaxis(mission.place - at[:, None], -1, 0)) for name, at in targets.items()}
        rows += rows_of(f"town {seed}", mission, once_s, away)
        tracks.append(_map(f"Town {seed}", world, mission, targets))
        distances.append(_distances(f"Town {seed}: distance to the nearer target", mission, away))
    return Figure(
        "Fig. 51: two quadrotors find and track two targets in a town", [*tracks, *distances], rows, columns=len(seeds)
    )


def rows_of(case: str, mission: MissionRun, once_s: float, away: dict[str, Array]) -> Iterator[Row]:
    """Rows with the requirements on a run."""
    last = float(np.max([*mission.found_s.values()]))  # NaN: a target was not found
    late = mission.time_s >= mission.time_s[-1] - LAST_S
    yield absolute(f"{case}: targets found", len(away), sum(np.isfinite(list(mission.found_s.values()))), 0.0)
    yield absolute(f"{case}: targets tracked", len(away), mission.mission["targets_tracked"], 0.0)
    yield absolute(f"{case}: finds of what is no target", 0.0, mission.mission["false_finds"], 0.0)
    yield absolute(f"{case}: contacts", 0.0, mission.safety["collisions"], 0.0)
    yield at_least(f"{case}: least clearance, m", BODY_M, mission.safety["min_clearance_m"])
    yield at_least(f"{case}: vehicles apart, m", 2.0 * BODY_M, mission.safety["min_separation_m"])
    yield absolute(f"{case}: last found, in times of one sweep of {once_s:.0f} s", 0.0, last / once_s, SLOW)
    for name, each in away.items():
        off_m = float(each[late].mean(axis=0).min())
        yield absolute(f"{case}: distance of the tracking vehicle from {name}, mean at the end, m", 0.0, off_m, ON_IT_M)


def _map(title: str, world: "worlds.World", mission: MissionRun, targets: dict[str, Array]) -> Panel:
    closed = [np.vstack([each, each[:1]]) for each in worlds.outlines(world)]
    around = [Curve(each[:, 0], each[:, 1], style="thin") for each in closed]
    curves = [Curve(at[-1:, 0], at[-1:, 1], "target", 2, "hollow") for at in targets.values()]
    tracks = [Curve(mission.place[:, i, 0], mission.place[:, i, 1], name, (1, 3)[i], "pose") for i, name in enumerate(NAMES)]
    return Panel(title, "x east [m]", "y north [m]", [*around, *tracks, *curves], equal=True)


def _distances(title: str, mission: MissionRun, away: dict[str, Array]) -> Panel:
    nearer = np.min(list(away.values()), axis=0)
    curves = [Curve(mission.time_s, nearer[:, i], name, (1, 3)[i]) for i, name in enumerate(NAMES)]
    up = np.array([0.0, float(nearer.max())])
    curves += [Curve(np.array([at_s, at_s]), up, "found", 2, "dotted") for at_s in mission.found_s.values()]
    return Panel(title, "time [s]", "distance [m]", curves)
