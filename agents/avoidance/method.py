"""Interface of a method of avoidance: a `Task` and a `View` in, a `Decision` out.

A method has no access to scenario, radio and clock. Speed limits near obstacles (`agents.avoidance.levels`) and invalid scans
are handled outside. All values are in the body frame, x forward, y left. Ground vehicles move along x only: their velocities
have y = 0.
"""

import math
from typing import Literal, NamedTuple, Protocol

from vcmvsp.agents.avoidance.view import View

Point = tuple[float, float]

Mode = Literal["task", "avoid", "turn", "blind"]


class Task(NamedTuple):
    """What the vehicle would do if nothing stood in its way."""

    velocity: Point  # m/s
    yaw_rate: float = 0.0  # rad/s
    aim: Point | None = None  # m: where it is to get; None: nowhere in particular, it roams
    leader: Point | None = None  # m: estimated position of the leader
    max_speed: float = 0.6  # m/s: as fast as it may go on its way around something
    now: tuple[float, float] = (0.0, 0.0)  # m/s ahead, rad/s: last command, after all limits


class Decision(NamedTuple):
    """What it is to do."""

    velocity: Point  # m/s
    yaw_rate: float  # rad/s
    mode: Mode  # "task": as the task says; "avoid": another way; "turn": on the spot, for want of a way; "blind": stand


def saturated(velocity: Point, max_speed: float) -> Point:
    """The same direction, no faster than that, m/s."""
    speed = math.hypot(*velocity)
    return velocity if speed <= max_speed else (velocity[0] * max_speed / speed, velocity[1] * max_speed / speed)


class Method(Protocol):
    """A method of avoidance: one object per vehicle, called once a tick, with its own state."""

    def decide(self, view: View, task: Task) -> Decision:
        """What to do at a tick."""
