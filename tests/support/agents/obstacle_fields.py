"""Vehicles among boxes, without the platform: exact ranges, and the minimal motion for avoidance methods."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.support.agents.agent_loop import T, info, observe
from tests.support.agents.scans import Point, Pose, Wall, ranges_of, scan_of, sides, view
from vcmvsp.agents.avoidance.method import Decision, Method, Settings, Task
from vcmvsp.agents.avoidance.steering import AvoidanceSteering
from vcmvsp.agents.avoidance.view import View
from vcmvsp.cosim.agent import Body, Observation
from vcmvsp.cosim.frames import arc, rotate2, wrap
from vcmvsp.cosim.types import Array, Scan

Box = tuple[Point, Point]  # lower and upper corner, m

PILLAR: Box = ((-0.25, -0.25), (0.25, 0.25))
GOAL: Point = (3.0, 0.0)
ORIGIN: Pose = (0.0, 0.0, 0.0)
ROBOT, DRONE = Body(width_m=0.33, radius_m=0.216), Body(width_m=0.5, radius_m=0.25, flies=True)


def to_goal(pose: Pose) -> Task:
    """Straight to the goal; turns on the spot first if the goal is to the side."""
    aim = rotate2(GOAL[0] - pose[0], GOAL[1] - pose[1], -pose[2])
    aside = math.atan2(aim[1], aim[0])
    return Task((0.0 if abs(aside) > 0.8 else min(0.3, math.hypot(*aim)), 0.0), max(-0.8, min(1.5 * aside, 0.8)), aim)


def there(pose: Pose) -> bool:
    return math.dist(pose[:2], GOAL) < 0.15


def rooms(seed: int) -> Array:
    """Ranges to walls at random distances."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(0.3, 2.5, 12), 16)[:181] + rng.uniform(0.0, 0.05, 181)


def look(pose: Pose, boxes: Sequence[Box], *, beams: int = 32, fov: float = math.tau) -> View:
    """Noise-free scan at a pose; with a full turn beam 0 points ahead, else beams go from right to left."""
    first = 0.0 if fov == math.tau else None
    return view(ranges_of(walls_of(boxes), pose, beams, fov, first), fov, first)


def walls_of(boxes: Sequence[Box]) -> list[Wall]:
    return [side for box in boxes for side in sides(*box)]


def clearance(place: Point, boxes: Sequence[Box]) -> float:
    """Distance to the nearest box, m; 0 inside."""
    x, y = place
    return min(math.hypot(max(lo[0] - x, 0, x - hi[0]), max(lo[1] - y, 0, y - hi[1])) for lo, hi in boxes)


@dataclass(frozen=True)
class DriveResult:
    """Result of a vehicle's drive."""

    poses: list[Pose]
    decisions: list[Decision]
    clearance: float  # m, the least at any tick

    @property
    def end(self) -> Pose:
        return self.poses[-1]

    @property
    def seconds(self) -> float:
        return T * len(self.decisions)


def drive(
    method: Method,
    start: Pose,
    task: Callable[[Pose], Task],
    until: Callable[[Pose], bool],
    *,
    boxes: Sequence[Box] = (PILLAR,),
    beams: int = 32,
    fov: float = math.tau,
    seconds: float = 60.0,
) -> DriveResult:
    """A wheeled robot with exact speeds; its task is given in its own frame."""
    pose = start
    poses = [start]
    decisions: list[Decision] = []
    nearest = clearance(start[:2], boxes)
    while len(decisions) < seconds / T and not until(pose):
        now = (decisions[-1].velocity[0], decisions[-1].yaw_rate) if decisions else (0.0, 0.0)
        decision = method.decide(look(pose, boxes, beams=beams, fov=fov), task(pose)._replace(now=now))
        assert decision.velocity[1] == 0.0
        pose = arc(pose, decision.velocity[0], decision.yaw_rate, T)
        nearest = min(nearest, clearance(pose[:2], boxes))
        poses.append(pose)
        decisions.append(decision)
    return DriveResult(poses, decisions, nearest)


# Through all of avoidance

WHEELS, WINGS = Body(width_m=0.33, radius_m=0.18), Body(width_m=0.5, radius_m=0.25, flies=True)


def steering(settings: Settings, body: Body = WHEELS) -> AvoidanceSteering:
    """Avoidance of one vehicle, before its first tick."""
    made = AvoidanceSteering(settings)
    made.start(info(body=body, sensors=("scan",)))
    return made


def observation_from(pose: Pose, scan: Scan | None, tick: int, speed: float = 0.0) -> Observation:
    """Observation of a vehicle that moves along its heading."""
    return observe(pose, tick * 10**8, v=speed, scan=scan)


def sweep(
    pose: Pose, boxes: Sequence[Box], tick: int = 0, *, beams: int = 181, fov: float = math.pi, first: float | None = None
) -> Scan:
    """A scan at a position, whose first beam points to ``first``, rad; default: straight behind, or the rightmost beam."""
    return scan_of(ranges_of(walls_of(boxes), pose, beams, fov, first), fov, first, tick * 10**8)


def seen(boxes: Sequence[Box], tick: int = 0, **scanner: Any) -> Observation:
    """Observation of a vehicle at the origin, with a scan of these boxes."""
    return observation_from(ORIGIN, sweep(ORIGIN, boxes, tick, **scanner), tick)


def steer_to_goal(
    settings: Settings,
    boxes: Sequence[Box],
    goal: Point,
    *,
    start: Pose = (0.0, 0.0, 0.0),
    every: int = 1,
    speed: float = 0.3,
    seconds: float = 60.0,
    **scanner: Any,
) -> tuple[DriveResult, bool]:
    """A robot on its way to a goal, scanning at an interval of ticks; also returned: whether it arrives.

    Its task heads for the goal, and turns on the spot where that is more than 0.8 rad to the side.
    """
    made, pose, way, nearest = steering(settings), start, [start], clearance(start[:2], boxes)
    decisions: list[Decision] = []
    while len(decisions) < seconds / T and math.dist(pose[:2], goal) > 0.15:
        tick = len(decisions)
        if tick % every == 0:
            scan = sweep(pose, boxes, tick, **scanner)
        aside = wrap(math.atan2(goal[1] - pose[1], goal[0] - pose[0]) - pose[2])
        wish = (0.0 if abs(aside) > 0.8 else speed, max(-0.8, min(1.5 * aside, 0.8)))
        now = decisions[-1].velocity[0] if decisions else 0.0
        decisions.append(made.drive(observation_from(pose, scan, tick, now), wish, goal))
        pose = arc(pose, decisions[-1].velocity[0], decisions[-1].yaw_rate, T)
        way.append(pose)
        nearest = min(nearest, clearance(pose[:2], boxes))
    return DriveResult(way, decisions, nearest), math.dist(pose[:2], goal) <= 0.15


def scattered_boxes(rng: np.random.Generator) -> list[Box]:
    """Four boxes of half a metre between the origin and (6, 0)."""
    places = [(rng.uniform(1.2, 4.5), rng.uniform(-1.5, 1.5)) for _ in range(4)]
    return [((x - 0.25, y - 0.25), (x + 0.25, y + 0.25)) for x, y in places]
