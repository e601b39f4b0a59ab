"""Avoidance around other agents: `GetAround` for single commands, `Avoid` for a whole agent."""

import math
from typing import Any

from vcmvsp.agents.avoidance import Avoidance
from vcmvsp.agents.avoidance.steering import AvoidanceSteering, around, velocity_to
from vcmvsp.agents.avoidance.view import Point
from vcmvsp.agents.factory import build_nested
from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.types import Velocity, Waypoint

SAME = 1e-9  # m/s: rounding of a rotation into the body frame and back


class GetAround(Agent):
    """Leads commands of another agent around obstacles.

    Velocities pass through the avoidance: in the body frame on wheels, in the world frame in the air (x and y only, not the
    height). A way-point is left to the autopilot while nothing is near; otherwise velocities lead there.

    Notes ``mode`` and ``level`` when they change.

    Attributes:
        goal: destination of the task, x and y, m, world; None: the direction of its commands.
    """

    def __init__(self, avoidance: Avoidance, goal: Point | None = None) -> None:
        self.goal = goal
        self._steering = AvoidanceSteering(avoidance)
        self.sensors = self._steering.sensors
        self._flies = False

    def start(self, info: VehicleInfo) -> None:
        """Find the scanner."""
        self._steering.start(info)
        self._flies = info.body is not None and info.body.flies

    def around(self, obs: Observation, radio: Radio, requested: Velocity | Waypoint | None) -> Velocity | Waypoint | None:
        """The requested command, led around obstacles."""
        command = self._around(obs, requested)
        self.note(**self._steering.notes)
        return command

    def _around(self, obs: Observation, command: Velocity | Waypoint | None) -> Velocity | Waypoint | None:
        if isinstance(command, Waypoint):
            if not self._flies:
                raise ValueError("avoid: the task returned a Waypoint, but a vehicle on wheels accepts velocities only")
            return self._flown(obs, velocity_to(obs, command, self._steering.settings.max_speed), command)
        if not isinstance(command, Velocity):
            return command  # None, or a type that the host rejects
        if self._flies:
            return self._flown(obs, command, None)
        decision = self._steering.drive(obs, (command.linear[0], command.yaw_rate), self.goal)
        return Velocity(linear=(*decision.velocity, 0.0), yaw_rate=decision.yaw_rate)

    def _flown(self, obs: Observation, command: Velocity, waypoint: Waypoint | None) -> Velocity | Waypoint:
        """As `_around` for a vehicle in the air; ``command`` may replace a way-point."""
        goal = self.goal if waypoint is None or self.goal is not None else waypoint.position[:2]
        decision = around(self._steering, obs, command.linear, command.yaw_rate, goal)
        as_wanted = (
            decision.mode == "task"
            and math.dist(decision.velocity, command.linear) < SAME
            and decision.yaw_rate == command.yaw_rate
        )
        if waypoint is not None and self._steering.level == 0 and as_wanted:
            return waypoint
        return Velocity(linear=decision.velocity, yaw_rate=decision.yaw_rate)


class Avoid(Agent):
    """Runs another agent and leads its commands around obstacles (`GetAround`).

    The last command of the task stays in force and is checked again at every tick. Notes ``mode`` and ``level`` when they
    change, besides the notes of the task.

    Args:
        task: table of the agent that commands: its ``kind`` and its parameters.
        avoidance: method of avoidance of this vehicle.
        goal: destination of the task, x and y, m, world; default: the direction of its commands.
    """

    def __init__(self, task: dict[str, Any], avoidance: Avoidance, *, goal: Point | None = None) -> None:
        self.task, self._around = build_nested(task, "task"), GetAround(avoidance, goal)
        self.period = self.task.period
        task_sensors, own_sensors = self.task.sensors, self._around.sensors or ()
        self.sensors = None if task_sensors is None else tuple(dict.fromkeys((*task_sensors, *own_sensors)))
        self._last: Velocity | Waypoint | None = None

    def start(self, info: VehicleInfo) -> None:
        """Start the task and the avoidance."""
        self._around.start(info)
        self._last = None
        self.task.start(info)
        self.follows = self.task.follows

    def act(self, obs: Observation, radio: Radio) -> Velocity | Waypoint | None:
        """The command of the task, led around obstacles."""
        self._last = self.task.act(obs, radio) or self._last
        self.follows = self.task.follows
        command = self._around.around(obs, radio, self._last)
        self.note(**{**self.task.drain_notes(), **self._around.drain_notes()})
        for value in self.task.drain_shown().values():
            self.show(value)
        return command

    def close(self) -> None:
        """Close the task."""
        self.task.close()
